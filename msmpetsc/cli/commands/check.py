"""``msmpetsc check``: compare the numbers of scenes with numbers that ``--update`` has stored.

``results.baseline`` has the numbers and their tolerance.
"""

import argparse
import json
import math
import tempfile
from collections.abc import Mapping
from contextlib import nullcontext, redirect_stdout
from pathlib import Path
from shlex import quote
from time import perf_counter

import numpy as np

from msmpetsc.errors import InputError
from msmpetsc.results.baseline import (
    ERROR,
    MOST_STEPS,
    Numbers,
    Recipe,
    allowed,
    differences,
    judged,
    read,
    summary,
    write,
)
from msmpetsc.scene.reading import load_scene
from msmpetsc.study.cases import launcher
from msmpetsc.study.process import PROGRAM, Processes

# default number of steps [-]; so that a check takes little time
STEPS = 20
HEAD = (
    f"{'scene':20} {'cells':>6} {'nodes':>6} {'springs':>8} "
    f"{'off by':>9} {'allowed':>9} {'time':>7}"
)


def run(args: argparse.Namespace) -> int:
    """Run each scene, and compare or store its numbers; return the exit status."""
    recipe = None
    if args.frames or args.cells or args.set:
        steps = min(args.frames or STEPS, MOST_STEPS)
        recipe = Recipe(cells=args.cells, steps=steps, changes=args.set)
    files = {scene: scene.with_suffix(".baseline.json") for scene in args.scenes}
    if not args.update:
        if recipe:
            raise InputError(
                "--cells, --frames and --set are for --update: a check uses the stored options"
            )
        return int(any(check(files, args.ranks, args.json).values()))
    if args.json:
        raise InputError("--json is for checks: --update compares nothing")
    for scene, file in files.items():
        update(scene, file, recipe, args.ranks)
    return 0


def update(scene: Path, file: Path, given: Recipe | None, ranks: int) -> None:
    """Run a scene and store its numbers.

    given : options of the run; None for the options stored before, or else the defaults
    """
    recipe = given or Recipe(cells=None, steps=STEPS)
    if file.is_file() and not given:
        recipe = read(file).run
    time = load_scene(scene, recipe.changes, by_user=False).time
    if time.error is not None:
        raise InputError(
            f"{scene}: time.error chooses steps by an estimate, so that no tolerance is known: "
            "--set time={step=..., duration=...} gives equal steps"
        )
    recipe = recipe.model_copy(update={"steps": min(recipe.steps, time.steps)})
    numbers = numbers_of(scene, recipe, ranks)
    write(file, numbers)
    count = len(numbers.counts) + len(numbers.numbers)
    accuracy = allowed(recipe.steps, "m")
    print(f"{file}: {count} numbers after {recipe.steps} steps, positions to {accuracy:.1g}")


def numbers_of(scene: Path, recipe: Recipe, ranks: int) -> Numbers:
    """Run a scene by a recipe and return its numbers. Raises InputError if the run fails."""
    cells = [] if recipe.cells is None else [f"cages.count={recipe.cells}"]
    words = [
        word
        for change in (*cells, "output.surface=false", *recipe.changes)
        for word in ("--set", change)
    ]
    with tempfile.TemporaryDirectory(prefix="msmpetsc-numbers-") as folder:
        path = Path(folder) / "run.h5"
        steps = ["--frames", str(recipe.steps), "--error", str(ERROR)]
        command = [*launcher(ranks), *PROGRAM, "run", str(scene), "-o", str(path), *steps, *words]
        ended = Processes().run(command, path.with_suffix(".log"), math.inf)
        if ended.reason:
            raise InputError(f"{scene}: the run failed: {ended.reason}")
        return summary(path, recipe)


def check(files: Mapping[Path, Path], ranks: int, as_json: bool) -> dict[str, list[str]]:
    """Compare scenes with their stored numbers; print and return the differences by scene."""
    for scene, file in files.items():
        if not file.is_file():
            # a scene that is not there has nothing to store
            load_scene(scene, by_user=False)
            raise InputError(
                f"nothing is stored of {scene}: "
                f"msmpetsc check --update {quote(str(scene))} stores {file}"
            )
    stored = {scene: read(file) for scene, file in files.items()}
    # stored changes may only name files in or below the scene's folder
    for scene, numbers in stored.items():
        load_scene(scene, numbers.run.changes, by_user=False)
    with redirect_stdout(None) if as_json else nullcontext():
        print(HEAD, flush=True)
        by_scene = {str(scene): checked(scene, numbers, ranks) for scene, numbers in stored.items()}
        for scene_name, lines in by_scene.items():
            for line in lines:
                print(f"{scene_name}: {line}")
    if as_json:
        print(json.dumps({"same": not any(by_scene.values()), "differences": by_scene}, indent=1))
    return by_scene


def checked(scene: Path, stored: Numbers, ranks: int) -> list[str]:
    """Run a scene by its stored recipe, print a summary, and return a line for each difference."""
    began = perf_counter()
    # a run that fails must not keep the other scenes from their check
    try:
        numbers = numbers_of(scene, stored.run, ranks)
    except InputError as error:
        print(f"{scene.stem:20} FAILED", flush=True)
        return [str(error).removeprefix(f"{scene}: ")]
    lines = judged(numbers, stored)
    verdict = "DIFFERS" if lines else "same"
    _, difference, tolerance = max(
        differences(numbers, stored), key=lambda row: row[1] / row[2] if row[2] else np.inf
    )
    sizes = "{cells:6} {nodes:6} {springs:8}".format_map(numbers.counts)
    seconds = perf_counter() - began
    print(
        f"{scene.stem:20} {sizes} {difference:9.1e} {tolerance:9.1e} {seconds:5.1f} s {verdict}",
        flush=True,
    )
    return lines
