"""The log lines of a run about its model, its end and its files, and the record of its cost."""

import json
import platform
import shlex
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from signal import Signals
from tempfile import TemporaryFile
from time import perf_counter

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc
from tqdm import tqdm

from msmpetsc import __version__
from msmpetsc.app.signals import STATUS
from msmpetsc.backend.arrays import on_host
from msmpetsc.backend.machine import machine, peak_memory
from msmpetsc.build import Model
from msmpetsc.comm import log, on_root
from msmpetsc.errors import StepFailed
from msmpetsc.fields import Frame
from msmpetsc.geometry.thickness import thickness_words
from msmpetsc.lattice.material import STEPS_A_PERIOD, bending_period
from msmpetsc.results.disk import plain_errors, refuse_read_only, write_whole
from msmpetsc.results.progress_bar import duration
from msmpetsc.scene.reading import Scene
from msmpetsc.solve.instrumentation import times
from msmpetsc.solve.petsc.events import FILES, OUTPUT
from msmpetsc.solve.simulate import TimeLoop


def log_model(comm: MPI.Intracomm, model: Model) -> None:
    """Log size, volume and mass of each body, and the counts of cells and nodes (collective)."""
    lattice = model.lattice
    masses = np.bincount(lattice.body[: lattice.owned], lattice.mass, len(model.bodies))
    filled = np.bincount(lattice.body_of(lattice.cells[:, 0]), lattice.cell_fill, len(model.bodies))
    sums = comm.allreduce(np.array([masses, filled * lattice.cell_size**3]))
    for number, (body, (mass, volume)) in enumerate(zip(model.bodies, sums.T, strict=True)):
        mesh = f"open mesh ({body.report.boundary_edges} boundary edges), its volume unknown"
        if body.report.closed:
            enclosed = abs(body.report.volume)
            mesh = f"closed mesh of {enclosed:.4g} m^3, {mass / volume * enclosed:.4g} kg"
        name = f"body.{number}" if len(model.bodies) > 1 else "body"
        size = " x ".join(f"{length:.4g}" for length in body.bounds[1] - body.bounds[0])
        if body.thickness:
            mesh = f"{thickness_words(body.thickness.cells(lattice.cell_size))}; {mesh}"
        log.info("%s of %s m; %s; lattice of %.4g m^3, %.4g kg", name, size, mesh, volume, mass)
    own_pinned = int(lattice.pinned[: lattice.owned].sum())
    cells, springs, pinned = (
        comm.allreduce(number) for number in (len(lattice.cells), lattice.springs_owned, own_pinned)
    )
    log.info(
        "%d cells of %.4g m, %d nodes (%d pinned), %d springs on %d rank%s",
        cells, lattice.cell_size, lattice.table.total, pinned, springs, comm.size,
        "s" * (comm.size > 1),
    )  # fmt: skip
    if model.node_counts:
        log.info("%s", ", ".join(model.node_counts))


def warn_of_long_steps(scene: Scene, model: Model) -> None:
    """Warn if the time step exceeds the longest vibration period of all bodies.

    Implicit steps of that length damp the vibration away. The period of a body is estimated as the
    period of a bending bar with the body's longest and shortest side, mostly an upper estimate. A
    body whose retardation time is longer does not vibrate: it creeps, in the retardation time.
    """
    time = scene.time
    if time.integrator not in ("implicit-euler", "bdf2") or time.error is not None:
        return
    moduli = [body.material and body.material.young_modulus for body in scene.body] or [None]
    softest = min((modulus or scene.material.young_modulus or np.inf) for modulus in moduli)
    lengths = [body.bounds[1] - body.bounds[0] for body in model.bodies]
    period = max(
        bending_period(sides.max(), sides.min(), softest, scene.material.density)
        for sides in lengths
    )
    if time.step > max(period, scene.material.retardation_time) and period > 0:
        log.warning(
            "time.step is %.2g periods of the slowest vibration, about %.1g s, which it damps "
            'away: time.step = %.1g resolves it, time.integrator = "static" goes to rest at once',
            time.step / period, period, period / STEPS_A_PERIOD,
        )  # fmt: skip


