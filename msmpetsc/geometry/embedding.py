"""Build the embedding W, a sparse matrix: surface points = W @ node positions (paper 3.1).

``stencil_weights`` computes the rows of W by one of three kinds of coordinates:

- "mvc": mean value coordinates of a cell (Eq. 1-6),
- "cages": *Cages coordinates, smooth across cells (Eq. 7-9),
- "affine": blended affine maps, smooth across cells (ours).

Mean value coordinates
----------------------
A cage is a union of unit cells, so its surface consists of unit squares. Each square is cut into
two triangles from its low to its high corner. The cut depends on the square alone, so neighbours
cut a shared face alike.

The coordinates are the same as in Ju et al. 2005, the formulas differ. On a grid the planes of
the triangles are known exactly. So the terms that become 0/0 as p nears a plane can be removed by
hand. The weights have full precision at any distance from faces, edges and corners.

Let e_i = v_i - p. The mean vector of a triangle seen from p is (Eq. 4-5, not solved for w_i yet)

    m = sum w_i e_i = 1/2 sum beta_jk n_jk = 1/2 sum g_jk (e_j x e_k), g_jk = beta_jk / |e_j x e_k|.

In the frame of the triangle's plane, at signed height d, the weights follow from

    m_a = sum w_i a_i,  m_b = sum w_i b_i,  m_n / d = sum w_i,

a system that stays well conditioned as d goes to 0.

*Cages coordinates
------------------
These properties hold for any set of valid cells:

- The position is continuous. If p lies on a face, edge or corner shared with a valid neighbour,
  that neighbour's factor in Eq. 9 is 0, so b = 0 and s = J. Only the shared corners have a weight
  in J there. They belong to B_c of every cell that has them, and their L_v is common.
- The slope is continuous across the interior of shared faces. The normal derivatives of b and W
  are 0 there (f_h'(0) = 0), and L_v is smooth inside its cage. At the rim of such a face on the
  body's surface, L_v itself has no derivative.

If the corners in B_c have no weight, b = 1 and s = x, so the normalisation never divides 0 by 0.

Affine maps
-----------
These are Eq. 8 alone, over all 8 corners, with L_v(p) = x_v + F_v (p - v). The gradient F_v fits
x_j - x_v = F_v (X_j - X_v) by least squares over the nodes j of the valid cells around v. It
depends only on which of these 8 cells are valid, so all cells at v use the same L_v. Hence position
and slope are continuous across every shared face (see ``block.corner_blend``).
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
    MIDDLE,
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
from msmpetsc.geometry.morton import decode_morton, encode_morton

# largest distance of a point outside its cell [cells]; above rounding
ROUNDING = 1e-9
# distance from a face of its cell at which a point is moved onto it [cells]; rounding
ON_FACE = 1e-14
# points in a batch [-]; bounds their weights to 16 MB
CHUNK = 1 << 15
# offsets of the cells and the nodes around a cell, in the order of stencil_weights
CELLS_AROUND = np.stack(np.unravel_index(np.arange(27), (3, 3, 3)), axis=1) - 1
NODES_AROUND = np.stack(np.unravel_index(np.arange(64), (4, 4, 4)), axis=1) - 1
Frame = tuple[float, float, float, float, float]
Angles = tuple[float, float, float, float, float]
Weights = tuple[float, float, float, float]

# height below which the leading terms of the sums are removed [cells]; they cancel
FLAT = 1e-2


def embed(
    points: Sequence[Positions], cages: Cages, nodes: SortedKeys, kind: str, smoothing: float = 1.0
) -> csr_array:
    """Return W for the surface points of all bodies in order (collective).

    Each rank has a contiguous range of the rows. The columns are global node numbers.

    points : for each body (v, 3) [m] on rank 0, (0, 3) on other ranks; all in its valid cells
    nodes  : node numbers of the lattice by grid key
    kind, smoothing : see ``stencil_weights``

    Raises ValueError if a point lies in no valid cell.
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
    # row ranges of the ranks
    first = total * np.arange(comm.size + 1) // comm.size
    route = Route(comm, np.searchsorted(first[1:], rows, side="right"))
    start, stop = first[comm.rank : comm.rank + 2]
    place = route.send(rows) - start, route.send(columns)
    return coo_array((route.send(weights), place), shape=(int(stop - start), nodes.total)).tocsr()


