"""Error of a step at x by the Newton correction e: H e = F(x), with H the true Hessian of g.

Terms of second order are left out. After k iterations, CG on H with the step's preconditioner P has
found e_k. The missing part of e is bounded in two ways,

    |e - e_k|_M <= |r_k|_(M^-1) / lambda
    |e - e_k|_M <= |r_k|_(P^-1) / sqrt(lambda kappa)

with r_k = F - H e_k, if no eigenvalue of M^(-1) H is below lambda and none of P^(-1) H below kappa.
The first bound is safe, but too high by up to a thousand on stiff bodies. The second bound is
close. It is too low if CG has not met the least eigenvalue, since kappa is the least Ritz value of
CG. kappa is at most 1, the mean of the eigenvalues if P is the diagonal of H. In Newton's own
solves the missing part counts as the geometric mean of both bounds, if this is below the first
bound. With contact, and in a solve for the estimate alone, it counts as the first bound.

A solve ends if the sum of |e_k|_M and the missing part is acceptable. Newton's own solves also end
by the tolerances of KSP. A solve for the estimate alone also ends if

- |e_k|_M is above the acceptable error, or
- the missing part is at most |e_k|_M, so that the estimate, their sum, is at most twice |e|_M.

Then g can be examined at x - e_k (optimality.Optimality).
"""

import numpy as np
from petsc4py import PETSc

from msmpetsc.solve.linear.operators import TrueHessian, python_matrix
from msmpetsc.solve.nonlinear.functional import Configuration, Iterate, StepFunctional
from msmpetsc.solve.nonlinear.preconditioning import StepPreconditioner
from msmpetsc.solve.petsc.events import ESTIMATE


