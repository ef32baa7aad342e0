"""``msmpetsc run``: simulate a scene and write its result file."""

import argparse
import json
import shlex
import sys
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from msmpetsc import __version__
from msmpetsc.cli import resume
from msmpetsc.cli.arguments import (
    MEASURE_NAMES,
    RESULT_NAMES,
    file_argument,
    path_argument,
    refuse_below_one,
    refuse_other_format,
)
from msmpetsc.cli.describe import log_end, log_model
from msmpetsc.cli.failure import ending_together
from msmpetsc.cli.profile import Cost, refuse_unwritable, versions
from msmpetsc.cli.resume import Resumed
from msmpetsc.cli.signals import Interval, Signals
from msmpetsc.cli.storing import tell_stop, write_frames, write_model
from msmpetsc.comm import log, on_root
from msmpetsc.errors import InputError, StepFailed
from msmpetsc.output.restart import Earlier
from msmpetsc.output.writer import Begin, ResultFile
from msmpetsc.output.xdmf import write_xdmf
from msmpetsc.scene.schema import Scene, Solver
from msmpetsc.solve.petsc.initialise import initialise

if TYPE_CHECKING:  # imports PETSc, which must first be given its options
    from msmpetsc.solve.instrumentation import Probes


def add_parser(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "run",
        help="simulate a scene",
        description="Simulate a scene and write OUT.h5 and OUT.xdmf. PETSc options (one dash) may follow.",
    )
    parser.add_argument("scene", type=path_argument, nargs="?", metavar="SCENE", help="scene file (TOML)")
    parser.add_argument("-o", "--output", type=file_argument, metavar="OUT.h5", help="default: out/SCENE.h5")
    parser.add_argument("--preset", metavar="NAME", help="solver preset (see --list-presets)")
    parser.add_argument("--error", metavar="E", help="relative error at which a step is done")
    parser.add_argument(
        "--device", choices=("cpu", "cuda"), help="where to compute: cuda is -mat_type aijcusparse, a CUDA GPU"
    )
    parser.add_argument("--frames", type=int, metavar="N", help="stop after N steps")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="override a scene key: cages.count=3000"
    )
    parser.add_argument("--picture", action="store_true", help="also draw a few moments: OUT.png")
    parser.add_argument("--overwrite", action="store_true", help="replace OUT.h5 if it exists")
    parser.add_argument(
        "--resume", type=file_argument, metavar="OUT.h5",
        help="go on where the run that wrote this file was stopped; with SCENE, start it if there is no such file yet",
    )  # fmt: skip
    parser.add_argument("--force", action="store_true", help="resume with another scene or other options than before")
    parser.add_argument(
        "--checkpoint-every", metavar="N", help="frames, or 30s, 5min, 2h; default: as takes 1%% of the time at most"
    )
    parser.add_argument(
        "--gather",
        action="store_true",
        help="let rank 0 write for all: where nodes of a cluster do not see one file alike",
    )
    parser.add_argument("--compress", action="store_true", help="pack the finished OUT.h5: smaller, slower to read")
    parser.add_argument(
        "--true-error", type=int, metavar="N", help="also solve every N-th step to rounding, and store its true error"
    )
    parser.add_argument("--trace", type=int, metavar="K", help="follow the iterates of step K (needs --measure)")
    parser.add_argument(
        "--measure", type=file_argument, metavar="OUT.json", help="write what the run cost: times, memory"
    )
    parser.add_argument(
        "--show-options", action="store_true", help="say which PETSc options a preset sets, as an options file"
    )
    parser.add_argument("--list-presets", action=ListPresets, help="say what each preset is for")


class ListPresets(argparse.Action):
    """Prints the presets and leaves."""

    def __init__(self, option_strings: list[str], dest: str, help: str):
        super().__init__(option_strings, dest, nargs=0, help=help)

    def __call__(self, parser: argparse.ArgumentParser, *_) -> None:
        from msmpetsc.solve.presets import PRESETS

        if MPI.COMM_WORLD.rank == 0:
            width = max(map(len, PRESETS))
            print("\n".join(f"{name:{width}} {preset.about}" for name, preset in PRESETS.items()))
        parser.exit()


