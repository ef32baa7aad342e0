"""Communication between ranks: shared errors, work on rank 0, exchange of rows."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from msmpetsc.backend.arrays import Array, Indices
from msmpetsc.errors import InputError, MsmpetscError, as_expected

if TYPE_CHECKING:
    from mpi4py import MPI
    from numpy.typing import ArrayLike

log = logging.getLogger("msmpetsc")

T = TypeVar("T")


@contextmanager
def together(comm: MPI.Comm) -> Iterator[None]:
    """Run a block; if it raises MsmpetscError or MemoryError, raise it on all ranks (collective).

    If several ranks fail, the error of the lowest rank is raised. The block must not contain a
    collective call, because a rank that fails would not reach it.
    """
    error = None
    try:
        yield
    except (MsmpetscError, MemoryError) as raised:
        error = as_expected(raised)
    if not reduced(comm, int(error is not None)):
        return
    for first in comm.allgather(error):
        if first is not None:
            first.on_all_ranks = True
            raise first


def refuse_unlike_ranks(comm: MPI.Comm, asked: Mapping[str, object]) -> None:
    """Raise InputError on all ranks if ranks ask for different things (collective).

    asked : what this rank asks for, by name; compared as text
    """
    texts = comm.allgather({name: repr(value) for name, value in asked.items()})
    unlike = [name for name in asked if len({text[name] for text in texts}) > 1]
    if unlike:
        error = InputError(f"{', '.join(unlike)}: all ranks must ask for the same")
        error.on_all_ranks = True
        raise error


def on_root(comm: MPI.Comm, function: Callable[[], T]) -> T | None:
    """Call a function on rank 0 only; return its value there, None elsewhere (collective).

    If the function raises an expected error, all ranks raise it.
    """
    value = None
    with together(comm):
        if comm.rank == 0:
            value = function()
    return value


def reduced(comm: MPI.Comm, values: ArrayLike, op: MPI.Op | None = None) -> Any:
    """Return the sums of numbers over all ranks, or another reduction (collective).

    ``comm.allreduce`` sends Python objects, which takes three times the time on one rank and four
    times the messages on several.

    values : a number or an array, of the same shape and type on all ranks
    """
    own = np.array(values, order="C")
    result = np.empty_like(own)
    comm.Allreduce(own, result, *(() if op is None else (op,)))
    return result if result.ndim else result.item()


class Stop:
    """The number of the signal that asks this process to stop; 0 if there is none.

    The number is a class attribute, because signals belong to the whole process.
    """

    signal = 0

    @classmethod
    def agreed(cls, comm: MPI.Comm) -> int:
        """Return the greatest signal number that any rank has received (collective)."""
        return max(comm.allgather(cls.signal)) if comm.size > 1 else cls.signal


class Route:
    """Exchange of rows by Alltoallv: send rows to other ranks, and answers back in the same order.

    destination : rank (n,) of each row
    """

    def __init__(self, comm: MPI.Comm, destination: Indices):
        self.comm = comm
        self.order = np.argsort(destination, kind="stable")
        self.sent = np.bincount(destination, minlength=comm.size).astype(np.int64)
        self.received = np.empty_like(self.sent)
        comm.Alltoall(self.sent, self.received)

    def send(self, rows: Array) -> Array:
        """Send rows; return the rows received from all ranks, ordered by the sender's rank."""
        return self._alltoall(np.asarray(rows)[self.order], self.sent, self.received)

    def answer(self, rows: Array) -> Array:
        """Send answers to the rows that ``send`` returned; return the answers to this rank's rows.

        The answers are in the order of the rows given to ``send``.
        """
        received = self._alltoall(np.asarray(rows), self.received, self.sent)
        answers = np.empty_like(received)
        answers[self.order] = received
        return answers

    def _alltoall(self, rows: Array, out_counts: Indices, in_counts: Indices) -> Array:
        # imported here, as an installation that only draws results has no mpi4py
        from mpi4py import MPI

        rows = np.ascontiguousarray(rows)
        result = np.empty((int(in_counts.sum()), *rows.shape[1:]), rows.dtype)
        row = MPI.BYTE.Create_contiguous(
            rows.dtype.itemsize * int(np.prod(rows.shape[1:], dtype=np.int64))
        ).Commit()
        try:
            self.comm.Alltoallv(
                [rows, out_counts, starts(out_counts), row],
                [result, in_counts, starts(in_counts), row],
            )
        finally:
            row.Free()
        return result


def starts(counts: Indices) -> Indices:
    """Return the exclusive prefix sum of counts: the first index of each part."""
    return (np.cumsum(counts) - counts).astype(np.int64)
