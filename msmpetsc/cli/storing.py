"""What a run stores: its model, then frames and checkpoints as steps are taken, until it is at its end or asked to stop."""

import shlex
from pathlib import Path
from signal import Signals as Signal
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from msmpetsc.cli.profile import Cost
from msmpetsc.cli.signals import STATUS, Interval, Signals
from msmpetsc.comm import log
from msmpetsc.output.progress import Progress
from msmpetsc.output.writer import ResultFile

if TYPE_CHECKING:  # these import PETSc, which must first be given its options
    from msmpetsc.model.build import Model
    from msmpetsc.solve.simulate import Simulation


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


def write_frames(
    comm: MPI.Comm, file: ResultFile, simulation: "Simulation", cost: Cost, signals: Signals, interval: Interval
) -> int:
    """Run, and store each frame when it is done; those before a failure stay. Returns the signal that ended it, or 0
    (collective)."""
    lattice, embedding = simulation.model.lattice, simulation.model.embedding
    points = embedding.points if embedding else None
    file.start_frames(simulation.stored, lattice.owned, points, saved=simulation.saved())
    progress = Progress(simulation.steps, enabled=comm.rank == 0)
    count = simulation.stored_until(simulation.step) if simulation.step else 0  # frames of the steps taken
    signal = 0
    signals.begin()
    try:
        for frame in simulation.advance():
            begun = perf_counter()
            if frame is not None:
                if count >= file.finished:  # else it was written before
                    file.append(frame)
                count += 1
                progress.update(frame)
            due = (comm.rank == 0 and interval.due(frame is not None)) or simulation.step in (0, simulation.steps)
            due, signal = signals.agree(due)
            if due:
                began = perf_counter()
                file.write_checkpoint(simulation.saved())
                interval.done(began)
            cost.add(frame.wall_time if frame else 0.0, begun)
            if signal:
                break
    finally:
        progress.close()
    return signal if simulation.step < simulation.steps else 0


def tell_stop(number: int, path: Path, simulation: "Simulation") -> int:
    """One line, and the exit status of that signal."""
    log.warning(
        "stopped by %s after step %d of %d (t = %.6g s); to go on: msmpetsc run --resume %s",
        Signal(number).name, simulation.step, simulation.steps, simulation.step * simulation.time_step,
        shlex.quote(str(path)),
    )  # fmt: skip
    return STATUS[number]