def run(args: argparse.Namespace) -> int:
    """Simulate; returns the exit status (collective)."""
    comm, started = MPI.COMM_WORLD, perf_counter()
    if args.show_options:
        return show_options(comm, args)
    refuse_other_format("-o", args.output, RESULT_NAMES)
    refuse_other_format("--measure", args.measure, MEASURE_NAMES)
    earlier = resume.look(comm, args)
    initialise(comm, args.petsc_options)
    np.seterr(all="ignore")  # what overflows ends in the residual of a step, which says so in one line
    from msmpetsc.backend.compiling import cache_is_empty, compilation_logged

    all_are_new = cache_is_empty()
    from msmpetsc.model.build import build_model
    from msmpetsc.solve.options import refuse_early
    from msmpetsc.solve.petsc.device import choose
    from msmpetsc.solve.simulate import (
        Simulation,
        refuse_bad_options,
    )  # imports PETSc, which reads its options only once

    refuse_early(comm, args.parser._option_string_actions)
    choose(comm, args.device)
    began = perf_counter()
    measured, interval = what_is_measured(args), Interval(args.checkpoint_every)
    scene = comm.bcast(on_root(comm, lambda: read_scene(args, earlier)))
    refuse_bad_options(comm, scene, measured)
    refuse_steps_beyond(scene.time.steps, args, earlier.step if earlier else 0)
    on_root(comm, lambda: refuse_unwritable(args.measure))
    path = args.output or Path("out") / f"{args.scene.stem}.h5"
    about = attributes(comm, scene, args)
    resumed = earlier and Resumed(earlier, scene, given_options(), args.force)
    if resumed and resumed.is_done:
        on_root(comm, lambda: finish(path, args))
        log.info("%s has all its %d frames: nothing left to do", path, earlier.finished)
        return 0
    try:
        with (
            compilation_logged(all_are_new),
            Signals(comm) as signals,
            resumed.file(comm, about, args.gather)
            if resumed
            else ResultFile(path, comm, about, Begin.OVERWRITE if args.overwrite else Begin.NEW, args.gather) as file,
        ):
            model = build_model(comm, scene)
            log_model(comm, model)
            if resumed:
                resumed.refuse_other_lattice(comm, model)
            with Simulation(comm, scene, model, measured) as simulation, ending_together(comm):
                simulation.refuse_unused_options()
                cost = Cost(comm, simulation, perf_counter() - began)
                write_model(comm, file, model)
                if resumed:
                    resumed.restore(comm, file, simulation)
                stopped = write_frames(comm, file, simulation, cost, signals, interval)
                file.close(trim=not stopped)
    except StepFailed as failure:
        on_root(comm, lambda: write_beside(path))  # the frames before the failure are worth a look
        if args.measure:
            cost.write(args.measure, failure)
        left = files_of(path, args, whole=False)
        on_root(comm, lambda: log_end(file.finished, perf_counter() - started, cost.setup, left))
        raise
    if args.measure:
        cost.write(args.measure)
    if stopped:
        on_root(comm, lambda: write_beside(path))
    else:
        on_root(comm, lambda: finish(path, args))
    left = files_of(path, args, whole=not stopped)
    on_root(comm, lambda: log_end(file.finished, perf_counter() - started, cost.setup, left))
    if stopped:
        return tell_stop(stopped, path, simulation)
    simulation.refuse_unused_options(at_end=True)
    return 0


def show_options(comm: MPI.Comm, args: argparse.Namespace) -> int:
    """Print what a run would have in PETSc's options database, which takes no mesh (collective)."""
    earlier = resume.look(comm, args) if args.scene or args.resume else None
    initialise(comm, args.petsc_options)
    from msmpetsc.solve.options import refuse_bad_values, refuse_early, silence_options_left
    from msmpetsc.solve.petsc.device import choose
    from msmpetsc.solve.presets import find_preset, shown_options
    from msmpetsc.solve.simulate import solvers_of

    refuse_early(comm, args.parser._option_string_actions)
    choose(comm, args.device)
    if args.scene or earlier:
        solvers = solvers_of(comm.bcast(on_root(comm, lambda: read_scene(args, earlier))), what_is_measured(args))
    elif args.set or args.frames:
        raise InputError("--set and --frames change a scene: name the SCENE; --preset alone needs none")
    else:
        solvers = {"": (find_preset(args.preset or Solver().preset), 0)}
    on_root(comm, lambda: refuse_bad_values(solvers))
    if comm.rank == 0:
        print("\n".join(shown_options(solvers)))
    silence_options_left()
    return 0


