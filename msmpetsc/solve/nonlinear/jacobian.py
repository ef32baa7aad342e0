"""Jacobian of F, as SNES has it: an operator to solve with, and a matrix to precondition that with."""

from contextlib import ExitStack

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import greatest
from msmpetsc.errors import InputError
from msmpetsc.model.contact.penalty import Contact
from msmpetsc.model.elasticity import Elasticity
from msmpetsc.solve.linear.operators import ContactBlocks, ThreeColumns, TrueHessian, python_matrix
from msmpetsc.solve.linear.preconditioner import ContactDiagonal, Preconditioned, Preconditioner
from msmpetsc.solve.linear.system import assemble
from msmpetsc.solve.linear.unknowns import Unknowns
from msmpetsc.solve.multigrid.preconditioner import LatticePreconditioner
from msmpetsc.solve.nonlinear.preconditioning import MULTIGRID, StepPreconditioner
from msmpetsc.solve.presets import SolverOptions


class Jacobian:
    """The true Hessian of g, or the constant A = M + t^2 L in its place (Eq. 15-17), and A for the preconditioner.

    owned        : takes what must be destroyed, in the order it was made
    true_hessian : the operator is the true Hessian, not A
    kronecker    : A is preconditioned as A (x) I_3, 3m x 3m
    touches      : steps may have a ``contact``
    options      : of the solver, for the types of matrices and preconditioner
    chooses      : the preconditioner, where the user has chosen none

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
        touches: bool,
        options: SolverOptions,
        chooses: bool,
    ):
        self.comm, self.true_hessian, self.touches = comm, true_hessian, touches
        self.matrix = assemble(comm, unknowns, time_step, prefix=options.prefix)
        owned.callback(self.matrix.destroy)
        options.hide("mat_view")  # which is of A: PETSc would show all matrices, and write each into the same file
        self.hessian = TrueHessian(unknowns, elasticity, time_step, _blocks(touches, unknowns, time_step))
        self.blocks = None if true_hessian else _blocks(touches, unknowns, time_step)  # that go with A
        context = self.hessian if true_hessian else ThreeColumns(self.matrix, unknowns, self.blocks)
        self.operator = python_matrix(unknowns, context, comm)
        owned.callback(self.operator.destroy)
        columns, preconditioned = 3 if kronecker else 1, self.matrix
        if kronecker:
            preconditioned = assemble(comm, unknowns, time_step, columns, options.prefix)
            owned.callback(preconditioned.destroy)
        elif touches:  # contact changes what A is preconditioned with, but not A
            preconditioned = self.matrix.copy()
            owned.callback(preconditioned.destroy)
        self.diagonal = ContactDiagonal(preconditioned, unknowns, time_step)
        owned.callback(self.diagonal.destroy)
        kind = options.value("pc_type")
        if kind == MULTIGRID and not true_hessian:
            raise InputError(f"-{options.prefix}pc_type mg: it is of the true Hessian, which newton's presets have; try gamg")
        self.preconditioner = StepPreconditioner(
            Preconditioner(preconditioned, unknowns.memory, 3 // columns, options.prefix),
            lambda: LatticePreconditioner(comm, unknowns, elasticity, time_step, options.prefix),
            kind,
            chooses and options.is_default("pc_type"),
            self._stiffness_ratio(unknowns),
        )
        self.pmat = python_matrix(unknowns, Preconditioned(preconditioned), comm)
        owned.callback(self.pmat.destroy)

    def linearise(self, q: np.ndarray, contact: Contact | None, projected: bool, known: bool = False) -> None:
        """Take the Jacobian at positions q (l, 3) [m] (collective): A is constant, only H and contact depend on q.

        projected : without the negative parts of H
        known     : H was linearised at this very q already
        """
        self.preconditioner.prepare(q, contact)
        if self.true_hessian and not known:
            self.hessian.linearise(q, contact, projected)
        elif self.blocks:
            self.blocks.linearise(contact, q, False)
        changed = self.touches and self.diagonal.follow(self.comm, contact, q)
        if self.true_hessian or changed:
            self.operator.assemble()
        if changed:
            self.pmat.assemble()

    def _stiffness_ratio(self, unknowns: Unknowns) -> float:
        """Return the greatest t^2 k / m of a free node (collective)."""
        mass = unknowns.lattice.mass[unknowns.free]
        return self.comm.allreduce(greatest(self.diagonal.own[: unknowns.size] / mass - 1), MPI.MAX)


def _blocks(touches: bool, unknowns: Unknowns, time_step: float) -> ContactBlocks | None:
    return ContactBlocks(unknowns, time_step) if touches else None
