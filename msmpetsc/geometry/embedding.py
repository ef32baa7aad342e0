"""The embedding W, a sparse matrix: surface points = W @ positions of nodes (paper 3.1).

``stencil_weights`` is the one interface to its kinds: mean value coordinates of a cell (Eq. 1-6), and two that are
smooth across cells, *Cages coordinates (Eq. 7-9) and affine maps (ours).

Mean value coordinates
----------------------
A cage is a union of unit cells. Its surface is made of unit squares, each cut in two triangles from
its low to its high corner: a rule of the square alone, so that neighbours cut a shared face alike.
These are the coordinates of Ju et al. 2005, not their formulas: on a grid the triangles' planes are
known exactly, and what divides 0 by 0 as p nears such a plane can be taken out by hand, which
leaves full precision at any distance from faces, edges and corners.

With e_i = v_i - p, a triangle sees from p the mean vector m = sum w_i e_i = 1/2 sum beta_jk n_jk
(Eq. 4-5 before they are solved for w_i). In the frame of its plane, at signed height d, m = 1/2 sum
g_jk (e_j x e_k) with g_jk = beta_jk / |e_j x e_k|, and the weights follow from m_a = sum w_i a_i,
m_b = sum w_i b_i, m_n / d = sum w_i: a system that stays well conditioned as d goes to 0.

*Cages coordinates
------------------
What is guaranteed, for any set of valid cells:
- The position is continuous. On a face, edge or corner that a cell shares with a valid neighbour that neighbour's
  factor of Eq. 9 is 0, so b = 0 and s = J; there only the shared corners weigh in J, they belong to
  B_c of every cell that has them, and their L_v are common. Corners outside B_c weigh nothing
  there: normalising without them changes nothing, whatever else B_c holds.
- The slope is continuous across the inside of shared faces: neither b (f_h' (0) = 0) nor W changes along the normal,
  and L_v is smooth inside its cage. At the rim of such a face on the body's surface, L_v itself has no slope.
Where the corners in B_c weigh nothing, b = 1 and s = x, so 0/0 of the normalisation is never met.

Affine maps
-----------
Every node carries an affine map of its neighbourhood, blended over a cell's corners.
Eq. 8 of the paper alone, over all 8 corners, with L_v(p) = x_v + F_v (p - v). F_v is the gradient that fits the nodes
j of the valid cells around v best: x_j - x_v = F_v (X_j - X_v), least squares. It depends on which of those 8 cells
are valid and on nothing else, so cells agree on it, and position and slope are continuous across every shared face
of every set of valid cells (block.corner_blend says why).
"""

from collections.abc import Sequence
from functools import cache
from math import atan2, sqrt
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array, csr_array

from msmpetsc.backend.arrays import Floats, Indices, Mask, Positions, Rows
from msmpetsc.backend.kernel import njit
from msmpetsc.comm import Route, SortedKeys
from msmpetsc.geometry.block import (
    AROUND,
    CELLS,
    EDGE,
    EDGES,
    ITSELF,
    NODES,
    OF_CORNER,
    SQUARE,
    cells_around,
    corner_bit,
    corner_blend,
    corner_node,
    smoothstep,
)
from msmpetsc.geometry.cages import Cages
from msmpetsc.geometry.grid import decode_morton, encode_morton

ROUNDING = 1e-9  # how far outside its cell a point may be computed to lie
ON_FACE = 1e-14  # nearer than this to a face of its cell, a point is on it
CHUNK = 1 << 15  # points at once: their 64 weights each take 16 MB
# offsets of the 3 x 3 x 3 cells and the 4 x 4 x 4 nodes around a cell, in the order of stencil_weights
CELLS_AROUND = np.stack(np.unravel_index(np.arange(27), (3, 3, 3)), axis=1) - 1
NODES_AROUND = np.stack(np.unravel_index(np.arange(64), (4, 4, 4)), axis=1) - 1
Frame = tuple[float, float, float, float, float]
Angles = tuple[float, float, float, float, float]
Weights = tuple[float, float, float, float]

FLAT = 1e-2  # height below which the sum of a triangle's weights is taken with its leading terms removed


def embed(
    points: Sequence[Positions], cages: Cages, nodes: SortedKeys, kind: str, smoothing: float = 1.0
) -> csr_array:
    """Return W for the surface points of all bodies, one after the other (collective).

    Each rank has a contiguous range of its rows; columns are global node numbers.

    points    : of each body (v, 3) [m] on rank 0, (0, 3) on the others: all must lie in valid cells of the body
    nodes     : the lattice's node numbers by grid key
    kind, smoothing : see ``stencil_weights``
    """
    comm = cages.table.comm
    total = comm.allreduce(sum(map(len, points)))
    row, ijk, u = _to_cells(points, cages)
    cell_keys, cell = np.unique(encode_morton(ijk), return_inverse=True)
    around = decode_morton(cell_keys)[:, None, :]
    neighbours = cages.table.find(encode_morton(around + CELLS_AROUND)) >= 0
    numbers = nodes.find(encode_morton(around + NODES_AROUND))

    def entries(part: slice) -> tuple[Indices, Indices, Floats]:
        """Return the nonzero weights of some points as rows, columns and values."""
        weights = stencil_weights(kind, u[part], neighbours[cell[part]], smoothing)
        point, node = np.nonzero(weights)
        return row[part][point], numbers[cell[part]][point, node], weights[point, node]

    parts = (slice(start, start + CHUNK) for start in range(0, max(len(u), 1), CHUNK))
    rows, columns, weights = (
        np.concatenate(part) for part in zip(*map(entries, parts), strict=True)
    )
    first = total * np.arange(comm.size + 1) // comm.size  # of the rows that each rank keeps
    route = Route(comm, np.searchsorted(first[1:], rows, side="right"))
    start, stop = first[comm.rank : comm.rank + 2]
    own = route.send(rows) - start, route.send(columns)
    return coo_array((route.send(weights), own), shape=(int(stop - start), nodes.total)).tocsr()


