"""Products with coarse matrices in single precision on the CPU, which PETSc lacks."""

from typing import NamedTuple

import numpy as np
from petsc4py import PETSc

from msmpetsc.backend.arrays import Array, Indices, Mask, Rows
from msmpetsc.backend.kernel import njit
from msmpetsc.solve.linear.ghosts import Ghosted, local_numbers


class BlockRows(NamedTuple):
    """Chosen 3 x 3 blocks of a matrix, in compressed rows.

    begin   : (n + 1,) row i has the blocks begin[i] to begin[i + 1]
    columns : (k,) column of each block
    place   : (k,) place of each block in the whole matrix
    values  : (k, 9) float32
    """

    begin: Indices
    columns: Indices
    place: Indices
    values: Array

    @classmethod
    def chosen(cls, chosen: Mask, rows: int, row: Indices, columns: Indices) -> "BlockRows":
        """Return the blocks (b,) that a mask chooses, without values."""
        begin = np.searchsorted(row[chosen], np.arange(rows + 1))
        place = np.flatnonzero(chosen).astype(np.int32)
        values = np.empty((len(place), 9), np.float32)
        return cls(begin, columns[chosen].astype(np.int32), place, values)


class CoarseOperator:
    """Apply the matrix H of a coarse level in single precision. All methods are collective.

    Memory bandwidth limits a product. Therefore only the upper triangle is kept, in single
    precision and with an index for each block: 0.6 kB a node instead of the 2.9 kB of an AIJ.
    Blocks multiply differences between nodes, and the sums of a row's blocks multiply the nodes.
    Thus the product with a translation keeps its digits, even if H is stiff.

    pattern  : symmetric AIJ of the nodes, with an entry for each block
    operator : MATPYTHON with this context
    own      : blocks of the upper triangle whose columns are on this rank
    remote   : blocks whose columns are ghosts
    sums     : (n, 9) sum of all blocks of each row
    nodes    : values of nodes in double precision, ghosts included; None on a single rank
    """

    def __init__(self, pattern: PETSc.Mat):
        self.comm = pattern.comm
        begin, columns, _ = pattern.getValuesCSR()
        first, last = pattern.getOwnershipRange()
        self.begin = begin[:-1]
        owned = last - first
        row = np.repeat(np.arange(owned), np.diff(begin))
        local, ghosts = local_numbers(columns, first, owned)
        self.own = BlockRows.chosen((local < owned) & (local > row), owned, row, local)
        self.remote = BlockRows.chosen(local >= owned, owned, row, local - owned)
        self.sums = np.empty((owned, 9), np.float32)
        self.x, self.y = np.empty((2, owned, 3), np.float32)
        self.nodes = Ghosted(self.comm, owned, ghosts, self.sums) if self.comm.size > 1 else None
        sizes = 3 * owned, 3 * pattern.getSize()[0]
        self.operator = PETSc.Mat().createPython((sizes, sizes), self, comm=self.comm)
        self.operator.setBlockSize(3)
        self.operator.setUp()

    def update(self, blocks: Rows) -> None:
        """Set the blocks (k, 9) of this rank's rows."""
        self.sums[:] = np.add.reduceat(blocks, self.begin, axis=0)
        for part in (self.own, self.remote):
            part.values[:] = blocks[part.place]
        self.operator.assemble()

    def mult(self, _: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Write H x to y."""
        self.x[:] = x.array_r.reshape(-1, 3)
        multiply_upper(self.own, self.sums, self.x, self.y)
        if self.nodes:
            owned = len(self.x)
            self.nodes.values[:owned] = x.array_r.reshape(-1, 3)
            self.nodes.update()
            ghosts = self.nodes.values[owned:].astype(np.float32)
            add_product(self.remote, self.x, ghosts, self.y)
        y.array_w[:] = self.y.ravel()

    def destroy(self, _: PETSc.Mat) -> None:
        if self.nodes:
            self.nodes.destroy()


@njit(fastmath={"reassoc", "contract", "nsz"})
def multiply_upper(blocks: BlockRows, sums: Array, x: Array, y: Array) -> None:
    """Write H x to y for a symmetric H given by the blocks above its diagonal.

    sums : (n, 9) sum of all blocks of each row
    """
    begin, columns, _, h = blocks
    y[:] = 0
    for i in range(len(begin) - 1):
        u, v, w = x[i, 0], x[i, 1], x[i, 2]
        a = y[i, 0] + sums[i, 0] * u + sums[i, 1] * v + sums[i, 2] * w
        b = y[i, 1] + sums[i, 3] * u + sums[i, 4] * v + sums[i, 5] * w
        c = y[i, 2] + sums[i, 6] * u + sums[i, 7] * v + sums[i, 8] * w
        for k in range(begin[i], begin[i + 1]):
            j = columns[k]
            d, e, f = x[j, 0] - u, x[j, 1] - v, x[j, 2] - w
            a += h[k, 0] * d + h[k, 1] * e + h[k, 2] * f
            b += h[k, 3] * d + h[k, 4] * e + h[k, 5] * f
            c += h[k, 6] * d + h[k, 7] * e + h[k, 8] * f
            y[j, 0] -= h[k, 0] * d + h[k, 3] * e + h[k, 6] * f
            y[j, 1] -= h[k, 1] * d + h[k, 4] * e + h[k, 7] * f
            y[j, 2] -= h[k, 2] * d + h[k, 5] * e + h[k, 8] * f
        y[i, 0], y[i, 1], y[i, 2] = a, b, c


@njit()
def add_product(blocks: BlockRows, x: Array, ghosts: Array, y: Array) -> None:
    """Add the products of blocks with ghosts - x to y, with x of each block's row."""
    begin, columns, _, h = blocks
    for i in range(len(begin) - 1):
        u, v, w = x[i, 0], x[i, 1], x[i, 2]
        for k in range(begin[i], begin[i + 1]):
            j = columns[k]
            d, e, f = ghosts[j, 0] - u, ghosts[j, 1] - v, ghosts[j, 2] - w
            for r in range(3):
                y[i, r] += h[k, 3 * r] * d + h[k, 3 * r + 1] * e + h[k, 3 * r + 2] * f