def what_is_measured(args: argparse.Namespace) -> "Probes":
    """Raises InputError for numbers of steps that are none."""
    from msmpetsc.solve.instrumentation import Probes, begin_timing

    refuse_below_one(args, "true_error", "trace")
    if args.trace is not None and args.measure is None:
        raise InputError("--trace needs --measure, the file that it is written to")
    if args.measure:
        begin_timing()
    return Probes(args.true_error, args.trace)


def refuse_steps_beyond(steps: int, args: argparse.Namespace, taken: int) -> None:
    """Raises InputError for steps to be measured that the run does not come to, or that it took before."""
    if args.trace is not None and args.trace <= taken:
        raise InputError(f"--trace {args.trace}: the run goes on after step {taken}")
    for option, number in {"--true-error": args.true_error, "--trace": args.trace}.items():
        if number is not None and number > steps:
            raise InputError(f"{option} {number}: the run has {steps} step{'s' * (steps > 1)} only")


def write_beside(path: Path) -> None:
    """The XDMF file. Raises InputError where it cannot be written."""
    try:
        write_xdmf(path)
    except OSError as error:
        raise InputError(f"{path.with_suffix('.xdmf')} cannot be written: {error.strerror}") from None


def finish(path: Path, args: argparse.Namespace) -> None:
    """The result file packed if that was asked for, and what stands beside it. Raises InputError where that cannot be
    written."""
    if args.compress:
        from msmpetsc.output.compress import pack

        pack(path)
    write_beside(path)
    if args.picture:
        from msmpetsc.output.render import contact_sheet  # loads VTK: a second that other runs need not wait

        contact_sheet(path, path.with_suffix(".png"))


def read_scene(args: argparse.Namespace, earlier: Earlier | None) -> Scene:
    """The scene with what the command line changes; --set comes last and wins."""
    from msmpetsc.solve.presets import PRESETS

    changes = []
    if args.preset is not None:
        changes.append(f"solver.preset={json.dumps(args.preset)}")
    if args.error is not None:
        changes.append(f"solver.error={args.error}")
    changes += args.set
    scene = resume.read_scene(args, earlier, changes, PRESETS)
    if args.frames is not None:
        refuse_below_one(args, "frames")
        changes.append(f"time.duration={args.frames * scene.time.step!r}")
        scene = resume.read_scene(args, earlier, changes, PRESETS)
    return scene


def given_options() -> dict[str, str]:
    """PETSc's, before any of ours are among them."""
    from petsc4py import PETSc

    return PETSc.Options().getAll()


def as_given(option: tuple[str, str]) -> str:
    name, value = option
    return f"-{name} {shlex.quote(value)}" if value else f"-{name}"


def attributes(comm: MPI.Comm, scene: Scene, args: argparse.Namespace) -> dict:
    """What the file says of the run that made it."""
    return {
        "msmpetsc_version": __version__,
        "petsc_version": versions()["petsc"],
        "petsc_options": " ".join(map(as_given, given_options().items())),
        "ranks": comm.size,
        "command": shlex.join(["msmpetsc", *sys.argv[1:]]),
        "scene": scene.text,
        "scene_file": str(args.scene.resolve()) if args.scene else "",
        "true_error": args.true_error or 0,
    }


def files_of(path: Path, args: argparse.Namespace, whole: bool) -> list[Path]:
    """What a run leaves: the result first; a picture is drawn of a ``whole`` one."""
    beside = [path.with_suffix(".xdmf"), *([path.with_suffix(".png")] if args.picture and whole else [])]
    return [path, *beside, *([args.measure] if args.measure else [])]
