"""Estimate of a step's error at x: the Newton correction e, which solves H e = F(x), H the true Hessian, but for terms
of second order.

|F|_(M^-1) bounds |e|_M, but was seen up to 6000 times too large on stiff bodies; some CG iterations on H,
preconditioned as the step is, tell more. Of e they have found e_k, with |e_k|_H^2 = e_k^T F, and miss no more than
|r_k|_(P^-1) / sqrt(lambda) in the norm of H, lambda the least eigenvalue of P^(-1) H, of which CG's own Ritz values
tell: the solve ends when the second is a part of the first (CLOSE) and |e_k|_M hardly grows, or when that is over the
error that would do. It does not end before k is half of sqrt(|F|_(M^-1) / |e_k|_M): modes so much stiffer hide the
others for that long.

What is missing of e is also no more than |r_k|_(M^-1) where H is no less than M. So the solve ends, too, once |e_k|_M
and that, or |r_k|_(P^-1) / sqrt(lambda), are together an error that will do; their sum is then the estimate.
Where F was not quite what the linear solve had left of it, more than half of that sum must be |e_k|_M, so that g can
be looked at there (minimum.Minimum). Where H was seen to be less than M in a step, bounds are over the least of it.
"""

from typing import ClassVar

import numpy as np
from petsc4py import PETSc

from msmpetsc.backend.arrays import Positions
from msmpetsc.checkpoint import ANY, Range
from msmpetsc.solve.linear.operators import TrueHessian, python_matrix
from msmpetsc.solve.nonlinear.functional import Iterate, StepFunctional
from msmpetsc.solve.nonlinear.preconditioning import StepPreconditioner
from msmpetsc.solve.petsc.events import ESTIMATE

STRAIGHT = 0.6  # of |F|_(P^-1) that is trusted: up to there g is a parabola in what no iteration has found, too
CHECK_EVERY = 4  # iterations
CLOSE = 0.1  # of |e_k|_H may be missing at the end: at 0.4 Jacobi in a stiff beam gave an estimate of a sixth
GROWTH = 1.2  # of |e_k|_M since k was half of it: what weighs little in the norm of H may still be to come
LEFT = 2.0  # |r_k|_(M^-1) over |e_k|_M: where g is convex the error is then at most three times what was found
MOST = 512
LOWER = 0.7  # of the least eigenvalue that some iterations of CG have come to
GREATEST = 1.1  # eigenvalue of P^(-1) H, where P has all that H has: not contact that came up since
FEW, MANY = 2, 4  # iterations: fewer have not come near the least eigenvalue; so many may have
PROBED = 4  # iterations on noise, which an eigenvalue far below the others takes to show
RISE = (
    2.0  # of it in a solve: where one had come to 5e-4, the next, of a few iterations, came to 0.38
)


