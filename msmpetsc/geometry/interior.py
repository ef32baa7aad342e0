"""Interior cells: what an exterior flood fill through the gaps between boundary cells does not reach.

Cells are handled a column at a time: the boundary cells of a column (i, j) leave gaps of cells
between them, and a gap as a whole is inside or outside. So memory follows the boundary, never the
bounding box. Each rank floods a slab of planes i; components that meet at a slab's face are joined
through one small graph of labels.
"""

from dataclasses import dataclass

import numba
import numpy as np
from mpi4py import MPI
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from msmpetsc.backend.arrays import Indices, Mask
from msmpetsc.comm import Route

EXTERIOR = 0


@dataclass(frozen=True)
class Slab:
    """The planes first <= i < last that a rank fills, of ``planes`` in all; empty on spare ranks."""

    first: int
    last: int
    planes: int

    @classmethod
    def of_rank(cls, rank: int, size: int, planes: int) -> "Slab":
        """Return the slab of a rank among ``size`` of them."""
        used = min(size, planes)
        return cls(planes * min(rank, used) // used, planes * min(rank + 1, used) // used, planes)

    @staticmethod
    def owner(plane: Indices, size: int, planes: int) -> Indices:
        """Return the rank whose slab holds each plane."""
        used = min(size, planes)
        edges = planes * np.arange(1, used, dtype=np.int64) // used
        return np.searchsorted(edges, plane, side="right")


def enclosed_gaps(comm: MPI.Comm, boundary: Indices, slab: Slab) -> Indices:
    """Return the gaps that no path of face neighbours joins with the outside (collective).

    boundary : (b, 3) int64 distinct boundary cells of this rank's slab, in lexicographic order
    returns  : (g, 4) int64 rows (i, j, k first, k last) of this slab
    """
    halo = _next_plane(comm, boundary, slab)
    cells = np.concatenate([boundary, halo])
    gaps, label = _flood(cells, slab.first, slab.last, slab.first == 0)
    own = gaps[:, 0] < slab.last
    label = _join(comm, gaps, label, own, slab)
    return gaps[own][label[own] != EXTERIOR]


def cells_of_gaps(gaps: Indices) -> Indices:
    """Return the cells of gaps (i, j, k first, k last), (c, 3) int64."""
    length = gaps[:, 3] - gaps[:, 2] + 1
    cells = np.repeat(gaps[:, :3], length, axis=0)
    cells[:, 2] += np.arange(len(cells)) - np.repeat(np.cumsum(length) - length, length)
    return cells


def _to_previous(comm: MPI.Comm, rows: Indices) -> Indices:
    """Send rows to the rank before this one; rank 0 has none and sends nothing."""
    rows = rows if comm.rank > 0 else rows[:0]
    return Route(comm, np.full(len(rows), comm.rank - 1)).send(rows)


def _next_plane(comm: MPI.Comm, boundary: Indices, slab: Slab) -> Indices:
    return _to_previous(comm, boundary[boundary[:, 0] == slab.first])


def _join(comm: MPI.Comm, gaps: Indices, label: Indices, own: Mask, slab: Slab) -> Indices:
    """Return the labels made global and equal wherever components of neighbouring slabs are one."""
    count = int(label.max(initial=EXTERIOR))
    offset = comm.exscan(count) or 0  # type: ignore[attr-defined]  # an intracommunicator
    label = np.where(label == EXTERIOR, EXTERIOR, label + offset)
    theirs = _to_previous(comm, label[own & (gaps[:, 0] == slab.first)])
    pairs = np.unique(np.stack([label[~own], theirs], axis=1), axis=0)
    pairs = np.concatenate(comm.allgather(pairs))
    names, ends = np.unique(np.append(pairs, [EXTERIOR]), return_inverse=True)
    ends = ends[:-1].reshape(-1, 2)
    graph = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(len(names), len(names)))
    component = connected_components(graph, directed=False)[1]
    outside = names[component == component[0]]  # names[0] is EXTERIOR
    return np.where(np.isin(label, outside), EXTERIOR, label)


