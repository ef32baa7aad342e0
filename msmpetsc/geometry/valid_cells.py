"""Find the valid cells (paper section 4.1): cells that triangles touch, and cells enclosed by them.

Everything is in cell units: cell (i, j, k) is the box [i, i+1) x [j, j+1) x [k, k+1). A cell owns
its low faces, so a face of the body in a grid plane marks a single layer of cells.

A flood from outside finds the enclosed cells. The boundary cells of a column (i, j) leave gaps
between them, and each gap is inside or outside as a whole. So the memory follows the boundary, not
the bounding box. Each rank floods a slab of planes i. A small graph of labels joins the components
that meet at the face between slabs.
"""

from typing import NamedTuple

import numpy as np
from mpi4py import MPI
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from msmpetsc.backend.arrays import Array, Indices, Mask, Rows
from msmpetsc.backend.kernel import njit
from msmpetsc.comm import Route
from msmpetsc.geometry.grid import PACK, packed
from msmpetsc.geometry.morton import LIMIT

# rounding of an interpolated coordinate, relative to the largest [-]; an upper bound
ROUNDING = 1e-12
# label of the outside
EXTERIOR = 0


@njit()
def grown(rows: Array, used: int) -> Array:
    """Return the ``used`` first of these rows (r, n) in an array with room for another row."""
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
                # not a weighted sum, so that equal coordinates stay exactly equal
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
    """Return the smallest and largest coordinate of a polygon along an axis."""
    smallest, largest = polygon[0, axis], polygon[0, axis]
    for a in range(1, n):
        smallest = min(smallest, polygon[a, axis])
        largest = max(largest, polygon[a, axis])
    return smallest, largest


@njit()
def _rounding_bound(triangle: Rows, axis: int) -> float:
    """Return an upper bound for the rounding of a coordinate interpolated on a triangle."""
    smallest, largest = extent(triangle, 3, axis)
    return ROUNDING * (1.0 + max(abs(smallest), abs(largest)))


@njit()
def _index_range(
    triangle: Rows, part: Rows, n: int, axis: int, limits: tuple[int, int], margin: float
) -> tuple[int, int]:
    """Return the first and last cell index of a part of a triangle along an axis.

    ``margin`` widens the part, whose points may be interpolated, up to the triangle's own corners.
    The corners are exact, so a triangle that ends in a grid plane does not mark the next layer.
    """
    smallest, largest = extent(part, n, axis)
    first, last = extent(triangle, 3, axis)
    smallest, largest = max(smallest - margin, first), min(largest + margin, last)
    return max(int(np.floor(smallest)), limits[0]), min(int(np.floor(largest)), limits[1] - 1)


@njit()
def touched_cells(corners: Rows, low: Indices, high: Indices) -> tuple[Indices, Indices]:
    """Return all cells that triangles touch; cells within rounding of a triangle may be added.

    corners   : (f, 3, 3) triangles in cell units
    low, high : (3,) int64, limits low <= cell < high
    returns   : keys (c,) of cells (grid.packed) and numbers (c,) of triangles, for each triangle
                and cell that touch
    """
    touching = np.empty((4 * len(corners) + 16, 2), np.int64)
    used = 0
    buffers = np.empty((3, 12, 3))
    work, across, along = buffers[0], buffers[1], buffers[2]
    for number, triangle in enumerate(corners):
        margin_j, margin_k = _rounding_bound(triangle, 1), _rounding_bound(triangle, 2)
        i0, i1 = _index_range(triangle, triangle, 3, 0, (low[0], high[0]), 0.0)
        for i in range(i0, i1 + 1):
            # never empty: the corners are exact, so the range of i is exact too
            n = clip_between(triangle, 3, 0, (float(i), i + 1.0), work, across)
            j0, j1 = _index_range(triangle, across, n, 1, (low[1], high[1]), margin_j)
            for j in range(j0, j1 + 1):
                m = clip_between(across, n, 1, (j - margin_j, j + 1 + margin_j), work, along)
                if m == 0:
                    continue
                k0, k1 = _index_range(triangle, along, m, 2, (low[2], high[2]), margin_k)
                for k in range(k0, k1 + 1):
                    touching = grown(touching, used)
                    touching[used, 0] = i * PACK[0] + j * PACK[1] + k * PACK[2]
                    touching[used, 1] = number
                    used += 1
    return touching[:used, 0].copy(), touching[:used, 1].copy()


class Slab(NamedTuple):
    """The planes first <= i < last of a rank."""

    first: int
    last: int