def log_end(frames: int, seconds: float, setup: float, files: Iterable[Path]) -> None:
    """Log the duration of the run [s] and its files; the first file has the frames."""
    sizes = {path: tqdm.format_sizeof(path.stat().st_size, "B") for path in files if path.is_file()}
    result, *companions = (f"{path} ({size})" for path, size in sizes.items())
    log.info("took %s, %s of it before the first step", duration(seconds), duration(setup))
    log.info("left %d frame%s in %s", frames, "s" * (frames != 1), ", ".join([result, *companions]))


def tell_stop(number: int, path: Path, simulation: TimeLoop) -> int:
    """Log the command that resumes a run after a signal; return the signal's exit status."""
    log.warning(
        "stopped by %s after step %d of %d (t = %.6g s); to go on: msmpetsc run --resume %s",
        Signals(number).name, simulation.step, simulation.steps,
        simulation.step * simulation.time_step, shlex.quote(str(path)),
    )  # fmt: skip
    return STATUS[number]


class Cost:
    """The cost of a run, summed over its frames.

    setup    : time before the first step [s]
    output   : time to write frames and checkpoints [s]
    stepping : time of the steps [s]
    products : number of Hessian-vector products
    counts   : cells, nodes, springs and unknowns of all ranks
    """

    def __init__(self, comm: MPI.Comm, simulation: TimeLoop, setup: float):
        self.comm = comm
        self.simulation = simulation
        self.setup = setup
        self.output = self.stepping = 0.0
        self.products = 0
        model = simulation.model
        lattice = model.lattice
        fixed = simulation.environment.anchors.fixed_at(simulation.time_step)[: lattice.owned]
        own_counts = {
            "cells": len(lattice.cells),
            "nodes": lattice.owned,
            "springs": lattice.springs_owned,
            "unknowns": int((~fixed).any(axis=1).sum()),
        }
        self.counts = {name: comm.allreduce(number) for name, number in own_counts.items()}

    @contextmanager
    def of_output(self) -> Iterator[None]:
        """Add the time of the block to ``output``."""
        began = perf_counter()
        with OUTPUT, FILES:
            yield
        self.output += perf_counter() - began

    def count(self, frame: Frame) -> None:
        """Add the time and products of the steps since the previous frame."""
        self.stepping += frame.wall_time
        self.products += frame.products

    def write(
        self, path: Path, command: str, before: dict[str, float], failure: StepFailed | None = None
    ) -> None:
        """Write the cost as JSON (collective). Raises InputError if the file cannot be written.

        command : command line of the run
        before  : time in each logged event of the process before the run [s]
        """
        comm, simulation = self.comm, self.simulation
        device = "cpu" if on_host(simulation.model.lattice.nodes) else "cuda"
        own = {"setup": self.setup, "output": self.output, "stepping": self.stepping}
        time = {name: comm.allreduce(seconds, MPI.MAX) for name, seconds in own.items()} | times(
            comm, before
        )
        record = {
            "machine": machine(), "device": device, "versions": versions(), "ranks": comm.size,
            "command": command, **self.counts,
            "time": time,
            "products": self.products,
            "memory": comm.allreduce(peak_memory()),
            "failure": failure
            and {"kind": failure.kind, "frame": failure.frame, "says": str(failure)},
        }  # fmt: skip
        on_root(comm, lambda: write_whole(path, json.dumps(record, indent=1)))


def refuse_unwritable(path: Path | None) -> None:
    """Raise InputError for a file that cannot be written, so that a run fails before its steps."""
    if path:
        with plain_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            TemporaryFile(dir=path.parent).close()
            refuse_read_only(path)


def versions() -> dict[str, str]:
    """Return the versions of this package, PETSc and Python."""
    petsc = ".".join(map(str, PETSc.Sys.getVersion()))
    return {"msmpetsc": __version__, "petsc": petsc, "python": platform.python_version()}
