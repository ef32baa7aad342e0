"""Communication between ranks: shared errors, work on rank 0, rows sent to the owners of keys."""

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

log = logging.getLogger("msmpetsc")

T = TypeVar("T")


@contextmanager
def together(comm: MPI.Comm) -> Iterator[None]:
    """Raise on all ranks the first rank's MsmpetscError or MemoryError, if any (collective).

    The block may contain no collective call, as a rank that fails leaves it early.
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
    """Return the value of a function called on rank 0 only, None elsewhere (collective).

    If the function raises an expected error, all ranks raise it.
    """
    value = None
    with together(comm):
        if comm.rank == 0:
            value = function()
    return value


class Stop:
    """The signal that asks this process to stop; 0 if there is none.

    The number is a class attribute, as signals belong to the whole process.
    """

    signal = 0

    @classmethod
    def agreed(cls, comm: MPI.Comm) -> int:
        """Return the greatest signal number that any rank has received (collective)."""
        return max(comm.allgather(cls.signal)) if comm.size > 1 else cls.signal


class Route:
    """Rows sent to their destination ranks by Alltoallv, and answers sent back in the same order.

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


def places_of(keys: Indices, wanted: Indices) -> Indices:
    """Return the place (...,) of each wanted key in ascending keys, -1 if it is not there."""
    if len(keys) == 0:
        return np.full(np.shape(wanted), -1)
    place = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    return np.where(keys[place] == wanted, place, -1)


# keys sampled on each rank to choose the splitters; parts then differ by some percent
SAMPLES = 128


class SortedKeys:
    """Distinct int64 keys sorted over all ranks; a key's position is its global index.

    The numbering does not depend on the number of ranks, and each rank owns a contiguous range
    of it. Construction and ``find`` are collective.

    keys  : this rank's keys (n_local,), ascending
    first : global index of ``keys[0]``
    total : number of keys on all ranks
    """

    def __init__(self, comm: MPI.Comm, keys: Indices):
        self.comm = comm
        keys = np.unique(np.asarray(keys, np.int64))
        step = max(1, comm.allreduce(len(keys)) // (comm.size * SAMPLES))
        sample = np.sort(np.concatenate(comm.allgather(keys[step // 2 :: step])))
        # first key of each rank but rank 0, at equal steps of the sorted sample
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
        """Return the rank that owns each key, or would own it."""
        return np.searchsorted(self.splitters, keys, side="right")

    def owner_of_index(self, index: Indices) -> Indices:
        """Return the rank that owns each global index."""
        last_start = np.append(self.first_of_rank[1:], self.total)
        return np.searchsorted(last_start, index, side="right")

    def find(self, keys: Indices) -> Indices:
        """Return the global index of each key, -1 for an unknown key (any shape; collective)."""
        distinct, inverse = np.unique(np.asarray(keys, np.int64), return_inverse=True)
        route = Route(self.comm, self.owner(distinct))
        index = route.answer(self._index(route.send(distinct)))
        return index[inverse].reshape(np.shape(keys))

    def rows_of(self, keys: Indices, rows: Array) -> Array:
        """Return the row of each key (k,); every key must exist (collective).

        rows : of this rank's keys, in their order
        """
        route = Route(self.comm, self.owner(keys))
        return route.answer(rows[self._index(route.send(keys)) - self.first])

    def with_ghosts(self, ghosts: Indices, rows: Array) -> Array:
        """Return rows (owned + g, ...) from rows (owned, ...) on the CPU (collective).

        ghosts : indices (g,) of keys of other ranks, whose rows follow this rank's own
        """
        to_owner = Route(self.comm, self.owner_of_index(ghosts))
        wanted = to_owner.send(ghosts) - self.first
        return np.concatenate([rows, to_owner.answer(rows[wanted])])

    def _index(self, keys: Indices) -> Indices:
        place = places_of(self.keys, keys)
        return np.where(place >= 0, self.first + place, -1)
