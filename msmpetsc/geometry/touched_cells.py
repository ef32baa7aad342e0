"""Triangles cut by the layers of a grid, and boundary cells: those that a triangle touches (paper section 4.1).

Everything is in cell units: cell (i, j, k) is the box [i, i+1) x [j, j+1) x [k, k+1). A cell owns
its low faces, so a face of the body that lies in a grid plane marks one layer of cells, not two.
"""

import numba
import numpy as np

from msmpetsc.backend.arrays import Array, Indices, Rows

SLACK = 1e-12  # of the largest coordinate: above the rounding of an interpolated one, below anything that matters


@numba.njit(cache=True)
def grown(rows: Array, used: int) -> Array:
    """Return an array with the ``used`` first of these rows (r, n) and room for one more."""
    if used < len(rows):
        return rows
    larger = np.empty((2 * len(rows), rows.shape[1]), rows.dtype)
    larger[:used] = rows
    return larger


@numba.njit(cache=True)
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


@numba.njit(cache=True)
def clip_between(polygon: Rows, n: int, axis: int, planes: tuple[float, float], work: Rows, out: Rows) -> int:
    """Clip a polygon to the layer between two planes of an axis; return its size."""
    m = _clip(polygon, n, axis, planes[0], 1.0, work)
    return _clip(work, m, axis, planes[1], -1.0, out)


@numba.njit(cache=True)
def extent(polygon: Rows, n: int, axis: int) -> tuple[float, float]:
    """Return the smallest and largest coordinate along an axis."""
    smallest, largest = polygon[0, axis], polygon[0, axis]
    for a in range(1, n):
        smallest = min(smallest, polygon[a, axis])
        largest = max(largest, polygon[a, axis])
    return smallest, largest


@numba.njit(cache=True)
def _slack(triangle: Rows, axis: int) -> float:
    """Return more than the rounding of a coordinate interpolated between corners of the triangle."""
    smallest, largest = extent(triangle, 3, axis)
    return SLACK * (1.0 + max(abs(smallest), abs(largest)))


@numba.njit(cache=True)
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


@numba.njit(cache=True)
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
