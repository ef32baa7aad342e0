"""Stopping rule of a step: the error that x is known to have, and how closely the next linear solve must be made.

The error of x is |x - x*|_M / |x - y|_M, estimated. |F(x)|_(M^-1) / |x - y|_M bounds it wherever E
is convex between x and x*. Where that will do, or no estimate can be had, the bound is the error.

No estimate is made where the linear solve that led to x knows that what it left of |e|_H will do (linear.cg_bound), and
F is little else than r, what it left of F: |F - r|_(M^-1) bounds the rest.

With multigrid |F|_(P^-1), P the preconditioner, tells when an estimate is worth its cost: a linear solve leaves it. It
is believed where F at the next iterate is about that, so that g is a parabola there (LINEAR).

The estimate is the Newton correction e, which solves H e = F(x), H the true Hessian, but for terms
of second order. |F|_(M^-1) bounds |e|_M, but was seen up to 6000 times too large on stiff bodies;
some CG iterations on H, preconditioned as the step is, tell more. In the norm of H their part is
|e_k|_H^2 = e_k^T F, and miss no more than |r_k|_(P^-1) / sqrt(lambda), lambda the least eigenvalue
of P^(-1) H, of which CG's own Ritz values tell: the solve ends when the second is a part of the
first and |e_k|_M hardly grows, or when that is over the error that would do. It does not end before
k is half of sqrt(|F|_(M^-1) / |e_k|_M): modes so much stiffer hide the others for that long.

What is missing of e is also no more than |r_k|_(M^-1) where H is no less than M. So the solve ends, too, once |e_k|_M
and that, or |r_k|_(P^-1) / sqrt(lambda), are together an error that will do; their sum is then the estimate.
Where F was not quite what the linear solve had left of it, more than half of that sum must be |e_k|_M, so that g can
be looked at there (minimum.Minimum). Where H was seen to be less than M in a step, bounds are over the least of it.
"""

from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
from petsc4py import PETSc

from msmpetsc.backend.arrays import Positions
from msmpetsc.checkpoint import ANY, Range
from msmpetsc.elasticity.locate import describe_inverted, node_of_greatest
from msmpetsc.errors import StepFailed
from msmpetsc.solve.linear.cg_bound import SolveBound
from msmpetsc.solve.linear.operators import TrueHessian, python_matrix
from msmpetsc.solve.nonlinear.curvature import Alarm, LowestCurvature
from msmpetsc.solve.nonlinear.functional import Iterate, Rounding, StepFunctional
from msmpetsc.solve.nonlinear.preconditioning import StepPreconditioner
from msmpetsc.solve.petsc.events import ESTIMATE

DEFAULT_ERROR = 1e-3
FULL_STEP_ERROR = 1e-5  # below it g, quadratic in the error, has no digits left to tell by
KNOWN = 0.8  # of the error that would do: one that is known to be less needs no closer estimate
FIRST_RATIO = 5.0  # of the bound on the error to the error, before any was estimated
LEAST_RATIO = 10.0  # taken, however near they were: an estimate that comes too early is the next solve's start
EARLY = 2.0  # times the error that would do: when a step is first estimated
LOOSEST = 0.3  # ksp_rtol
SHARE = 0.5  # of the error that would do, left to the linear solve
LINEAR = 2.0  # times |F|_(P^-1) that a linear solve leaves of it: g is a parabola there
FINAL = 60.0  # times the error that would do: a linear solve from there on is to be the last
PARABOLA = 0.2  # of F: what the linear solve has not left of it, where its bound is believed
STRAIGHT = 0.6  # of that: up to there it is one as far as what no iteration has found yet
NEAR = 0.02  # least eigenvalue of P^(-1) H: P is near H
STAYS = 0.5  # of the bound before: F no longer falls though each correction was known
CLOSER, CLOSEST = 0.1, 1e-3  # of the error that was doubted: asked for next, and at the most
NOT_FINITE = -4  # DIVERGED_FNORM_NAN; PETSc 3.25 has another name for it
KINDS = {
    PETSc.SNES.ConvergedReason.DIVERGED_LINE_SEARCH: "line search",
    PETSc.SNES.ConvergedReason.DIVERGED_LINEAR_SOLVE: "linear solve",
    NOT_FINITE: "not finite",
    -14: "not finite",  # from PETSc 3.25 on: DIVERGED_OBJECTIVE_NANORINF
}
REASON = {value: name for name, value in vars(PETSc.SNES.ConvergedReason).items() if isinstance(value, int)}
KSP_REASON = {value: name for name, value in vars(PETSc.KSP.ConvergedReason).items() if isinstance(value, int)}
CHECK_EVERY = 4  # iterations
CLOSE = 0.1  # the part: at 0.4 a stiff beam, which takes Jacobi hundreds of iterations, had an estimate of a sixth
GROWTH = 1.2  # of |e_k|_M since k was half of it: what weighs little in the norm of H may still be to come
LEFT = 2.0  # |r_k|_(M^-1) over |e_k|_M: where g is convex the error is then at most three times what was found
MOST = 512
LOWER = 0.7  # of the least eigenvalue that some iterations of CG have come to
GREATEST = 1.1  # eigenvalue of P^(-1) H, where P has all that H has: not contact that came up since
FEW, MANY = 2, 4  # iterations: fewer have not come near the least eigenvalue; so many may have
PROBED = 4  # iterations on noise, which an eigenvalue far below the others takes to show
RISE = 2.0  # of it in a solve: where one had come to 5e-4, the next, of a few iterations, came to 0.38


