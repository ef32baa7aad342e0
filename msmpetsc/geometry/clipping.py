"""Clipping of polygons to the layers of a grid, in cell units."""

import numba
import numpy as np

from msmpetsc.backend.arrays import Array, Rows


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
