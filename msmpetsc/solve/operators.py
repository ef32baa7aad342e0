"""What PETSc's solvers see: operators and a preconditioner on vectors of three coordinates.

Each is a Python context over the scalar matrix A, which acts on the m x 3 block that a vector of
unknowns is: one product or one solve for three right-hand sides.
"""

import numba
import numpy as np
from petsc4py import PETSc

from msmpetsc.model.elasticity import Elasticity
from msmpetsc.model.penalty import Contact
from msmpetsc.solve.unknowns import Unknowns


class Block:
    """PETSc dense m x 3 matrix that vectors of unknowns are copied into and out of."""

    def __init__(self, matrix: PETSc.Mat):
        rows, _ = matrix.getSizes()
        self.mat = PETSc.Mat().createDense((rows, (None, 3)), comm=matrix.comm)
        self.mat.setUp()
        self.mat.assemble()
        self.values = self.mat.getDenseArray().T.reshape(-1)  # a view of PETSc's memory: x, then y, then z
        self.destroy = self.mat.destroy


class ContactBlocks:
    """t^2 (Hessian of contact): a 3 x 3 block for each node in contact, added to either operator below."""

    def __init__(self, unknowns: Unknowns, time_step: float):
        self.t2 = time_step**2
        self.row = np.full(unknowns.lattice.owned, -1)
        self.row[unknowns.free] = np.arange(unknowns.size)
        self.rows, self.blocks = np.empty(0, np.int64), np.empty((0, 3, 3))

    def linearise(self, contact: Contact | None, q: np.ndarray, true: bool) -> None:
        """Take the blocks at positions q, ``true`` ones or such as go with A."""
        nodes, blocks = contact.hessian(q, true) if contact else (np.empty(0, np.int64), np.empty((0, 3, 3)))
        free = self.row[nodes] >= 0
        self.rows, self.blocks = self.row[nodes[free]], self.t2 * blocks[free]

    def add(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y += blocks x."""
        if len(self.rows):
            x, y = x.array_r.reshape(3, -1), y.array.reshape(3, -1)
            y[:, self.rows] += np.einsum("aij,ja->ia", self.blocks, x[:, self.rows])


class ThreeColumns:
    """A (x) I_3 without forming it; ``contact`` is None where the scene has no penalty."""

    def __init__(self, matrix: PETSc.Mat, contact: ContactBlocks | None = None):
        self.matrix, self.contact = matrix, contact
        self.input = Block(matrix)
        self.product = matrix.matMult(self.input.mat)
        self.values = self.product.getDenseArray().T.reshape(-1)

    def mult(self, _: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        self.input.values[:] = x.array_r
        self.matrix.matMult(self.input.mat, result=self.product)
        y.array[:] = self.values
        if self.contact:
            self.contact.add(x, y)

    def destroy(self, _: PETSc.Mat) -> None:
        self.input.destroy()
        self.product.destroy()


class TrueHessian:
    """M + t^2 (Hessian of E, and of contact) at the positions last linearised about, applied spring by spring."""

    def __init__(
        self, unknowns: Unknowns, elasticity: Elasticity, time_step: float, contact: ContactBlocks | None = None
    ):
        self.unknowns, self.elasticity, self.t2, self.contact = unknowns, elasticity, time_step**2, contact
        lattice = unknowns.lattice
        self.v = np.zeros_like(lattice.nodes)  # pinned nodes stay zero
        self.product = np.empty_like(lattice.nodes)

    def linearise(self, q: np.ndarray, contact: Contact | None, projected: bool = False) -> None:
        """Take the Hessian at positions q (l, 3); ``projected`` leaves out its negative parts (model.energy)."""
        self.elastic = self.elasticity.hessian_at(q, projected)
        if self.contact:
            self.contact.linearise(contact, q, True)

    def mult(self, _: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        self.unknowns.to_nodes(x, self.v)
        self.product[:] = 0
        self.elastic.add_product(self.v, self.product)
        lattice, free = self.unknowns.lattice, self.unknowns.free
        scaled_sum(free, lattice.mass, self.v, self.t2, self.product, y.array.reshape(3, -1))
        if self.contact:
            self.contact.add(x, y)


@numba.njit(cache=True)
def scaled_sum(rows, mass, a, t2, b, columns):
    """M a + t^2 b at the given rows of (l, 3) arrays, written as (3, m) columns."""
    for i in range(len(rows)):
        for c in range(3):
            columns[c, i] = mass[rows[i]] * a[rows[i], c] + t2 * b[rows[i], c]


class Preconditioner:
    """Any PETSc preconditioner of A, applied to the three columns (a PCPYTHON context).

    It is this inner one that the options -pc_... set, for every preset: A is also what the true Hessian is
    preconditioned with.

    matrix : A, m x m, then all three columns go in one call, which MUMPS solves at once; or A (x) I_3, 3m x 3m
    """

    def __init__(self, matrix: PETSc.Mat, columns: int, prefix: str):
        self.pc = PETSc.PC().create(matrix.comm)
        self.pc.setOptionsPrefix(prefix)
        self.pc.setOperators(matrix)
        self.blocks = [Block(matrix), Block(matrix)] if columns > 1 else []

    def setFromOptions(self, _: PETSc.PC) -> None:  # noqa: N802 (PETSc's name)
        self.pc.setFromOptions()

    def setUp(self, _: PETSc.PC) -> None:  # noqa: N802
        self.pc.setUp()

    def apply(self, _: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        if not self.blocks:
            self.pc.apply(x, y)
            return
        given, found = self.blocks
        given.values[:] = x.array_r
        self.pc.matApply(given.mat, found.mat)
        y.array[:] = found.values

    def view(self, _: PETSc.PC, viewer: PETSc.Viewer) -> None:
        self.pc.view(viewer)

    def destroy(self, _: PETSc.PC) -> None:
        for part in (*self.blocks, self.pc):
            part.destroy()


def python_matrix(unknowns: Unknowns, context: ThreeColumns | TrueHessian, comm: PETSc.Comm) -> PETSc.Mat:
    """A MATPYTHON on vectors of unknowns."""
    size = (3 * unknowns.size, 3 * unknowns.total)
    matrix = PETSc.Mat().createPython((size, size), context, comm=comm)
    matrix.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    matrix.setUp()
    return matrix
