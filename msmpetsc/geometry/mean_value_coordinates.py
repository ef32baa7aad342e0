"""Mean value coordinates of a point in a cage of grid cells, and their limits on its planes.

A cage is a union of unit cells, so its surface consists of unit squares. Each square is cut into
two triangles from its low to its high corner. The cut depends on the square alone, so neighbours
cut a shared face alike.

The coordinates are those of Ju et al. 2005, but the formulas differ. On a grid the planes of the
triangles are known exactly. So the terms that become 0/0 as p nears a plane are cancelled by hand.
The weights have full precision at any distance from faces, edges and corners.

Let e_i = v_i - p. The mean vector of a triangle seen from p is (Eq. 4-5, not solved for w_i yet)

    m = sum w_i e_i = 1/2 sum beta_jk n_jk = 1/2 sum g_jk (e_j x e_k), g_jk = beta_jk / |e_j x e_k|.

In the frame of the triangle's plane, at signed height d, the weights follow from

    m_a = sum w_i a_i,  m_b = sum w_i b_i,  m_n / d = sum w_i,

a system that stays well conditioned as d goes to 0.
"""

from math import atan2, sqrt

import numpy as np

from msmpetsc.backend.arrays import Floats, Mask, Rows
from msmpetsc.backend.kernel import njit
from msmpetsc.geometry.block import AROUND, CELLS, EDGE, EDGES, NODES, OF_CORNER, SQUARE

Frame = tuple[float, float, float, float, float]
Angles = tuple[float, float, float, float, float]
Weights = tuple[float, float, float, float]
# height below which the leading terms of the sums, which cancel, are left out [cells]
FLAT = 1e-2


@njit()
def plane_heights(u: Floats) -> Rows:
    """Return the heights (3,4) of the block's grid planes over the point u (3,)."""
    planes = np.empty((3, 4))
    for axis in range(3):
        for i in range(4):
            planes[axis, i] = i - 1 - u[axis]
    return planes


@njit()
def edge_angle(edge: int, planes: Rows) -> float:
    """Return g_jk of a grid edge: the angle that the edge subtends at p, over |e_j x e_k|."""
    axis, i, j, k = EDGE[edge, 0], EDGE[edge, 1], EDGE[edge, 2], EDGE[edge, 3]
    distance2 = planes[(axis + 1) % 3, j] ** 2 + planes[(axis + 2) % 3, k] ** 2
    cross = sqrt(distance2)
    return atan2(cross, planes[axis, i] * planes[axis, i + 1] + distance2) / cross


@njit()
def turn_from_plane(c: float, length2: float, dot: float, d2: float) -> float:
    """Return sign(c) (beta |c| / |e_j x e_k| - the edge's angle at p's foot in the plane).

    c = (e_j x e_k)_n, dot = e_j . e_k in the plane, d2 = height^2. If a triangle does not contain
    the foot, the angles at the foot sum to 0: these differences, of order d2, sum to 2 m_n stably.
    """
    size = abs(c)
    cross = sqrt(c * c + length2 * d2)
    beta = atan2(cross, dot + d2)
    lift = atan2(d2 * (length2 * dot / (cross + size) - size), (dot + d2) * dot + cross * size)
    turn = lift - d2 * length2 * beta / (cross * (cross + size))
    return turn if c >= 0.0 else -turn


@njit()
def triangle_sums(frame: Frame, g: Angles) -> tuple[float, float]:
    """Return m_n / d of the triangles (00,10,11) and (00,11,01) of a square.

    g : g_jk of the edges, as in ``square_weights``
    """
    a0, a1, b0, b1, d = frame
    c = a0 - b0
    first = -b0 * g[0] + a1 * g[1] - c * g[4]
    second = b1 * g[2] - a0 * g[3] + c * g[4]
    if abs(d) < FLAT:
        d2 = d * d
        diagonal = turn_from_plane(c, 2.0, a0 * a1 + b0 * b1, d2)
        if min(-b0, a1, -c) < 0.0:
            first = (turn_from_plane(-b0, 1.0, a0 * a1 + b0 * b0, d2)
                     + turn_from_plane(a1, 1.0, a1 * a1 + b0 * b1, d2) - diagonal)  # fmt: skip
        if min(b1, -a0, c) < 0.0:
            second = (turn_from_plane(b1, 1.0, a0 * a1 + b1 * b1, d2)
                      + turn_from_plane(-a0, 1.0, a0 * a0 + b0 * b1, d2) + diagonal)  # fmt: skip
    half = 0.5 / d
    return half * first, half * second


