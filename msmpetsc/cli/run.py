"""``msmpetsc run``: simulate a scene and write its result file."""

import argparse
import json
import shlex
import sys
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np
import petsc4py
from mpi4py import MPI

from msmpetsc import __version__
from msmpetsc.cli.cost import Cost, refuse_unwritable, versions
from msmpetsc.comm import log, on_root
from msmpetsc.errors import InputError, StepFailed
from msmpetsc.output.frames import ResultFile
from msmpetsc.output.progress import Progress
from msmpetsc.output.xdmf import write_xdmf
from msmpetsc.scene import Scene
from msmpetsc.scene_reading import load_scene

if TYPE_CHECKING:  # these import PETSc, which must first be given its options
    from msmpetsc.model.build import Model
    from msmpetsc.solve.measured import Measured
    from msmpetsc.solve.simulate import Simulation


def add_parser(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "run",
        help="simulate a scene",
        description="Simulate a scene and write OUT.h5 and OUT.xdmf. PETSc options (one dash) may follow.",
    )
    parser.add_argument("scene", type=Path, metavar="SCENE", help="scene file (TOML)")
    parser.add_argument("-o", "--output", type=Path, metavar="OUT.h5", help="default: out/SCENE.h5")
    parser.add_argument("--preset", metavar="NAME", help="solver preset (see --list-presets)")
    parser.add_argument("--error", metavar="E", help="relative error at which a step is done")
    parser.add_argument("--frames", type=int, metavar="N", help="stop after N steps")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="override a scene key: cages.count=3000"
    )
    parser.add_argument("--picture", action="store_true", help="also draw a few moments: OUT.png")
    parser.add_argument("--overwrite", action="store_true", help="replace OUT.h5 if it exists")
    parser.add_argument(
        "--true-error", type=int, metavar="N", help="also solve every N-th step to rounding, and store its true error"
    )
    parser.add_argument("--trace", type=int, metavar="K", help="follow the iterates of step K (needs --measure)")
    parser.add_argument("--measure", type=Path, metavar="OUT.json", help="write what the run cost: times, memory")
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
    petsc4py.init(["msmpetsc", *args.petsc_options])
    np.seterr(all="ignore")  # what overflows ends in the residual of a step, which says so in one line
    comm = MPI.COMM_WORLD
    from msmpetsc.model.build import build_model
    from msmpetsc.solve.simulate import Simulation  # imports PETSc, which reads its options only once

    began = perf_counter()
    measured = what_is_measured(args)
    scene = comm.bcast(on_root(comm, lambda: read_scene(args)))
    refuse_steps_beyond(scene.time.steps, args)
    on_root(comm, lambda: refuse_unwritable(args.measure))
    path = args.output or Path("out") / f"{args.scene.stem}.h5"
    try:
        with ResultFile(path, comm, attributes(comm, scene), args.overwrite) as file:
            model = build_model(comm, scene)
            describe(comm, model)
            with Simulation(comm, scene, model, measured) as simulation:
                simulation.refuse_unused_options()
                cost = Cost(comm, simulation, perf_counter() - began)
                write_model(comm, file, model)
                write_frames(comm, file, simulation, cost)
    except StepFailed as failure:
        on_root(comm, lambda: write_xdmf(path))  # the frames before the failure are worth a look
        if args.measure:
            cost.write(args.measure, failure)
        raise
    if args.measure:
        cost.write(args.measure)
    on_root(comm, lambda: finish(path, args.picture))
    simulation.refuse_unused_options(at_end=True)
    return 0


def what_is_measured(args: argparse.Namespace) -> "Measured":
    """Raises InputError for numbers of steps that are none."""
    from msmpetsc.solve.measured import Measured, begin_timing

    for option, number in {"--true-error": args.true_error, "--trace": args.trace}.items():
        if number is not None and number < 1:
            raise InputError(f"{option} must be at least 1, not {number}")
    if args.trace is not None and args.measure is None:
        raise InputError("--trace needs --measure, the file that it is written to")
    if args.measure:
        begin_timing()
    return Measured(args.true_error, args.trace)


def refuse_steps_beyond(steps: int, args: argparse.Namespace) -> None:
    """Raises InputError for steps to be measured that the run does not come to."""
    for option, number in {"--true-error": args.true_error, "--trace": args.trace}.items():
        if number is not None and number > steps:
            raise InputError(f"{option} {number}: the run has {steps} step{'s' * (steps > 1)} only")


