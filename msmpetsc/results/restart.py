"""Restart from a result file: its run, its last checkpoint, its lattice."""

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Array
from msmpetsc.checkpoint import Checkpoint
from msmpetsc.comm import on_root, together
from msmpetsc.errors import InputError
from msmpetsc.fields import CHECKPOINT
from msmpetsc.results.comparison import rows_agree
from msmpetsc.results.layout import scatter_rows
from msmpetsc.results.reader import Result, as_python, newest_slot, plain_damage

NEAR, FARTHEST = 0.01, 1e6  # of the body's longest side
SAME = 1e-9  # of the greatest: sums over cells go another way on another number of ranks


@dataclass(frozen=True)
class Earlier:
    """What a resumed run must know of the run that wrote the result file.

    texts      : the file's attributes that are text
    true_error : every so many steps the true error was measured, 0 for never
    step       : of the last checkpoint, 0 if it has none
    finished   : frames that it has
    planned    : frames that it has room for
    """

    path: Path
    texts: dict[str, str]
    true_error: int
    step: int
    finished: int
    planned: int

    @classmethod
    def read(cls, path: Path) -> "Earlier":
        """Read the earlier run on one rank. Raises InputError for no result, or a damaged one."""
        with Result(path) as result:  # which checks it
            texts = {
                name: value for name, value in result.attributes.items() if isinstance(value, str)
            }
            true_error = result.attributes.get("true_error")
            count, planned = len(result.frames.time), result.frames.time.planned[0]
            newest = _newest(result)
        step = newest[1].step if newest is not None and count else 0
        true_error = true_error if isinstance(true_error, int) and true_error > 0 else 0
        return cls(path, texts, true_error, step, count, planned)


def _newest(run: Result) -> tuple[int, Checkpoint, list[str]] | None:
    """Return the slot, the step with its numbers, and the names of rows of the newest checkpoint, or None.

    Raises InputError for a checkpoint that no run wrote so.
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
    names: list[str] = []
    values = np.empty(0)
    if "numbers" in stored:
        values = run["checkpoint/numbers"][slot]
        with plain_damage(run.path):
            names = str(as_python(run.file["checkpoint/numbers"].attrs.get("names", ""))).split()
    if len(names) != len(values):
        raise InputError(
            f"{run.path} is damaged: checkpoint/numbers has {len(values)} numbers of {len(names)} names"
        )
    numbers = dict(zip(names, values.tolist(), strict=True))
    rows = [name for name in stored if name not in ("step", "numbers")]
    return slot, Checkpoint(int(steps[slot]), numbers=numbers), rows


def read_checkpoint(comm: MPI.Comm, path: Path, owned: int) -> Checkpoint | None:
    """Return the last checkpoint with this rank's rows, or None if there is none (collective).

    owned : nodes of this rank; the ranks' follow each other
    """
    with opened_on_root(comm, path) as run:
        newest: tuple[int, Checkpoint, list[str]] | None = comm.bcast(
            on_root(comm, lambda: _newest(run))
        )
        if newest is None:
            return None
        slot, empty, names = newest
        return replace(
            empty,
            rows={
                name: _own_rows(comm, run, (f"checkpoint/{name}", slot), owned) for name in names
            },
        )


def refuse_unlike_frame(path: Path, number: int, is_frame: bool) -> None:
    """Raise InputError where the newest checkpoint's positions cannot follow from those of a frame.

    number   : of the last frame up to its step
    is_frame : whether it is of that very step

    They need not be equal: contact may have reflected nodes since, and after a stop other ranks may have gone on. But a
    body goes no farther than its own length in a step, and most of it stays nearly where the frame has it.
    """
    with Result(path) as run:
        slot = newest_slot(run["checkpoint/step"][:])
        q, q_previous = (run[f"checkpoint/{name}"][slot] for name in ("q", "q_previous"))
        frame = run.frames.position[number]
        moved = np.abs(frame - run.frames.position[number - 1]).max() if number else 0.0
        size = np.ptp(run.lattice.nodes[:], axis=0).max()
    far, step = (np.abs(a - b).max(axis=1) for a, b in ((q, frame), (q, q_previous)))
    most, usual = (
        (size + moved, NEAR * size + moved) if is_frame else (FARTHEST * size, FARTHEST * size)
    )
    in_step = most if number else FARTHEST * size  # a body may start fast
    if not (far.max() <= most and np.median(far) <= usual and step.max() <= in_step):
        raise InputError(
            f"{path} is damaged: its checkpoint's positions are {far.max():.3g} m from those of frame {number}, "
            f"and moved by {step.max():.3g} m in a step"
        )


def refuse_changed_lattice(comm: MPI.Comm, path: Path, lattice: dict[str, Array]) -> None:
    """Raise InputError where a lattice differs from the one in the file (collective).

    lattice : this rank's rows by dataset, "lattice/nodes"
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
                agree = rows_agree(np.asarray(rows, float), stored, SAME * greatest).all()
                same = all(comm.allgather(bool(agree)))
            if not same:
                raise InputError(
                    f"{path}: the mesh has changed: {name} is not what this run makes of it"
                )


@contextmanager
def opened_on_root(comm: MPI.Comm, path: Path) -> Iterator[Any]:
    """Open a result file on rank 0 alone; yield None on other ranks (collective). Raises InputError."""
    with on_root(comm, lambda: Result(path)) or nullcontext() as run:
        yield run


def _own_rows(comm: MPI.Comm, run: Any, place: tuple[str] | tuple[str, int], count: int) -> Array:
    """Return this rank's `count` rows of a dataset, or of one of its slots (collective)."""
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
