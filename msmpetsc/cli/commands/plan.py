"""``msmpetsc plan``: the cheapest way to simulate a scene to an error."""

import argparse
import json
import shlex
import signal
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext, redirect_stdout
from dataclasses import asdict
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from msmpetsc.cli.arguments import (
    PICTURE_NAMES,
    RUNS_ITSELF,
    interrupt,
    refuse_below_one,
    refuse_other_format,
    refuse_ranks,
)
from msmpetsc.comm import log
from msmpetsc.errors import InputError
from msmpetsc.scene.statics import STATIC

if TYPE_CHECKING:
    from msmpetsc.study.plan import Candidate
    from msmpetsc.study.runner import Bench
    from msmpetsc.study.scene_lines import Tables
    from msmpetsc.study.sizing.answer import SizePlan, SizeTrial

NOTHING_MEETS = 3
HEAD = f"{'method':34} {'time step [s]':>13} {'step error':>10} {'cost [s/s]':>10} {'error':>9}"
SIZE_HEAD = f"{'integrator':16} {'time step [s]':>13} {'step error':>10} {'cells':>8} {'cost [s/s]':>10}"


def run(args: argparse.Namespace) -> int:
    """Plan a scene; return the exit status."""
    refuse_ranks("plan", RUNS_ITSELF)
    target = next(each for each in (args.error, args.step_error, args.surface_error) if each is not None)
    if not 0 < target < 1:
        raise InputError(f"the error must lie between 0 and 1, not {target:g}")
    refuse_below_one(frames=args.frames, ranks=args.ranks, cells=args.cells)
    refuse_other_format("--chart", args.chart, PICTURE_NAMES)
    if args.surface_error is None and (args.cells or args.chart):
        raise InputError("--cells and --chart are for --surface-error only")
    try:
        with redirect_stdout(sys.stderr) if args.json else nullcontext():  # what was tried, as it goes
            met, record = (run_methods if args.surface_error is None else run_sizes)(args, target)
    except OSError as error:  # of a full disk, of an mpiexec that is not there
        raise InputError(f"{error.filename}: {error.strerror}") from None
    if args.json:
        print(json.dumps({"met": met, "target": target, **record}, indent=1))
    return 0 if met else NOTHING_MEETS


@contextmanager
def bench() -> Iterator["Bench"]:
    """Give a bench in a folder of its own; afterwards none of its runs is left."""
    from msmpetsc.study.process import Processes
    from msmpetsc.study.runner import Bench

    signal.signal(signal.SIGTERM, interrupt)
    processes = Processes()
    with tempfile.TemporaryDirectory(prefix="msmpetsc-plan-") as folder:
        try:
            yield Bench(Path(folder), processes, warm=True)  # costs are held against each other alone
        finally:
            processes.stop()


def print_command(args: argparse.Namespace, method: "Candidate", more: "Tables" = MappingProxyType({})) -> str:
    """Print lines to paste and a command that says the same, or change the file; return the command."""
    from msmpetsc.study.cases import launcher
    from msmpetsc.study.scene_lines import lines, overrides, put_into

    print(f"\n{lines(method, more)}\n")
    changes = [word for change in overrides(args.scene, method, more) for word in ("--set", change)]
    options = shlex.split(method.options)
    command = shlex.join([*launcher(args.ranks), "msmpetsc", "run", str(args.scene), *changes, *options])
    print(command, flush=True)
    if args.write:
        put_into(args.scene, method, more)
        print(f"\nwritten into {args.scene}")
    return command


# For an error of the trajectory or of a step


def run_methods(args: argparse.Namespace, target: float) -> tuple[bool, dict[str, Any]]:
    """Try methods on the scene's own lattice; return whether any meets the error, and all as a record."""
    from msmpetsc.study.plan import cheapest

    trials = try_all(args, target)
    best = cheapest(trials, target)
    if best is None:
        print_nearest(trials, target)
        return False, {"trials": list(map(asdict, trials))}
    print(f"\ncheapest: {best.cost:.3g} computing seconds a simulated second, error {best.error:.1e}")
    print("each was tried once: how much its time varies is not known")
    command = print_command(args, best.method)
    return True, {"choice": asdict(best), "command": command, "trials": list(map(asdict, trials))}


