"""Distribute distinct keys of cells or nodes over the ranks, in ascending order and equal parts.

This is the partition of a lattice: the keys follow a Morton curve, so each part is compact.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from msmpetsc.backend.arrays import Array, Indices
from msmpetsc.comm import Route, starts

if TYPE_CHECKING:
    from mpi4py import MPI

# keys sampled per rank to choose the splitters [-]; parts then differ by some percent
SAMPLES = 128


def places_of(keys: Indices, wanted: Indices) -> Indices:
    """Return the place (...,) of each wanted key in ascending ``keys``; -1 for a missing key."""
    if len(keys) == 0:
        return np.full(np.shape(wanted), -1)
    place = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    return np.where(keys[place] == wanted, place, -1)


def ranges(first: Indices, length: Indices) -> Indices:
    """Return the concatenated ranges first[i] .. first[i] + length[i] - 1."""
    begin = np.cumsum(length) - length
    return np.arange(length.sum()) - np.repeat(begin - first, length)


def rows_of(keys: Indices, wanted: Indices) -> Indices:
    """Return the rows of ascending ``keys`` (r,) that equal one of the wanted keys."""
    first = np.searchsorted(keys, wanted)
    return ranges(first, np.searchsorted(keys, wanted, side="right") - first)


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
        """Return the rank that owns each key, or would own a missing key."""
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
        """Return the row of each key (k,) of any rank; every key must exist (collective).

        rows : rows of this rank's keys, in the order of ``keys``
        """
        route = Route(self.comm, self.owner(keys))
        return route.answer(rows[self._index(route.send(keys)) - self.first])

    def with_ghosts(self, ghosts: Indices, rows: Array) -> Array:
        """Return this rank's rows (owned, ...) followed by the rows of ghosts (collective).

        ghosts : global indices (g,) of keys of other ranks
        rows   : on the CPU
        """
        to_owner = Route(self.comm, self.owner_of_index(ghosts))
        wanted = to_owner.send(ghosts) - self.first
        return np.concatenate([rows, to_owner.answer(rows[wanted])])

    def _index(self, keys: Indices) -> Indices:
        place = places_of(self.keys, keys)
        return np.where(place >= 0, self.first + place, -1)