class ErrorEstimate:
    """Estimates |x - x*|_M of a step; of the last one ``correction`` is e, ``residual`` F - H e."""

    state: ClassVar[dict[str, Range]] = {"floor": ANY}

    def __init__(
        self, functional: StepFunctional, hessian: TrueHessian, preconditioner: StepPreconditioner, prefix: str
    ):
        self.functional, self.hessian, self.preconditioner = functional, hessian, preconditioner
        self.operator = python_matrix(functional.unknowns, hessian, functional.comm)
        self.correction, self.residual = self.operator.createVecs()
        self.length = np.inf  # the last estimate [m sqrt(kg)]
        self.products = 0  # with H so far, and at multigrid's finest level
        self.right_side: PETSc.Vec | None = None  # of the solve in progress, as the next four
        self.bound = self.enough = np.inf
        self.lowest, self.will_do = 1.0, 0.0
        self.convexity = 1.0  # lowest eigenvalue of M^(-1) H that the step has come by, if it is below 1
        self.trusted = self.begun = 0.0  # |F|_(P^-1) up to which that norm bounds errors, and as it was
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
        if length + residual > self.will_do:  # as the preconditioner is no more than M^(-1), |r_k|_(M^-1) is no less
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
        least = LOWER * self._least(self.ksp) * self.lowest
        return min(missing, residual / np.sqrt(least)) if least > 0 else missing

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
        self.functional.memory.write(self.residual)[:] = self.functional.mass * self.functional.noise(1)[0]
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
        if not (min(least, energy) > 0 and residual < CLOSE * np.sqrt(self.lowest * least * energy)):
            return False
        return self._left() < LEFT * self.lengths[ksp.its]

    def _left(self) -> float:
        """Bound on what is missing of |e|_M, where H is no less than ``lowest`` M: |r_k|_(M^-1) over that."""
        self.residual = self.ksp.buildResidual(self.residual)
        return self.functional.dual_norm(self.residual) / self.lowest

    def destroy(self) -> None:
        """Collective."""
        for owned in (self.ksp, self.correction, self.residual, self.operator):
            owned.destroy()


@dataclass(frozen=True)
class Outcome:
    """What a solve has come to, as far as is known at its last iterate.

    corrected   : the last iterate's error was estimated, so that its Newton correction is known
    doubts      : how often the step came to a point that is no minimum, or farther from one than it seemed
    """

    goal: float = 0.0  # relative error to come to; 0 where a budget of iterations ends the step
    error: float = np.inf  # of the last iterate, estimated or bounded
    bound: float = np.inf  # on it
    residual: float = np.inf  # |F|_(M^-1) of the last iterate
    distance: float = 0.0  # |x - y|_M of it
    early: float = EARLY  # how many times the goal an error may be to be estimated
    corrected: bool = False
    left: float = np.inf  # by the linear solve that led here, |r|_(P^-1); infinite where that says nothing
    solved: float = np.inf  # bound on what it left of |e|_H
    beside: float = np.inf  # |F - r|_(M^-1), r what it left of F; infinite where g is no parabola there
    alarm: Alarm = Alarm.NOWHERE  # where something has shown a negative curvature
    at_rounding: bool = False  # F is nothing but rounding
    doubts: int = 0

    def known(self, lowest: float) -> float:
        """The relative error by what the linear solve left and what F is beside that, where M^(-1) H has no eigenvalue
        below ``lowest``; infinite where that says nothing."""
        if not min(lowest, self.distance) > 0:
            return np.inf
        return float((self.solved / np.sqrt(lowest) + self.beside / lowest) / self.distance)

    @property
    def is_enough(self) -> bool:
        """Whether the error is below the goal, or nothing but rounding is left."""
        return self.at_rounding or self.error <= self.goal


