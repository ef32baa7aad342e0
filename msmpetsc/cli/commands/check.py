"""``msmpetsc check``: are the numbers of a scene still those that were stored; ``--update`` stores them."""

import argparse
import json
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from xml.etree import ElementTree

from msmpetsc.app.checks import MEASURE_NAMES, XML_NAMES, refuse_below_one, refuse_other_format
from msmpetsc.cli.ranks import RUNS_ITSELF, refuse_ranks
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
    refuse_ranks("check", RUNS_ITSELF)
    refuse_below_one(ranks=args.ranks, frames=args.frames, cells=args.cells)
    refuse_other_format("--junit", args.junit, XML_NAMES)
    refuse_other_format("--baseline", args.baseline, MEASURE_NAMES)
    if args.baseline and len(args.scenes) > 1:
        raise InputError("--baseline names the numbers of one scene: of several, each has its own beside it")
    files = {scene: args.baseline or scene.with_suffix(".baseline.json") for scene in args.scenes}
    if args.update:
        if args.junit or args.json:
            raise InputError("--update checks nothing: --junit and --json have no place beside it")
        for scene, file in files.items():
            update(scene, file, args)
        return SAME
    if args.frames or args.cells or args.set:
        raise InputError("--cells, --frames and --set are for --update: the numbers stored say how they were made")
    return check(files, args)


# Storing


def update(scene: Path, file: Path, args: argparse.Namespace) -> None:
    """Run a scene and store its numbers, as those stored before were made if nothing else is asked for."""
    cells, steps, changes = args.cells, args.frames or STEPS, args.set
    if file.is_file() and not (args.frames or args.cells or args.set):
        before = baseline.read(file).run
        cells, steps, changes = before.cells, before.steps, before.changes
    time = load_scene(scene, changes, by_user=False).time
    if time.error is not None:
        raise InputError(
            f"{scene}: time.error chooses steps by an estimate: how far numbers may be apart then is not known; "
            "--set time={step=..., duration=...} takes steps of one length"
        )
    recipe = Recipe(cells=cells, steps=min(steps, time.steps, baseline.MOST_STEPS), changes=changes)
    numbers = found(scene, recipe, args.ranks)
    baseline.write(file, numbers)
    count = len(numbers.counts) + len(numbers.numbers)
    accuracy = baseline.allowed(recipe.steps, "m")
    print(f"{file}: {count} numbers after {recipe.steps} steps, positions to {accuracy:.1g}")


def found(scene: Path, recipe: Recipe, ranks: int) -> Numbers:
    """Run a scene by a recipe; return its numbers. Raises InputError where the run fails."""
    load_scene(scene, recipe.changes, by_user=False)  # they come with the scene, and name what lies beside it
    with tempfile.TemporaryDirectory(prefix="msmpetsc-numbers-") as folder:
        path = Path(folder) / "run.h5"
        try:
            baseline.simulate(scene, recipe, path, ranks)
        except RuntimeError as error:
            raise InputError(f"{scene}: the run failed: {error}") from None
        except OSError as error:  # of a full disk, of an mpiexec that is not there
            raise InputError(f"{error.filename}: {error.strerror}") from None
        return baseline.summary(path, recipe)


# Comparing


def check(files: Mapping[Path, Path], args: argparse.Namespace) -> int:
    """Hold the scenes against the files of their numbers; return the exit status."""
    for scene, file in files.items():
        if not file.is_file():
            raise InputError(f"nothing is stored of {scene}: msmpetsc check --update {scene} stores {file}")
    stored = {scene: baseline.read(file) for scene, file in files.items()}
    if not args.json:
        print(HEAD, flush=True)
    outcomes = [checked(scene, numbers, args) for scene, numbers in stored.items()]
    wrong = [f"{outcome.scene}: {line}" for outcome in outcomes for line in outcome.wrong]
    if args.json:
        lines = {str(outcome.scene): outcome.wrong for outcome in outcomes}
        print(json.dumps({"same": not wrong, "differences": lines}, indent=1))
    else:
        print("".join(f"{line}\n" for line in wrong), end="")
    if args.junit:
        write_junit(args.junit, outcomes)
    return DIFFERENT if wrong else SAME


def checked(scene: Path, stored: Numbers, args: argparse.Namespace) -> Checked:
    """Run a scene as its stored numbers were made, and print its line."""
    began = perf_counter()
    numbers = found(scene, stored.run, args.ranks)
    outcome = Checked(scene, judged(numbers, stored), perf_counter() - began)
    if not args.json:
        verdict = "DIFFERS" if outcome.wrong else "same"
        print(row(scene.stem, numbers, stored, outcome.seconds, verdict), flush=True)
    return outcome


def write_junit(path: Path, outcomes: list[Checked]) -> None:
    """Write a suite for each scene, a case for each number, as continuous integration reads. Raises InputError."""
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
