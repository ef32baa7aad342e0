"""Valid cells (paper section 4.1): those that a triangle touches, and those that no flood reaches.

Everything is in cell units: cell (i, j, k) is the box [i, i+1) x [j, j+1) x [k, k+1). A cell owns
its low faces, so a face of the body that lies in a grid plane marks one layer of cells, not two.

The flood comes from outside, a column at a time: the boundary cells of a column (i, j) leave gaps
between them, and a gap as a whole is inside or outside. So memory follows the boundary, never the
bounding box. Each rank floods a slab of planes i; components that meet at a slab's face are joined
through one small graph of labels.
"""

from typing import NamedTuple

import numpy as np
from mpi4py import MPI
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from msmpetsc.backend.arrays import Array, Indices, Mask, Rows
from msmpetsc.backend.kernel import njit
from msmpetsc.comm import Route
from msmpetsc.geometry.grid import LIMIT, packed

SLACK = 1e-12  # of the largest coordinate: above the rounding of an interpolated one, below anything that matters
EXTERIOR = 0


@njit()
def grown(rows: Array, used: int) -> Array:
    """Return an array with the ``used`` first of these rows (r, n) and room for one more."""
    if used < len(rows):
        return rows
    larger = np.empty((2 * len(rows), rows.shape[1]), rows.dtype)
    larger[:used] = rows
    return larger


@njit()
def _clip(polygon: Rows, n: int, axis: int, plane: float, side: float, out: Rows) -> int:
    """Clip a polygon to side * (x[axis] - plane) >= 0 (Sutherland-Hodgman); return its size."""
    m = 0
    for a in range(n):
        p, q = polygon[a], polygon[(a + 1) % n]
        dp, dq = side * (p[axis] - plane), side * (q[axis] - plane)
        if dp >= 0:
            out[m] = p
            m += 1
        if (dp > 0 and dq < 0) or (dp < 0 and dq > 0):
            s = dp / (dp - dq)
            for c in range(3):
                # p + s (q - p) and not a weighted sum: equal coordinates stay exactly equal
                out[m, c] = p[c] + s * (q[c] - p[c])
            out[m, axis] = plane
            m += 1
    return m


@njit()
def clip_between(
    polygon: Rows, n: int, axis: int, planes: tuple[float, float], work: Rows, out: Rows
) -> int:
    """Clip a polygon to the layer between two planes of an axis; return its size."""
    m = _clip(polygon, n, axis, planes[0], 1.0, work)
    return _clip(work, m, axis, planes[1], -1.0, out)


@njit()
def extent(polygon: Rows, n: int, axis: int) -> tuple[float, float]:
    """Return the smallest and largest coordinate along an axis."""
    smallest, largest = polygon[0, axis], polygon[0, axis]
    for a in range(1, n):
        smallest = min(smallest, polygon[a, axis])
        largest = max(largest, polygon[a, axis])
    return smallest, largest


@njit()
def _slack(triangle: Rows, axis: int) -> float:
    """Return more than the rounding of a coordinate interpolated between a triangle's corners."""
    smallest, largest = extent(triangle, 3, axis)
    return SLACK * (1.0 + max(abs(smallest), abs(largest)))


@njit()
def _index_range(
    triangle: Rows, part: Rows, n: int, axis: int, limits: tuple[int, int], slack: float
) -> tuple[int, int]:
    """Return the first and last cell index that a part of a triangle reaches along an axis.

    Slack widens the part, whose points may be interpolated, but never past the triangle's own
    corners: those are exact, so a triangle that ends in a grid plane does not mark the layer behind.
    """
    smallest, largest = extent(part, n, axis)
    first, last = extent(triangle, 3, axis)
    smallest, largest = max(smallest - slack, first), min(largest + slack, last)
    return max(int(np.floor(smallest)), limits[0]), min(int(np.floor(largest)), limits[1] - 1)


@njit()
def touched_cells(corners: Rows, low: Indices, high: Indices) -> Indices:
    """Return every cell that a triangle touches: exact up to rounding, and conservative within it.

    corners   : (f, 3, 3) triangles in cell units
    low, high : (3,) int64, cells outside low..high-1 are left out
    returns   : (c, 3) int64, one row a touched (triangle, cell) pair, so cells repeat
    """
    cells = np.empty((4 * len(corners) + 16, 3), np.int64)
    used = 0
    rooms = np.empty((3, 12, 3))
    work, across, along = rooms[0], rooms[1], rooms[2]
    for triangle in corners:
        slack_j, slack_k = _slack(triangle, 1), _slack(triangle, 2)
        i0, i1 = _index_range(triangle, triangle, 3, 0, (low[0], high[0]), 0.0)
        for i in range(i0, i1 + 1):
            n = clip_between(
                triangle, 3, 0, (float(i), i + 1.0), work, across
            )  # never empty: corners are exact, so is i's range
            j0, j1 = _index_range(triangle, across, n, 1, (low[1], high[1]), slack_j)
            for j in range(j0, j1 + 1):
                m = clip_between(across, n, 1, (j - slack_j, j + 1 + slack_j), work, along)
                if m == 0:
                    continue
                k0, k1 = _index_range(triangle, along, m, 2, (low[2], high[2]), slack_k)
                for k in range(k0, k1 + 1):
                    cells = grown(cells, used)
                    cells[used, 0], cells[used, 1], cells[used, 2] = i, j, k
                    used += 1
    return cells[:used]


class Slab(NamedTuple):
    """The planes first <= i < last that a rank fills."""

    first: int
    last: int


def slab_edges(ranks: int, planes: int) -> Indices:
    """Return where the ranks' slabs begin and the last ends, (ranks + 1,); spare ranks have none."""
    used = min(ranks, planes)
    return planes * np.minimum(np.arange(ranks + 1), used) // used


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
    graph = coo_array(
        (np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(len(names), len(names))
    )
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
    columns = np.append(
        keys // LIMIT, -2 * LIMIT
    )  # the last is no column: that of a cell before all, or after
    below = columns[np.searchsorted(keys, first, side="right") - 1]
    above = columns[np.searchsorted(keys, last)]
    past = (below != first // LIMIT) | (above != first // LIMIT)
    touched = np.append(others + 1, np.full(past.sum(), EXTERIOR))
    return np.stack([np.append(np.repeat(asked, count), asked[past]) + 1, touched])
