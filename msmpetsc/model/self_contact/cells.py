"""Points of a surface that lie in cells of another part of a body: how deep, and which way leads out.

A point S in a deformed cell, at the local coordinates xi in [0, 1)^3, is at X(xi) in the body at rest. There it is

    d = min(d(xi), |X(xi) - X_S| - NEAR h)

deep: d(xi) is the distance below the surface at rest, interpolated from the corners of the cell, and X_S where the
point itself is at rest. So a point is not pushed where it always is, in the cells around its own place, and d is
continuous. It gets out by  g = J^(-T) grad_xi d,  J = dx/dxi, for  dd = g . (dS - sum_v N_v(xi) dq_v).

Points are sorted into bins as wide as a cell, so that a cell looks at those near it only.
"""

from dataclasses import dataclass

import numba
import numpy as np

from msmpetsc.model.boundary_cells import CORNERS

NEAR = 2.0  # cells: what is nearer at rest is not seen
ITERATIONS = 30  # of Newton's method for xi
SETTLED = 1e-13  # change of xi
FAR = 4.0  # from the middle of a cell: no way leads back into it
FLAT = 1e-9  # of a cell's volume at rest: it has no inside
PER_POINT = 4  # cells that a point may be in, before there is room for more
AT = CORNERS.astype(float)


@dataclass(frozen=True)
class Cells:
    """Cells of a rank that points may come into.

    corners : (c, 8) local nodes
    lowest  : (c, 3) first corner at rest [m]
    depth   : (c, 8) of the corners below the surface at rest [m], negative outside
    body    : (c,) number of the body
    edge    : h [m]
    """

    corners: np.ndarray
    lowest: np.ndarray
    depth: np.ndarray
    body: np.ndarray
    edge: float


@dataclass(frozen=True)
class Places:
    """Where points of the surface are at rest (p, 3) [m], and the number (p,) of their body."""

    rest: np.ndarray
    body: np.ndarray


@dataclass(frozen=True)
class Intrusions:
    """Points in cells: their numbers (a,), those of the cells (a,), depths (a,) [m], N(xi) (a, 8) and g (a, 3).

    Depths are negative in the part of a boundary cell that is outside.
    """

    point: np.ndarray
    cell: np.ndarray
    depth: np.ndarray
    weights: np.ndarray
    way_out: np.ndarray


def intrusions(q: np.ndarray, points: np.ndarray, cells: Cells, places: Places) -> Intrusions:
    """Return the points (p, 3) [m] that are in cells at positions q (l, 3) [m], in the order of the cells."""
    if not len(cells.corners) or not len(points):
        return Intrusions(*(np.zeros(0, int),) * 2, np.zeros(0), np.zeros((0, 8)), np.zeros((0, 3)))
    low = points.min(axis=0)
    bins = np.floor((points - low) / cells.edge).astype(np.int64)
    counts = bins.max(axis=0) + 1
    keys = (bins[:, 0] * counts[1] + bins[:, 1]) * counts[2] + bins[:, 2]
    order = np.argsort(keys, kind="stable")
    room = PER_POINT * len(points)
    while True:
        found = np.empty((room, 2), np.int64), np.empty(room), np.empty((room, 8)), np.empty((room, 3))
        count = _search(
            q, points, order, keys[order], low, counts, cells.edge,
            cells.corners, cells.lowest, cells.depth, cells.body, places.rest, places.body, *found,
        )  # fmt: skip
        if count <= room:
            numbers, depth, weights, way_out = (each[:count] for each in found)
            return Intrusions(numbers[:, 0], numbers[:, 1], depth, weights, way_out)
        room = count


@numba.njit(cache=True)
def _search(
    q, points, order, keys, low, counts, edge, corners, lowest, depth, body, rest, of_point, numbers, deep, weights, out
):
    """Find the points in each cell; return how many there are, of which the arrays hold as many as they have room."""
    count, xi = 0, np.empty(3)
    first, last = np.empty(3, np.int64), np.empty(3, np.int64)
    w, slopes, jacobian = np.empty(8), np.empty((8, 3)), np.empty((3, 3))
    for c in range(len(corners)):
        if not _box(q, corners[c], low, counts, edge, first, last):
            continue
        for x in range(first[0], last[0] + 1):
            for y in range(first[1], last[1] + 1):
                row = (x * counts[1] + y) * counts[2]
                begin = np.searchsorted(keys, row + first[2])
                for i in range(begin, np.searchsorted(keys, row + last[2], side="right")):
                    p = order[i]
                    same = of_point[p] == body[c]
                    if same and _is_near(rest[p], lowest[c], edge):
                        continue
                    if not _locate(q, corners[c], points[p], xi, w, slopes, jacobian, FLAT * edge**3):
                        continue
                    found, way = _depth(xi, w, slopes, depth[c], lowest[c], rest[p], edge, same)
                    if np.isinf(found):
                        continue
                    if count < len(deep):
                        numbers[count, 0], numbers[count, 1], deep[count] = p, c, found
                        weights[count], out[count] = w, _solve(jacobian.T.copy(), way)
                    count += 1
    return count


