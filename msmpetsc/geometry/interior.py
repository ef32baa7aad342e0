"""Interior cells, which a flood fill from outside does not reach.

Cells are handled a column at a time: the boundary cells of a column (i, j) leave gaps of cells
between them, and a gap as a whole is inside or outside. So memory follows the boundary, never the
bounding box. Each rank floods a slab of planes i; components that meet at a slab's face are joined
through one small graph of labels.
"""

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from msmpetsc.backend.arrays import Indices, Mask
from msmpetsc.comm import Route
from msmpetsc.geometry.grid import LIMIT, packed

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
    halo = _to_previous(comm, boundary[boundary[:, 0] == slab.first])
    gaps, label = _flood(np.concatenate([boundary, halo]), slab)
    own = gaps[:, 0] < slab.last
    enclosed: Mask = own & (_join(comm, gaps, label, own, slab) != EXTERIOR)
    return gaps[enclosed]


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


def _join(comm: MPI.Comm, gaps: Indices, label: Indices, own: Mask, slab: Slab) -> Indices:
    """Return global labels, equal where components of neighbouring slabs are connected."""
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


def _flood(cells: Indices, slab: Slab) -> tuple[Indices, Indices]:
    """Return gaps (g, 4) and their labels (g,): EXTERIOR, or the number of a component.

    Planes first..last-1 are owned, plane ``last`` may be given as a halo: its own neighbours beyond
    it are its owner's business.
    """
    gaps = _gaps(cells)
    plane, owned = gaps[:, 0], gaps[:, 0] < slab.last
    before = (plane > slab.first) | (slab.first == 0)
    sides = (([0, -1], owned), ([0, 1], owned), ([1, 0], owned), ([-1, 0], before))
    links = [_links(cells, gaps, np.flatnonzero(asked), np.array(side)) for side, asked in sides]
    ends = np.concatenate(links, axis=1)
    graph = coo_array((np.ones(ends.shape[1]), ends), shape=(len(gaps) + 1, len(gaps) + 1))
    component = connected_components(graph, directed=False)[1]
    return gaps, np.where(component == component[EXTERIOR], EXTERIOR, component + 1)[1:]


def _gaps(cells: Indices) -> Indices:
    """Return the gaps (i, j, k first, k last) between sorted cells (c, 3) of one column, (g, 4)."""
    low, high = cells[:-1], cells[1:]
    parted = (low[:, :2] == high[:, :2]).all(axis=1) & (high[:, 2] - low[:, 2] > 1)
    return np.column_stack([low[parted, :2], low[parted, 2] + 1, high[parted, 2] - 1])


def _links(cells: Indices, gaps: Indices, asked: Indices, side: Indices) -> Indices:
    """Return the pairs (2, p) of each gap asked for and those that touch it in the column to one side.

    Gap g is node g + 1 of the graph. A gap that reaches past the column's cells touches EXTERIOR.
    """
    column = gaps[asked, :2] + side
    first, last = (packed(np.column_stack([column, gaps[asked, end]])) for end in (2, 3))
    begins, ends = (packed(gaps[:, [0, 1, end]]) for end in (2, 3))
    low = np.searchsorted(ends, first)
    count = np.searchsorted(begins, last, side="right") - low
    others = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count - low, count)
    keys = packed(cells)
    columns = np.append(keys // LIMIT, -2 * LIMIT)  # the last is no column: that of a cell before all, or after
    below = columns[np.searchsorted(keys, first, side="right") - 1]
    above = columns[np.searchsorted(keys, last)]
    past = (below != first // LIMIT) | (above != first // LIMIT)
    touched = np.append(others + 1, np.full(past.sum(), EXTERIOR))
    return np.stack([np.append(np.repeat(asked, count), asked[past]) + 1, touched])
