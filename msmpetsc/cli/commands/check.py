"""``msmpetsc check``: are the numbers of a scene still those that were stored; ``--update`` stores them."""

import argparse
import json
import tempfile
from collections.abc import Mapping
from contextlib import nullcontext, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from xml.etree import ElementTree

from msmpetsc.app.checks import MEASURE_NAMES, XML_NAMES, refuse_other_format
from msmpetsc.errors import InputError
from msmpetsc.results.disk import write_whole
from msmpetsc.scene.reading import load_scene
from msmpetsc.study import baseline
from msmpetsc.study.baseline import HEAD, Numbers, Recipe, judged, row

SAME, DIFFERENT = 0, 1
STEPS = 20  # of a scene's numbers, if nothing else is asked for


@dataclass(frozen=True)
class Checked:
    """A scene that was run and held against its numbers.

    lines   : for each count and number what is wrong with it, nothing for what is as stored
    seconds : that the run took
    """

    scene: Path
    lines: Mapping[str, str]
    seconds: float

    @property
    def wrong(self) -> list[str]:
        """What is not as stored, a line each."""
        return [line for line in self.lines.values() if line]


def run(args: argparse.Namespace) -> int:
    """Run each scene, and compare or store its numbers; return the exit status."""
    refuse_other_format("--junit", args.junit, XML_NAMES)
    refuse_other_format("--baseline", args.baseline, MEASURE_NAMES)
    if args.baseline and len(args.scenes) > 1:
        raise InputError("--baseline names the numbers of one scene: of several, each has its own beside it")
    asked = None
    if args.frames or args.cells or args.set:
        steps = min(args.frames or STEPS, baseline.MOST_STEPS)
        asked = Recipe(cells=args.cells, steps=steps, changes=args.set)
    files = {scene: args.baseline or scene.with_suffix(".baseline.json") for scene in args.scenes}
    if not args.update:
        if asked:
            raise InputError("--cells, --frames and --set are for --update: the numbers stored say how they were made")
        outcomes = check(files, args.ranks, args.json)
        if args.junit:
            write_junit(args.junit, outcomes)
        return DIFFERENT if any(outcome.wrong for outcome in outcomes) else SAME
    if args.junit or args.json:
        raise InputError("--update checks nothing: --junit and --json have no place beside it")
    for scene, file in files.items():
        update(scene, file, asked, args.ranks)
    return SAME


def update(scene: Path, file: Path, asked: Recipe | None, ranks: int) -> None:
    """Run a scene and store its numbers, as those stored before were made if nothing else is asked for."""
    recipe = asked or Recipe(cells=None, steps=STEPS)
    if file.is_file() and not asked:
        recipe = baseline.read(file).run
    time = load_scene(scene, recipe.changes, by_user=False).time
    if time.error is not None:
        raise InputError(
            f"{scene}: time.error chooses steps by an estimate: how far numbers may be apart then is not known; "
            "--set time={step=..., duration=...} takes steps of one length"
        )
    recipe = recipe.model_copy(update={"steps": min(recipe.steps, time.steps)})
    numbers = found(scene, recipe, ranks)
    baseline.write(file, numbers)
    count = len(numbers.counts) + len(numbers.numbers)
    accuracy = baseline.allowed(recipe.steps, "m")
    print(f"{file}: {count} numbers after {recipe.steps} steps, positions to {accuracy:.1g}")


def found(scene: Path, recipe: Recipe, ranks: int) -> Numbers:
    """Run a scene by a recipe; return its numbers. Raises InputError where the run fails."""
    load_scene(scene, recipe.changes, by_user=False)  # they come with the scene, and name what lies beside it
    with tempfile.TemporaryDirectory(prefix="msmpetsc-numbers-") as folder:
        path = Path(folder) / "run.h5"
        baseline.simulate(scene, recipe, path, ranks)
        return baseline.summary(path, recipe)


def check(files: Mapping[Path, Path], ranks: int, as_json: bool) -> list[Checked]:
    """Hold the scenes against the files of their numbers, and print what is not as stored."""
    for scene, file in files.items():
        if not file.is_file():
            raise InputError(f"nothing is stored of {scene}: msmpetsc check --update {scene} stores {file}")
    stored = {scene: baseline.read(file) for scene, file in files.items()}
    with redirect_stdout(None) if as_json else nullcontext():
        print(HEAD, flush=True)
        outcomes = [checked(scene, numbers, ranks) for scene, numbers in stored.items()]
        print("".join(f"{outcome.scene}: {line}\n" for outcome in outcomes for line in outcome.wrong), end="")
    if as_json:
        lines = {str(outcome.scene): outcome.wrong for outcome in outcomes}
        print(json.dumps({"same": not any(lines.values()), "differences": lines}, indent=1))
    return outcomes


def checked(scene: Path, stored: Numbers, ranks: int) -> Checked:
    """Run a scene as its stored numbers were made, and print its line."""
    began = perf_counter()
    numbers = found(scene, stored.run, ranks)
    outcome = Checked(scene, judged(numbers, stored), perf_counter() - began)
    verdict = "DIFFERS" if outcome.wrong else "same"
    print(row(scene.stem, numbers, stored, outcome.seconds, verdict), flush=True)
    return outcome


def write_junit(path: Path, outcomes: list[Checked]) -> None:
    """Write a suite for each scene, a case for each number. Raises InputError."""
    root = ElementTree.Element("testsuites", name="msmpetsc check")
    for outcome in outcomes:
        counts = {"tests": str(len(outcome.lines)), "failures": str(len(outcome.wrong))}
        suite = ElementTree.SubElement(root, "testsuite", {"name": str(outcome.scene), "errors": "0"} | counts)
        suite.set("time", f"{outcome.seconds:.3f}")
        for name, line in outcome.lines.items():
            case = ElementTree.SubElement(suite, "testcase", classname=outcome.scene.stem, name=name)
            if line:
                ElementTree.SubElement(case, "failure", message=line).text = line
    write_whole(path, ElementTree.tostring(root, encoding="utf-8", xml_declaration=True))
