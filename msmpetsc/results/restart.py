"""Restart: what a result file says of the run that wrote it, its last checkpoint, whether a lattice is its own."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Array
from msmpetsc.checkpoint import AT_REST, ROWS, Checkpoint
from msmpetsc.comm import together
from msmpetsc.errors import InputError, printable
from msmpetsc.fields import FRAME_FIELDS
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
    exact      : whether its checkpoints are laid out as those of today
    at_rest    : whether it ended there (time.until)
    """

    path: Path
    texts: dict[str, str]
    true_error: int
    step: int
    finished: int
    planned: int
    exact: bool
    at_rest: bool

    @classmethod
    def read(cls, path: Path) -> "Earlier":
        """Read it on one rank. Raises InputError for what is no result, or a damaged one."""
        with Result(path) as result:  # which checks it
            texts = {name: value for name, value in result.attributes.items() if isinstance(value, str)}
            true_error = result.attributes.get("true_error")
            names = _checked_numbers(path, result.file)
            _refuse_foreign_series(result)
            is_of_now = names is not None and set(result.file["checkpoint"]) <= {"step", "numbers", *ROWS}
            count, planned = len(result.frames.time), result.frames.time.planned[0]
            at_rest = bool(count) and _is_at_rest(result, names or [])
            step = max(0, int(result["checkpoint/step"][:].max())) if names is not None and count else 0
        true_error = true_error if isinstance(true_error, int) and true_error > 0 else 0
        return cls(path, texts, true_error, step, count, planned, bool(names) and is_of_now, at_rest)


def _is_at_rest(result: Result, names: list[str]) -> bool:
    """Return whether the newest checkpoint, with numbers of these names, is of a run at rest."""
    slot = newest_slot(result["checkpoint/step"][:]) if AT_REST in names else None
    return slot is not None and bool(result["checkpoint/numbers"][slot][names.index(AT_REST)] == 1)


def _refuse_foreign_series(result: Result) -> None:
    """Raise InputError where the numbers of frames are not stored as a run stores them; an older one may lack some."""
    for name, array in result.frames.items():
        if name not in ("position", "surface"):
            field = FRAME_FIELDS[name]
            if array.dtype != field.dtype or array.shape[1:] != field.shape[1:]:
                raise InputError(f"{result.path} is damaged: frames/{name} has type {array.dtype}")


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
    with RootFile(comm, path) as file:
        slot = file.ask(lambda stored: newest_slot(stored["checkpoint/step"][:]) if "checkpoint" in stored else None)
        if slot is None:
            return None
        step = file.ask(lambda stored: int(stored["checkpoint/step"][slot]))
        names = file.ask(lambda stored: _checked_numbers(path, stored)) or []
        values = file.ask(lambda stored: stored["checkpoint/numbers"][slot].tolist() if names else [])
        stored_rows = file.ask(
            lambda stored: [name for name in stored["checkpoint"] if name not in ("step", "numbers")]
        )
        rows = {name: file.rows(f"checkpoint/{name}", owned, slot) for name in stored_rows}
        return Checkpoint(step, rows, dict(zip(names, values, strict=True)))


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
    with RootFile(comm, path) as file:
        for name, rows in lattice.items():
            stored_count = file.length(name)
            if stored_count is None:
                continue
            same = stored_count == comm.allreduce(len(rows))
            if same:
                stored = file.rows(name, len(rows)).astype(float)
                greatest = max(comm.allgather(np.abs(stored).max(initial=0)))
                agree = rows_agree(np.asarray(rows, float), stored, SAME * greatest).all()
                same = all(comm.allgather(bool(agree)))
            if not same:
                raise InputError(f"{path}: the mesh has changed: {name} is not what this run makes of it")


class RootFile:
    """A result file, open on rank 0, from which the ranks take their rows (all methods are collective)."""

    def __init__(self, comm: MPI.Comm, path: Path):
        """Open the file. Raises InputError where it is no result."""
        self._comm, self._path = comm, path
        self._file: h5py.File | None = None
        with together(comm):
            if comm.rank == 0:
                self._file = open_result(path)

    def __enter__(self) -> "RootFile":
        return self

    def __exit__(self, *_: object) -> None:
        if self._file is not None:
            self._file.close()

    def length(self, name: str) -> int | None:
        """Return the rows of a dataset; None if the file does not have it."""
        count: int | None = self.ask(lambda file: len(file[name]) if name in file else None)
        return count

    def rows(self, name: str, count: int, index: int | None = None) -> Array:
        """Return this rank's `count` rows of a dataset, or of its row `index`: (count, ...)."""
        counts: Sequence[int] = self._comm.allgather(count)
        dtype, shape = self.ask(lambda file: (file[name].dtype, file[name].shape[1 if index is None else 2 :]))
        own = np.empty((count, *shape), dtype)
        file: Any = self._file
        failure = scatter_rows(
            self._comm, own, counts, lambda part: file[name][part if index is None else (index, part)]
        )
        with together(self._comm):
            if failure is not None:
                raise InputError(f"{self._path} cannot be read: {failure}")
        return own

    def ask(self, question: Callable[[h5py.File], Any]) -> Any:
        """Return on every rank what rank 0 reads from the file."""
        answer = None
        with together(self._comm):
            if self._file is not None:
                try:
                    answer = question(self._file)
                except (OSError, KeyError) as error:
                    raise InputError(f"{self._path} is damaged: {error}") from None
        return self._comm.bcast(answer)
