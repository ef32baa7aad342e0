"""``msmpetsc plan``: find the cheapest options that meet an error of a scene's surface."""

import argparse
import json
import shlex
import sys
import tempfile
from contextlib import closing, nullcontext, redirect_stdout
from dataclasses import asdict
from pathlib import Path

from mpi4py import MPI

from msmpetsc.build import read_bodies
from msmpetsc.errors import InputError
from msmpetsc.geometry.cell_size import advised_size, estimated_cells
from msmpetsc.scene.reading import load_scene
from msmpetsc.study.cases import launcher
from msmpetsc.study.process import Processes
from msmpetsc.study.runner import Bench
from msmpetsc.study.sizing.choice import (
    Choice,
    SizePlan,
    SizeTrial,
    Tables,
    overrides,
    put_into,
    tables,
)
from msmpetsc.study.sizing.trials import Sizer

NOTHING_MEETS = 3
HEAD = f"{'integrator':16} {'time error':>10} {'step error':>10} {'cells':>8} {'cost [s/s]':>10}"


def run(args: argparse.Namespace) -> int:
    """Plan a scene; return the exit status."""
    target = args.surface_error
    if not 0 < target < 1:
        raise InputError(f"the error must lie between 0 and 1, not {target:g}")
    # with --json the table of trials goes to stderr
    with redirect_stdout(sys.stderr) if args.json else nullcontext():
        plan = size_all(args, target)
        print_size(plan, target)
        command = print_command(args, plan.choice) if plan.met else None
    if args.json:
        record = asdict(plan) | {
            "target": target,
            "error": plan.choice.budget.total,
            "command": command,
        }
        # default=str writes paths as text
        print(json.dumps(record, indent=1, default=str))
    return 0 if plan.met else NOTHING_MEETS


def print_command(args: argparse.Namespace, choice: Choice) -> str:
    """Print and return the command that runs the choice; with --write, also write the scene."""
    answer: Tables = {**tables(choice.method), "cages": {"count": choice.cells, "cell_size": None}}
    changes = [word for change in overrides(args.scene, answer) for word in ("--set", change)]
    command = shlex.join([*launcher(args.ranks), "msmpetsc", "run", str(args.scene), *changes])
    print(f"\n{command}", flush=True)
    if args.write:
        put_into(args.scene, answer)
        print(f"\nwritten into {args.scene}")
    return command


def size_all(args: argparse.Namespace, target: float) -> SizePlan:
    """Run the trials in a temporary folder, print each trial, and return the plan."""
    scene = load_scene(args.scene)
    bodies = read_bodies(MPI.COMM_SELF, scene)
    advised = estimated_cells(bodies, advised_size(bodies, scene.material.law))
    with (
        tempfile.TemporaryDirectory(prefix="msmpetsc-plan-") as folder,
        closing(Processes()) as processes,
    ):
        runs = Bench(Path(folder), processes)
        sizer = Sizer(
            args.scene, runs, print_size_trial, target=target, frames=args.frames,
            cells=args.cells, ranks=args.ranks, advised=advised,
        )  # fmt: skip
        print(HEAD, flush=True)
        return sizer.plan()


def print_size_trial(trial: SizeTrial | str) -> None:
    """Print a line for a trial, or a note."""
    if isinstance(trial, str):
        print(trial, flush=True)
        return
    method = trial.method
    goals = [f"{goal:.1e}" if goal else "" for goal in (method.time_error, method.step_error)]
    words = f"{method.integrator:16} {goals[0]:>10} {goals[1]:>10}"
    print(f"{words} {trial.cells:8.0f} {trial.cost:10.3g}", flush=True)


def print_size(plan: SizePlan, target: float) -> None:
    """Print the choice with the parts of its error and its limitations."""
    choice = plan.choice
    print(
        "\ncheapest:"
        if plan.met
        else f"\nnothing meets {target:g}; the smallest error within reach:"
    )
    cost = f"{choice.cost:.3g} computing seconds a simulated second"
    print(f"{cost}, surface error {choice.budget.total:.1e}")
    print(f"{'part':16} {'error':>9}")
    for name, error in vars(choice.budget).items():
        print(f"{name:16} {error:9.1e}")
    for bound in plan.bounds:
        print(f"limited by: {bound}")
