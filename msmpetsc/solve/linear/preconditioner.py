"""Preconditioner of a step's linear solves: any PETSc preconditioner of A, with what bounds contact on its diagonal."""

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.backend.arrays import Positions, like
from msmpetsc.contact.obstacles.penalty import Contact
from msmpetsc.solve.linear.operators import Block
from msmpetsc.solve.linear.unknowns import Unknowns
from msmpetsc.solve.petsc.memory import HOST, Memory

DIRECT = {PETSc.PC.Type.CHOLESKY, PETSc.PC.Type.LU}


class Preconditioner:
    """Any PETSc preconditioner of A, applied to the three columns.

    It is this inner one that the options -pc_... set, for every preset: A is also what the true
    Hessian is preconditioned with.

    matrix  : A, m x m: all three columns go in one call, which MUMPS solves at once
    contact : what is added to its diagonal, if anything
    """

    def __init__(self, matrix: PETSc.Mat, memory: Memory, prefix: str, contact: "ContactDiagonal | None" = None):
        self.matrix, self.memory, self.contact = matrix, memory, contact
        self.blocks: list[Block] = []
        self.pc = PETSc.PC().create(matrix.comm)
        self.pc.setOptionsPrefix(prefix)
        self.pc.setOperators(matrix)

    def prepare(self, q: Positions, contact: Contact | None) -> bool:
        """Make ready for positions q (l, 3) [m]; whether that changed the matrix (collective)."""
        return self.contact is not None and self.contact.follow(contact, q)

    def apply(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        if not self.blocks:  # where the inner preconditioner works: a direct solver does on the CPU
            memory = HOST if self.pc.getType() in DIRECT else self.memory
            self.blocks = [Block(self.matrix, memory), Block(self.matrix, memory)]
        right, solution = self.blocks
        values = right.values
        values[:] = like(values, self.memory.read(x))
        self.pc.matApply(right.mat, solution.mat)
        columns = self.memory.write(y)
        columns[:] = like(columns, solution.values)

    def destroy(self) -> None:
        for part in (*self.blocks, self.pc, *([self.contact] if self.contact else [])):
            part.destroy()


class ContactDiagonal:
    """Diagonal of the matrix that is preconditioned: that of A, and a bound on contact's blocks.

    A + t^2 bound is no less than A plus the blocks, so that a direct solve with it is a step downhill too.

    own   : (m,) diagonal of A, of this rank [kg]
    added : (m,) t^2 times what is added to it, over t^2 [N/m]
    """

    def __init__(self, matrix: PETSc.Mat, unknowns: Unknowns, time_step: float):
        self.matrix, self.unknowns, self.t2 = matrix, unknowns, time_step**2
        self.vector = matrix.createVecLeft()
        matrix.getDiagonal(self.vector)
        self.own = unknowns.memory.read(self.vector).copy()
        self.added = np.zeros_like(self.own)

    def follow(self, contact: Contact | None, q: Positions) -> bool:
        """Add the bound of contact at positions q (l, 3) [m]; whether that changed the matrix (collective)."""
        lattice = self.unknowns.lattice
        bound = (contact.bound(q) if contact else np.zeros(lattice.owned, like=q))[self.unknowns.free]
        changed = lattice.table.comm.allreduce(not bool(np.array_equal(bound, self.added)), MPI.LOR)
        if changed:
            self.added = bound
            self.unknowns.memory.write(self.vector)[:] = self.own + self.t2 * bound
            self.matrix.setDiagonal(self.vector)
        return changed

    def destroy(self) -> None:
        """Collective."""
        self.vector.destroy()
