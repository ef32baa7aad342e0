"""Read an earlier run and its last checkpoint from a result file; check lattice and positions."""

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Array, Indices
from msmpetsc.checkpoint import AT_END, Checkpoint
from msmpetsc.comm import on_root, together
from msmpetsc.errors import InputError
from msmpetsc.fields import CHECKPOINT
from msmpetsc.lattice.initial_state import InitialState
from msmpetsc.lattice.lattice import Lattice
from msmpetsc.results.comparison import rows_agree
from msmpetsc.results.layout import scatter_rows
from msmpetsc.results.reader import Result
from msmpetsc.results.untrusted_file import as_python, plain_damage
from msmpetsc.scene.reading import scene_of

# largest distance of a checkpoint from a frame, in longest sides [-]; a larger distance
# shows a damaged file
FARTHEST = 1e6
# largest difference of equal lattices, relative to the largest value [-]; the order of
# sums over cells depends on the number of ranks
SAME_LATTICE = 1e-9


@dataclass(frozen=True)
class Earlier:
    """Facts about an earlier run, from its result file, that a resumed run needs.

    texts      : the file's attributes that are text
    true_error : number of steps between measurements of the true error, 0 for never
    step       : step of the last checkpoint, 0 if there is none
    finished   : number of finished frames
    planned    : number of frames that are laid out
    """

    path: Path
    texts: dict[str, str]
    true_error: int
    step: int
    finished: int
    planned: int

    @classmethod
    def read(cls, path: Path) -> "Earlier":
        """Read the earlier run on a single rank. Raises InputError if the file is no result."""
        with Result(path) as result:
            if "frequencies" in result.attributes:
                raise InputError(f"{path} has the modes of a body, no run to go on from")
            attributes = result.attributes.items()
            texts = {name: value for name, value in attributes if isinstance(value, str)}
            true_error = result.attributes.get("true_error")
            count = len(result.frames.time)
            planned = result.frames.time.planned[0]
            newest = _newest_checkpoint(result)
        step = newest[1].step if newest is not None and count else 0
        true_error = true_error if isinstance(true_error, int) and true_error > 0 else 0
        return cls(path, texts, true_error, step, count, planned)


def _newest_checkpoint(run: Result) -> tuple[int, Checkpoint, list[str]] | None:
    """Return the newest checkpoint: its slot, its step and numbers, and the names of its rows.

    Return None if there is none. Raises InputError if the checkpoint is incomplete.
    """
    stored = [name for name in CHECKPOINT if f"checkpoint/{name}" in run]
    if not stored:
        return None
    for name in ("step", "q", "q_previous"):
        if name not in stored:
            raise InputError(f"{run.path} is damaged: its checkpoint is not whole")
    steps = run["checkpoint/step"][:]
    slot = newest_slot(steps)
    if slot is None:
        return None
    numbers: dict[str, float] = {}
    if "numbers" in stored:
        values = run["checkpoint/numbers"][slot].tolist()
        with plain_damage(run.path):
            names = str(as_python(run.file["checkpoint/numbers"].attrs.get("names", "")))
            numbers = dict(zip(names.split(), values, strict=True))
    rows = [name for name in stored if name not in ("step", "numbers")]
    return slot, Checkpoint(int(steps[slot]), numbers=numbers), rows


def newest_slot(steps: Indices) -> int | None:
    """Return the slot of the newest checkpoint from the steps (2,) of both slots, or None."""
    slot = int(np.argmax(steps))
    return slot if steps[slot] >= 0 else None


def read_checkpoint(comm: MPI.Comm, path: Path, owned: int) -> Checkpoint | None:
    """Return the last checkpoint with this rank's rows, or None if there is none (collective).

    owned : number of this rank's nodes; nodes follow each other in the order of the ranks

    Raises InputError if the checkpoint is incomplete or cannot be read.
    """
    with opened_on_root(comm, path) as run:
        newest: tuple[int, Checkpoint, list[str]] | None = comm.bcast(
            on_root(comm, lambda: _newest_checkpoint(run))
        )
        if newest is None:
            return None
        slot, empty, names = newest
        rows = {name: _own_rows(comm, run, (f"checkpoint/{name}", slot), owned) for name in names}
        return replace(empty, rows=rows)


