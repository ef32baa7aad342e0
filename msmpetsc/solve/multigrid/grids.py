"""Coarse grids of a lattice and the interpolation between them.

Each grid has every second node of the finer grid along each axis. Interpolation is trilinear: along
an axis, a node at integer position i lies on the coarse node i / 2 or halfway between two coarse
nodes. Its 1, 2, 4 or 8 parents therefore have equal weights.
"""

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from scipy.sparse import csr_array

from msmpetsc.backend.arrays import Array, Indices, Mask
from msmpetsc.geometry.grid import CORNERS
from msmpetsc.geometry.morton import decode_morton, encode_morton
from msmpetsc.geometry.partition import SortedKeys
from msmpetsc.solve.linear.unknowns import Unknowns
from msmpetsc.solve.multigrid.coarse_copies import CoarseCopies
from msmpetsc.solve.petsc.library import refuse_unknowns


@dataclass(frozen=True)
class CoarseGrid:
    """Nodes of a coarse level.

    table  : Morton keys of the nodes, which number the nodes over all ranks
    copies : (n, 8) copies of the parents of this rank's finer nodes (multigrid.coarse_copies)
    """

    table: SortedKeys
    copies: Array


def node_keys(unknowns: Unknowns) -> Indices:
    """Return the key (l,) of each local node, ghosts included (collective)."""
    table = unknowns.lattice.table
    return table.with_ghosts(unknowns.lattice.ghosts, table.keys)


def parents_of(keys: Indices, copies: Array) -> tuple[Indices, Mask]:
    """Return the keys (n, 8) of the parents of nodes (n,), and a mask (n, 8) of parents that exist.

    Along an axis with an even index, a node has one parent, not two.

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

    Coarsening stops early if the next grid would not be smaller. Raises InputError if PETSc
    cannot number the nodes.

    free     : (n,) local numbers of the nodes in the lattice
    total    : number of nodes on all ranks
    coarsest : greatest number of nodes of the last grid, if ``count`` is None
    count    : number of grids; None for as many as ``coarsest`` needs
    """
    levels: list[CoarseGrid] = []
    while not levels or (total > coarsest if count is None else len(levels) < count):
        of_parents = copies.of(levels[-1].table) if levels else copies.of_nodes[free]
        parents, needed = parents_of(keys, of_parents)
        grid = CoarseGrid(SortedKeys(comm, parents[needed]), of_parents)
        refuse_unknowns(grid.table.total)
        if levels and grid.table.total >= total:
            break
        levels.append(grid)
        total, keys = grid.table.total, grid.table.keys
    return levels


def interpolation(keys: Indices, grid: CoarseGrid) -> csr_array:
    """Return the interpolation P (n, total) of a coordinate to finer nodes (n,) (collective).

    keys : (n,) keys of the finer nodes, the rows of P; its columns are all coarse nodes
    """
    parents, needed = parents_of(keys, grid.copies)
    count = needed.sum(axis=1)
    begin = np.append(0, np.cumsum(count))
    columns = grid.table.find(parents[needed])
    return csr_array((np.repeat(1 / count, count), columns, begin), (len(keys), grid.table.total))
