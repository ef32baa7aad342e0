"""Estimate of a step's error at x by the Newton correction e: H e = F(x), H the true Hessian of g.

Terms of second order are left out. |F|_(M^-1) bounds |e|_M, but overestimates it a thousandfold on
stiff bodies. Some iterations of CG on H, with the step's preconditioner P, tell more. Iteration k
has found e_k with |e_k|_H^2 = e_k^T F. The missing part of e has at most the norm |r_k|_(M^-1) in
M, if H is no less than M. The solve ends if

- |e_k|_M is above the error of interest, or
- |e_k|_M and the missing part together are an acceptable error: their sum is the estimate, or
- the missing part is a small share of |e_k|_H (CLOSE) and |e_k|_M hardly grows. This rule holds
  from iteration sqrt(|F|_(M^-1) / |e_k|_M) / 2 on: before, stiff modes hide soft modes.

Then g can be examined at x - e_k (minimum.Minimum). If a step has met an eigenvalue of M^(-1) H
below 1, bounds are divided by it.
"""

import numpy as np
from petsc4py import PETSc

from msmpetsc.backend.arrays import Positions
from msmpetsc.contact.obstacles.penalty import ContactAt
from msmpetsc.solve.linear.operators import TrueHessian, python_matrix
from msmpetsc.solve.nonlinear.functional import Iterate, StepFunctional
from msmpetsc.solve.nonlinear.preconditioning import StepPreconditioner
from msmpetsc.solve.petsc.events import ESTIMATE

# Share of |e_k|_H that may be missing at the end
CLOSE = 0.1
# Growth of |e_k|_M since iteration k / 2 up to which soft modes count as found
GROWTH = 1.2
# Ratio of |r_k|_(M^-1) to |e_k|_M; if g is convex, the error is at most three times
# |e_k|_M
LEFT = 2.0
# Most iterations of an estimate
MOST = 512


class ErrorEstimate:
    """Estimate of |x - x*|_M in the steps of one lattice.

    correction : e of the last estimate
    residual   : F - H e of the last estimate
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
        # The last estimate [m sqrt(kg)]
        self.length = np.inf
        # Products with H, multigrid's finest level included, of all estimates so far
        self.products = 0
        # Arguments of the estimate in progress (see __call__)
        self.right_side: PETSc.Vec | None = None
        self.bound = self.enough = np.inf
        self.lowest, self.acceptable = 1.0, 0.0
        # Least eigenvalue of M^(-1) H that the step has met, at most 1
        self.convexity = 1.0
        # Bound on the missing part of an acceptable error; None if the estimate ended
        # otherwise
        self.missing: float | None = None
        # |e_k|_M by iteration
        self.lengths: dict[int, float] = {}
        self.ksp = PETSc.KSP().create(functional.comm)
        self.ksp.setOptionsPrefix(f"{prefix}estimate_")
        self.ksp.setType(PETSc.KSP.Type.CG)
        self.ksp.setNormType(PETSc.KSP.NormType.NATURAL)
        self.ksp.setComputeEigenvalues(True)
        # A PC of its own around the same context: a PC knows its operator
        pc = self.ksp.getPC()
        pc.setType(PETSc.PC.Type.PYTHON)
        pc.setPythonContext(preconditioner)
        self.ksp.setOperators(self.operator, self.operator)
        self.ksp.setConvergenceTest(self._converged)

    def __call__(
        self,
        iterate: Iterate,
        bound: float,
        enough: float,
        acceptable: float = 0.0,
        lowest: float = 1.0,
    ) -> float:
        """Return an estimate of |x - x*|_M at an iterate (collective).

        The estimate is infinite if the Hessian is not positive definite.

        bound      : |F|_(M^-1), a bound on the error if H is no less than M
        enough     : error of interest; an estimate above it may be too low
        acceptable : error that need not be known better
        lowest     : least known eigenvalue of M^(-1) H
        """
        self.right_side, self.bound, self.enough = iterate.f, bound, enough
        self.lowest, self.lengths = min(lowest, self.convexity), {}
        self.acceptable, self.missing = acceptable, None
        before = self.hessian.products + self.preconditioner.products
        with ESTIMATE:
            self.linearise(iterate.q, iterate.contact)
            self.ksp.solve(iterate.f, self.correction)
            self.length = self._length() if self.ksp.reason > 0 else np.inf
        self.products += self.hessian.products + self.preconditioner.products - before
        return self.length

    def _length(self) -> float:
        """Return |e_k|_M, extrapolated by its growth; its upper bound if CG was cut short."""
        length, its = self.functional.norm(self.correction), self.ksp.its
        if self.missing is not None:
            return length + self.missing
        left, half = self._left(), self.lengths.get(its // 2, 0.0)
        if its >= MOST and left > LEFT * length:
            return length + left
        return length * max(length / half, 1.0) if half > 0 else length

    def linearise(self, q: Positions, contact: ContactAt | None) -> None:
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
        length = self.lengths[its] = self.functional.norm(ksp.getSolution())
        if (
            residual == 0
            or its >= MOST
            or length > self.enough
            or self._is_acceptable(length, residual)
        ):
            return reasons.CONVERGED_ITS
        if length > GROWTH * self.lengths.get(its // 2, 0.0):
            return reasons.ITERATING
        if not self.preconditioner.is_uniform and 4 * its**2 * length < self.bound:
            return reasons.ITERATING
        return reasons.CONVERGED_ITS if self._is_close(ksp, residual) else reasons.ITERATING

    def _is_acceptable(self, length: float, residual: float) -> bool:
        """Return whether |e_k|_M, here ``length``, and its missing part together are acceptable."""
        # P is at most M, so |r_k|_(M^-1) is no less than the natural norm
        if length + residual > self.acceptable:
            return False
        missing = self._left()
        if length + missing > self.acceptable:
            return False
        self.missing = missing
        return True

    def _is_close(self, ksp: PETSc.KSP, residual: float) -> bool:
        """Return whether e_k is close to e in the norm of H, as far as CG can show."""
        least = ksp.computeExtremeSingularValues()[1]
        energy = ksp.getSolution().dot(self.right_side)
        if not (
            min(least, energy) > 0 and residual < CLOSE * np.sqrt(self.lowest * least * energy)
        ):
            return False
        if not self._left() < LEFT * self.lengths[ksp.its]:
            return False
        return bool(self.preconditioner.least_norm(self.residual) < CLOSE * np.sqrt(energy))

    def _left(self) -> float:
        """Return the bound |r_k|_(M^-1) / lowest on the missing part of |e|_M."""
        self.residual = self.ksp.buildResidual(self.residual)
        return self.functional.dual_norm(self.residual) / self.lowest

    def destroy(self) -> None:
        """Destroy all PETSc objects (collective)."""
        for owned in (self.ksp, self.correction, self.residual, self.operator):
            owned.destroy()