@numba.njit(cache=True)
def _box(q, corners, low, counts, edge, first, last):
    """Find the bins of a cell's bounding box; whether it has any."""
    for k in range(3):
        least, most = np.inf, -np.inf
        for v in range(8):
            least, most = min(least, q[corners[v], k]), max(most, q[corners[v], k])
        least, most = (least - low[k]) / edge, (most - low[k]) / edge
        if not (most >= 0 and least < counts[k]):
            return False
        first[k], last[k] = int(max(least, 0.0)), int(min(most, counts[k] - 1.0))
    return True


@numba.njit(cache=True)
def _is_near(rest, lowest, edge):
    """Whether no point of a cell is farther from ``rest`` than is not seen."""
    square = 0.0
    for k in range(3):
        square += max(abs(rest[k] - lowest[k]), abs(lowest[k] + edge - rest[k])) ** 2
    return square <= (NEAR * edge) ** 2


@numba.njit(cache=True)
def _locate(q, corners, point, xi, w, slopes, jacobian, flat):
    """Find the local coordinates of a point in a cell, N, dN/dxi and J there; whether it lies in it."""
    xi[:] = 0.5
    for _ in range(ITERATIONS):
        _interpolate(xi, w, slopes)
        missing = point.copy()
        jacobian[:] = 0.0
        for v in range(8):
            for k in range(3):
                x = q[corners[v], k]
                missing[k] -= w[v] * x
                for m in range(3):
                    jacobian[k, m] += slopes[v, m] * x
        if not _determinant(jacobian) > flat:
            return False
        step = _solve(jacobian, missing)
        largest = 0.0
        for k in range(3):
            xi[k] += step[k]
            largest = max(largest, abs(step[k]))
            if not abs(xi[k] - 0.5) < FAR:
                return False
        if largest < SETTLED:
            break
    return 0.0 <= xi[0] < 1.0 and 0.0 <= xi[1] < 1.0 and 0.0 <= xi[2] < 1.0


@numba.njit(cache=True)
def _interpolate(xi, w, slopes):
    """Write N (8,) and dN/dxi (8, 3) at xi."""
    for v in range(8):
        x = xi[0] if AT[v, 0] > 0 else 1.0 - xi[0]
        y = xi[1] if AT[v, 1] > 0 else 1.0 - xi[1]
        z = xi[2] if AT[v, 2] > 0 else 1.0 - xi[2]
        w[v] = x * y * z
        slopes[v, 0] = y * z if AT[v, 0] > 0 else -y * z
        slopes[v, 1] = x * z if AT[v, 1] > 0 else -x * z
        slopes[v, 2] = x * y if AT[v, 2] > 0 else -x * y


@numba.njit(cache=True)
def _depth(xi, w, slopes, depth, lowest, rest, edge, same):
    """Return how deep a point at xi is, and the gradient over xi; less than anything where it is not seen."""
    deep, way = 0.0, np.zeros(3)
    for v in range(8):
        deep += w[v] * depth[v]
        for k in range(3):
            way[k] += slopes[v, k] * depth[v]
    if not same:
        return deep, way
    apart = lowest + edge * xi - rest
    length = np.sqrt((apart**2).sum())
    if length <= NEAR * edge:
        return -np.inf, way
    if length - NEAR * edge < deep:
        deep = length - NEAR * edge
        way = apart * (edge / length)
    return deep, way


@numba.njit(cache=True)
def _determinant(a):
    return (
        a[0, 0] * (a[1, 1] * a[2, 2] - a[1, 2] * a[2, 1])
        - a[0, 1] * (a[1, 0] * a[2, 2] - a[1, 2] * a[2, 0])
        + a[0, 2] * (a[1, 0] * a[2, 1] - a[1, 1] * a[2, 0])
    )


@numba.njit(cache=True)
def _solve(a, b):
    """Return the solution of a 3 x 3 system by Cramer's rule."""
    x, whole = np.empty(3), _determinant(a)
    for k in range(3):
        other = a.copy()
        other[:, k] = b
        x[k] = _determinant(other) / whole
    return x
