"""Kernels of a convex solid that has plane faces: how deep a node is in it, and by which face it came in."""

import numba
import numpy as np

from msmpetsc.backend.arrays import Positions, Rows

OPPOSITE = -1 + 1e-9  # cosine of two faces that look away from each other
ROUNDED = 1e-12  # of a node's way: a plate as thin as that is not passed either


@numba.njit(cache=True)
def behind(x: Positions, points: Positions, normals: Rows, face: int) -> float:
    """Return how far x (3,) lies behind a face [m]; negative in front of it."""
    distance = 0.0
    for c in range(3):
        distance -= normals[face, c] * (x[c] - points[face, c])
    return distance


@numba.njit(cache=True)
def depth(x: Positions, points: Positions, normals: Rows, side: int) -> tuple[float, int]:
    """Return how deep x (3,) lies behind the face of its ``side`` [m], and that face.

    Without a side: how deep in the solid, not positive outside, and the nearest face.
    """
    if side > 0:
        return behind(x, points, normals, side - 1), side - 1
    least, face = np.inf, 0
    for f in range(len(points)):
        distance = behind(x, points, normals, f)
        if distance < least:
            least, face = distance, f
    return least, face


@numba.njit(cache=True)
def _stays(x: Positions, points: Positions, normals: Rows, face: int) -> bool:
    """Return whether x lies behind a face and has not slid off it past another.

    The opposite face is left aside: that of a thin plate may be passed.
    """
    if behind(x, points, normals, face) <= 0.0:
        return False
    for f in range(len(points)):
        along = 0.0
        for c in range(3):
            along += normals[f, c] * normals[face, c]
        if along > OPPOSITE and behind(x, points, normals, f) <= 0.0:
            return False
    return True


@numba.njit(cache=True)
def side_of(x: Positions, end: Positions, points: Positions, normals: Rows, side: int) -> int:
    """Return 1 + the face by which a node is in contact on its straight way from x to ``end`` (3,), 0 if it meets none.

    side : by which it was before: it keeps that until it is out of the solid

    It is the node that counts here, however far it sticks out of the surface: with a side, but no depth yet, it is on
    its way in, or out again.
    """
    if side > 0 and _stays(x, points, normals, side - 1):
        return side
    inside, face = depth(x, points, normals, 0)
    if inside > 0.0:
        return face + 1
    enter, leave, side = -1.0, 1.0, 0  # fractions of the way
    for f in range(len(points)):
        first, last = behind(x, points, normals, f), behind(end, points, normals, f)
        if first <= 0.0:
            if last < 0.0 or last == first:
                return 0
            crossing = first / (first - last)
            if crossing > enter:
                enter, side = crossing, f + 1
        elif last <= 0.0:
            leave = min(leave, first / (first - last))
    return side if enter <= leave + ROUNDED else 0
