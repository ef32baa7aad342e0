"""The embedding W, a sparse matrix: surface points = W @ positions of nodes (paper 3.1).

``stencil_weights`` is the one interface to its kinds: mean value coordinates of a cell (geometry.mvc), and two that
are smooth across cells, *Cages coordinates (Eq. 7-9) and affine maps (ours).

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

import numba
import numpy as np
from scipy.sparse import coo_array, csr_array

from msmpetsc.backend.arrays import Floats, Indices, Mask, Positions, Rows
from msmpetsc.comm import Route, SortedKeys
from msmpetsc.geometry.block import AROUND, ITSELF, cells_around, corner_bit, corner_blend, corner_node, smoothstep
from msmpetsc.geometry.cages import Cages
from msmpetsc.geometry.grid import decode_morton, encode_morton
from msmpetsc.geometry.mvc import joined_cage, new_view, set_view

ROUNDING = 1e-9  # how far outside its cell a point may be computed to lie
ON_FACE = 1e-14  # nearer than this to a face of its cell, a point is on it
CHUNK = 1 << 15  # points at once: their 64 weights each take 16 MB
# offsets of the 3 x 3 x 3 cells and the 4 x 4 x 4 nodes around a cell, in the order of stencil_weights
CELLS_AROUND = np.stack(np.unravel_index(np.arange(27), (3, 3, 3)), axis=1) - 1
NODES_AROUND = np.stack(np.unravel_index(np.arange(64), (4, 4, 4)), axis=1) - 1


def embed(points: Sequence[Positions], cages: Cages, nodes: SortedKeys, kind: str, smoothing: float = 1.0) -> csr_array:
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
    rows, columns, weights = (np.concatenate(part) for part in zip(*map(entries, parts), strict=True))
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
    neighbours = np.ascontiguousarray(neighbours, bool)  # one memory layout: the kernels are compiled once
    weights = np.empty((len(u), 64))
    if kind == "mvc":  # *Cages coordinates of a cell without neighbours
        neighbours = neighbours & (np.arange(27) == ITSELF)
    if kind == "affine":
        affine_weights(u, neighbours, gradient_table(), weights)
    else:
        cages_weights(u, neighbours, smoothing, weights)
    return weights


@numba.njit(cache=True)
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


@numba.njit(cache=True)
def boundary_blends(u: Floats, valid: Mask, blends: Floats) -> float:
    """Set W(v, p) of Eq. 8 in blends (8,), 0 at corners of no other valid cell; return their sum."""
    for v in range(8):
        mask = cells_around(v, valid)
        alone = mask & (mask - 1) == 0
        blends[v] = 0.0 if alone else corner_blend(v, u)
    return float(blends.sum())


@numba.njit(cache=True)
def cages_weights(u: Rows, neighbours: Mask, smoothing: float, weights: Rows) -> None:
    """Set s(p) of Eq. 7: u (p,3) in [0,1]; neighbours (p,27) bool; smoothing h in (0,1]; weights (p,64), result."""
    alone = np.zeros(27, np.bool_)
    alone[ITSELF] = True
    view, blends, joined = new_view(), np.empty(8), np.empty(64)
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
    is_corner = ((offsets == 0) | (offsets == offsets[octants][:, None])).all(-1)  # (8 cells, 27 nodes)
    bits = np.arange(256)[:, None] >> np.arange(8) & 1
    spans = (bits @ is_corner > 0)[..., None] * offsets  # (256,27,3): X_j - X_v, 0 where there is no node
    table = np.zeros((256, 3, 27))
    normal = spans[1:].swapaxes(1, 2)  # normal equations: exactly 0 where there is no node
    table[1:] = np.linalg.solve(normal @ spans[1:], normal)
    table[:, :, 13] = -table.sum(2)  # x_j - x_v: v itself, whose own span is 0
    return table


@numba.njit(cache=True)
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
