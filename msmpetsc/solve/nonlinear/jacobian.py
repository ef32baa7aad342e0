"""Jacobian of F: the operator of the linear solves, and its preconditioner."""

from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.backend.arrays import Floats, greatest
from msmpetsc.comm import reduced
from msmpetsc.contact.step_contact import Duals, StepContact, StepContactAt
from msmpetsc.errors import InputError
from msmpetsc.solve.linear.operators import (
    ContactBlocks,
    ThreeColumns,
    TrueHessian,
    assemble,
    python_matrix,
)
from msmpetsc.solve.nonlinear.functional import Configuration, StepFunctional
from msmpetsc.solve.nonlinear.preconditioning import (
    MASSLESS,
    MULTIGRID,
    STIFF,
    LatticePreconditioner,
    MatrixPreconditioner,
    StepPreconditioner,
)
from msmpetsc.solve.presets import Preset, SolverOptions


@dataclass(eq=False)
class Jacobian:
    """True Hessian of g, or the constant A = M + t^2 L in its place (paper Eq. 15-17).

    touches  : whether steps may have a ``contact``
    owned    : stack of objects to destroy, in the order of their creation
    diagonal : (m,) inertia plus t^2 times the stiffness at rest of this rank's free nodes [kg]

    Raises InputError if A is too large for PETSc, if its type is for another device, or if options
    ask for multigrid of A (collective).
    """

    functional: StepFunctional
    preset: Preset
    options: SolverOptions
    touches: bool
    owned: ExitStack

    def __post_init__(self) -> None:
        functional, options, true_hessian = self.functional, self.options, self.preset.true_hessian
        self.comm, self.unknowns = functional.comm, functional.unknowns
        self.diagonal = self._diagonal()
        self.hessian = TrueHessian(
            self.unknowns,
            functional.elasticity,
            functional.time_step,
            self._contact_blocks(),
            functional.scratch,
        )
        # Blocks of contact to add to products with A
        self.blocks = None if true_hessian else self._contact_blocks()
        kind = options.value("pc_type")
        if kind == MULTIGRID and not true_hessian:
            raise InputError(
                f"-{options.prefix}pc_type mg needs the Hessian, which newton's presets have; "
                "gamg does for A"
            )
        context = (
            self.hessian if true_hessian else ThreeColumns(self.matrix, self.unknowns, self.blocks)
        )
        self.operator = python_matrix(self.unknowns, context, self.comm)
        self.owned.callback(self.operator.destroy)
        is_multigrid = kind == MULTIGRID or (true_hessian and not kind and self._is_stiff())
        self.preconditioner: StepPreconditioner = (
            self.multigrid() if is_multigrid else self._of_matrix()
        )

    def _is_stiff(self) -> bool:
        """Return whether multigrid is faster than Jacobi's preconditioner and rounding keeps M."""
        unknowns, mass = self.unknowns, self.unknowns.lattice.mass[self.unknowns.free]
        inertia = unknowns.inertia[unknowns.free]
        ratio = reduced(self.comm, greatest((self.diagonal - inertia) / mass), MPI.MAX)
        return bool(ratio > STIFF and (unknowns.has_fixed or ratio < MASSLESS))

    def multigrid(self) -> LatticePreconditioner:
        """Return a new multigrid preconditioner of the Hessian."""
        return LatticePreconditioner(
            self.unknowns,
            self.functional.elasticity,
            self.functional.time_step,
            self.options.prefix,
        )

    @cached_property
    def matrix(self) -> PETSc.Mat:
        """Matrix A, assembled on first use."""
        matrix = assemble(self.comm, self.unknowns, self.functional.time_step, self.options.prefix)
        self.owned.callback(matrix.destroy)
        return matrix

    def _of_matrix(self) -> MatrixPreconditioner:
        matrix = self.matrix
        if self.touches:
            # Contact changes the preconditioner of A, but not A
            matrix = matrix.copy()
            self.owned.callback(matrix.destroy)
        return MatrixPreconditioner(
            matrix, self.unknowns, self.options.prefix, self.functional.time_step, self.touches
        )

    def _contact_blocks(self) -> ContactBlocks | None:
        return ContactBlocks(self.unknowns, self.functional.time_step) if self.touches else None

    def _diagonal(self) -> Floats:
        """Return inertia + t^2 times the trace of the stiffness block of free nodes (m,) [kg]."""
        unknowns, lattice = self.unknowns, self.unknowns.lattice
        blocks = np.zeros((len(lattice.nodes), 9), like=lattice.nodes)
        self.functional.elasticity.add_bound(lattice.nodes, blocks)
        stiffness = blocks[unknowns.free][:, [0, 4, 8]].sum(axis=1)
        diagonal: Floats = unknowns.inertia[unknowns.free] + self.functional.t2 * stiffness
        return diagonal

    def linearise(self, configuration: Configuration, projected: bool, duals: Duals | None) -> None:
        """Linearise H and contact at a configuration; A is constant (collective).

        projected : leave out the negative parts of H
        duals     : duals of friction; None for its true curvature
        """
        q, contact = configuration.q, configuration.contact
        if self.preset.true_hessian:
            self.hessian.linearise(q, contact, projected, duals)
        elif self.blocks:
            self.blocks.linearise(contact, contact.step.no_duals() if contact else None)
        changed = self.preconditioner.prepare(q, contact)
        if self.preset.true_hessian or changed:
            self.operator.assemble()


class FrictionDuals:
    """Dual unknowns of Newton's method: friction forces over their limits (contact.friction).

    duals : duals for the next Hessian; None without contact. At the start of a step, nodes on
            obstacles have zeros, which give the secants. Pairs of surfaces have None, which gives
            their own forces
    """

    def __init__(self) -> None:
        self.duals: Duals | None = None

    def begin(self, contact: StepContact | None) -> None:
        """Begin a step."""
        self.duals = contact.no_duals() if contact else None

    def update(
        self, contact: StepContactAt | None, base: StepContactAt | None, is_full: bool
    ) -> None:
        """Update the duals after an iteration.

        contact, base : contact after and before the iteration
        is_full : whether the step is the full Newton step; a shorter step resets the duals
        """
        if contact is None or base is None or self.duals is None:
            return
        if is_full:
            self.duals = contact.duals_after(base, self.duals)
        else:
            self.duals = [None if known is None else np.zeros_like(known) for known in self.duals]
