"""Matrix A and the true Hessian as operators on vectors of unknowns (contexts of MATPYTHON).

A vector of unknowns is an m x 3 dense block. The scalar matrix A multiplies the three columns of
the block in a single product.
"""

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse import coo_array

from msmpetsc.backend.arrays import Array, Floats, Indices, Positions, Rows, like, to_host
from msmpetsc.contact.step_contact import Duals, StepContactAt
from msmpetsc.contact.surface.surface_contact import SurfaceHessian
from msmpetsc.elasticity.energy import Elasticity, Hessian
from msmpetsc.elasticity.solid import CellHessians
from msmpetsc.errors import InputError
from msmpetsc.solve.linear.unknowns import Unknowns
from msmpetsc.solve.petsc.device import Memory
from msmpetsc.solve.petsc.events import CONTACT, HESSIAN, PRODUCT
from msmpetsc.solve.petsc.library import petsc_csr, refuse_nonzeros


class Block:
    """Dense m x 3 matrix of PETSc that holds a copy of a vector of unknowns."""

    def __init__(self, matrix: PETSc.Mat, memory: Memory):
        rows, _ = matrix.getSizes()
        self.mat, self.memory = memory.dense(rows, 3, matrix.comm), memory
        self.destroy = self.mat.destroy

    @property
    def values(self) -> Floats:
        """Return this rank's numbers, x, then y, then z, for immediate reading or writing."""
        return self.memory.values(self.mat)


class ContactBlocks:
    """Apply t^2 times the Hessian of contact: a 3 x 3 block for each node in contact.

    parts : rows of unknowns (k,) and their blocks (k, 3, 3) [kg]
    row   : (owned,) row of each node among the unknowns, -1 if pinned
    """

    def __init__(self, unknowns: Unknowns, time_step: float):
        self.t2, self.unknowns = time_step**2, unknowns
        self.parts: list[tuple[Indices, Rows]] = []
        row = np.full(unknowns.lattice.owned, -1)
        row[to_host(unknowns.free)] = np.arange(unknowns.size)
        self.row = like(unknowns.free, row)

    def linearise(self, contact: StepContactAt | None, duals: Duals | None) -> None:
        """Compute the blocks of contact.

        duals : duals of friction; None for its true curvature
        """
        self.parts = []
        with CONTACT:
            for nodes, blocks in contact.hessian(duals) if contact else ():
                free = np.flatnonzero(self.row[nodes] >= 0)
                if len(free):
                    self.parts.append((self.row[nodes[free]], self.t2 * blocks[free]))

    def add(self, x: PETSc.Vec, vector: PETSc.Vec) -> None:
        """Add the product of the blocks with x to a vector."""
        if not self.parts:
            return
        with CONTACT:
            x, y = self.unknowns.columns(x), self.unknowns.columns_to_write(vector)
            for rows, blocks in self.parts:
                y[:, rows] += np.einsum("aij,ja->ia", blocks, x[:, rows])
            self.unknowns.project(vector)