def _to_cells(points: Sequence[Positions], cages: Cages) -> tuple[Indices, Indices, Rows]:
    """Send points to the ranks of their cells: number, cell (p, 3), coordinates in it (p, 3)."""
    at = [grid.to_cells(of_body) for grid, of_body in zip(cages.grids.grids, points, strict=True)]
    cells = [np.floor(of_body).astype(np.int64) for of_body in at]
    u = np.concatenate([x - ijk for x, ijk in zip(at, cells, strict=True)])
    ijk = np.concatenate([of_body + cages.grids.first(body) for body, of_body in enumerate(cells)])
    route = Route(cages.table.comm, cages.table.owner(encode_morton(ijk)))
    return route.send(np.arange(len(u))), route.send(ijk), route.send(u)


def stencil_weights(kind: str, u: Rows, neighbours: Mask, smoothing: float = 1.0) -> Rows:
    """Return the weights (p,64) of the nodes around points in valid cells, lengths in cells.

    u          : (p,3) coordinates in the cell, in [0,1]
    neighbours : (p,27) bool; column (dx+1)*9 + (dy+1)*3 + (dz+1): the cell at that offset is valid. 13 is the cell
    smoothing  : h of Eq. 9, in (0,1]; used by "cages"
    result     : column ix*16 + iy*4 + iz: the node at offset (ix-1, iy-1, iz-1) from the cell's low corner

    kind "mvc": mean value coordinates in the cell, continuous (Eq. 1-6); "cages": smooth blends of the coordinates in
    joined cells (Eq. 7-9); "affine": smooth blends of affine maps, the most accurate. A row sums to 1, reproduces
    linear fields and is exactly 0 at nodes of no valid cell. Nothing but the result grows with p.
    Raises ValueError for points outside their cell or cells not valid.
    """
    if not np.all((u >= -ROUNDING) & (u <= 1.0 + ROUNDING)):
        raise ValueError("a point lies outside its cell")
    if not np.all(neighbours[:, ITSELF]):
        raise ValueError("a point lies in a cell that is not valid")
    u = np.ascontiguousarray(np.where(u < ON_FACE, 0.0, np.where(u > 1.0 - ON_FACE, 1.0, u)))
    neighbours = np.ascontiguousarray(
        neighbours, bool
    )  # one memory layout: the kernels are compiled once
    weights = np.empty((len(u), 64))
    if kind == "mvc":  # *Cages coordinates of a cell without neighbours
        neighbours = neighbours & (np.arange(27) == ITSELF)
    if kind == "affine":
        affine_weights(u, neighbours, gradient_table(), weights)
    else:
        cages_weights(u, neighbours, smoothing, weights)
    return weights


class PointView(NamedTuple):
    """Geometry of a point p in its block, by set_view; the last two on demand."""

    planes: Rows  # (3,4) heights of the block's grid planes over p
    angles: Floats  # (144,) g_jk of the grid edges; 0 = not yet
    squares: Rows  # (108,4) weights of the grid squares; NaN = not yet


@njit()
def set_view(u: Floats, view: PointView) -> None:
    """Set the view to that of the point u (3,)."""
    for axis in range(3):
        for i in range(4):
            view.planes[axis, i] = i - 1 - u[axis]
    view.angles[:] = 0.0
    view.squares[:, 0] = np.nan


@njit()
def edge_angle(edge: int, view: PointView) -> float:
    """Return g_jk of a grid edge: the angle that it subtends from p over |e_j x e_k|."""
    if view.angles[edge] == 0.0:
        axis, i, j, k = EDGE[edge, 0], EDGE[edge, 1], EDGE[edge, 2], EDGE[edge, 3]
        distance2 = view.planes[(axis + 1) % 3, j] ** 2 + view.planes[(axis + 2) % 3, k] ** 2
        cross = sqrt(distance2)
        view.angles[edge] = (
            atan2(cross, view.planes[axis, i] * view.planes[axis, i + 1] + distance2) / cross
        )
    return float(view.angles[edge])


@njit()
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


@njit()
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


@njit()
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
    return (
        first - first_a + second - second_b,
        first_a - first_b,
        first_b + second_a,
        second_b - second_a,
    )