def finish(path: Path, picture: bool) -> None:
    """What stands beside the result file."""
    write_xdmf(path)
    if picture:
        from msmpetsc.output.render import contact_sheet  # loads VTK: a second that other runs need not wait

        contact_sheet(path, path.with_suffix(".png"))


def read_scene(args: argparse.Namespace) -> Scene:
    """The scene with what the command line changes; --set comes last and wins."""
    from msmpetsc.solve.presets import PRESETS

    changes = []
    if args.preset is not None:
        changes.append(f"solver.preset={json.dumps(args.preset)}")
    if args.error is not None:
        changes.append(f"solver.error={args.error}")
    changes += args.set
    scene = load_scene(args.scene, changes, PRESETS)
    if args.frames is not None:
        if args.frames < 1:
            raise InputError(f"--frames must be at least 1, not {args.frames}")
        scene = load_scene(args.scene, [*changes, f"time.duration={args.frames * scene.time.step!r}"], PRESETS)
    return scene


def attributes(comm: MPI.Comm, scene: Scene) -> dict:
    """What the file says of the run that made it."""
    from petsc4py import PETSc

    given = PETSc.Options().getAll()
    return {
        "msmpetsc_version": __version__,
        "petsc_version": versions()["petsc"],
        "petsc_options": " ".join(f"-{name} {value}".strip() for name, value in given.items()),
        "ranks": comm.size,
        "command": shlex.join(["msmpetsc", *sys.argv[1:]]),
        "scene": scene.text,
    }


def describe(comm: MPI.Comm, model: "Model") -> None:
    """One line on the lattice."""
    lattice = model.lattice
    cells, springs = comm.allreduce(len(lattice.cells)), comm.allreduce(lattice.springs_owned)
    log.info(
        "%d cells of %.4g m, %d nodes, %d springs on %d rank%s",
        cells, lattice.cell_size, lattice.table.total, springs, comm.size, "s" * (comm.size > 1),
    )  # fmt: skip


def write_model(comm: MPI.Comm, file: ResultFile, model: "Model") -> None:
    """The parts of the file that do not change with time (collective)."""
    lattice, owned = model.lattice, model.lattice.owned
    springs = slice(lattice.springs_owned)
    numbers = lattice.global_numbers
    file.write("lattice/nodes", lattice.nodes[:owned])
    file.write("lattice/cells", lattice.cells)
    file.write("lattice/cell_kind", lattice.cell_kind)
    file.write("lattice/springs", numbers[lattice.springs[springs]])
    file.write("lattice/rest_length", lattice.rest_length[springs])
    file.write("lattice/stiffness", lattice.stiffness[springs])
    file.write("lattice/mass", lattice.mass)
    file.write("lattice/pinned", numbers[:owned][lattice.pinned[:owned]])
    surface, embedding = model.surface, model.embedding
    if embedding is None:
        return
    file.write("surface/points", np.empty((0, 3)) if surface is None else surface.points)
    file.write("surface/triangles", np.empty((0, 3), np.int64) if surface is None else surface.triangles)
    offset = comm.exscan(len(embedding.indices)) or 0
    indptr = embedding.indptr[1:] + offset
    file.write("embedding/indptr", np.append(0, indptr) if comm.rank == 0 else indptr)
    file.write("embedding/indices", embedding.indices)
    file.write("embedding/weights", embedding.weights)


def write_frames(comm: MPI.Comm, file: ResultFile, simulation: "Simulation", cost: Cost) -> None:
    """Run, and store each frame when it is done; those before a failure stay (collective)."""
    lattice, embedding = simulation.model.lattice, simulation.model.embedding
    owned = slice(lattice.owned)
    file.start_frames(simulation.stored, lattice.owned, embedding.points if embedding else None)
    progress = Progress(simulation.steps, enabled=comm.rank == 0)
    try:
        for frame in simulation.frames():
            begun = perf_counter()
            file.append(frame)
            state = simulation.state
            file.write_checkpoint(frame.index, state.q[owned], state.q_previous[owned])
            cost.add(frame.wall_time, begun)
            progress.update(frame)
    finally:
        progress.close()
