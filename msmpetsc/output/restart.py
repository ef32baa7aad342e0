"""A result file whose run is to go on: what it says of itself, its last checkpoint, whether a lattice is its own."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

from msmpetsc.comm import together
from msmpetsc.errors import InputError
from msmpetsc.model.checkpoint import Checkpoint
from msmpetsc.output.reader import (
    Result,
    checked_checkpoint,
    checked_dataset,
    damage_told,
    finished,
    open_result,
)
from msmpetsc.output.writer import SERIES, pieces

SAME = 1e-9  # of the greatest: sums over cells go another way on another number of ranks


@dataclass(frozen=True)
class Earlier:
    """texts: its attributes that are text; true_error: every so many steps it was measured, 0 for never; step: of its
    last checkpoint, 0 if it has none; finished, planned: frames that are there, and have their place; exact: whether a
    checkpoint has all that a run goes on from."""

    path: Path
    texts: dict[str, str]
    true_error: int
    step: int
    finished: int
    planned: int
    exact: bool

    @classmethod
    def look(cls, path: Path) -> "Earlier":
        """For one rank. Raises InputError for what is no result, or a damaged one."""
        with Result(path) as result:  # which checks it
            texts = {name: value for name, value in result.attributes.items() if isinstance(value, str)}
            true_error = result.attributes.get("true_error")
        with open_result(path) as file:
            names = checked_checkpoint(file)
            refuse_other_series(path, file)
            count, planned = finished(file), len(file["frames/time"])
            step = max(0, int(np.max(file["checkpoint/step"]))) if names is not None and count else 0
        true_error = true_error if isinstance(true_error, int) and true_error > 0 else 0
        return cls(path, texts, true_error, step, count, planned, bool(names))


def refuse_other_series(path: Path, file: h5py.File) -> None:
    """Raise InputError where the numbers of frames are not stored as a run stores them; an older one may lack some."""
    with damage_told(path):
        for name, (dtype, shape, _) in SERIES.items():
            if name in list(file["frames"]):
                dataset = checked_dataset(path, file, f"frames/{name}")
                if dataset.dtype != dtype or dataset.shape[1:] != shape:
                    raise InputError(f"{path} is damaged: frames/{name} has shape {dataset.shape}")


def read_saved(comm, path: Path, owned: int) -> Checkpoint | None:
    """The last checkpoint, this rank's rows of it; None if there is none (collective).

    owned : nodes of this rank; the ranks' follow each other
    """
    with Source(comm, path) as source:
        steps = source.value("checkpoint/step")
        if steps is None or max(steps) < 0:
            return None
        slot = int(np.argmax(steps))
        rows = {name: source.rows(f"checkpoint/{name}", owned, slot) for name in source.row_names()}
        names, numbers = source.names(), source.value("checkpoint/numbers")
        numbers = numbers[slot].tolist() if names else []
        return Checkpoint(int(steps[slot]), rows, dict(zip(names, numbers, strict=True)))


def refuse_other_lattice(comm, path: Path, found: dict[str, np.ndarray]) -> None:
    """Raises InputError where ``found``, the ranks' rows by dataset, is not what the file has (collective)."""
    with Source(comm, path) as source:
        for name, rows in found.items():
            there, here = source.value(name, "shape"), comm.allreduce(len(rows))
            if there is None:
                continue
            same = there[0] == here
            if same:
                rows, stored = np.asarray(rows, float), source.rows(name, len(rows)).astype(float)
                greatest = max(comm.allgather(np.abs(stored).max(initial=0)))
                same = all(comm.allgather(bool(np.abs(rows - stored).max(initial=0) <= SAME * greatest)))
            if not same:
                raise InputError(f"{path}: the mesh has changed: {name} is not what this run makes of it")


class Source:
    """A result file, open on rank 0, from which the ranks take their rows (all methods are collective)."""

    def __init__(self, comm, path: Path):
        self._comm, self._path, self._file = comm, path, None
        with together(comm):
            if comm.rank == 0:
                self._file = open_result(path)

    def __enter__(self) -> "Source":
        return self

    def __exit__(self, *_) -> None:
        if self._file is not None:
            self._file.close()

    def value(self, name: str, part: str | None = None) -> np.ndarray | tuple | None:
        """A small dataset, or its "shape"; None if it is not there."""
        return self._asked(lambda file: None if name not in file else file[name].shape if part else file[name][...])

    def names(self) -> list[str]:
        """Of the checkpoint's numbers."""
        return self._asked(checked_checkpoint) or []

    def row_names(self) -> list[str]:
        """Of what the checkpoint has of each node."""
        return self._asked(lambda file: [name for name in file["checkpoint"] if name not in ("step", "numbers")])

    def rows(self, name: str, count: int, index: int | None = None) -> np.ndarray:
        """This rank's ``count`` rows of a dataset, or of its ``index``."""
        counts = self._comm.allgather(count)
        dtype, shape = self._asked(lambda file: (file[name].dtype, file[name].shape[1 if index is None else 2 :]))
        own, failure = np.empty((count, *shape), dtype), None
        if self._comm.rank > 0:
            for part in pieces(own, count):
                self._comm.Recv(own[part], source=0)
        else:
            failure = self._send(self._file[name], counts, index, own)
        with together(self._comm):
            if failure is not None:
                raise InputError(f"{self._path} cannot be read: {failure}")
        return own

    def _send(
        self, dataset: h5py.Dataset, counts: Sequence[int], index: int | None, own: np.ndarray
    ) -> Exception | None:
        """Rank 0's part of ``rows``; what could not be read."""
        start, failure = 0, None
        for rank, count in enumerate(counts):
            for part in pieces(own, count):
                place = slice(start + part.start, start + part.stop)
                piece = np.zeros((part.stop - part.start, *own.shape[1:]), own.dtype)
                try:
                    piece[...] = dataset[place if index is None else (index, place)]
                except (OSError, ValueError) as error:
                    failure = error  # the others still wait
                if rank > 0:
                    self._comm.Send(piece, dest=rank)
                else:
                    own[part] = piece
            start += count
        return failure

    def _asked(self, question):
        """What rank 0 finds in the file."""
        answer = None
        with together(self._comm):
            if self._file is not None:
                try:
                    answer = question(self._file)
                except (OSError, KeyError) as error:
                    raise InputError(f"{self._path} is damaged: {error}") from None
        return self._comm.bcast(answer)