@njit()
def square_weights(frame: Frame, g: Angles) -> Weights:
    """Return the unnormalised weights (w00, w10, w11, w01) of a unit square (Eq. 3-5).

    frame : (a0, a1, b0, b1, d); (a0, b0) and (a1, b1) are the low and high corner relative to p
            along the next two axes; d is the height of the square's plane over p, not 0
    g     : g_jk of the edges 00-10, 10-11, 01-11, 00-01 and 00-11
    """
    a0, _, b0, _, d = frame
    first, second = triangle_sums(frame, g)
    # m_a - a0 sum: the weight of the vertices at a1
    first_a = 0.5 * d * (g[4] - g[1]) - a0 * first
    first_b = 0.5 * d * (g[0] - g[4]) - b0 * first
    second_a = 0.5 * d * (g[3] - g[4]) - a0 * second
    second_b = 0.5 * d * (g[4] - g[2]) - b0 * second
    return (
        first - first_a + second - second_b,
        first_a - first_b,
        first_b + second_a,
        second_b - second_a,
    )


@njit()
def square_frame(square: int, planes: Rows) -> Frame:
    """Return (a0, a1, b0, b1, d) of a square in the block, see ``square_weights``."""
    axis, plane, j, k = SQUARE[square, 0], SQUARE[square, 1], SQUARE[square, 2], SQUARE[square, 3]
    a, b = (axis + 1) % 3, (axis + 2) % 3
    return planes[a, j], planes[a, j + 1], planes[b, k], planes[b, k + 1], planes[axis, plane]


@njit()
def add_square(square: int, outwards: int, planes: Rows, weights: Floats) -> None:
    """Add the weights of a square, unless p lies in its plane but not on the square."""
    a0, a1, b0, b1, d = square_frame(square, planes)
    if d == 0.0:
        return
    cross = sqrt((a0 - b0) ** 2 + 2.0 * d * d)
    g = (
        edge_angle(EDGES[square, 0], planes),
        edge_angle(EDGES[square, 1], planes),
        edge_angle(EDGES[square, 2], planes),
        edge_angle(EDGES[square, 3], planes),
        atan2(cross, a0 * a1 + b0 * b1 + d * d) / cross,
    )
    w = square_weights((a0, a1, b0, b1, d), g)
    for i in range(4):
        weights[NODES[square, i]] += outwards * w[i]


@njit()
def set_limit(square: int, planes: Rows, weights: Floats) -> bool:
    """Set the barycentric weights of p if it lies on this closed square; return whether it does.

    They are the limit of the mean value coordinates on the cage's surface.
    """
    a0, a1, b0, b1, d = square_frame(square, planes)
    if d != 0.0 or not (a0 <= 0.0 <= a1 and b0 <= 0.0 <= b1):
        return False
    weights[:] = 0.0
    limit = 1.0 - max(-a0, -b0), max(b0 - a0, 0.0), min(-a0, -b0), max(a0 - b0, 0.0)
    for i in range(4):
        weights[NODES[square, i]] = limit[i]
    return True


@njit()
def joined_cage(corner: int, valid: Mask, planes: Rows, weights: Floats) -> None:
    """Set the mean value coordinates of p in the valid cells around a corner (L_v of Eq. 8).

    corner  : 0..7
    valid   : (27,) bool
    planes  : ``plane_heights`` over p
    weights : (64,) result

    The 8 cells around the corner have 36 squares. The squares with a valid cell on a single side
    are the surface of the cage. So a corner with 8 valid cells is no vertex of the cage. Cells that
    touch only at an edge or a corner still have a closed surface. The weights (Eq. 1-2) have a
    positive sum because p lies in the cage.
    """
    weights[:] = 0.0
    for s in range(36):
        square = OF_CORNER[corner, s]
        below, above = CELLS[square, 0], CELLS[square, 1]
        outwards = int(AROUND[corner, below] and valid[below]) - int(
            AROUND[corner, above] and valid[above]
        )
        if outwards != 0:
            if set_limit(square, planes, weights):
                return
            add_square(square, outwards, planes, weights)
    weights /= weights.sum()