class ErrorEstimate:
    """Estimates |x - x*|_M of a step; of the last one ``correction`` is e, ``residual`` F - H e."""

    state: ClassVar[dict[str, Range]] = {"floor": ANY}

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
        self.length = np.inf  # the last estimate [m sqrt(kg)]
        self.products = 0  # with H so far, and at multigrid's finest level
        self.right_side: PETSc.Vec | None = None  # of the solve in progress, as the next four
        self.bound = self.enough = np.inf
        self.lowest, self.will_do = 1.0, 0.0
        self.convexity = (
            1.0  # lowest eigenvalue of M^(-1) H that the step has come by, if it is below 1
        )
        self.trusted = self.begun = (
            0.0  # |F|_(P^-1) up to which that norm bounds errors, and as it was
        )
        self.missing: float | None = None  # of a length that will do
        self.least = 0.0  # eigenvalue of P^(-1) H that CG has come to; 0 where none is known
        self.floor = np.inf  # that it has come to on noise; infinite where that was not tried
        self.is_probe = False  # whether the solve in progress is one of noise
        self.lengths: dict[int, float] = {}  # |e_k|_M by iteration
        self.ksp = PETSc.KSP().create(functional.comm)
        self.ksp.setOptionsPrefix(f"{prefix}estimate_")
        self.ksp.setType(PETSc.KSP.Type.CG)
        self.ksp.setNormType(PETSc.KSP.NormType.NATURAL)
        self.ksp.setComputeEigenvalues(True)
        pc = self.ksp.getPC()  # its own around the same context, for a PC knows its operator
        pc.setType(PETSc.PC.Type.PYTHON)
        pc.setPythonContext(preconditioner)
        self.ksp.setOperators(self.operator, self.operator)
        self.ksp.setConvergenceTest(self._converged)

    def __call__(
        self,
        iterate: Iterate,
        bound: float,
        enough: float,
        will_do: float = 0.0,
        lowest: float = 1.0,
        trusted: float = 0.0,
    ) -> float:
        """Estimate |x - x*|_M at an iterate (collective); a result over ``enough`` may be too low.

        bound   : on it, |F|_(M^-1) where H is no less than M
        will_do : an error bounded by that need not be known better
        lowest  : eigenvalue of M^(-1) H, as far as is known
        trusted : |F|_(P^-1) up to which that norm may bound the error

        Infinite where the Hessian is not positive definite: no linear correction shows the way.
        """
        self.right_side, self.bound, self.enough = iterate.f, bound, enough
        self.lowest, self.lengths = min(lowest, self.convexity), {}
        self.will_do, self.missing, self.trusted = will_do, None, trusted
        before = self.hessian.products + self.preconditioner.products
        with ESTIMATE:
            self.linearise(iterate.q)
            if self.is_blind:
                self._probe()
            self.ksp.solve(iterate.f, self.correction)
            self.learn(self.ksp)
            self.length = self._length() if self.ksp.reason > 0 else np.inf
        self.products += self.hessian.products + self.preconditioner.products - before
        return self.length

    def _length(self) -> float:
        """|e_k|_M, grown once more as it has since k was half of it; or, where CG was cut short, all that it may be."""
        length, its = self.functional.norm(self.correction), self.ksp.its
        if self.missing is not None:
            return length + self.missing
        left, half = self._left(), self.lengths.get(its // 2, 0.0)
        if its >= MOST and left > LEFT * length:
            return length + left
        return length * max(length / half, 1.0) if half > 0 else length

    @property
    def is_blind(self) -> bool:
        """Whether P^(-1) H may have an eigenvalue far below all that CG has come to."""
        return self.preconditioner.is_uniform and np.isinf(self.floor)

    def linearise(self, q: Positions) -> None:
        """Take the Hessian at positions q (l, 3) [m]."""
        self.preconditioner.prepare(q, self.functional.problem.contact)
        self.hessian.linearise(q, self.functional.problem.contact)
        self.operator.assemble()

    def _converged(self, ksp: PETSc.KSP, its: int, residual: float) -> PETSc.KSP.ConvergedReason:
        """Whether the solve has shown what an estimate needs (a convergence test of KSP)."""
        reasons = PETSc.KSP.ConvergedReason
        if not np.isfinite(residual):
            return reasons.DIVERGED_NANORINF
        if self.is_probe:
            return reasons.ITERATING if its < PROBED else reasons.CONVERGED_ITS
        every = 1 if self.preconditioner.is_uniform else CHECK_EVERY
        if its == 0:
            self.begun = residual
        too_early = residual > self.trusted if its == 0 else bool(its % max(every // 2, 1))
        if residual > 0 and too_early:
            return reasons.ITERATING
        length = self.lengths[its] = self.functional.norm(ksp.getSolution())
        if residual == 0 or its >= MOST or length > self.enough or self._will_do(length, residual):
            return reasons.CONVERGED_ITS
        if its % every or length > GROWTH * self.lengths.get(its // 2, 0.0):
            return reasons.ITERATING
        if not self.preconditioner.is_uniform and 4 * its**2 * length < self.bound:
            return reasons.ITERATING
        return reasons.CONVERGED_ITS if self._is_close(ksp, residual) else reasons.ITERATING

    def _will_do(self, length: float, residual: float) -> bool:
        """Whether |e_k|_M, here ``length``, and all that may be missing are together less than will do."""
        if (
            length + residual > self.will_do
        ):  # as the preconditioner is no more than M^(-1), |r_k|_(M^-1) is no less
            return False
        missing = self._missing(residual)
        is_unknown = missing > length and self.trusted >= self.begun > STRAIGHT * self.trusted
        if is_unknown or length + missing > self.will_do:
            return False
        self.missing = missing
        return True

    @property
    def is_trusted(self) -> bool:
        """Whether |F|_(P^-1) bounds the error of what is estimated."""
        return self.begun <= self.trusted

    def _missing(self, residual: float) -> float:
        """Bound on what is missing of |e|_M, by the norm of the residual in M^-1 or, where CG has come to the least
        eigenvalue of P^(-1) H, in P^-1, which makes much less of what is rough."""
        missing = self._left()
        if not self.is_trusted:
            return missing
        least = LOWER * self._least(self.ksp)
        if not least > 0 or self.preconditioner.least_norm(self.residual) > residual / np.sqrt(
            least
        ):
            return missing
        return min(missing, float(residual / np.sqrt(least * self.lowest)))

    def _least(self, ksp: PETSc.KSP) -> float:
        """The least eigenvalue of P^(-1) H that is known, that of a solve by CG included; 0 where there is none."""
        if ksp.its < FEW:
            return self.least
        least = float(ksp.computeExtremeSingularValues()[1])
        if not 0 < least <= GREATEST:
            return 0.0
        least = min(least, self.floor)
        return min(least, (RISE if ksp.its >= MANY else 1.0) * self.least) if self.least else least

    def learn(self, ksp: PETSc.KSP) -> None:
        """A solve by CG with this Hessian and preconditioner has ended."""
        self.least = self._least(ksp)

    def _probe(self) -> None:
        """Look for an eigenvalue of P^(-1) H far below the others by CG on noise, which has something of each mode: the
        few iterations of a step's solve miss one of 2e-5, as a cell has that hangs by an edge."""
        self.functional.memory.write(self.residual)[:] = (
            self.functional.mass * self.functional.noise(1)[0]
        )
        self.is_probe = True
        self.ksp.solve(self.residual, self.correction)
        self.is_probe = False
        least = float(self.ksp.computeExtremeSingularValues()[1])
        if least > 0:  # else at a fold, and the next estimate tries again
            self.floor = least
            self.least = min(self.least, least)

    def forget(self, modes: bool) -> None:
        self.least = 0.0
        if modes:
            self.floor = np.inf

    def _is_close(self, ksp: PETSc.KSP, residual: float) -> bool:
        """Whether e is near in the norm of H, as far as CG can show."""
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
        """Bound on what is missing of |e|_M, where H is no less than ``lowest`` M: |r_k|_(M^-1) over that."""
        self.residual = self.ksp.buildResidual(self.residual)
        return self.functional.dual_norm(self.residual) / self.lowest

    def destroy(self) -> None:
        """Collective."""
        for owned in (self.ksp, self.correction, self.residual, self.operator):
            owned.destroy()