@dataclass(eq=False)
class ErrorControl:
    """Judges the iterates of one stepper. All methods that are given an iterate are collective."""

    functional: StepFunctional
    estimate: ErrorEstimate
    curvature: LowestCurvature
    rounding: Rounding
    target: float  # relative error at which a step is done; 0 where a budget of iterations ends it
    tightest: float  # ksp_rtol that no linear solve goes below
    ratio: float = FIRST_RATIO  # of bound to error in the last estimate
    solve_bound: SolveBound = field(default_factory=SolveBound)
    has_residual: bool = False  # of the last linear solve, in estimate.residual until the iterate is judged
    slack: float = 0.0  # bound on |e|_H over |r|_(P^-1) at the end of the last linear solve; 0: none

    def judge(self, iterate: Iterate, before: Outcome) -> Outcome:
        """What is known at an iterate: its error, or a bound on it while that is far too large."""
        residual, distance = self.functional.dual_norm(iterate.f), self.functional.distance(iterate.q)
        at_rounding, alarm = self.rounding.is_all_of(iterate.f), min(before.alarm, Alarm.ON_THE_WAY)
        now = replace(before, residual=residual, distance=distance, at_rounding=at_rounding, alarm=alarm)
        now = replace(now, corrected=False, beside=np.inf)
        if not distance > 0 or not np.isfinite(residual):  # the start x = y tells nothing yet
            return replace(now, error=0.0 if at_rounding else np.inf)
        now = replace(now, bound=residual / distance)
        if self.has_residual and now.solved <= now.goal * now.distance and not now.alarm:
            now = self._known(iterate, now)
            if now.error <= now.goal:
                return now
        if self._is_next_no_dearer(now):
            return replace(now, error=now.bound)
        is_near = at_rounding or now.bound <= self._farthest(now)
        seems_near = is_near
        if self._is_smooth(now):  # whether the linear solve that led here has left so little
            seems_near = now.left <= EARLY * now.goal * now.distance * np.sqrt(self.estimate.least)
        if not seems_near and not at_rounding:
            return replace(now, error=now.bound)
        if now.bound <= now.goal:
            lowest = self.curvature.compression(iterate.q).least_curvature
            if lowest > 0 and now.bound <= now.goal * lowest:
                return replace(now, error=now.bound / lowest)
        found = self.estimated(iterate, now, now.goal)
        stays = before.corrected and STAYS * before.bound < now.bound < FULL_STEP_ERROR  # rounding of stiff contact
        if is_near or stays or self.estimate.is_trusted:
            return found
        return replace(found, error=now.bound)  # F is not what was left of it: g is no parabola here

    def _is_next_no_dearer(self, now: Outcome) -> bool:
        """Whether the next linear solve costs no more than an estimate, which with Jacobi's is one itself."""
        if self.estimate.preconditioner.is_uniform or now.alarm or now.doubts or now.at_rounding:
            return False
        return now.goal * now.distance < now.solved < np.inf

    def _known(self, iterate: Iterate, now: Outcome) -> Outcome:
        """What is known where the last linear solve has left so little that it may be the last of all."""
        self.estimate.residual.aypx(-1.0, iterate.f)
        self.has_residual = False
        beside = self.functional.dual_norm(self.estimate.residual)
        if beside > PARABOLA * now.residual:
            return replace(now, error=np.inf)
        now = replace(now, beside=beside)
        error = now.known(self.curvature.compression(iterate.q).least_curvature or self.estimate.convexity)
        if error > 0:
            self.ratio = max(now.bound / error, 1.0)
        return replace(now, error=error)

    def estimated(self, iterate: Iterate, now: Outcome, goal: float) -> Outcome:
        """The error against x less its correction: where x has not come far, |x - y|_M is not yet |x* - y|_M."""
        distance = now.distance
        enough = EARLY * goal * distance if goal else np.inf
        trusted = LINEAR * now.left if self._is_smooth(now) else 0.0
        length = self.estimate(iterate, now.residual, enough, KNOWN * goal * distance, trusted=trusted)
        if not np.isfinite(length):
            return replace(now, error=now.bound, alarm=Alarm.HERE)
        is_known = now.bound <= self._farthest(now) or self.estimate.is_trusted
        if self.estimate.missing is None and is_known:
            self.ratio = max(now.bound * distance / length, 1.0) if length > 0 else 1.0
        error = self.rounding.relative(length, self.functional.distance(iterate.q, self.estimate.correction))
        return replace(now, error=error, early=1.0, corrected=True)

    def _farthest(self, now: Outcome) -> float:
        """The bound up to which an estimate says something, by what those before have said."""
        return max(self.ratio, LEAST_RATIO) * now.early * now.goal

    def _is_smooth(self, now: Outcome) -> bool:
        """Whether |F|_(P^-1) may bound errors: P is near H, and nothing has shown a negative curvature."""
        return now.left < np.inf and not now.alarm and self.estimate.least >= NEAR

    def led_by(self, ksp: PETSc.KSP, now: Outcome) -> Outcome:
        """What is known once a linear solve with the true Hessian has led to the next iterate."""
        is_natural = ksp.getType() == PETSc.KSP.Type.CG and ksp.getNormType() == PETSc.KSP.NormType.NATURAL
        now = replace(now, left=np.inf, solved=np.inf)
        if ksp.reason < 0 or not is_natural:
            return now
        self.estimate.learn(ksp)
        solved = self._solved(ksp)
        self.has_residual = solved <= now.goal * now.distance
        if self.has_residual:
            self.estimate.residual = ksp.buildResidual(self.estimate.residual)
        left = ksp.getResidualNorm() if self.estimate.preconditioner.is_uniform else np.inf
        return replace(now, left=left, solved=solved)

    def _solved(self, ksp: PETSc.KSP) -> float:
        """Bound on |e|_H that a linear solve has left."""
        if ksp.its < FEW or ksp.getInitialGuessNonzero() or self.estimate.is_blind:
            return np.inf
        solved, residual = self.solve_bound.of(LOWER * self.estimate.least), ksp.getResidualNorm()
        if np.isfinite(solved) and residual > 0:
            self.slack = solved / residual
        return solved

    def tolerances(self, now: Outcome) -> tuple[float, float]:
        """ksp_rtol and ksp_atol of the next linear solve: it need not gain more digits than are missing."""
        missing = now.bound / self.ratio
        is_last = missing <= FINAL * now.goal
        rtol = CLOSEST * self.tightest if is_last else self.tightest
        if self._is_smooth(now):
            return rtol, SHARE * KNOWN * now.goal * now.distance * np.sqrt(self.estimate.least)
        if is_last and self.slack and not self.estimate.preconditioner.is_uniform:
            return rtol, SHARE * now.goal * now.distance / self.slack
        return min(max(SHARE * now.goal / missing, self.tightest), LOOSEST), 1e-50  # PETSc's: none

    def doubt(self, now: Outcome, has_moved: bool) -> Outcome | None:
        """What is known where a step goes on from a point that is no minimum, or farther from one
        than it seemed; None where there is no more to gain.

        has_moved : the point was left; if not the goal becomes closer, until g has no digits left to tell by
        """
        goal = now.goal if has_moved else CLOSER * now.goal
        if not has_moved and goal < CLOSEST * self.target and np.isfinite(now.error):
            return None
        return replace(now, goal=goal, doubts=now.doubts + 1, bound=np.inf, left=np.inf, solved=np.inf, corrected=False)

    def forget(self, modes: bool) -> None:
        self.ratio = FIRST_RATIO
        self.slack = 0.0
        self.estimate.forget(modes)