def try_all(args: argparse.Namespace, target: float) -> list:
    """Make the trials, and print each when it is done."""
    from msmpetsc.solve.presets import preset_names
    from msmpetsc.study.plan import Planner

    with bench() as runs:
        planner = Planner(
            args.scene, runs, presets=preset_names(), frames=args.frames, ranks=args.ranks, report=print_trial
        )
        print(HEAD, flush=True)
        trials = planner.for_step(target) if args.error is None else planner.for_trajectory(target)
        if not planner.deforms():
            log.warning("nothing deforms in the first %d frames: more --frames will tell more", args.frames)
        return trials


def print_trial(trial) -> None:
    """Print one line of the table of what was tried."""
    method = trial.method
    name = f"{method.preset or method.integrator} {method.options}".strip()
    goal = "" if method.step_error is None else f"{method.step_error:.1e}"
    cost = "" if trial.cost is None else f"{trial.cost:.3g}"
    error = "" if trial.error is None else f"{trial.error:.1e}"
    line = f"{name:34} {method.time_step:13.4g} {goal:>10} {cost:>10} {error:>9}  {trial.reason}"
    print(line.rstrip(), flush=True)


def print_nearest(trials: Sequence, target: float) -> None:
    """Print the trial that came nearest to the error."""
    from msmpetsc.study.plan import nearest_miss

    best = nearest_miss(trials)
    print(f"\nnothing tried meets {target:g}; the smallest error reached:" if best else "\nnothing tried gave an error")
    if best:
        print_trial(best)


# For an error of the surface


def run_sizes(args: argparse.Namespace, target: float) -> tuple[bool, dict[str, Any]]:
    """Try lattices and steps; return whether the choice meets the error, and all as a record."""
    plan = size_all(args, target)
    if args.chart:
        draw(plan, args.chart, target)
    print_size(plan, target)
    choice, budget = plan.choice, plan.choice.budget
    more: Tables = {
        "cages": {"count": choice.cells, "cell_size": None},
        "budget": {
            "target": target, **{name: float(f"{value:.2g}") for name, value in vars(budget).items()},
            "count": choice.cells, "time_step": choice.method.time_step,
        },
    }  # fmt: skip
    command = print_command(args, choice.method, more) if plan.met else None
    record = {"choice": asdict(choice), "error": budget.total, "bounds": plan.bounds, "command": command}
    return plan.met, json.loads(json.dumps(record, default=str))  # of paths the names


def size_all(args: argparse.Namespace, target: float) -> "SizePlan":
    """Make the trials, and print each when it is done."""
    from msmpetsc.solve.presets import preset_names
    from msmpetsc.study.sizing.trials import Sizer

    with bench() as runs:
        sizer = Sizer(
            args.scene, runs, target=target, presets=preset_names(), frames=args.frames, cells=args.cells,
            ranks=args.ranks, report=print_size_trial,
        )  # fmt: skip
        print(SIZE_HEAD, flush=True)
        return sizer.plan()


def print_size_trial(trial: "SizeTrial | str") -> None:
    """Print one line of what was tried, or a note."""
    if isinstance(trial, str):
        print(trial, flush=True)
        return
    method = trial.method
    goal = "" if method.step_error is None else f"{method.step_error:.1e}"
    print(
        f"{method.integrator:16} {method.time_step:13.4g} {goal:>10} {trial.cells:8.0f} {trial.cost:10.3g}", flush=True
    )


def print_size(plan: "SizePlan", target: float) -> None:
    """Print the choice with its error, the parts of that, and what bounds it."""
    choice, budget, shares = plan.choice, plan.choice.budget, plan.choice.shares
    print("\ncheapest:" if plan.met else f"\nnothing meets {target:g}; the smallest error within reach:")
    cost = f"{choice.cost:.3g} computing seconds a simulated second"
    if choice.method.integrator == STATIC:
        cost = f"{choice.cost * choice.method.time_step:.3g} computing seconds a state"
    print(f"{cost}, surface error {budget.total:.1e}")
    print(f"{'part':16} {'error':>9} {'of the cost':>11}")
    for name in vars(budget):
        print(f"{name:16} {getattr(budget, name):9.1e} {100 * getattr(shares, name):10.0f}%")
    for bound in plan.bounds:
        print(f"what bounds it: {bound}")


def draw(plan: "SizePlan", path: Path, target: float) -> None:
    """Draw the expected error of each trial over its cost, and ring the choice."""
    from msmpetsc.study.charts.sizes import plan_picture

    plan_picture(plan, target, path)
    print(f"drawn: {path}")
