"""Restart: what a result file says of its run, its last checkpoint, its lattice."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Array
from msmpetsc.checkpoint import AT_REST, Checkpoint
from msmpetsc.comm import on_root, together
from msmpetsc.errors import InputError, printable
from msmpetsc.results.comparison import rows_agree
from msmpetsc.results.reader import (
    Result,
    as_python,
    checked_dataset,
    newest_slot,
    object_at,
    open_result,
    plain_damage,
)
from msmpetsc.results.transfer import scatter_rows

NEAR, FARTHEST = 0.01, 1e6  # of the body's longest side
SAME = 1e-9  # of the greatest: sums over cells go another way on another number of ranks


@dataclass(frozen=True)
class Earlier:
    """The run that wrote a result file, as far as a run that goes on must know it.

    texts      : the file's attributes that are text
    true_error : every so many steps the true error was measured, 0 for never
    step       : of the last checkpoint, 0 if it has none
    finished   : frames that it has
    planned    : frames that it has room for
    at_rest    : whether it ended there (time.until)
    """

    path: Path
    texts: dict[str, str]
    true_error: int
    step: int
    finished: int
    planned: int
    at_rest: bool

    @classmethod
    def read(cls, path: Path) -> "Earlier":
        """Read it on one rank. Raises InputError for what is no result, or a damaged one."""
        with Result(path) as result:  # which checks it
            texts = {name: value for name, value in result.attributes.items() if isinstance(value, str)}
            true_error = result.attributes.get("true_error")
            names = _checked_numbers(path, result.file)
            count = len(result.frames.time)
            planned = result.frames.time.planned[0]
            slot = newest_slot(result["checkpoint/step"][:]) if count and AT_REST in (names or ()) else None
            at_rest = slot is not None and result["checkpoint/numbers"][slot][(names or []).index(AT_REST)] == 1
            step = max(0, int(result["checkpoint/step"][:].max())) if names is not None and count else 0
        true_error = true_error if isinstance(true_error, int) and true_error > 0 else 0
        return cls(path, texts, true_error, step, count, planned, bool(at_rest))


def _checked_numbers(path: Path, file: h5py.File) -> list[str] | None:
    """Return the names of the checkpoint's numbers, [] if it has none; None if the file has no checkpoint.

    Raises InputError for a checkpoint that no run wrote so.
    """
    with plain_damage(path):
        group = object_at(path, file, "checkpoint")
        if group is None:
            return None
        if not isinstance(group, h5py.Group):
            raise InputError(f"{path} is damaged: its checkpoint is no group")
        names: list[str] = []
        for name in group:
            if not name.isprintable():  # lines that tell of it would not be lines
                raise InputError(f"{path} is damaged: its checkpoint has {printable(name, 40)!r}")
            dataset = checked_dataset(path, file, f"checkpoint/{name}")
            if name == "numbers":
                names, shape = str(as_python(dataset.attrs.get("names", ""))).split(), (2, dataset.shape[-1])
            else:
                shape = (2,) if name == "step" else (2, len(file["lattice/nodes"]), *dataset.shape[2:])
            kind = "i8" if name == "step" else "f8"
            if dataset.shape != shape or dataset.dtype != kind or (name == "numbers" and len(names) != shape[1]):
                raise InputError(f"{path} is damaged: checkpoint/{name} has shape {dataset.shape}")
        if not {"step", "q", "q_previous"} <= set(group):
            raise InputError(f"{path} is damaged: its checkpoint is not whole")
        return names


def read_checkpoint(comm: MPI.Comm, path: Path, owned: int) -> Checkpoint | None:
    """Return the last checkpoint, this rank's rows of it; None if there is none (collective).

    owned : nodes of this rank; the ranks' follow each other
    """
    with opened_on_root(comm, path) as file:
        newest = comm.bcast(on_root(comm, lambda: _newest(path, file)))
        if newest is None:
            return None
        slot, names, empty = newest
        rows = {name: _own_rows(comm, path, file, (f"checkpoint/{name}", slot), owned) for name in names}
        return replace(empty, rows=rows)


def _newest(path: Path, file: h5py.File) -> tuple[int, list[str], Checkpoint] | None:
    """Return slot, names of rows, step and numbers of the newest checkpoint; None for none."""
    numbers = _checked_numbers(path, file)
    if numbers is None:
        return None
    with plain_damage(path):
        group = file["checkpoint"]
        slot = newest_slot(group["step"][:])
        if slot is None:
            return None
        values = group["numbers"][slot].tolist() if numbers else []
        rows = [name for name in group if name not in ("step", "numbers")]
        return slot, rows, Checkpoint(int(group["step"][slot]), numbers=dict(zip(numbers, values, strict=True)))


def refuse_unlike_frame(path: Path, number: int, is_frame: bool) -> None:
    """Raise InputError where the newest checkpoint's positions cannot be those of a body as a frame shows it.

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
    most, usual = (size + moved, NEAR * size + moved) if is_frame else (FARTHEST * size, FARTHEST * size)
    in_step = most if number else FARTHEST * size  # a body may start fast
    if not (far.max() <= most and np.median(far) <= usual and step.max() <= in_step):
        raise InputError(
            f"{path} is damaged: its checkpoint's positions are {far.max():.3g} m from those of frame {number}, "
            f"and moved by {step.max():.3g} m in a step"
        )


def refuse_changed_lattice(comm: MPI.Comm, path: Path, lattice: dict[str, Array]) -> None:
    """Raise InputError where a lattice is not the one of the file (collective).

    lattice : this rank's rows by dataset, "lattice/nodes"
    """
    with opened_on_root(comm, path) as file:
        counts = comm.bcast(on_root(comm, lambda: {name: len(file[name]) for name in lattice if name in file}))
        for name, count in (counts or {}).items():
            rows = lattice[name]
            same = count == comm.allreduce(len(rows))
            if same:
                stored = _own_rows(comm, path, file, (name,), len(rows)).astype(float)
                greatest = max(comm.allgather(np.abs(stored).max(initial=0)))
                agree = rows_agree(np.asarray(rows, float), stored, SAME * greatest).all()
                same = all(comm.allgather(bool(agree)))
            if not same:
                raise InputError(f"{path}: the mesh has changed: {name} is not what this run makes of it")


@contextmanager
def opened_on_root(comm: MPI.Comm, path: Path) -> Iterator[Any]:
    """Open a result file on rank 0 alone, None elsewhere (collective). Raises InputError."""
    file = on_root(comm, lambda: open_result(path))
    try:
        yield file
    finally:
        if file is not None:
            file.close()


def _own_rows(comm: MPI.Comm, path: Path, file: Any, place: tuple[str] | tuple[str, int], count: int) -> Array:
    """Return this rank's `count` rows of a dataset, or of its row of a number: (count, ...) (collective)."""
    name, *index = place
    counts = comm.allgather(count)
    dtype, shape = comm.bcast(on_root(comm, lambda: (file[name].dtype, file[name].shape[1 + len(index) :])))
    own = np.empty((count, *shape), dtype)
    failure = scatter_rows(comm, own, counts, lambda part: file[name][(*index, part)])
    with together(comm):
        if failure is not None:
            raise InputError(f"{path} cannot be read: {failure}")
    return own