def slab_edges(ranks: int, planes: int) -> Indices:
    """Return the first plane of each rank's slab and the end of the last slab, (ranks + 1,).

    If there are more ranks than planes, the last ranks have no planes.
    """
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
    """Return the cells (c, 3) int64 of gaps (i, j, k first, k last)."""
    length = gaps[:, 3] - gaps[:, 2] + 1
    cells = np.repeat(gaps[:, :3], length, axis=0)
    cells[:, 2] += np.arange(len(cells)) - np.repeat(np.cumsum(length) - length, length)
    return cells


def _to_previous(comm: MPI.Comm, rows: Indices) -> Indices:
    """Send rows to the rank before this rank; rank 0 sends nothing (collective)."""
    rows = rows if comm.rank > 0 else rows[:0]
    return Route(comm, np.full(len(rows), comm.rank - 1)).send(rows)


def _join(comm: MPI.Comm, gaps: Indices, label: Indices, own: Mask, slab: Slab) -> Indices:
    """Return global labels: equal for connected components of different slabs (collective)."""
    count = int(label.max(initial=EXTERIOR))
    offset = comm.exscan(count) or 0  # type: ignore[attr-defined]  # an intracommunicator
    label = np.where(label == EXTERIOR, EXTERIOR, label + offset)
    labels_beyond = _to_previous(comm, label[own & (gaps[:, 0] == slab.first)])
    pairs = np.unique(np.stack([label[~own], labels_beyond], axis=1), axis=0)
    pairs = np.concatenate(comm.allgather(pairs))
    names, ends = np.unique(np.append(pairs, [EXTERIOR]), return_inverse=True)
    ends = ends[:-1].reshape(-1, 2)
    graph = coo_array(
        (np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(len(names), len(names))
    )
    component = connected_components(graph, directed=False)[1]
    # names[0] is EXTERIOR
    outside = names[component == component[0]]
    return np.where(np.isin(label, outside), EXTERIOR, label)


def _flood(cells: Indices, slab: Slab) -> tuple[Indices, Indices]:
    """Return gaps (g, 4) and their labels (g,): EXTERIOR, or the number of a component.

    Planes first..last-1 belong to this rank. Plane ``last`` may be given as a halo; the rank that
    owns it handles its neighbours beyond.
    """
    gaps = _gaps(cells)
    plane, owned = gaps[:, 0], gaps[:, 0] < slab.last
    before = (plane > slab.first) | (slab.first == 0)
    sides = (([0, -1], owned), ([0, 1], owned), ([1, 0], owned), ([-1, 0], before))
    links = [_links(cells, gaps, np.flatnonzero(chosen), np.array(side)) for side, chosen in sides]
    ends = np.concatenate(links, axis=1)
    graph = coo_array((np.ones(ends.shape[1]), ends), shape=(len(gaps) + 1, len(gaps) + 1))
    component = connected_components(graph, directed=False)[1]
    return gaps, np.where(component == component[EXTERIOR], EXTERIOR, component + 1)[1:]


def _gaps(cells: Indices) -> Indices:
    """Return the gaps (g, 4) between sorted cells (c, 3) of the same column."""
    low, high = cells[:-1], cells[1:]
    has_gap = (low[:, :2] == high[:, :2]).all(axis=1) & (high[:, 2] - low[:, 2] > 1)
    return np.column_stack([low[has_gap, :2], low[has_gap, 2] + 1, high[has_gap, 2] - 1])


def _links(cells: Indices, gaps: Indices, chosen: Indices, side: Indices) -> Indices:
    """Return pairs (2, p) of a chosen gap and a gap that touches it in the column to one side.

    Gap g is node g + 1 of the graph. A gap that extends past the column's cells touches EXTERIOR.
    """
    column = gaps[chosen, :2] + side
    first, last = (packed(np.column_stack([column, gaps[chosen, end]])) for end in (2, 3))
    begins, ends = (packed(gaps[:, [0, 1, end]]) for end in (2, 3))
    low = np.searchsorted(ends, first)
    count = np.searchsorted(begins, last, side="right") - low
    neighbours = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count - low, count)
    keys = packed(cells)
    # a last, empty column, for gaps before or after all cells
    columns = np.append(keys // LIMIT, -2 * LIMIT)
    below = columns[np.searchsorted(keys, first, side="right") - 1]
    above = columns[np.searchsorted(keys, last)]
    past = (below != first // LIMIT) | (above != first // LIMIT)
    touched = np.append(neighbours + 1, np.full(past.sum(), EXTERIOR))
    return np.stack([np.append(np.repeat(chosen, count), chosen[past]) + 1, touched])
