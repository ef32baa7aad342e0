"""Stopping rule of a step: the error that x is known to have, and how closely the next linear solve must be made.

The error of x is |x - x*|_M / |x - y|_M, estimated. |F(x)|_(M^-1) / |x - y|_M bounds it wherever E
is convex between x and x*. Where that will do, or no estimate can be had, the bound is the error.

No estimate is made where the linear solve that led to x knows that what it left of |e|_H will do (linear.cg_bound), and
F is little else than r, what it left of F: |F - r|_(M^-1) bounds the rest.

With multigrid |F|_(P^-1), P the preconditioner, tells when an estimate is worth its cost: a linear solve leaves it. It
is believed where F at the next iterate is about that, so that g is a parabola there (LINEAR).
"""

from dataclasses import dataclass, field, replace

import numpy as np
from petsc4py import PETSc

from msmpetsc.elasticity.locate import describe_inverted, node_of_greatest
from msmpetsc.errors import StepFailed
from msmpetsc.solve.linear.cg_bound import SolveBound
from msmpetsc.solve.nonlinear.curvature import Alarm, Compression, LowestCurvature
from msmpetsc.solve.nonlinear.error_estimate import FEW, LOWER, ErrorEstimate
from msmpetsc.solve.nonlinear.functional import Iterate, Rounding, StepFunctional

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
NEAR = 0.02  # least eigenvalue of P^(-1) H: P is near H
STAYS = 0.5  # of |F| before: where it no longer falls, it may be rounding of stiff contact
CLOSER, CLOSEST = 0.1, 1e-3  # of the error that was doubted: asked for next, and at the most
NOT_FINITE = -4  # DIVERGED_FNORM_NAN; PETSc 3.25 has another name for it
KINDS = {
    PETSc.SNES.ConvergedReason.DIVERGED_LINE_SEARCH: "line search",
    PETSc.SNES.ConvergedReason.DIVERGED_LINEAR_SOLVE: "linear solve",
    NOT_FINITE: "not finite",
    -14: "not finite",  # from PETSc 3.25 on: DIVERGED_OBJECTIVE_NANORINF
}
REASON = {
    value: name
    for name, value in vars(PETSc.SNES.ConvergedReason).items()
    if isinstance(value, int)
}
KSP_REASON = {
    value: name for name, value in vars(PETSc.KSP.ConvergedReason).items() if isinstance(value, int)
}


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
    left: float = (
        np.inf
    )  # by the linear solve that led here, |r|_(P^-1); infinite where that says nothing
    solved: float = np.inf  # bound on what it left of |e|_H
    beside: float = (
        np.inf
    )  # |F - r|_(M^-1), r what it left of F; infinite where g is no parabola there
    alarm: Alarm = Alarm.NOWHERE  # where something has shown a negative curvature
    at_rounding: bool = False  # F is nothing but rounding
    doubts: int = 0
    compression: Compression | None = None  # of the last iterate, where it was asked for

    def known(self, lowest: float) -> float:
        """The relative error by what the linear solve left and what F is beside that, where M^(-1) H has no eigenvalue
        below ``lowest``; infinite where that says nothing."""
        if not min(lowest, self.distance) > 0:
            return np.inf
        return float((self.solved / np.sqrt(lowest) + self.beside / lowest) / self.distance)

    @property
    def is_flat(self) -> bool:
        """Whether g is so near its minimum that changes of it have no digits."""
        return self.bound < FULL_STEP_ERROR and (self.corrected or not self.doubts)

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
    has_residual: bool = (
        False  # of the last linear solve, in estimate.residual until the iterate is judged
    )
    slack: float = (
        0.0  # bound on |e|_H over |r|_(P^-1) at the end of the last linear solve; 0: none
    )

    def judge(self, iterate: Iterate, before: Outcome) -> Outcome:
        """What is known at an iterate: its error, or a bound on it while that is far too large."""
        residual, distance = (
            self.functional.dual_norm(iterate.f),
            self.functional.distance(iterate.q),
        )
        stays = residual > STAYS * before.residual
        at_rounding = self.rounding.is_all_of(
            iterate, self.functional.problem.contact if stays else None
        )
        alarm = min(before.alarm, Alarm.ON_THE_WAY)
        now = replace(
            before, residual=residual, distance=distance, at_rounding=at_rounding, alarm=alarm
        )
        now = replace(now, corrected=False, beside=np.inf, compression=None)
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
            now = self.with_compression(iterate, now)
            assert now.compression is not None
            lowest = now.compression.least_curvature
            if lowest > 0 and now.bound <= now.goal * lowest:
                return replace(now, error=now.bound / lowest)
        found = self.estimated(iterate, now, now.goal)
        if is_near or self.estimate.is_trusted:
            return found
        return replace(
            found, error=now.bound
        )  # F is not what was left of it: g is no parabola here

    def _is_next_no_dearer(self, now: Outcome) -> bool:
        """Whether the next linear solve costs no more than an estimate, which is one itself, and leads on."""
        if now.alarm or now.doubts or now.at_rounding:
            return False
        return now.goal * now.distance < now.solved < np.inf

    def _known(self, iterate: Iterate, now: Outcome) -> Outcome:
        """What is known where the last linear solve has left so little that it may be the last of all."""
        self.estimate.residual.aypx(-1.0, iterate.f)
        self.has_residual = False
        beside = self.functional.dual_norm(self.estimate.residual)
        if beside > PARABOLA * now.residual:
            return replace(now, error=np.inf)
        now = self.with_compression(iterate, replace(now, beside=beside))
        assert now.compression is not None
        error = now.known(now.compression.least_curvature or self.estimate.convexity)
        if error > 0:
            self.ratio = max(now.bound / error, 1.0)
        return replace(now, error=error)

    def with_compression(self, iterate: Iterate, now: Outcome) -> Outcome:
        """Return the outcome of an iterate, with its compression."""
        return (
            now
            if now.compression
            else replace(now, compression=self.curvature.compression(iterate.q))
        )

    def estimated(self, iterate: Iterate, now: Outcome, goal: float) -> Outcome:
        """The error against x less its correction: where x has not come far, |x - y|_M is not yet |x* - y|_M."""
        distance = now.distance
        enough = EARLY * goal * distance if goal else np.inf
        trusted = LINEAR * now.left if self._is_smooth(now) else 0.0
        length = self.estimate(
            iterate, now.residual, enough, KNOWN * goal * distance, trusted=trusted
        )
        if not np.isfinite(length):
            return replace(now, error=now.bound, alarm=Alarm.HERE)
        is_known = now.bound <= self._farthest(now) or self.estimate.is_trusted
        if self.estimate.missing is None and is_known:
            self.ratio = max(now.bound * distance / length, 1.0) if length > 0 else 1.0
        error = self.rounding.relative(
            length, self.functional.distance(iterate.q, self.estimate.correction)
        )
        return replace(now, error=error, early=1.0, corrected=True)

    def _farthest(self, now: Outcome) -> float:
        """The bound up to which an estimate says something, by what those before have said."""
        return max(self.ratio, LEAST_RATIO) * now.early * now.goal

    def _is_smooth(self, now: Outcome) -> bool:
        """Whether |F|_(P^-1) may bound errors: P is near H, and nothing has shown a negative curvature."""
        return now.left < np.inf and not now.alarm and self.estimate.least >= NEAR

    def led_by(self, ksp: PETSc.KSP, now: Outcome) -> Outcome:
        """What is known once a linear solve with the true Hessian has led to the next iterate."""
        is_natural = (
            ksp.getType() == PETSc.KSP.Type.CG and ksp.getNormType() == PETSc.KSP.NormType.NATURAL
        )
        now = replace(now, left=np.inf, solved=np.inf)
        if ksp.reason < 0 or not is_natural:
            return now
        self.estimate.learn(ksp)
        solved = self._solved(ksp)
        self.has_residual = solved <= now.goal * now.distance
        if self.has_residual:
            self.estimate.residual = ksp.buildResidual(self.estimate.residual)
            if self.estimate.preconditioner.least_norm(self.estimate.residual) > solved:
                self.has_residual, solved = False, np.inf
        left = ksp.getResidualNorm() if self.estimate.preconditioner.is_uniform else np.inf
        return replace(now, left=left, solved=solved)

    def _solved(self, ksp: PETSc.KSP) -> float:
        """Bound on |e|_H that a linear solve has left."""
        is_far = self.estimate.preconditioner.is_uniform and self.estimate.least < NEAR
        if ksp.its < FEW or ksp.getInitialGuessNonzero() or self.estimate.is_blind or is_far:
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

        has_moved : the point was left. From a saddle the goal stays; else it becomes closer, until g has no digits left
            to tell by: where a second correction has shown that g is no parabola, a bound of the same size says nothing
        """
        is_saddle, closest = np.isinf(now.error), CLOSEST * self.target
        goal = now.goal if has_moved and is_saddle else CLOSER * now.goal
        if not has_moved and goal < closest and not is_saddle:
            return None
        goal = max(goal, min(closest, now.goal)) if has_moved else goal
        return replace(
            now,
            goal=goal,
            doubts=now.doubts + 1,
            bound=np.inf,
            left=np.inf,
            solved=np.inf,
            corrected=False,
        )

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
    seen = (
        "a saddle or a fold"
        if np.isinf(now.error)
        else "a point farther from its solution than it seemed"
    )
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