def refuse_unlike_frame(path: Path, number: int) -> None:
    """Raise InputError if the newest checkpoint's positions cannot follow from a frame."""
    with Result(path) as run:
        slot = newest_slot(run["checkpoint/step"][:])
        frame = run.frames.position[number]
        size = np.ptp(run.lattice.nodes[:], axis=0).max()
        for name in ("q", "q_previous"):
            distance = np.abs(run[f"checkpoint/{name}"][slot] - frame).max()
            if not distance <= FARTHEST * size:
                raise InputError(
                    f"{path} is damaged: checkpoint/{name} is {distance:.3g} m from frame {number}"
                )


def end_of_run(comm: MPI.Comm, folder: Path, name: str, lattice: Lattice) -> InitialState:
    """Return positions and velocities at the end of a result file's run (collective).

    folder, name : the file's path, as in ``start.from``

    A run that was stopped ends at its last checkpoint. Raises InputError for a file without a
    state, of another lattice, or damaged.
    """
    path = folder / name
    earlier: Earlier = comm.bcast(on_root(comm, lambda: Earlier.read(path)))
    at_rest = lattice.nodes[: lattice.owned]
    words = "start.from: it is of another lattice"
    refuse_changed_lattice(comm, path, {"lattice/nodes": at_rest}, words)
    with opened_on_root(comm, path) as run:
        slot = comm.bcast(on_root(comm, lambda: _last_slot(run)))
        if slot is None or "scene" not in earlier.texts:
            raise InputError(f"{path}: start.from: it has no state to start from")
        names = "q", "q_previous"
        own = {n: _own_rows(comm, run, (f"checkpoint/{n}", slot), lattice.owned) for n in names}
    Checkpoint(rows=own).refuse_rows_unlike(comm, Checkpoint(rows=dict.fromkeys(names, at_rest)))
    time_step = scene_of(path, earlier.texts["scene"], to_read=False).time.step
    q, q_previous = (lattice.table.with_ghosts(lattice.ghosts, own[n]) for n in names)
    return q, (q - q_previous) / time_step


def _last_slot(run: Result) -> int | None:
    """Return the slot of the state at the end of a run, or of the newest checkpoint, or None."""
    steps = run["checkpoint/step"][:]
    return int(np.argmin(steps)) if steps.min() <= AT_END else newest_slot(steps)


def refuse_changed_lattice(
    comm: MPI.Comm, path: Path, lattice: dict[str, Array], words: str = "the mesh has changed"
) -> None:
    """Raise InputError if a lattice differs from the lattice in the file (collective).

    lattice : this rank's rows by name of a dataset, such as "lattice/nodes"
    words   : reason given in the message
    """
    with opened_on_root(comm, path) as run:
        counts = comm.bcast(
            on_root(comm, lambda: {name: len(run[name]) for name in lattice if name in run})
        )
        for name, count in (counts or {}).items():
            rows = lattice[name]
            same = count == comm.allreduce(len(rows))
            if same:
                stored = _own_rows(comm, run, (name,), len(rows)).astype(float)
                greatest = max(comm.allgather(np.abs(stored).max(initial=0)))
                agree = rows_agree(np.asarray(rows, float), stored, SAME_LATTICE * greatest).all()
                same = all(comm.allgather(bool(agree)))
            if not same:
                raise InputError(f"{path}: {words}: {name} differs from this run's lattice")


@contextmanager
def opened_on_root(comm: MPI.Comm, path: Path) -> Iterator[Any]:
    """Open a result file on rank 0; yield None on other ranks (collective). Raises InputError."""
    with on_root(comm, lambda: Result(path)) or nullcontext() as run:
        yield run


def _own_rows(comm: MPI.Comm, run: Any, place: tuple[str] | tuple[str, int], count: int) -> Array:
    """Return this rank's `count` rows of a dataset, or of a slot of it (collective).

    place : name of the dataset, and the slot if there are slots

    Raises InputError if the rows cannot be read.
    """
    name, *index = place
    counts = comm.allgather(count)
    dtype, shape = comm.bcast(
        on_root(comm, lambda: (run[name].dtype, run[name].shape[1 + len(index) :]))
    )
    own = np.empty((count, *shape), dtype)
    failure = scatter_rows(comm, own, counts, lambda part: run[name][(*index, part)])
    with together(comm):
        if failure is not None:
            raise failure
    return own
