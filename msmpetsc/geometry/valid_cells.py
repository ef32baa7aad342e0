"""Find the valid cells (paper section 4.1): cells that triangles touch, and gaps between them.

All lengths are in cells: cell (i, j, k) is the box [i, i+1) x [j, j+1) x [k, k+1). A cell owns its
low faces, so a face of the body in a grid plane marks a single layer of cells.

The boundary cells of a column (i, j) leave gaps between them, and each gap is inside or outside as
a whole. So the memory grows with the valid cells, not with the bounding box. Each rank has a slab
of planes i.
"""

import numpy as np

from msmpetsc.backend.arrays import Array, Indices, Mask, Rows
from msmpetsc.backend.kernel import njit
from msmpetsc.geometry.grid import PACK
from msmpetsc.geometry.partition import ranges

# upper bound of the rounding of an interpolated coordinate, over the largest [-]
ROUNDING = 1e-12


@njit()
def grown(rows: Array, used: int) -> Array:
    """Return the first ``used`` of rows (r, n), in an array with room for another row."""
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
def clip_to_cell(triangle: Rows, cell: Indices, buffers: Rows) -> Rows:
    """Return the corners (n, 3) of the piece of a triangle in a cell (3,).

    buffers : (3, 12, 3) memory of the result
    """
    piece, work, out = buffers[0], buffers[1], buffers[2]
    piece[:3] = triangle
    size = 3
    for axis in range(3):
        planes = (float(cell[axis]), cell[axis] + 1.0)
        size = clip_between(piece, size, axis, planes, work, out)
        piece[:size] = out[:size]
    corners: Rows = piece[:size]
    return corners


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

    ``margin`` widens the part, because its points may be interpolated, but not beyond the corners
    of the triangle. Corners are exact, so a triangle that ends in a grid plane does not mark the
    next layer.
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


def cells_below(cells: Indices, is_inside: Mask) -> Indices:
    """Return the cells (n, 3) in the gaps of columns (i, j) below marked cells.

    cells     : (c, 3), in lexicographic order
    is_inside : (c,) whether the gap below each cell, down to the next cell, is inside the body
    """
    low, high = cells[:-1], cells[1:]
    above = (low[:, :2] == high[:, :2]).all(axis=1) & is_inside[1:]
    length = (high - low)[above, 2] - 1
    between = np.repeat(low[above], length, axis=0)
    between[:, 2] = ranges(low[above, 2] + 1, length)
    return between
