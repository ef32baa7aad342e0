"""How far a step is from its exact solution: the Newton correction, found no better than an estimate needs.

The error x - x* solves H e = F(x) but for terms of second order, H the true Hessian. |F|_(M^-1) bounds |e|_M, but
was seen up to 500 times too large on stiff bodies; a few CG iterations on H, preconditioned as the step is, tell
more. Their |e_k|_M grows towards |e|_M: the solve ends when doubling the iterations has added little, or when more
is there already than the error that would do.
"""

import numpy as np
from petsc4py import PETSc

from msmpetsc.solve.functional import StepFunctional
from msmpetsc.solve.operators import Preconditioner, TrueHessian, python_matrix

LEAST = 4  # iterations before growth tells anything
GROWTH = 1.5  # of |e_k|_M since k was half of it; what the next doubling adds is taken to be as much again
REDUCED = 0.5  # residual, in CG's norm: while it does not fall at all, growth tells nothing
MOST = 512


class ErrorEstimate:
    """Estimates |x - x*|_M of a step; ``correction`` is the e it found."""

    def __init__(
        self, functional: StepFunctional, hessian: TrueHessian, preconditioner: Preconditioner, prefix: str
    ):
        self.functional, self.hessian = functional, hessian
        self.operator = python_matrix(functional.unknowns, hessian, functional.comm)
        self.correction = self.operator.createVecRight()
        self.ksp = PETSc.KSP().create(functional.comm)
        self.ksp.setOptionsPrefix(f"{prefix}estimate_")
        self.ksp.setType(PETSc.KSP.Type.CG)
        self.ksp.setNormType(PETSc.KSP.NormType.NATURAL)
        pc = self.ksp.getPC()  # its own, for a PC knows its operator, around the same preconditioner
        pc.setType(PETSc.PC.Type.PYTHON)
        pc.setPythonContext(preconditioner)
        self.ksp.setOperators(self.operator, self.operator)
        self.ksp.setConvergenceTest(self._told_enough)

    def __call__(self, f: PETSc.Vec, enough: float) -> float:
        """|x - x*|_M at functional.q, where F is f (collective); what comes out over ``enough`` may be too low.

        Infinite where the Hessian is not positive definite: there no linear correction tells the way.
        """
        self.enough, self.length, self.estimate = enough, 0.0, np.inf
        self.hessian.linearise(self.functional.q, self.functional.contact)
        self.operator.assemble()
        self.ksp.solve(f, self.correction)
        return self.estimate if self.ksp.reason > 0 else np.inf

    def _told_enough(self, ksp: PETSc.KSP, its: int, residual: float) -> int | None:
        reasons = PETSc.KSP.ConvergedReason
        if not np.isfinite(residual):
            return reasons.DIVERGED_NANORINF
        if its == 0:
            self.first = residual
        if residual > 0 and (its == 0 or its & (its - 1)):  # looked at when the iterations have doubled
            return reasons.ITERATING
        length, before = self.functional.norm(ksp.getSolution()), self.length
        over, done = length > self.enough, residual == 0 or its >= MOST
        self.length, self.estimate = length, length if over or done else 2 * length - before
        steady = its >= LEAST and length < GROWTH * before and residual < REDUCED * self.first
        return reasons.CONVERGED_ITS if steady or over or done else reasons.ITERATING

    def destroy(self) -> None:
        for owned in (self.ksp, self.correction, self.operator):
            owned.destroy()
