"""Coarse grids of a lattice and the interpolation between them.

Each grid has every second node of the finer grid along each axis. Interpolation is trilinear: along
an axis, a node at integer position i lies on the coarse node i / 2 or halfway between two coarse
nodes. Its 1, 2, 4 or 8 parents therefore have equal weights.
"""

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.backend.arrays import Array, Indices, Mask
from msmpetsc.geometry.grid import CORNERS
from msmpetsc.geometry.morton import decode_morton, encode_morton
from msmpetsc.geometry.partition import SortedKeys
from msmpetsc.solve.linear.unknowns import Unknowns, refuse_unknowns
from msmpetsc.solve.multigrid.coarse_copies import CoarseCopies

# most nodes of a coarse grid, over the finer grid's; a larger grid does not pay
SHRINK = 0.7


@dataclass(frozen=True)
class CoarseGrid:
    """Nodes of a coarse level.

    table  : their Morton keys, which number them over all ranks
    copies : (n, 8) copies of the parents of this rank's finer nodes (multigrid.coarse_copies)
    """

    table: SortedKeys
    copies: Array

    def sizes(self, width: int) -> tuple[int, int]:
        """Return the numbers of unknowns of this rank and of all ranks, ``width`` for each node."""
        return width * len(self.table.keys), width * self.table.total


def node_keys(unknowns: Unknowns) -> Indices:
    """Return the key (l,) of each local node, ghosts included (collective)."""
    table = unknowns.lattice.table
    return table.with_ghosts(unknowns.lattice.ghosts, table.keys)


def parents_of(keys: Indices, copies: Array) -> tuple[Indices, Mask]:
    """Return the keys (n, 8) of the parents of nodes (n,), and a mask (n, 8).

    Corners that lie beyond an even index have no weight; the mask leaves them out.

    copies : (n, 8) numbers of the parents' copies (solve.multigrid.coarse_copies)
    """
    ijk = decode_morton(keys)
    needed = ~((CORNERS[None] > 0) & (ijk[:, None, :] % 2 == 0)).any(axis=2)
    return encode_morton(ijk[:, None, :] // 2 + CORNERS * (ijk[:, None, :] % 2)) + copies, needed


def grids(
    comm: MPI.Comm,
    keys: Indices,
    copies: CoarseCopies,
    free: Indices,
    total: int,
    coarsest: int,
    count: int | None = None,
) -> list[CoarseGrid]:
    """Return the coarse grids of nodes with keys (n,), the finest first (collective).

    Coarsening stops early if the next grid would not be much smaller. Raises InputError if PETSc
    cannot number the nodes.

    free     : (n,) local numbers of the nodes in the lattice
    total    : number of nodes on all ranks
    coarsest : most nodes of the last grid, if ``count`` is None
    count    : number of grids
    """
    levels: list[CoarseGrid] = []
    while not levels or (total > coarsest if count is None else len(levels) < count):
        of_parents = copies.of(levels[-1].table) if levels else copies.of_nodes[free]
        parents, needed = parents_of(keys, of_parents)
        grid = CoarseGrid(SortedKeys(comm, parents[needed]), of_parents)
        refuse_unknowns(grid.table.total)
        if levels and grid.table.total > SHRINK * total:
            break
        levels.append(grid)
        total, keys = grid.table.total, grid.table.keys
    return levels


def interpolation(
    comm: MPI.Comm,
    keys: Indices,
    rows: Indices,
    row_sizes: tuple[int, int],
    grid: CoarseGrid,
    mat_type: str,
) -> PETSc.Mat:
    """Return the interpolation P (AIJ) from a coarse grid to finer nodes (collective).

    keys      : (n,) keys of this rank's finer nodes that are unknowns
    rows      : (n, w) local rows of their w components, 3 or 1
    row_sizes : numbers of rows of this rank and of all ranks
    """
    width = rows.shape[1]
    parents, needed = parents_of(keys, grid.copies)
    number = np.full(parents.shape, -1)
    number[needed] = grid.table.find(parents[needed])
    count = needed.sum(axis=1)
    lengths = np.empty(row_sizes[0], np.int64)
    lengths[rows] = count[:, None]
    begin = np.concatenate([[0], np.cumsum(lengths)])
    columns, values = np.empty(begin[-1], PETSc.IntType), np.empty(begin[-1])
    slot = np.cumsum(needed, axis=1) - 1
    node, corner = np.nonzero(needed)
    for c in range(width):
        entry = begin[rows[node, c]] + slot[node, corner]
        columns[entry] = width * number[node, corner] + c
        values[entry] = 1 / count[node]
    csr = begin.astype(PETSc.IntType), columns, values
    matrix = PETSc.Mat().create(comm=comm)
    matrix.setSizes((row_sizes, grid.sizes(width)))
    matrix.setType(mat_type)
    matrix.setPreallocationCSR(csr)
    matrix.setName("interpolation")
    return matrix
