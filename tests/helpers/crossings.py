"""Count crossings of a surface: each edge against each triangle, without a contact library."""

from collections.abc import Sequence

import numba
import numpy as np
import trimesh

from msmpetsc.build import Model
from msmpetsc.fields import Frame


def unique_edges(triangles: np.ndarray) -> np.ndarray:
    """Return the edges (e, 2) of triangles (f, 3), each once."""
    pairs = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    return np.unique(pairs, axis=0)


def count_crossings(points: np.ndarray, triangles: np.ndarray) -> int:
    """Return the number of crossing pairs of an edge and a triangle without a common corner.

    An edge that ends in the triangle's plane, up to rounding, does not cross it, because the
    triangles of a flat face are coplanar.

    points : (v, 3)
    """
    return _count(
        np.ascontiguousarray(points, float),
        unique_edges(triangles),
        np.ascontiguousarray(triangles),
    )


def crossings(model: Model, frames: Sequence[Frame], *solids: trimesh.Trimesh) -> int:
    """Return the number of edges that cross triangles of bodies and fixed solids in the frames."""
    assert model.surface is not None
    triangles, first = [model.surface.triangles], len(model.surface.points)
    for solid in solids:
        triangles.append(solid.faces + first)
        first += len(solid.vertices)
    still, of_all = [solid.vertices for solid in solids], np.concatenate(triangles)
    return sum(count_crossings(np.concatenate([frame.surface, *still]), of_all) for frame in frames)


@numba.njit(cache=True)
def _volume(a, b, c, d):
    u, v, w = b - a, c - a, d - a
    x, y, z = u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]
    return x * w[0] + y * w[1] + z * w[2]


@numba.njit(cache=True)
def _count(points, edges, triangles):
    count, low, high = 0, np.empty((len(triangles), 3)), np.empty((len(triangles), 3))
    for f in range(len(triangles)):
        for c in range(3):
            x, y, z = (
                points[triangles[f, 0], c],
                points[triangles[f, 1], c],
                points[triangles[f, 2], c],
            )
            low[f, c], high[f, c] = min(x, y, z), max(x, y, z)
    rounding = 1e-13 * np.abs(points).max()
    order = np.argsort(low[:, 0])
    begins, widest = low[order, 0], (high[:, 0] - low[:, 0]).max()
    for e in range(len(edges)):
        a, b = edges[e]
        p, q = points[a], points[b]
        first = np.searchsorted(begins, min(p[0], q[0]) - widest)
        for f in order[first : np.searchsorted(begins, max(p[0], q[0]), side="right")]:
            i, j, k = triangles[f]
            separate = a in (i, j, k) or b in (i, j, k)
            for c in range(3):
                separate = separate or max(p[c], q[c]) < low[f, c] or min(p[c], q[c]) > high[f, c]
            if separate:
                continue
            r, s, t = points[i], points[j], points[k]
            above, below = _volume(r, s, t, p), _volume(r, s, t, q)
            if above * below >= 0:
                continue
            if min(abs(above), abs(below)) <= rounding * np.linalg.norm(np.cross(s - r, t - r)):
                continue
            u, v, w = _volume(p, q, r, s), _volume(p, q, s, t), _volume(p, q, t, r)
            count += (u > 0 and v > 0 and w > 0) or (u < 0 and v < 0 and w < 0)
    return count
