"""Build the embedding W, a sparse matrix: surface points = W @ node positions (paper 3.1).

``stencil_weights`` computes the rows of W by one of four kinds of coordinates:

- "mvc": mean value coordinates of a cell (Eq. 1-6, geometry.mean_value_coordinates),
- "cages": *Cages coordinates, smooth across cells (Eq. 7-9, geometry.blended_coordinates),
- "affine": blended affine maps, smooth across cells (ours, geometry.blended_coordinates),
- "trilinear": the cell's trilinear interpolation, for loads on the surface.
"""

from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_array, csr_array

from msmpetsc.backend.arrays import Floats, Indices, Mask, Positions, Rows
from msmpetsc.comm import Route
from msmpetsc.geometry.blended_coordinates import affine_weights, cages_weights, gradient_table
from msmpetsc.geometry.block import MIDDLE, NODE_STRIDE
from msmpetsc.geometry.cages import Cages
from msmpetsc.geometry.grid import CHUNK, CORNERS
from msmpetsc.geometry.morton import COPIES, decode_morton, encode_morton
from msmpetsc.geometry.partition import SortedKeys

# distance within which a point is moved onto a face of its cell [cells]; rounding
ON_FACE = 1e-14
# offsets of the cells and the nodes around a cell, in the order of stencil_weights
CELLS_AROUND = np.stack(np.unravel_index(np.arange(27), (3, 3, 3)), axis=1) - 1
NODES_AROUND = np.stack(np.unravel_index(np.arange(64), (4, 4, 4)), axis=1) - 1


def embed(
    points: Sequence[Positions], cages: Cages, nodes: SortedKeys, kind: str, smoothing: float = 1.0
) -> csr_array:
    """Return W for the surface points of all bodies in order (collective).

    Each rank has a contiguous range of the rows. The columns are global node numbers.

    points : for each body (v, 3) [m] on rank 0, (0, 3) on other ranks; all in valid cells
    nodes  : keys of the lattice's nodes, whose positions are the node numbers
    kind, smoothing : see ``stencil_weights``

    Raises ValueError on all ranks if a point lies in no valid cell.
    """
    comm = cages.table.comm
    total = comm.allreduce(sum(map(len, points)))
    row, key, u = _to_cells(points, cages)
    cell_keys, cell = np.unique(key, return_inverse=True)
    neighbours, node_keys = _around(cages, cell_keys)
    if not all(comm.allgather(bool(neighbours[:, MIDDLE].all()))):
        raise ValueError("a point lies in a cell that is not valid")
    numbers = nodes.find(node_keys)

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
    """Send points to the ranks that own their cells (collective).

    Return, for the points received, number (p,), key of the cell (p,) and coordinates in it (p, 3).
    """
    of_bodies = [cells_at(cages, body, of_body) for body, of_body in enumerate(points)]
    keys, u = (np.concatenate(rows) for rows in zip(*of_bodies, strict=True))
    route = Route(cages.table.comm, cages.table.owner(keys))
    return route.send(np.arange(len(u))), route.send(keys), route.send(u)


def cells_at(cages: Cages, body: int, points: Positions) -> tuple[Indices, Rows]:
    """Return the key (n,) of the cell of each point (n, 3) [m], and coordinates in it (n, 3).

    In a cell with several parts, the key names the copy for the part that holds the point. Only
    rank 0 finds this copy. The points lie on a body's surface or inside it.
    """
    at, parts = cages.grids.grids[body].to_cells(points), cages.parts[body]
    ijk = np.floor(at).astype(np.int64)
    copy = parts.find(points, ijk) if parts else 0
    return encode_morton(ijk + cages.grids.first(body)) + copy, at - ijk


def _around(cages: Cages, keys: Indices) -> tuple[Mask, Indices]:
    """Return the valid cells (c, 27) and the node keys (c, 64) around cells (c,) (collective).

    A neighbour counts as valid if exactly one copy of it shares a corner with the cell. A node that
    belongs to no such cell has a key of no node, or of a node without weight.
    """
    around = decode_morton(keys)[:, None, :]
    cells = encode_morton(around + CELLS_AROUND)
    neighbours = cages.table.find(cells) >= 0
    node_keys = encode_morton(around + NODES_AROUND)
    ordinary = cages.copies.keys - cages.copies.keys % COPIES
    rows = np.flatnonzero(np.isin(cells, ordinary).any(axis=1))
    copies = cells[rows, :, None] + np.arange(COPIES)
    own, corners = cages.copies.corner_keys(keys[rows]), cages.copies.corner_keys(copies)
    joined = (corners[..., None] == own[:, None, None, None, :]).any(axis=(3, 4))
    # a cell outside the grid has the key -1, and -1 + 1 is the key of the first cell
    joined &= (cages.table.find(copies) >= 0) & (cells[rows] >= 0)[..., None]
    joined[:, MIDDLE] = copies[:, MIDDLE] == keys[rows, None]
    neighbours[rows] = joined.sum(axis=2) == 1
    # cells that share a face come late, and the cell itself last: their corners count
    for cell in np.argsort(-np.abs(CELLS_AROUND).sum(axis=1), kind="stable"):
        row, copy = np.nonzero(joined[:, cell] & neighbours[rows, cell, None])
        place = (CELLS_AROUND[cell] + CORNERS + 1) @ NODE_STRIDE
        node_keys[rows[row][:, None], place] = corners[row, cell, copy]
    return neighbours, node_keys


def stencil_weights(kind: str, u: Rows, neighbours: Mask, smoothing: float = 1.0) -> Rows:
    """Return the weights (p,64) of the nodes around points in valid cells; lengths in cell sizes.

    kind       : one of the module's coordinates
    u          : (p,3) coordinates in the cell, in [0,1]
    neighbours : (p,27) bool, whether the cell at offset (dx, dy, dz) is valid, in the column
                 (dx+1)*9 + (dy+1)*3 + (dz+1)
    smoothing  : h of Eq. 9, in (0,1]; used by "cages"
    returns    : column ix*16 + iy*4 + iz is the node at (ix-1, iy-1, iz-1) from the low corner

    Each row sums to 1, reproduces linear fields, and is exactly 0 at nodes of no valid cell.
    """
    u = np.ascontiguousarray(np.where(u < ON_FACE, 0.0, np.where(u > 1.0 - ON_FACE, 1.0, u)))
    # a single memory layout, so that the kernels are compiled once
    neighbours = np.ascontiguousarray(neighbours, bool)
    if kind == "trilinear":
        x, y, z = np.stack([1 - u, u], axis=2).transpose(1, 0, 2)
        whole = np.zeros((len(u), 4, 4, 4))
        whole[:, 1:3, 1:3, 1:3] = np.einsum("pi,pj,pk->pijk", x, y, z)
        return whole.reshape(len(u), 64)
    weights = np.empty((len(u), 64))
    # mean value coordinates are *Cages coordinates of a cell without neighbours
    if kind == "mvc":
        neighbours = neighbours & (np.arange(27) == MIDDLE)
    if kind == "affine":
        affine_weights(u, neighbours, gradient_table(), weights)
    else:
        cages_weights(u, neighbours, smoothing, weights)
    return weights
