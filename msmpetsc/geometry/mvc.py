"""Mean value coordinates of a cage made of grid cells (paper 3.1, Eq. 1-5).

A cage is a union of unit cells. Its surface is made of unit squares, each cut in two triangles from
its low to its high corner: a rule of the square alone, so that neighbours cut a shared face alike.
These are the coordinates of Ju et al. 2005, not their formulas: on a grid the triangles' planes are
known exactly, and what divides 0 by 0 as p nears such a plane can be taken out by hand, which
leaves full precision at any distance from faces, edges and corners.

With e_i = v_i - p, a triangle sees from p the mean vector m = sum w_i e_i = 1/2 sum beta_jk n_jk
(Eq. 4-5 before they are solved for w_i). In the frame of its plane, at signed height d, m = 1/2 sum
g_jk (e_j x e_k) with g_jk = beta_jk / |e_j x e_k|, and the weights follow from m_a = sum w_i a_i,
m_b = sum w_i b_i, m_n / d = sum w_i: a system that stays well conditioned as d goes to 0.
"""

from math import atan2, sqrt
from typing import NamedTuple

import numba
import numpy as np

from msmpetsc.backend.arrays import Floats, Mask, Rows
from msmpetsc.geometry.block import AROUND, CELLS, EDGE, EDGES, NODES, OF_CORNER, SQUARE

Frame = tuple[float, float, float, float, float]
Angles = tuple[float, float, float, float, float]
Weights = tuple[float, float, float, float]

FLAT = 1e-2  # height below which the sum of a triangle's weights is taken with its leading terms removed


class PointView(NamedTuple):
    """Geometry of a point p in its block, by new_view and set_view; the last two on demand."""

    planes: Rows  # (3,4) heights of the block's grid planes over p
    angles: Floats  # (144,) g_jk of the grid edges; 0 = not yet
    squares: Rows  # (108,4) weights of the grid squares; NaN = not yet


@numba.njit(cache=True)
def new_view() -> PointView:
    """Return a PointView, to be used point after point."""
    return PointView(np.empty((3, 4)), np.empty(144), np.empty((108, 4)))


@numba.njit(cache=True)
def set_view(u: Floats, view: PointView) -> None:
    """Set the view to that of the point u (3,)."""
    for axis in range(3):
        for i in range(4):
            view.planes[axis, i] = i - 1 - u[axis]
    view.angles[:] = 0.0
    view.squares[:, 0] = np.nan


@numba.njit(cache=True)
def edge_angle(edge: int, view: PointView) -> float:
    """Return g_jk of a grid edge: the angle that it subtends from p over |e_j x e_k|."""
    if view.angles[edge] == 0.0:
        axis, i, j, k = EDGE[edge, 0], EDGE[edge, 1], EDGE[edge, 2], EDGE[edge, 3]
        distance2 = view.planes[(axis + 1) % 3, j] ** 2 + view.planes[(axis + 2) % 3, k] ** 2
        cross = sqrt(distance2)
        view.angles[edge] = atan2(cross, view.planes[axis, i] * view.planes[axis, i + 1] + distance2) / cross
    return float(view.angles[edge])


@numba.njit(cache=True)
def turn_from_plane(c: float, length2: float, dot: float, d2: float) -> float:
    """Return sign(c) (beta |c| / |e_j x e_k| - the edge's angle from p's foot in the plane).

    c = (e_j x e_k)_n, dot = e_j . e_k in the plane, d2 = height^2. The angles of a triangle that does not hold the
    foot sum to 0, so these differences, each of order d2, sum to 2 m_n without cancelling.
    """
    size = abs(c)
    cross = sqrt(c * c + length2 * d2)
    beta = atan2(cross, dot + d2)
    lift = atan2(d2 * (length2 * dot / (cross + size) - size), (dot + d2) * dot + cross * size)
    turn = lift - d2 * length2 * beta / (cross * (cross + size))
    return turn if c >= 0.0 else -turn


@numba.njit(cache=True)
def triangle_sums(frame: Frame, g: Angles) -> tuple[float, float]:
    """Return m_n / d of the two triangles (00,10,11) and (00,11,01) of a square; g: see square_weights."""
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


