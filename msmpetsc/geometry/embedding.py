"""The embedding W: one sparse matrix that carries the surface along, surface = W @ positions (paper 3.1).

``stencil_weights`` is the one interface to the kinds of embedding, in geometry.mvc and geometry.smoothing.
"""

from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_array, csr_array

from msmpetsc.backend.arrays import Floats, Indices, Mask, Positions, Rows
from msmpetsc.comm import Route, SortedKeys
from msmpetsc.geometry.block import ITSELF
from msmpetsc.geometry.cages import Cages
from msmpetsc.geometry.grid import decode_morton, encode_morton
from msmpetsc.geometry.mvc import mvc_weights
from msmpetsc.geometry.smoothing import affine_weights, cages_weights

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
    """Send each point to its cell's rank: its number there, its cell (p, 3), its coordinates in the cell (p, 3)."""
    at = [grid.to_cells(of_body) for grid, of_body in zip(cages.grids.grids, points, strict=True)]
    cells = [np.floor(of_body).astype(np.int64) for of_body in at]
    u = np.concatenate([x - ijk for x, ijk in zip(at, cells, strict=True)])
    ijk = np.concatenate([of_body + cages.grids.first(body) for body, of_body in enumerate(cells)])
    route = Route(cages.table.comm, cages.table.owner(encode_morton(ijk)))
    return route.send(np.arange(len(u))), route.send(ijk), route.send(u)


def stencil_weights(kind: str, u: Rows, neighbours: Mask, smoothing: float = 1.0) -> Rows:
    """Return the weights (p,64) of the nodes around points in valid cells; lengths in units of the cell size.

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
    if kind == "mvc":
        mvc_weights(u, weights)
    elif kind == "cages":
        cages_weights(u, neighbours, smoothing, weights)
    else:
        affine_weights(u, neighbours, weights)
    return weights
