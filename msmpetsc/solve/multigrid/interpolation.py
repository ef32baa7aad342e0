"""Interpolation between the grids of multigrid, and its transpose, by lists of nodes."""

from typing import NamedTuple

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse import csr_array

from msmpetsc.backend.arrays import Array, Floats, Indices, Rows, like, to_host
from msmpetsc.backend.kernel import kernel
from msmpetsc.comm import reduced
from msmpetsc.solve.linear.ghosts import Ghosted, local_numbers
from msmpetsc.solve.multigrid.grids import CoarseGrid
from msmpetsc.solve.petsc.device import memory_of


class Lists(NamedTuple):
    """A list of nodes for each of n nodes.

    begin : (n + 1,) node i has the list nodes[begin[i] : begin[i + 1]]
    """

    begin: Indices
    nodes: Indices


class Interpolation:
    """Apply P from a coarse grid to finer nodes, and P^T (a context of MATPYTHON).

    P is the same for x, y and z, and the parents of a node have equal weights. So lists of parents
    and children replace an AIJ, with 32 bytes a finer node instead of 134.

    parents  : coarse nodes of each finer node, by local numbers
    children : finer nodes of each local coarse node
    coarse   : values of the coarse nodes, ghosts included; None if no rank has ghosts
    is_first : whether finer vectors are ordered by coordinate, as unknowns are, not by node
    """

    def __init__(
        self, comm: MPI.Comm, rows: csr_array, grid: CoarseGrid, device: Array, first: bool
    ):
        """Build the lists from the matrix P of a coordinate.

        rows   : this rank's rows of P (n, total)
        device : an array on the device of the vectors
        first  : value of ``is_first``
        """
        table, columns = grid.table, rows.indices
        self.own, self.first, self.is_first = len(table.keys), table.first, first
        local, self.ghosts = local_numbers(columns, table.first, self.own)
        size = rows.shape[0], self.own + len(self.ghosts)
        here = csr_array((rows.data, local, rows.indptr), size)
        self.parents, self.children = (
            Lists(*(like(device, part.astype(np.uint32)) for part in (p.indptr, p.indices)))
            for p in (here, csr_array(here.T))
        )
        self.memory, any_ghosts = memory_of(device), reduced(comm, len(self.ghosts)) > 0
        self.coarse = Ghosted(comm, self.own, self.ghosts, device) if any_ghosts else None
        shape = tuple((3 * size, 3 * reduced(comm, size)) for size in (rows.shape[0], self.own))
        self.operator = PETSc.Mat().createPython(shape, self, comm=comm)
        self.operator.setVecType(self.memory.vec_type)
        self.operator.setUp()

    def mult(self, matrix: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        y.set(0.0)
        self.multAdd(matrix, x, y, y)

    def multAdd(self, _: PETSc.Mat, x: PETSc.Vec, before: PETSc.Vec, y: PETSc.Vec) -> None:
        """Write P x + before to y."""
        if before.handle != y.handle:
            before.copy(y)
        coarse = self.memory.read(x).reshape(self.own, 3)
        if self.coarse:
            self.coarse.values[: self.own] = coarse
            self.coarse.update()
            coarse = self.coarse.values
        finer = self._by_node(self.memory.write(y))
        add_means(len(finer), finer, coarse, self.parents)

    def multTranspose(self, _: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Write P^T x to y."""
        own = self.memory.write(y).reshape(self.own, 3)
        coarse = self.coarse.values if self.coarse else own
        finer = self._by_node(self.memory.read(x))
        sum_shares(len(coarse), coarse, finer, self.children, self.parents)
        if self.coarse:
            self.coarse.add_ghosts()
            own[:] = coarse[: self.own]

    def _by_node(self, values: Floats) -> Rows:
        """Return the values of a finer vector as a view (n, 3)."""
        return values.reshape(3, -1).T if self.is_first else values.reshape(-1, 3)

    def rows(self) -> csr_array:
        """Return this rank's rows (n, total) of the matrix P of a coordinate."""
        begin, nodes = map(to_host, self.parents)
        count = np.diff(begin)
        numbers = np.append(self.first + np.arange(self.own), self.ghosts)[nodes]
        size = len(count), self.operator.getSize()[1] // 3
        return csr_array((np.repeat(1 / count, count), numbers, begin), size)

    def destroy(self, _: PETSc.Mat) -> None:
        if self.coarse:
            self.coarse.destroy()


@kernel
def add_means(first: int, count: int, step: int, y: Rows, x: Rows, parents: Lists) -> None:
    """Add the mean of x (c, 3) over the parents of each node to y (n, 3)."""
    begin, nodes = parents
    for i in range(first, count, step):
        a, b, c = 0.0, 0.0, 0.0
        for k in range(begin[i], begin[i + 1]):
            j = nodes[k]
            a, b, c = a + x[j, 0], b + x[j, 1], c + x[j, 2]
        share = 1.0 / (begin[i + 1] - begin[i])
        y[i, 0] += share * a
        y[i, 1] += share * b
        y[i, 2] += share * c


@kernel
def sum_shares(
    first: int, count: int, step: int, y: Rows, x: Rows, children: Lists, parents: Lists
) -> None:
    """Write to y (c, 3) the sum over each node's children of their x (n, 3) / number of parents."""
    begin, nodes = children
    for i in range(first, count, step):
        a, b, c = 0.0, 0.0, 0.0
        for k in range(begin[i], begin[i + 1]):
            j = nodes[k]
            share = 1.0 / (parents.begin[j + 1] - parents.begin[j])
            a, b, c = a + share * x[j, 0], b + share * x[j, 1], c + share * x[j, 2]
        y[i, 0], y[i, 1], y[i, 2] = a, b, c