@numba.njit(cache=True)
def square_weights(frame: Frame, g: Angles) -> Weights:
    """Return the unnormalised weights (w00, w10, w11, w01) of a unit square whose normal is its plane's axis (Eq. 3-5).

    (a0, b0) and (a1, b1): low and high corner, relative to p, along the next two axes; d: the plane's height over
    p, not 0: together the frame; g: g_jk of the edges 00-10, 10-11, 01-11, 00-01 and 00-11.
    """
    a0, _, b0, _, d = frame
    first, second = triangle_sums(frame, g)
    first_a = 0.5 * d * (g[4] - g[1]) - a0 * first  # m_a - a0 sum: what the vertices at a1 weigh
    first_b = 0.5 * d * (g[0] - g[4]) - b0 * first
    second_a = 0.5 * d * (g[3] - g[4]) - a0 * second
    second_b = 0.5 * d * (g[4] - g[2]) - b0 * second
    return first - first_a + second - second_b, first_a - first_b, first_b + second_a, second_b - second_a


@numba.njit(cache=True)
def square_frame(square: int, view: PointView) -> Frame:
    """Return (a0, a1, b0, b1, d) of a square in the block, as in square_weights."""
    axis, plane, j, k = SQUARE[square, 0], SQUARE[square, 1], SQUARE[square, 2], SQUARE[square, 3]
    a, b = (axis + 1) % 3, (axis + 2) % 3
    planes = view.planes
    return planes[a, j], planes[a, j + 1], planes[b, k], planes[b, k + 1], planes[axis, plane]


@numba.njit(cache=True)
def set_square(square: int, view: PointView) -> None:
    """Put the weights of a square into the view; 0 where its plane holds p, which is not on it."""
    a0, a1, b0, b1, d = square_frame(square, view)
    if d == 0.0:
        view.squares[square] = 0.0
        return
    cross = sqrt((a0 - b0) ** 2 + 2.0 * d * d)
    g = (
        edge_angle(EDGES[square, 0], view),
        edge_angle(EDGES[square, 1], view),
        edge_angle(EDGES[square, 2], view),
        edge_angle(EDGES[square, 3], view),
        atan2(cross, a0 * a1 + b0 * b1 + d * d) / cross,
    )
    w = square_weights((a0, a1, b0, b1, d), g)
    for i in range(4):
        view.squares[square, i] = w[i]


@numba.njit(cache=True)
def set_limit(square: int, view: PointView, weights: Floats) -> bool:
    """Set the weights of p on the cage's surface if it lies on this closed square; return whether it does.

    They are barycentric in the triangle there.
    """
    a0, a1, b0, b1, d = square_frame(square, view)
    if d != 0.0 or not (a0 <= 0.0 <= a1 and b0 <= 0.0 <= b1):
        return False
    weights[:] = 0.0
    limit = 1.0 - max(-a0, -b0), max(b0 - a0, 0.0), min(-a0, -b0), max(a0 - b0, 0.0)
    for i in range(4):
        weights[NODES[square, i]] = limit[i]
    return True


@numba.njit(cache=True)
def joined_cage(corner: int, valid: Mask, view: PointView, weights: Floats) -> None:
    """Set the mean value coordinates of p in the union of the valid cells around a corner (L_v of Eq. 8; Eq. 1-2).

    corner 0..7; valid (27,) bool; view: of p; weights (64,): result.
    The 8 cells around the corner have 36 squares; those with one valid side are the cage's surface, so a corner
    with 8 valid cells is no vertex of it. Cells that touch only at an edge or a corner still make a closed surface.
    The weights' sum is positive: p lies in the cage, so each ray from it leaves through the first of its crossings.
    """
    weights[:] = 0.0
    for s in range(36):
        square = OF_CORNER[corner, s]
        below, above = CELLS[square, 0], CELLS[square, 1]
        outwards = int(AROUND[corner, below] and valid[below]) - int(AROUND[corner, above] and valid[above])
        if outwards != 0:
            if set_limit(square, view, weights):
                return
            if np.isnan(view.squares[square, 0]):
                set_square(square, view)
            for i in range(4):
                weights[NODES[square, i]] += outwards * view.squares[square, i]
    weights /= weights.sum()
