"""Jacobian of F, as SNES has it: an operator to solve with, and what that is preconditioned with."""

from contextlib import ExitStack
from functools import cached_property, partial

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.backend.arrays import greatest
from msmpetsc.contact.obstacles.penalty import Contact, Secants
from msmpetsc.elasticity.energy import Elasticity
from msmpetsc.errors import InputError
from msmpetsc.solve.linear.operators import ContactBlocks, ThreeColumns, TrueHessian, python_matrix
from msmpetsc.solve.linear.preconditioner import ContactDiagonal, Preconditioner
from msmpetsc.solve.linear.system import assemble, diagonal_of
from msmpetsc.solve.linear.unknowns import Unknowns
from msmpetsc.solve.multigrid.preconditioner import LatticePreconditioner
from msmpetsc.solve.nonlinear.preconditioning import MASSLESS, MULTIGRID, Preconditioned, StepPreconditioner
from msmpetsc.solve.presets import SolverOptions


class Jacobian:
    """The true Hessian of g, or the constant A = M + t^2 L in its place (Eq. 15-17).

    owned        : takes what must be destroyed, in the order it was made
    true_hessian : the operator is the true Hessian, not A
    kronecker    : A is preconditioned as A (x) I_3, 3m x 3m
    chooses      : the preconditioner, where the user has chosen none
    touches      : steps may have a ``contact``
    options      : of the solver, for the types of matrices and preconditioner

    diagonal     : of A (m,), of this rank's free nodes [kg]

    Raises InputError where A is too large for PETSc, or of a type that does not go with the arrays, and for multigrid
    of the Hessian where the operator is A (collective).
    """

    def __init__(
        self,
        comm: MPI.Comm,
        unknowns: Unknowns,
        elasticity: Elasticity,
        time_step: float,
        owned: ExitStack,
        *,
        true_hessian: bool,
        kronecker: bool,
        chooses: bool,
        touches: bool,
        options: SolverOptions,
    ):
        self.comm, self.unknowns, self.time_step, self.owned, self.options = comm, unknowns, time_step, owned, options
        self.true_hessian, self.kronecker, self.touches = true_hessian, kronecker, touches
        self.diagonal = diagonal_of(unknowns, time_step)
        self.hessian = TrueHessian(unknowns, elasticity, time_step, self._contact_blocks())
        self.blocks = None if true_hessian else self._contact_blocks()  # that go with A
        chooses = chooses and options.is_default("pc_type")
        kind = MULTIGRID if chooses and options.users_of("mg_", "pc_mg_") else options.value("pc_type")
        if kind == MULTIGRID and not true_hessian:
            raise InputError(f"-{options.prefix}pc_type mg is of the Hessian, for newton's presets; of A there is gamg")
        context = self.hessian if true_hessian else ThreeColumns(self.matrix, unknowns, self.blocks)
        self.operator = python_matrix(unknowns, context, comm)
        owned.callback(self.operator.destroy)
        of_lattice = partial(LatticePreconditioner, comm, unknowns, elasticity, time_step, options.prefix, touches)
        ratio, is_held = self._stiffness_ratio(), unknowns.total < unknowns.lattice.table.total
        chooses = chooses and (is_held or ratio < MASSLESS)
        self.preconditioner = StepPreconditioner(self._of_matrix, of_lattice, kind, chooses, ratio, unknowns.total)
        self.pmat = python_matrix(unknowns, Preconditioned(self.preconditioner), comm)
        owned.callback(self.pmat.destroy)

    @cached_property
    def matrix(self) -> PETSc.Mat:
        """A, assembled where something is to be done with it."""
        matrix = self._assembled(1)
        self.options.hide("mat_view")  # which is of A: PETSc would show all matrices, and write each into the same file
        return matrix

    def _assembled(self, columns: int) -> PETSc.Mat:
        matrix = assemble(self.comm, self.unknowns, self.time_step, columns, self.options.prefix)
        self.owned.callback(matrix.destroy)
        return matrix

    def _of_matrix(self) -> Preconditioner:
        matrix = self.matrix
        if self.kronecker:
            matrix = self._assembled(3)
        elif self.touches:  # contact changes what A is preconditioned with, but not A
            matrix = matrix.copy()
            self.owned.callback(matrix.destroy)
        diagonal = ContactDiagonal(matrix, self.unknowns, self.time_step) if self.touches else None
        return Preconditioner(matrix, self.unknowns.memory, 1 if self.kronecker else 3, self.options.prefix, diagonal)

    def _contact_blocks(self) -> ContactBlocks | None:
        return ContactBlocks(self.unknowns, self.time_step) if self.touches else None

    def _stiffness_ratio(self) -> float:
        """Return the greatest t^2 k / m of a free node (collective)."""
        mass, inertia = (m[self.unknowns.free] for m in (self.unknowns.lattice.mass, self.unknowns.inertia))
        return self.comm.allreduce(greatest((self.diagonal - inertia) / mass), MPI.MAX)

    def linearise(
        self, q: np.ndarray, contact: Contact | None, projected: bool, secants: Secants | None, known: bool = False
    ) -> None:
        """Take the Jacobian at positions q (l, 3) [m] (collective): A is constant, only H and contact depend on q.

        projected : without the negative parts of H
        secants   : of friction that H does not have the true curvature of
        known     : H was linearised at this very q already
        """
        if self.true_hessian and not known:
            self.hessian.linearise(q, contact, projected, secants)
        elif self.blocks:
            self.blocks.linearise(contact, q, False)
        changed = self.preconditioner.prepare(q, contact)
        if self.true_hessian or changed:
            self.operator.assemble()
        if changed:
            self.pmat.assemble()