class ThreeColumns:
    """Apply A (x) I_3, plus contact if given, without assembling the sum."""

    def __init__(self, matrix: PETSc.Mat, unknowns: Unknowns, contact: ContactBlocks | None = None):
        self.matrix, self.contact = matrix, contact
        self.unknowns, self.memory = unknowns, unknowns.memory
        self.input = Block(matrix, self.memory)
        self.product = matrix.matMult(self.input.mat)

    def mult(self, _: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        self.input.values[:] = self.memory.read(x)
        self.matrix.matMult(self.input.mat, result=self.product)
        self.memory.write(y)[:] = self.memory.values(self.product)
        if self.contact:
            self.contact.add(x, y)

    def destroy(self, _: PETSc.Mat) -> None:
        self.input.destroy()
        self.product.destroy()


class TrueHessian:
    """Apply the true Hessian H = M + t^2 (Hessian of E and of contact), without a matrix.

    products : number of products so far
    product  : (l, 3) memory for the forces of a product
    elastic  : Hessian of E at the last positions; None before ``linearise``
    at       : last positions (l, 3) [m], and whether the Hessian is projected
    """

    def __init__(
        self,
        unknowns: Unknowns,
        elasticity: Elasticity,
        time_step: float,
        contact: ContactBlocks | None = None,
        product: Rows | None = None,
    ):
        self.unknowns, self.elasticity = unknowns, elasticity
        self.t2, self.contact = time_step**2, contact
        lattice = unknowns.lattice
        # The rows of pinned nodes stay zero.
        self.v = np.zeros_like(lattice.nodes)
        self.product = np.empty_like(lattice.nodes) if product is None else product
        self.elastic: Hessian | None = None
        self.at = lattice.nodes, False
        self.surface: SurfaceHessian | None = None
        self.products = 0

    def linearise(
        self,
        q: Positions,
        contact: StepContactAt | None,
        projected: bool = False,
        duals: Duals | None = None,
    ) -> None:
        """Linearise about positions q (l, 3) [m], with the contact there.

        projected : leave out the negative parts of springs, cells and contact pairs
        duals     : duals of friction, which replace its true curvature (contact.friction)
        """
        # Free the memory of the old Hessian before the new Hessian takes memory
        self.at, self.elastic = (q, projected), None
        with HESSIAN:
            self.elastic = self.elasticity.hessian_at(q, projected)
            if self.contact:
                self.contact.linearise(contact, duals)
            self.surface = None
            if contact and contact.surface:
                self.surface = contact.surface.hessian(projected, duals[-1] if duals else None)

    def take_slopes(self, slopes: Array) -> None:
        """Replace V U' of a solid's cells at q by ``slopes`` (elasticity.solid.CellHessians)."""
        for part in self.elastic.parts if self.elastic else ():
            if isinstance(part, CellHessians):
                part.slopes[:] = slopes

    def mult(self, _: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        self.products += 1
        with PRODUCT:
            self.unknowns.to_nodes(x, self.v)
            self.unknowns.scaled_sum(self.v, self.t2, self.forces(self.v), y)
            if self.contact:
                self.contact.add(x, y)

    def forces(self, v: Rows) -> Rows:
        """Return the Hessian of E and of surface contact times v (l, 3) [m], (l, 3) [N].

        The next call overwrites the array.
        """
        assert self.elastic is not None, "the Hessian was not linearised"
        self.product[:] = 0
        self.elastic.add_product(v, self.product)
        if self.surface:
            with CONTACT:
                self.surface.add_product(v, self.product)
        return self.product


def assemble(comm: MPI.Comm, unknowns: Unknowns, time_step: float, prefix: str = "") -> PETSc.Mat:
    """Return A = M + t^2 L [kg] as a PETSc matrix of type ``-mat_type`` (collective).

    Raises InputError if the nonzeros exceed PETSc's integers, or if the matrix type computes on
    another device than the run.
    """
    lattice = unknowns.lattice.with_springs()
    row, free = np.full(len(lattice.nodes), -1), to_host(unknowns.free)
    row[free] = np.arange(unknowns.size)
    weight = time_step**2 * lattice.stiffness
    ends = np.concatenate([lattice.springs, lattice.springs[:, ::-1]])
    stiffness = np.bincount(lattice.springs[:, 0], lattice.stiffness, len(row))
    stiffness += np.bincount(lattice.springs[:, 1], lattice.stiffness, len(row))
    diagonal = to_host(unknowns.inertia)[free] + time_step**2 * stiffness[free]
    kept = (row[ends[:, 0]] >= 0) & (unknowns.numbers[ends[:, 1]] >= 0)
    refuse_nonzeros(comm, unknowns.size + int(kept.sum()))
    rows = np.concatenate([np.arange(unknowns.size), row[ends[kept, 0]]])
    columns = unknowns.numbers[np.concatenate([free, ends[kept, 1]])]
    values = np.concatenate([diagonal, -np.tile(weight, 2)[kept]])
    sizes = unknowns.size, unknowns.total
    csr = coo_array((values, (rows, columns)), shape=sizes).tocsr()

    matrix = PETSc.Mat().create(comm=comm)
    matrix.setOptionsPrefix(prefix)
    matrix.setSizes((sizes, sizes))
    matrix.setType(unknowns.memory.mat_type)
    matrix.setOption(PETSc.Mat.Option.SPD, True)
    matrix.setFromOptions()
    matrix.setName("A")
    on_gpu = "cusparse" in unknowns.memory.mat_type
    if ("cusparse" in matrix.getType()) != on_gpu:
        computes = f"the run computes on the {'GPU' if on_gpu else 'CPU'}"
        raise InputError(f"-{prefix}mat_type {matrix.getType()}: {computes}")
    matrix.setPreallocationCSR(petsc_csr(csr))
    return matrix


def python_matrix(unknowns: Unknowns, context: object, comm: PETSc.Comm) -> PETSc.Mat:
    """Return a MATPYTHON with a context, which acts on vectors of unknowns (collective)."""
    size = (3 * unknowns.size, 3 * unknowns.total)
    matrix = PETSc.Mat().createPython((size, size), context, comm=comm)
    matrix.setName(type(context).__name__)
    matrix.setVecType(unknowns.memory.vec_type)
    matrix.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    matrix.setUp()
    return matrix