@njit()
def square_frame(square: int, view: PointView) -> Frame:
    """Return (a0, a1, b0, b1, d) of a square in the block, as in square_weights."""
    axis, plane, j, k = SQUARE[square, 0], SQUARE[square, 1], SQUARE[square, 2], SQUARE[square, 3]
    a, b = (axis + 1) % 3, (axis + 2) % 3
    planes = view.planes
    return planes[a, j], planes[a, j + 1], planes[b, k], planes[b, k + 1], planes[axis, plane]


@njit()
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


@njit()
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


@njit()
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
        outwards = int(AROUND[corner, below] and valid[below]) - int(
            AROUND[corner, above] and valid[above]
        )
        if outwards != 0:
            if set_limit(square, view, weights):
                return
            if np.isnan(view.squares[square, 0]):
                set_square(square, view)
            for i in range(4):
                weights[NODES[square, i]] += outwards * view.squares[square, i]
    weights /= weights.sum()


@njit()
def own_weight(own: Floats, valid: Mask, smoothing: float) -> float:
    """Return b(p) of Eq. 9, f_h = smoothstep(x / h): 0 on what valid neighbours share, else up to 1.

    own (64,): the cell's own coordinates; the sum in Eq. 9 is taken over the corners shared with that neighbour.
    """
    product = 1.0
    for cell in range(27):
        if valid[cell] and cell != ITSELF:
            shared = 0.0
            for v in range(8):
                if AROUND[v, cell]:
                    shared += own[corner_node(v)]
            product *= max(1.0 - shared, 0.0)
    return smoothstep(product / smoothing)


@njit()
def boundary_blends(u: Floats, valid: Mask, blends: Floats) -> float:
    """Set W(v, p) of Eq. 8 in blends (8,), 0 at corners of no other valid cell; return their sum."""
    for v in range(8):
        mask = cells_around(v, valid)
        alone = mask & (mask - 1) == 0
        blends[v] = 0.0 if alone else corner_blend(v, u)
    return float(blends.sum())


@njit()
def cages_weights(u: Rows, neighbours: Mask, smoothing: float, weights: Rows) -> None:
    """Set s(p) of Eq. 7: u (p,3) in [0,1]; neighbours (p,27) bool; smoothing h in (0,1]; weights (p,64), result."""
    alone = np.zeros(27, np.bool_)
    alone[ITSELF] = True
    view = PointView(np.empty((3, 4)), np.empty(144), np.empty((108, 4)))
    blends = np.empty(8)
    joined = np.empty(64)
    for p in range(len(u)):
        set_view(u[p], view)
        joined_cage(0, alone, view, weights[p])  # x(p)
        b = own_weight(weights[p], neighbours[p], smoothing)
        if b == 1.0:
            continue
        total = boundary_blends(u[p], neighbours[p], blends)
        weights[p] *= b
        for v in range(8):
            if blends[v] > 0.0:
                joined_cage(v, neighbours[p], view, joined)
                share = (1.0 - b) * blends[v] / total
                for node in range(64):
                    weights[p, node] += share * joined[node]


@cache
def gradient_table() -> Rows:
    """Return a table (256,3,27): column a of F_v is table[mask, a] @ x over the 3x3x3 nodes around v.

    The mask is that of cells_around.

    One valid cell is enough: its 8 nodes span space. Mask 0 does not occur and holds zeros.
    """
    offsets = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3, indexing="ij"), -1).reshape(27, 3)
    octants = (offsets != 0).all(1)  # a cell around v has its far corner at (+-1, +-1, +-1)
    is_corner = ((offsets == 0) | (offsets == offsets[octants][:, None])).all(
        -1
    )  # (8 cells, 27 nodes)
    bits = np.arange(256)[:, None] >> np.arange(8) & 1
    spans = (bits @ is_corner > 0)[
        ..., None
    ] * offsets  # (256,27,3): X_j - X_v, 0 where there is no node
    table = np.zeros((256, 3, 27))
    normal = spans[1:].swapaxes(1, 2)  # normal equations: exactly 0 where there is no node
    table[1:] = np.linalg.solve(normal @ spans[1:], normal)
    table[:, :, 13] = -table.sum(2)  # x_j - x_v: v itself, whose own span is 0
    return table


@njit()
def affine_weights(u: Rows, neighbours: Mask, table: Rows, weights: Rows) -> None:
    """Set J(p) of Eq. 8 with affine L_v by ``gradient_table``; arguments as of ``cages_weights``."""
    weights[:] = 0.0
    for p in range(len(u)):
        for v in range(8):
            gradient = table[cells_around(v, neighbours[p])]
            x, y, z = corner_bit(v, 0), corner_bit(v, 1), corner_bit(v, 2)
            dx, dy, dz = u[p, 0] - x, u[p, 1] - y, u[p, 2] - z
            blend = corner_blend(v, u[p])
            weights[p, corner_node(v)] += blend
            for j in range(27):
                node = 16 * (x + j // 9) + 4 * (y + j // 3 % 3) + z + j % 3
                lever = dx * gradient[0, j] + dy * gradient[1, j] + dz * gradient[2, j]
                weights[p, node] += blend * lever
