"""Estimate of a step's error at x by the Newton correction e: H e = F(x), H the true Hessian of g.

Terms of second order are left out. |F|_(M^-1) bounds |e|_M, but overestimates it a thousandfold on
stiff bodies. Iteration k of CG on H, with the step's preconditioner, has found e_k. The missing
part of e has at most the norm |r_k|_(M^-1) / lambda in M, if no eigenvalue of M^(-1) H is below
lambda. The solve ends if

- |e_k|_M is above the acceptable error, or
- |e_k|_M and the missing part together are acceptable, or
- the missing part is at most |e_k|_M, so that the estimate, their sum, is at most twice |e|_M.

Then g can be examined at x - e_k (optimality.Optimality).
"""

import numpy as np
from petsc4py import PETSc

from msmpetsc.backend.arrays import Positions
from msmpetsc.contact.step_contact import StepContactAt
from msmpetsc.solve.linear.operators import TrueHessian, python_matrix
from msmpetsc.solve.nonlinear.functional import Iterate, StepFunctional
from msmpetsc.solve.nonlinear.preconditioning import StepPreconditioner
from msmpetsc.solve.petsc.events import ESTIMATE


class ErrorEstimate:
    """Estimate of |x - x*|_M in the steps of one lattice.

    correction : e of the last estimate
    residual   : F - H e of the last estimate
    correction_norm : |e_k|_M of the last estimate [m sqrt(kg)]
    missing    : bound on the part of e that the last estimate has not found [m sqrt(kg)]
    lowest     : bound on the eigenvalues of M^(-1) H that the last estimate used
    convexity  : least eigenvalue of M^(-1) H that the step has met, at most 1
    products   : products with H, multigrid's finest level included, of all estimates so far
    """

    def __init__(
        self,
        functional: StepFunctional,
        hessian: TrueHessian,
        preconditioner: StepPreconditioner,
        prefix: str,
    ):
        self.functional, self.hessian, self.preconditioner = functional, hessian, preconditioner
        self.operator = python_matrix(functional.unknowns, hessian, functional.comm)
        self.correction, self.residual = self.operator.createVecs()
        self.correction_norm = self.missing = np.inf
        self.products = 0
        self.lowest = self.convexity = 1.0
        self._acceptable = 0.0
        self.ksp = PETSc.KSP().create(functional.comm)
        self.ksp.setOptionsPrefix(f"{prefix}estimate_")
        self.ksp.setType(PETSc.KSP.Type.CG)
        self.ksp.setNormType(PETSc.KSP.NormType.NATURAL)
        # A PC of its own around the same context: a PC knows its operator
        pc = self.ksp.getPC()
        pc.setType(PETSc.PC.Type.PYTHON)
        pc.setPythonContext(preconditioner)
        self.ksp.setOperators(self.operator, self.operator)
        self.ksp.setConvergenceTest(self._converged)

    def __call__(self, iterate: Iterate, acceptable: float = 0.0) -> float:
        """Return an estimate of |x - x*|_M at an iterate (collective).

        The estimate is infinite if the Hessian is not positive definite.

        acceptable : error [m sqrt(kg)]; an estimate above it may be too low
        """
        self.lowest, self._acceptable = self.convexity, acceptable
        before = self.hessian.products + self.preconditioner.products
        with ESTIMATE:
            self.linearise(iterate.q, iterate.contact)
            self.ksp.solve(iterate.f, self.correction)
        self.products += self.hessian.products + self.preconditioner.products - before
        return self.correction_norm + self.missing if self.ksp.reason > 0 else np.inf

    def linearise(self, q: Positions, contact: StepContactAt | None) -> None:
        """Linearise the Hessian and the preconditioner at positions q (l, 3) [m]."""
        self.preconditioner.prepare(q, contact)
        self.hessian.linearise(q, contact)
        self.operator.assemble()

    def _converged(self, ksp: PETSc.KSP, its: int, residual: float) -> PETSc.KSP.ConvergedReason:
        """Return whether the estimate is complete (the convergence test of KSP)."""
        reasons = PETSc.KSP.ConvergedReason
        if not np.isfinite(residual):
            return reasons.DIVERGED_NANORINF
        if residual > 0 and its == 0:
            return reasons.ITERATING
        self.residual = ksp.buildResidual(self.residual)
        self.correction_norm = self.functional.norm(ksp.getSolution())
        self.missing = self.functional.dual_norm(self.residual) / self.lowest
        is_decided = (
            0 < self._acceptable < self.correction_norm
            or self.correction_norm + self.missing <= self._acceptable
        )
        if residual == 0 or is_decided or self.missing <= self.correction_norm:
            return reasons.CONVERGED_ITS
        return reasons.ITERATING

    def destroy(self) -> None:
        """Destroy all PETSc objects (collective)."""
        for owned in (self.ksp, self.correction, self.residual, self.operator):
            owned.destroy()