@numba.njit(cache=True)
def _root(parent, a):
    while parent[a] != a:
        parent[a] = parent[parent[a]]
        a = parent[a]
    return a


@numba.njit(cache=True)
def _union(parent, a, b):
    a, b = _root(parent, a), _root(parent, b)
    parent[max(a, b)] = min(a, b)  # so that EXTERIOR, the smallest, stays a root


@numba.njit(cache=True)
def _columns(cells):
    """Return where each column (i, j) starts in the sorted cells, with the end appended."""
    start = np.empty(len(cells) + 1, np.int64)
    n = 0
    for c in range(len(cells)):
        if c == 0 or cells[c, 0] != cells[c - 1, 0] or cells[c, 1] != cells[c - 1, 1]:
            start[n] = c
            n += 1
    start[n] = len(cells)
    return start[: n + 1]


@numba.njit(cache=True)
def _gaps(cells, start):
    """Return all gaps (i, j, k first, k last), and where those of each column begin."""
    gaps = np.empty((len(cells), 4), np.int64)
    begin = np.zeros(len(start), np.int64)
    n = 0
    for c in range(len(start) - 1):
        begin[c] = n
        for a in range(start[c], start[c + 1] - 1):
            if cells[a + 1, 2] - cells[a, 2] > 1:
                gaps[n, 0], gaps[n, 1] = cells[a, 0], cells[a, 1]
                gaps[n, 2], gaps[n, 3] = cells[a, 2] + 1, cells[a + 1, 2] - 1
                n += 1
    begin[len(start) - 1] = n
    return gaps[:n], begin


@numba.njit(cache=True)
def _find_column(cells, start, i, j):
    """Return the number of the column (i, j), -1 where it has no boundary cell."""
    low, high = 0, len(start) - 1
    while low < high:
        middle = (low + high) // 2
        ci, cj = cells[start[middle], 0], cells[start[middle], 1]
        if ci < i or (ci == i and cj < j):
            low = middle + 1
        else:
            high = middle
    if low < len(start) - 1 and cells[start[low], 0] == i and cells[start[low], 1] == j:
        return low
    return -1


@numba.njit(cache=True)
def _meet(parent, gaps, begin, cells, start, column, neighbour):
    """Join the gaps of a column with what touches them in the column ``neighbour``."""
    for g in range(begin[column], begin[column + 1]):
        if neighbour < 0:
            _union(parent, EXTERIOR, g + 1)
            continue
        if gaps[g, 2] < cells[start[neighbour], 2] or gaps[g, 3] > cells[start[neighbour + 1] - 1, 2]:
            _union(parent, EXTERIOR, g + 1)
        for h in range(begin[neighbour], begin[neighbour + 1]):
            if gaps[h, 2] <= gaps[g, 3] and gaps[h, 3] >= gaps[g, 2]:
                _union(parent, g + 1, h + 1)


@numba.njit(cache=True)
def _flood(cells, first, last, lowest):
    """Return gaps and their labels: EXTERIOR, or 1, 2, ... a component.

    Planes first..last-1 are owned, plane ``last`` may be given as a halo: its own neighbours beyond it are its
    owner's business.
    """
    start = _columns(cells)
    gaps, begin = _gaps(cells, start)
    parent = np.arange(len(gaps) + 1)
    for column in range(len(start) - 1):
        i, j = cells[start[column], 0], cells[start[column], 1]
        for step in (-1, 1):
            owned = i < last
            if owned:
                _meet(parent, gaps, begin, cells, start, column, _find_column(cells, start, i, j + step))
            if (step == 1 and owned) or (step == -1 and (i > first or lowest)):
                _meet(parent, gaps, begin, cells, start, column, _find_column(cells, start, i + step, j))
    label = np.empty(len(gaps), np.int64)
    name = np.zeros(len(gaps) + 1, np.int64)
    names = 0
    for g in range(len(gaps)):
        root = _root(parent, g + 1)
        if root != EXTERIOR and name[root] == 0:
            names += 1
            name[root] = names
        label[g] = name[root]
    return gaps, label