class ErrorEstimate:
    """Estimate of |x - x*|_M in the steps of one lattice.

    correction      : e_k of the last estimate
    residual        : F - H e_k of the last estimate
    correction_norm : |e_k|_M of the last estimate [m sqrt(kg)]
    missing         : bound on the part of e that the last estimate has not found [m sqrt(kg)]
    lowest          : lower bound of the eigenvalues of M^(-1) H that the last estimate used
    convexity       : least eigenvalue of M^(-1) H that the step has met, at most 1
    is_accepted     : whether the last solve has shown that the error is acceptable
    products        : number of products with H in all estimates so far, multigrid's finest level
                      included
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
        self.is_accepted = False
        self._acceptable = self._first = 0.0
        # Least eigenvalue of P^(-1) H that the step has met, at most 1; 0 with contact
        self._least = 1.0
        self.ksp = PETSc.KSP().create(functional.comm)
        self.ksp.setOptionsPrefix(f"{prefix}estimate_")
        self.ksp.setType(PETSc.KSP.Type.CG)
        self.ksp.setNormType(PETSc.KSP.NormType.NATURAL)
        # A new PC around the same context, because a PC knows its operator
        pc = self.ksp.getPC()
        pc.setType(PETSc.PC.Type.PYTHON)
        pc.setPythonContext(preconditioner)
        self.ksp.setOperators(self.operator, self.operator)
        self.ksp.setConvergenceTest(self._test_alone)

    def __call__(self, iterate: Iterate, acceptable: float = 0.0) -> float:
        """Return an estimate of |x - x*|_M at an iterate (collective).

        The estimate is infinite if the Hessian is not positive definite.

        acceptable : acceptable error [m sqrt(kg)]; an estimate above this error may be too low
        """
        self.begin(acceptable)
        before = self.hessian.products + self.preconditioner.products
        with ESTIMATE:
            self.linearise(iterate)
            self.ksp.solve(iterate.f, self.correction)
        self.products += self.hessian.products + self.preconditioner.products - before
        return self.correction_norm + self.missing if self.ksp.reason > 0 else np.inf

    def linearise(self, configuration: Configuration) -> None:
        """Linearise the Hessian and the preconditioner at a configuration."""
        self.preconditioner.prepare(configuration.q, configuration.contact)
        self.hessian.linearise(configuration.q, configuration.contact)
        self.operator.assemble()

    def begin_step(self, has_contact: bool) -> None:
        """Forget the eigenvalues and the acceptable error of the last step.

        has_contact : whether H has contact, whose small eigenvalues CG meets late
        """
        self.convexity, self._least = 1.0, 0.0 if has_contact else 1.0
        self._acceptable = 0.0

    def begin(self, acceptable: float) -> None:
        """Begin a solve.

        acceptable : acceptable error of x [m sqrt(kg)]; 0 if the solve does not tell the error
        """
        self.lowest, self.is_accepted, self._acceptable = self.convexity, False, acceptable

    def test(self, ksp: PETSc.KSP, its: int, residual: float) -> PETSc.KSP.ConvergedReason:
        """Return KSP's reason to end Newton's solve H e = F, or to go on."""
        reasons, (rtol, atol, divtol, _) = PETSc.KSP.ConvergedReason, ksp.getTolerances()
        if not np.isfinite(residual):
            return reasons.DIVERGED_NANORINF
        if its == 0:
            self._first = residual
        elif self._acceptable > 0 and self._accepts_met(ksp, residual):
            return reasons.CONVERGED_HAPPY_BREAKDOWN
        if residual <= atol:
            return reasons.CONVERGED_ATOL
        if residual <= rtol * self._first:
            if its > 0:
                self._meet_eigenvalues(ksp)
            return reasons.CONVERGED_RTOL
        return reasons.DIVERGED_DTOL if residual >= divtol * self._first else reasons.ITERATING

    def reached(self, ksp: PETSc.KSP) -> float:
        """Return |r_k| / |F|, in the norm of P^-1, of Newton's last solve."""
        return ksp.getResidualNorm() / self._first if self._first > 0 else 1.0

    def _test_alone(self, ksp: PETSc.KSP, its: int, residual: float) -> PETSc.KSP.ConvergedReason:
        """Return KSP's reason to end a solve for the estimate alone, or to go on."""
        reasons = PETSc.KSP.ConvergedReason
        if not np.isfinite(residual):
            return reasons.DIVERGED_NANORINF
        if its == 0 and residual > 0:
            return reasons.ITERATING
        self.is_accepted = self._accepts(ksp, np.inf)
        is_above = 0 < self._acceptable < self.correction_norm
        if self.is_accepted or is_above or self.missing <= self.correction_norm:
            return reasons.CONVERGED_HAPPY_BREAKDOWN
        return reasons.ITERATING

    def _accepts_met(self, ksp: PETSc.KSP, natural: float) -> bool:
        """Return ``_accepts`` with the eigenvalues that CG has met so far.

        Once e_k is above the acceptable error, no later iteration can show that x is acceptable.
        """
        if self._accepts(ksp, natural):
            self._meet_eigenvalues(ksp)
            self.is_accepted = self._accepts(ksp, natural)
        elif self.correction_norm > self._acceptable:
            self._acceptable = 0.0
        return self.is_accepted

    def _meet_eigenvalues(self, ksp: PETSc.KSP) -> None:
        """Store the least Ritz value of the solve so far; after k iterations this costs O(k^2).

        Once a Ritz value is not positive, the second bound is not used.
        """
        if self._least > 0:
            self._least = min(self._least, ksp.computeExtremeSingularValues()[1])

    def _accepts(self, ksp: PETSc.KSP, natural: float) -> bool:
        """Measure the correction of a solve so far. Return whether the error is acceptable.

        natural : |r_k|_(P^-1); infinite to use the first bound alone
        """
        self.residual = ksp.buildResidual(self.residual)
        self.correction_norm, f = self.functional.norms(ksp.getSolution(), self.residual)
        self.missing = f / self.lowest
        if self._least > 0 and np.isfinite(natural):
            close = natural / float(np.sqrt(self.lowest * self._least))
            self.missing = min(self.missing, float(np.sqrt(self.missing * close)))
        return self.correction_norm + self.missing <= self._acceptable

    def destroy(self) -> None:
        """Destroy all PETSc objects (collective)."""
        for owned in (self.ksp, self.correction, self.residual, self.operator):
            owned.destroy()
