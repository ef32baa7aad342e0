"""Ranks together: what rank 0 reads all know, what fails on any fails on all, rows go to owners."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from msmpetsc.backend.arrays import Array, Indices
from msmpetsc.errors import MsmpetscError, as_expected

if TYPE_CHECKING:
    from mpi4py import MPI

log = logging.getLogger("msmpetsc")  # the command line lets rank 0 alone speak

T = TypeVar("T")


@contextmanager
def together(comm: MPI.Comm) -> Iterator[None]:
    """Raise on all ranks the first rank's MsmpetscError, or lack of memory, if any (collective).

    Nothing collective may stand in the block: a rank that fails leaves it early.
    """
    error = None
    try:
        yield
    except (MsmpetscError, MemoryError) as raised:
        error = as_expected(raised)
    for first in comm.allgather(error):
        if first is not None:
            first.on_all_ranks = True
            raise first


def on_root(comm: MPI.Comm, function: Callable[[], T]) -> T | None:
    """Call a function on rank 0 only; its error is everyone's. Returns None elsewhere."""
    value = None
    with together(comm):
        if comm.rank == 0:
            value = function()
    return value


class Stop:
    """The signal that asks this process to stop, 0 while none does: signals are a process's own, so there is one."""

    signal = 0

    @classmethod
    def agreed(cls, comm: MPI.Comm) -> int:
        """Return the greatest that any rank has got (collective)."""
        return max(comm.allgather(cls.signal)) if comm.size > 1 else cls.signal


class Route:
    """A way of rows to the ranks named for them (Alltoallv), and of answers back in their order.

    destination : (n,) rank of each row
    """

    def __init__(self, comm: MPI.Comm, destination: Indices):
        self.comm = comm
        self.order = np.argsort(destination, kind="stable")
        self.sent = np.bincount(destination, minlength=comm.size).astype(np.int64)
        self.received = np.empty_like(self.sent)
        comm.Alltoall(self.sent, self.received)

    def send(self, rows: Array) -> Array:
        """Send rows; return those that all ranks sent to this one, by rank and then in its order."""
        return self._alltoall(np.asarray(rows)[self.order], self.sent, self.received)

    def answer(self, rows: Array) -> Array:
        """Send answers to the rows that ``send`` returned; return those to this rank's own rows, in their order."""
        back = self._alltoall(np.asarray(rows), self.received, self.sent)
        answers = np.empty_like(back)
        answers[self.order] = back
        return answers

    def _alltoall(self, rows: Array, out_counts: Indices, in_counts: Indices) -> Array:
        from mpi4py import MPI  # late: what draws results has none

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
    """Return where each part begins when parts of these sizes follow each other."""
    return (np.cumsum(counts) - counts).astype(np.int64)


SAMPLES = 128  # a rank: keeps the ranks' parts within some percent of each other


class SortedKeys:
    """Distinct int64 keys in ascending order over all ranks; a key's position is its global index.

    So the numbering does not depend on the number of ranks, and each rank owns one contiguous
    range of it. Collective to build and to ask.

    keys  : (n_local,) those of this rank, ascending
    first : global index of ``keys[0]``
    total : number of keys on all ranks
    """

    def __init__(self, comm: MPI.Comm, keys: Indices):
        self.comm = comm
        keys = np.unique(np.asarray(keys, np.int64))
        step = max(1, comm.allreduce(len(keys)) // (comm.size * SAMPLES))
        sample = np.sort(np.concatenate(comm.allgather(keys[step // 2 :: step])))
        # the keys at which the next rank's part begins: at equal steps of all ranks' samples
        self.splitters = (
            sample[np.arange(1, comm.size) * len(sample) // comm.size] if len(sample) else sample
        )
        route = Route(comm, self.owner(keys))
        self.keys = np.unique(route.send(keys))
        counts = np.array(comm.allgather(len(self.keys)), np.int64)
        self.first_of_rank = starts(counts)
        self.first = int(self.first_of_rank[comm.rank])
        self.total = int(counts.sum())

    def owner(self, keys: Indices) -> Indices:
        """Return the rank that holds each key, or would hold it."""
        return np.searchsorted(self.splitters, keys, side="right")

    def owner_of_index(self, index: Indices) -> Indices:
        """Return the rank that holds each global index."""
        last_start = np.append(self.first_of_rank[1:], self.total)
        return np.searchsorted(last_start, index, side="right")

    def find(self, keys: Indices) -> Indices:
        """Return the global index of each key, -1 where there is none (any shape; collective)."""
        wanted, inverse = np.unique(np.asarray(keys, np.int64), return_inverse=True)
        route = Route(self.comm, self.owner(wanted))
        index = route.answer(self._index(route.send(wanted)))
        return index[inverse].reshape(np.shape(keys))

    def rows_of(self, keys: Indices, rows: Array) -> Array:
        """Return the row of each key (k,), all of which there are; ``rows`` go with this rank's keys (collective)."""
        route = Route(self.comm, self.owner(keys))
        return route.answer(rows[self._index(route.send(keys)) - self.first])

    def _index(self, keys: Indices) -> Indices:
        if len(self.keys) == 0:
            return np.full(len(keys), -1, np.int64)
        slot = np.minimum(np.searchsorted(self.keys, keys), len(self.keys) - 1)
        return np.where(self.keys[slot] == keys, self.first + slot, -1)