def not_converged(
    snes: PETSc.SNES, ksp: PETSc.KSP, now: Outcome, iterations: int, worst: str, true_hessian: bool
) -> StepFailed:
    """SNES gave up after ``iterations``.

    worst        : words of where_worst
    true_hessian : newton's presets, which another one would not help
    """
    reason, kind = REASON.get(snes.reason, str(snes.reason)), KINDS.get(snes.reason, "iterations")
    preset = "" if true_hessian else "another preset (newton), "
    advice = f'a smaller time.step, {preset}a looser solver.error, or safety.on_failure = "substep"'
    if kind == "linear solve":
        reason += f" (KSP {KSP_REASON.get(ksp.reason, str(ksp.reason))} after {ksp.its} its)"
        advice = "a looser -ksp_rtol, a larger -ksp_max_it, or another -pc_type"
    return StepFailed(
        f"did not converge: {reason} after {iterations} iterations, residual |F| = {now.residual:.2e}, "
        f"relative error {now.error:.2e}{worst}; try {advice}",
        kind,
    )


def no_minimum(now: Outcome, worst: str) -> StepFailed:
    """All that the step came to was no minimum, or farther from one than it seemed."""
    seen = "a saddle or a fold" if np.isinf(now.error) else "a point farther from its solution than it seemed"
    return StepFailed(
        f"did not come to a minimum: it came to {seen} {now.doubts} times, residual |F| = {now.residual:.2e}{worst}; "
        "try a smaller time.step, or another preset (newton)",
        "no minimum",
    )


def where_worst(functional: StepFunctional, iterate: Iterate) -> str:
    """Words on where F pulls farthest, and on what is inside out (collective)."""
    comm, lattice = functional.comm, functional.lattice
    node = node_of_greatest(comm, lattice, *functional.pull(iterate.f))
    return f", worst at {node}{describe_inverted(comm, lattice, iterate.q)}"