def _to_cells(points: Sequence[Positions], cages: Cages) -> tuple[Indices, Indices, Rows]:
    """Send points to the ranks of their cells (collective).

    Return the number (p,), the cell (p, 3) and the coordinates in the cell (p, 3) of each.
    """
    at = [grid.to_cells(of_body) for grid, of_body in zip(cages.grids.grids, points, strict=True)]
    cells = [np.floor(of_body).astype(np.int64) for of_body in at]
    u = np.concatenate([x - ijk for x, ijk in zip(at, cells, strict=True)])
    ijk = np.concatenate([of_body + cages.grids.first(body) for body, of_body in enumerate(cells)])
    route = Route(cages.table.comm, cages.table.owner(encode_morton(ijk)))
    return route.send(np.arange(len(u))), route.send(ijk), route.send(u)


def stencil_weights(kind: str, u: Rows, neighbours: Mask, smoothing: float = 1.0) -> Rows:
    """Return the weights (p,64) of the nodes around points in valid cells; lengths in cell sizes.

    kind       : "mvc", mean value coordinates in the cell, continuous (Eq. 1-6); "cages", smooth
                 blends of coordinates in joined cells (Eq. 7-9); "affine", smooth blends of affine
                 maps, the most accurate
    u          : (p,3) coordinates in the cell, in [0,1]
    neighbours : (p,27) bool, whether the cell at offset (dx, dy, dz) is valid, in the column
                 (dx+1)*9 + (dy+1)*3 + (dz+1)
    smoothing  : h of Eq. 9, in (0,1]; used by "cages"
    returns    : column ix*16 + iy*4 + iz is the node at (ix-1, iy-1, iz-1) from the low corner

    Each row sums to 1, reproduces linear fields, and is exactly 0 at nodes of no valid cell.

    Raises ValueError for points outside their cell, or in cells that are not valid.
    """
    if not np.all((u >= -ROUNDING) & (u <= 1.0 + ROUNDING)):
        raise ValueError("a point lies outside its cell")
    if not np.all(neighbours[:, MIDDLE]):
        raise ValueError("a point lies in a cell that is not valid")
    u = np.ascontiguousarray(np.where(u < ON_FACE, 0.0, np.where(u > 1.0 - ON_FACE, 1.0, u)))
    # a single memory layout, so that the kernels are compiled once
    neighbours = np.ascontiguousarray(neighbours, bool)
    weights = np.empty((len(u), 64))
    # mean value coordinates are *Cages coordinates of a cell without neighbours
    if kind == "mvc":
        neighbours = neighbours & (np.arange(27) == MIDDLE)
    if kind == "affine":
        affine_weights(u, neighbours, gradient_table(), weights)
    else:
        cages_weights(u, neighbours, smoothing, weights)
    return weights


class PointView(NamedTuple):
    """Geometry of a point p in its block, set by ``set_view``.

    planes  : (3,4) heights of the block's grid planes over p
    angles  : (144,) g_jk of the grid edges, computed on demand; 0 if not computed
    squares : (108,4) weights of the grid squares, computed on demand; NaN if not computed
    """

    planes: Rows
    angles: Floats
    squares: Rows


@njit()
def set_view(u: Floats, view: PointView) -> None:
    """Set the planes of the point u (3,) in the view, and clear the values computed on demand."""
    for axis in range(3):
        for i in range(4):
            view.planes[axis, i] = i - 1 - u[axis]
    view.angles[:] = 0.0
    view.squares[:, 0] = np.nan


@njit()
def edge_angle(edge: int, view: PointView) -> float:
    """Return g_jk of a grid edge: the angle that it subtends at p over |e_j x e_k|."""
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
def square_frame(square: int, view: PointView) -> Frame:
    """Return (a0, a1, b0, b1, d) of a square in the block, see ``square_weights``."""
    axis, plane, j, k = SQUARE[square, 0], SQUARE[square, 1], SQUARE[square, 2], SQUARE[square, 3]
    a, b = (axis + 1) % 3, (axis + 2) % 3
    planes = view.planes
    return planes[a, j], planes[a, j + 1], planes[b, k], planes[b, k + 1], planes[axis, plane]


