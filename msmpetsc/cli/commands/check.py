"""``msmpetsc check``: are the numbers of a scene still those that ``baseline`` stored."""

import argparse
import json
from pathlib import Path
from time import perf_counter

from msmpetsc.cli.arguments import RUNS_ITSELF, XML_NAMES, refuse_below_one, refuse_other_format, refuse_ranks
from msmpetsc.cli.commands.baseline import found, stored_beside
from msmpetsc.errors import InputError
from msmpetsc.study.baselines.baseline import HEAD, Numbers, Recipe, judged, nearest_to_limit, read, row
from msmpetsc.study.baselines.junit import Checked, write_junit

SAME, DIFFERENT = 0, 1


def run(args: argparse.Namespace) -> int:
    """Run each scene and compare; return the exit status."""
    refuse_ranks("check", RUNS_ITSELF)
    refuse_below_one(ranks=args.ranks)
    refuse_other_format("--junit", args.junit, XML_NAMES)
    if args.baseline and len(args.scenes) > 1:
        raise InputError("--baseline names the numbers of one scene: of several, each has its own beside it")
    files = {scene: args.baseline or stored_beside(scene) for scene in args.scenes}
    for scene, file in files.items():
        if not file.is_file():
            raise InputError(f"nothing is stored of {scene}: msmpetsc baseline {scene} stores {file}")
    stored = {scene: read(file) for scene, file in files.items()}
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
    numbers = found(scene, Recipe.of(stored), args.ranks)
    outcome = Checked(scene, judged(numbers, stored), perf_counter() - began)
    if not args.json:
        verdict = "DIFFERS" if outcome.wrong else "same"
        limit = nearest_to_limit(numbers, stored)
        print(row(scene.stem, numbers["counts"], limit, outcome.seconds, verdict), flush=True)
    return outcome
