"""Coarse grids of a lattice and the interpolation between them.

Each grid has every second node of the finer grid along each axis. Interpolation is trilinear: along
an axis, a node at integer position i lies on the coarse node i / 2 or halfway between two coarse
nodes. Its 1, 2, 4 or 8 parents therefore have equal weights.
"""

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.backend.arrays import Indices, Mask, to_host
from msmpetsc.comm import SortedKeys
from msmpetsc.geometry.morton import decode_morton, encode_morton
from msmpetsc.lattice.cut_cells import CORNERS
from msmpetsc.solve.linear.unknowns import Unknowns, refuse_unknowns

# most nodes of a coarse grid, over the finer grid's; a larger grid does not pay
SHRINK = 0.7


@dataclass(frozen=True)
class CoarseGrid:
    """Nodes of a coarse level, numbered over all ranks by their Morton keys ``table``."""

    table: SortedKeys

    @property
    def sizes(self) -> tuple[int, int]:
        """Return the numbers of coordinates of this rank and of all ranks, interleaved by node."""
        return 3 * len(self.table.keys), 3 * self.table.total


def grid_indices(unknowns: Unknowns) -> Indices:
    """Return the grid index (l, 3) of each local node, ghosts included."""
    lattice = unknowns.lattice
    nodes, keys = to_host(lattice.nodes), lattice.table.keys
    if not len(nodes):
        return np.empty((0, 3), np.int64)
    # The origin is an owned node: a spring joins each ghost with an owned node.
    first = np.maximum(lattice.first_of_body[lattice.body] - lattice.table.first, 0)
    steps: Indices = np.rint((nodes - nodes[first]) / lattice.cell_size).astype(np.int64)
    return decode_morton(keys[first]) + steps


def parents_of(ijk: Indices) -> tuple[Indices, Mask]:
    """Return the Morton keys (n, 8) of the parents of grid indices (n, 3), and a mask (n, 8).

    Corners that lie beyond an even index have no weight; the mask leaves them out.
    """
    needed = ~((CORNERS[None] > 0) & (ijk[:, None, :] % 2 == 0)).any(axis=2)
    return encode_morton(ijk[:, None, :] // 2 + CORNERS * (ijk[:, None, :] % 2)), needed


def grids(
    comm: MPI.Comm, ijk: Indices, total: int, coarsest: int, count: int | None = None
) -> list[CoarseGrid]:
    """Return the coarse grids of nodes at grid indices (n, 3), the finest first (collective).

    Coarsening stops early if the next grid would not be much smaller. Raises InputError if PETSc
    cannot number the nodes.

    total    : number of nodes on all ranks
    coarsest : most nodes of the last grid, if ``count`` is None
    count    : number of grids
    """
    levels: list[CoarseGrid] = []
    while not levels or (total > coarsest if count is None else len(levels) < count):
        keys, needed = parents_of(ijk)
        grid = CoarseGrid(SortedKeys(comm, keys[needed]))
        refuse_unknowns(grid.table.total)
        if levels and grid.table.total > SHRINK * total:
            break
        levels.append(grid)
        total, ijk = grid.table.total, decode_morton(grid.table.keys)
    return levels


def interpolation(
    comm: MPI.Comm,
    ijk: Indices,
    rows: Indices,
    row_sizes: tuple[int, int],
    grid: CoarseGrid,
    mat_type: str,
) -> PETSc.Mat:
    """Return the interpolation P (AIJ) from a coarse grid to finer nodes (collective).

    ijk       : (n, 3) grid indices of this rank's finer nodes that are unknowns
    rows      : (n, 3) local rows of their x, y and z
    row_sizes : numbers of rows of this rank and of all ranks
    """
    keys, needed = parents_of(ijk)
    number = np.full(keys.shape, -1)
    number[needed] = grid.table.find(keys[needed])
    count = needed.sum(axis=1)
    lengths = np.empty(row_sizes[0], np.int64)
    lengths[rows] = count[:, None]
    begin = np.concatenate([[0], np.cumsum(lengths)])
    columns, values = np.empty(begin[-1], PETSc.IntType), np.empty(begin[-1])
    slot = np.cumsum(needed, axis=1) - 1
    node, corner = np.nonzero(needed)
    for c in range(3):
        entry = begin[rows[node, c]] + slot[node, corner]
        columns[entry] = 3 * number[node, corner] + c
        values[entry] = 1 / count[node]
    csr = begin.astype(PETSc.IntType), columns, values
    matrix = PETSc.Mat().create(comm=comm)
    matrix.setSizes((row_sizes, grid.sizes))
    matrix.setType(mat_type)
    matrix.setPreallocationCSR(csr)
    matrix.setName("interpolation")
    return matrix