@njit()
def set_square(square: int, view: PointView) -> None:
    """Set the weights of a square in the view: 0 if p lies in its plane but not on the square."""
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
    """Set the barycentric weights of p if it lies on this closed square; return whether it does.

    They are the limit of the mean value coordinates on the cage's surface.
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
    """Set the mean value coordinates of p in the valid cells around a corner (L_v of Eq. 8).

    corner  : 0..7
    valid   : (27,) bool
    view    : of p
    weights : (64,) result

    The 8 cells around the corner have 36 squares. The squares with a single valid side are the
    surface of the cage, so a corner with 8 valid cells is no vertex of it. Cells that touch only
    at an edge or a corner still have a closed surface. The weights (Eq. 1-2) have a positive sum
    because p lies in the cage.
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
    """Return b(p) of Eq. 9, f_h = smoothstep(x / h): 0 on the parts shared with valid neighbours.

    own : (64,) coordinates in the cell alone; Eq. 9 sums them over the corners that a neighbour has
    """
    product = 1.0
    for cell in range(27):
        if valid[cell] and cell != MIDDLE:
            shared = 0.0
            for v in range(8):
                if AROUND[v, cell]:
                    shared += own[corner_node(v)]
            product *= max(1.0 - shared, 0.0)
    return smoothstep(product / smoothing)


@njit()
def boundary_blends(u: Floats, valid: Mask, blends: Floats) -> float:
    """Set W(v, p) of Eq. 8 in blends (8,), 0 at corners of no other cell; return their sum."""
    for v in range(8):
        mask = cells_around(v, valid)
        alone = mask & (mask - 1) == 0
        blends[v] = 0.0 if alone else corner_blend(v, u)
    return float(blends.sum())


@njit()
def cages_weights(u: Rows, neighbours: Mask, smoothing: float, weights: Rows) -> None:
    """Set s(p) of Eq. 7 in ``weights``.

    u          : (p,3) in [0,1]
    neighbours : (p,27) bool
    smoothing  : h in (0,1]
    weights    : (p,64) result
    """
    alone = np.zeros(27, np.bool_)
    alone[MIDDLE] = True
    view = PointView(np.empty((3, 4)), np.empty(144), np.empty((108, 4)))
    blends = np.empty(8)
    joined = np.empty(64)
    for p in range(len(u)):
        set_view(u[p], view)
        # x(p) of Eq. 7
        joined_cage(0, alone, view, weights[p])
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
    """Return a table (256,3,27) of gradients: column a of F_v is table[mask, a] @ x.

    The mask is the result of ``cells_around``, and x are the 3x3x3 nodes around v. A single valid
    cell suffices, as its 8 nodes span space. Mask 0 does not occur and holds zeros.
    """
    axes = [[-1.0, 0.0, 1.0]] * 3
    offsets = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(27, 3)
    # a cell around v has its far corner at (+-1, +-1, +-1)
    octants = (offsets != 0).all(1)
    # (8 cells, 27 nodes)
    is_corner = ((offsets == 0) | (offsets == offsets[octants][:, None])).all(-1)
    bits = np.arange(256)[:, None] >> np.arange(8) & 1
    has_node = bits @ is_corner > 0
    # (256,27,3) X_j - X_v, and 0 if node j belongs to no valid cell
    spans = has_node[..., None] * offsets
    table = np.zeros((256, 3, 27))
    # normal equations: their solution is exactly 0 at nodes of no valid cell
    normal = spans[1:].swapaxes(1, 2)
    table[1:] = np.linalg.solve(normal @ spans[1:], normal)
    # x_j - x_v gives the negative sum at v itself
    table[:, :, 13] = -table.sum(2)
    return table


@njit()
def affine_weights(u: Rows, neighbours: Mask, table: Rows, weights: Rows) -> None:
    """Set J(p) of Eq. 8 with the affine L_v of ``gradient_table``; see ``cages_weights``."""
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
