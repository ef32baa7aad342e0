"""The coarse grids of a lattice: every second node of its grid, then every second of those, and how
values pass from one to the next.

A node of the finer grid at integer position i is interpolated trilinearly: along an axis it lies on the coarse node
i / 2, or halfway between two. So all its weights are alike, 1 over the number of its parents: 1, 2, 4 or 8.
"""

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.backend.arrays import Indices, Mask, to_host
from msmpetsc.comm import SortedKeys
from msmpetsc.geometry.grid import decode_morton, encode_morton
from msmpetsc.lattice.lattice import CORNERS
from msmpetsc.solve.linear.unknowns import Unknowns, refuse_unknowns

SHRINK = 0.7  # a grid with more nodes than this share of the finer one's is no help


@dataclass(frozen=True)
class CoarseGrid:
    """Nodes of one level; ``table`` has their Morton keys, in whose order they are numbered over all ranks."""

    table: SortedKeys

    @property
    def sizes(self) -> tuple[int, int]:
        """Coordinates of this rank's nodes, and of all: x, y and z of a node follow each other."""
        return 3 * len(self.table.keys), 3 * self.table.total


def grid_indices(unknowns: Unknowns) -> Indices:
    """Return the grid index (l, 3) of each local node, ghosts included."""
    lattice = unknowns.lattice
    nodes, keys = to_host(lattice.nodes), lattice.table.keys
    if not len(nodes):
        return np.empty((0, 3), np.int64)
    # the first node of its body that this rank owns: a spring joins ghosts with such a node
    first = np.maximum(lattice.first_of_body[lattice.body] - lattice.table.first, 0)
    steps: Indices = np.rint((nodes - nodes[first]) / lattice.cell_size).astype(np.int64)
    return decode_morton(keys[first]) + steps


def parents_of(ijk: Indices) -> tuple[Indices, Mask]:
    """Return the Morton keys (n, 8) of the coarse nodes that grid indices (n, 3) are interpolated from, and which of
    them are needed, (n, 8) bool: those of a corner that lies beyond an even index have no weight."""
    needed = ~((CORNERS[None] > 0) & (ijk[:, None, :] % 2 == 0)).any(axis=2)
    return encode_morton(ijk[:, None, :] // 2 + CORNERS * (ijk[:, None, :] % 2)), needed


def grids(
    comm: MPI.Comm, ijk: Indices, total: int, coarsest: int, count: int | None = None
) -> list[CoarseGrid]:
    """Return the grids above nodes at grid indices (n, 3), of ``total`` on all ranks, the finest first (collective).

    There are ``count``, or so many that the last has ``coarsest`` nodes or less; but fewer where a
    coarser one would not be much smaller. Raises InputError for more nodes than PETSc can number.
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
    """Return P (AIJ), from the values at a grid to those at finer nodes (collective).

    ijk  : (n, 3) grid indices of this rank's finer nodes that are unknowns
    rows : (n, 3) this rank's rows of their x, y and z
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
