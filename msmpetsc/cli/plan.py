"""``msmpetsc plan``: the cheapest way to simulate a scene to an error."""

import argparse
import shlex
import signal
import tempfile
from collections.abc import Sequence
from pathlib import Path

from msmpetsc.cli.arguments import RUNS_ITSELF, interrupt, refuse_below_one, refuse_ranks
from msmpetsc.comm import log
from msmpetsc.errors import InputError

NOTHING_MEETS = 3
HEAD = f"{'method':34} {'time step [s]':>13} {'step error':>10} {'cost [s/s]':>10} {'error':>9}"


def run(args: argparse.Namespace) -> int:
    """Plan a scene; return the exit status."""
    refuse_ranks("plan", RUNS_ITSELF)
    target = args.error if args.step_error is None else args.step_error
    if not 0 < target < 1:
        raise InputError(f"the error must lie between 0 and 1, not {target:g}")
    refuse_below_one(frames=args.frames, ranks=args.ranks)
    from msmpetsc.study.plan import cheapest

    try:
        trials = try_all(args, target)
    except OSError as error:  # of a full disk, of an mpiexec that is not there
        raise InputError(f"{error.filename}: {error.strerror}") from None
    best = cheapest(trials, target)
    if best is None:
        print_nearest(trials, target)
        return NOTHING_MEETS
    print_answer(args, best)
    return 0


def try_all(args: argparse.Namespace, target: float) -> list:
    """Make the trials, and print each when it is done."""
    from msmpetsc.solve.presets import PRESETS
    from msmpetsc.study.measure import Bench
    from msmpetsc.study.plan import Planner
    from msmpetsc.study.process import Processes

    signal.signal(signal.SIGTERM, interrupt)
    processes = Processes()
    with tempfile.TemporaryDirectory(prefix="msmpetsc-plan-") as folder:
        planner = Planner(args.scene, Bench(Path(folder), processes), PRESETS, args.frames, args.ranks, print_trial)
        print(HEAD, flush=True)
        try:
            trials = planner.for_step(target) if args.error is None else planner.for_trajectory(target)
            if not planner.deforms():
                log.warning("nothing deforms in the first %d frames: more --frames will tell more", args.frames)
            return trials
        finally:
            processes.stop()


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


def print_answer(args: argparse.Namespace, best) -> None:
    """Print lines to paste and a command that says the same, or change the file."""
    from msmpetsc.study.case import launcher
    from msmpetsc.study.scene_lines import lines, overrides, put_into

    print(f"\ncheapest: {best.cost:.3g} computing seconds a simulated second, error {best.error:.1e}")
    print("each was tried once: how much its time varies is not known")
    print(f"\n{lines(best.method)}\n")
    changes = [word for change in overrides(args.scene, best.method) for word in ("--set", change)]
    options = shlex.split(best.method.options)
    print(shlex.join([*launcher(args.ranks), "msmpetsc", "run", str(args.scene), *changes, *options]), flush=True)
    if args.write:
        try:
            put_into(args.scene, best.method)
        except OSError as error:
            raise InputError(f"{args.scene}: cannot be written: {error.strerror}") from None
        print(f"\nwritten into {args.scene}")
