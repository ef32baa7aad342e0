"""Stopping rule of a step: the estimated error of an iterate x, and the tolerance of the next
linear solve.

The relative error of x is |x - x*|_M / |x - y|_M. Three numbers stand for the error, from the
cheapest to the dearest:

1. |F(x)|_(M^-1) is an upper bound if E is convex between x and x*.
2. The residual r of the linear solve that led to x bounds the error of this solve in the norm of
   H, |r|_(P^-1) / sqrt(lambda). P is the preconditioner, lambda the least eigenvalue of P^(-1) H.
   The nonlinear residual F - r bounds the rest of the error.
3. An estimate solves for the Newton correction at x (error_estimate).
"""

from dataclasses import dataclass, replace

import numpy as np
from petsc4py import PETSc

from msmpetsc.elasticity.locate import describe_inverted, node_of_greatest
from msmpetsc.errors import StepFailed
from msmpetsc.solve.nonlinear.curvature import Alarm, Compression, LowestCurvature
from msmpetsc.solve.nonlinear.error_estimate import FEW, LOWER, ErrorEstimate
from msmpetsc.solve.nonlinear.functional import Iterate, Rounding, StepFunctional

# Relative error below which g, which is quadratic in the error, has no digits left
FULL_STEP_ERROR = 1e-5
# Share of the acceptable error; an error known to be below it needs no closer estimate
KNOWN = 0.8
# Ratio of the bound to the error before any estimate was made
FIRST_RATIO = 5.0
# Least ratio of bound to error in use; an estimate that is early starts the next linear
# solve
LEAST_RATIO = 10.0
# Multiple of the acceptable error at which a step is first estimated
EARLY = 2.0
# Iterations of a step after which its linear solves gain a digit. Loose solves may open
# and close a stiff gap for ever
ITS_PER_DIGIT = 50
# Share of the acceptable error that the linear solve may leave
SHARE = 0.5
# Multiple of the acceptable error from which a linear solve should be the last
FINAL = 200.0
# Share of F that the nonlinear residual may have for the bound of the linear solve to
# hold
PARABOLA = 0.2
# Least eigenvalue of P^(-1) H for which P counts as close to H
NEAR = 0.02
# Ratio of |F| to the last |F| above which F may be rounding of stiff contact
STAYS = 0.5
# Factor on the goal after a doubt, and its least value
CLOSER, CLOSEST = 0.1, 1e-3
# ksp_atol that never ends a solve, PETSc's default
NO_ATOL = 1e-50
# DIVERGED_FNORM_NAN, which PETSc 3.25 renames
NOT_FINITE = -4
KINDS = {
    PETSc.SNES.ConvergedReason.DIVERGED_LINE_SEARCH: "line search",
    PETSc.SNES.ConvergedReason.DIVERGED_LINEAR_SOLVE: "linear solve",
    NOT_FINITE: "not finite",
    # DIVERGED_OBJECTIVE_NANORINF, from PETSc 3.25 on
    -14: "not finite",
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
    """State of a solve at its last iterate.

    goal        : relative error at which the solve ends; 0 if a budget of iterations ends it
    error       : relative error of the iterate, estimated or bounded
    bound       : upper bound of the relative error, by |F|_(M^-1)
    residual    : |F|_(M^-1) of the iterate
    distance    : |x - y|_M of the iterate
    early       : multiple of the goal at which the error is estimated
    corrected   : whether the error was estimated, so that the Newton correction is known
    solved      : bound on |e|_H that the last linear solve has left; infinite if unknown
    nonlinear   : |F - r|_(M^-1), r the residual of the last linear solve; infinite if unknown
    alarm       : place where a solve has met a negative curvature
    at_rounding : whether F is rounding and nothing else
    doubts      : number of points found to be no minimum, or farther from it than estimated
    compression : of the iterate; None if not yet computed
    """

    goal: float = 0.0
    error: float = np.inf
    bound: float = np.inf
    residual: float = np.inf
    distance: float = 0.0
    early: float = EARLY
    corrected: bool = False
    solved: float = np.inf
    nonlinear: float = np.inf
    alarm: Alarm = Alarm.NOWHERE
    at_rounding: bool = False
    doubts: int = 0
    compression: Compression | None = None

    def error_of_solve(self, lowest: float) -> float:
        """Return the bound of the relative error by the last linear solve; infinite if it has none.

        lowest : lower bound of the eigenvalues of M^(-1) H
        """
        if not min(lowest, self.distance) > 0:
            return np.inf
        return float((self.solved / np.sqrt(lowest) + self.nonlinear / lowest) / self.distance)

    @property
    def is_flat(self) -> bool:
        """Whether g is so close to its minimum that changes of g have no digits."""
        return self.bound < FULL_STEP_ERROR and (self.corrected or not self.doubts)

    @property
    def is_enough(self) -> bool:
        """Whether the error is below the goal or F is rounding."""
        return self.at_rounding or self.error <= self.goal


@dataclass(eq=False)
class ErrorControl:
    """Errors of the iterates of one stepper. All methods that take an iterate are collective.

    target       : relative error at which a step is done; 0 if a budget of iterations ends it
    rtol         : ksp_rtol of the linear solves before the last
    ratio        : ratio of bound to error in the last estimate
    has_residual : whether estimate.residual has the residual of the last linear solve
    error_per_residual : ratio of the bound on |e|_H to |r|_(P^-1) in the last linear solve; 0 if
                   no solve had a bound
    """

    functional: StepFunctional
    estimate: ErrorEstimate
    curvature: LowestCurvature
    rounding: Rounding
    target: float
    rtol: float
    ratio: float = FIRST_RATIO
    has_residual: bool = False
    error_per_residual: float = 0.0

    def judge(self, iterate: Iterate, before: Outcome) -> Outcome:
        """Return the outcome at an iterate, with its error.

        The error is the upper bound while the bound is far above the goal.
        """
        residual, distance = (
            self.functional.dual_norm(iterate.f),
            self.functional.distance(iterate.q),
        )
        stays = residual > STAYS * before.residual
        at_rounding = self.rounding.explains(iterate, stays)
        alarm = min(before.alarm, Alarm.ON_THE_WAY)
        now = replace(
            before, residual=residual, distance=distance, at_rounding=at_rounding, alarm=alarm
        )
        now = replace(now, corrected=False, nonlinear=np.inf, compression=None)
        # No error is relative to the start x = y
        if not distance > 0 or not np.isfinite(residual):
            return replace(now, error=0.0 if at_rounding else np.inf)
        now = replace(now, bound=residual / distance)
        if self.has_residual and now.solved <= now.goal * now.distance and not now.alarm:
            now = self._bounded_by_solve(iterate, now)
            if now.error <= now.goal:
                return now
        if self._prefers_next_solve(now):
            return replace(now, error=now.bound)
        is_near = at_rounding or now.bound <= self._useful_bound(now)
        if not is_near:
            return replace(now, error=now.bound)
        if now.bound <= now.goal:
            now = self.with_compression(iterate, now)
            assert now.compression is not None
            lowest = now.compression.least_curvature
            if lowest > 0 and now.bound <= now.goal * lowest:
                return replace(now, error=now.bound / lowest)
        return self.estimated(iterate, now, now.goal)

    def _prefers_next_solve(self, now: Outcome) -> bool:
        """Return whether the next linear solve costs no more than an estimate."""
        if now.alarm or now.doubts or now.at_rounding:
            return False
        return now.goal * now.distance < now.solved < np.inf

    def _bounded_by_solve(self, iterate: Iterate, now: Outcome) -> Outcome:
        """Return the outcome with the error bounded by the last linear solve."""
        self.estimate.residual.aypx(-1.0, iterate.f)
        self.has_residual = False
        nonlinear = self.functional.dual_norm(self.estimate.residual)
        if nonlinear > PARABOLA * now.residual:
            return replace(now, error=np.inf)
        now = self.with_compression(iterate, replace(now, nonlinear=nonlinear))
        assert now.compression is not None
        error = now.error_of_solve(now.compression.least_curvature or self.estimate.convexity)
        if error > 0:
            self.ratio = max(now.bound / error, 1.0)
        return replace(now, error=error)

    def with_compression(self, iterate: Iterate, now: Outcome) -> Outcome:
        """Return the outcome with the compression of its iterate."""
        return (
            now
            if now.compression
            else replace(now, compression=self.curvature.compression(iterate.q))
        )

    def estimated(self, iterate: Iterate, now: Outcome, goal: float) -> Outcome:
        """Return the outcome with an estimated error.

        The error is relative to |x - e - y|_M, e the Newton correction, since x may still be close
        to y.
        """
        distance = now.distance
        enough = EARLY * goal * distance if goal else np.inf
        length = self.estimate(iterate, now.residual, enough, KNOWN * goal * distance)
        if not np.isfinite(length):
            return replace(now, error=now.bound, alarm=Alarm.HERE)
        is_known = now.bound <= self._useful_bound(now)
        if self.estimate.missing is None and is_known:
            self.ratio = max(now.bound * distance / length, 1.0) if length > 0 else 1.0
        error = self.rounding.relative(
            length, self.functional.distance(iterate.q, self.estimate.correction)
        )
        return replace(now, error=error, early=1.0, corrected=True)

    def _useful_bound(self, now: Outcome) -> float:
        """Return the bound up to which an estimate is useful, by the last ratio."""
        return max(self.ratio, LEAST_RATIO) * now.early * now.goal

    def after_linear_solve(self, ksp: PETSc.KSP, now: Outcome) -> Outcome:
        """Return the outcome with the bounds that a linear solve with the true Hessian gives."""
        is_natural = (
            ksp.getType() == PETSc.KSP.Type.CG and ksp.getNormType() == PETSc.KSP.NormType.NATURAL
        )
        now = replace(now, solved=np.inf)
        if ksp.reason < 0 or not is_natural:
            return now
        self.estimate.learn(ksp)
        solved = self._solved(ksp)
        self.has_residual = solved <= now.goal * now.distance
        if self.has_residual:
            self.estimate.residual = ksp.buildResidual(self.estimate.residual)
            if self.estimate.preconditioner.least_norm(self.estimate.residual) > solved:
                self.has_residual, solved = False, np.inf
        return replace(now, solved=solved)

    def _solved(self, ksp: PETSc.KSP) -> float:
        """Return the bound on |e|_H that a linear solve has left; infinite if unknown."""
        is_far = self.estimate.preconditioner.is_uniform and self.estimate.least < NEAR
        # A residual below the tolerance at the start: the ratio is of another H
        if ksp.its < FEW:
            self.error_per_residual = 0.0
            return np.inf
        if ksp.getInitialGuessNonzero() or self.estimate.needs_probe or is_far:
            return np.inf
        if not self.estimate.least > 0:
            return np.inf
        self.error_per_residual = float(1 / np.sqrt(LOWER * self.estimate.least))
        return self.error_per_residual * float(ksp.getResidualNorm())

    def tolerances(self, now: Outcome, its: int = 0) -> tuple[float, float]:
        """Return ksp_rtol and ksp_atol of the linear solve after ``its`` iterations of a step.

        A solve that should be the last goes on until its bound is below the acceptable error.
        """
        is_last = now.bound / self.ratio <= FINAL * now.goal
        if is_last and self.error_per_residual:
            atol = SHARE * now.goal * now.distance / self.error_per_residual
            return CLOSEST * self.rtol, atol
        return self.rtol * max(0.1 ** (its // ITS_PER_DIGIT), CLOSEST), NO_ATOL

    def doubt(self, now: Outcome, has_moved: bool) -> Outcome | None:
        """Return the outcome from which a step goes on after a doubt; None without any gain.

        The goal stays after a saddle. Otherwise the goal becomes closer until g has no digits left:
        a second correction has shown that g is not quadratic, so an error bound of the same size
        says nothing.

        has_moved : whether the step goes on from another point
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
            solved=np.inf,
            corrected=False,
        )

    def forget(self, modes: bool) -> None:
        self.ratio = FIRST_RATIO
        self.error_per_residual = 0.0
        self.estimate.forget(modes)


def not_converged(
    snes: PETSc.SNES, ksp: PETSc.KSP, now: Outcome, iterations: int, worst: str, true_hessian: bool
) -> StepFailed:
    """Return the failure of a SNES that gave up after ``iterations``.

    worst        : description by ``where_worst``
    true_hessian : whether the preset is newton's, so that no other preset can help
    """
    reason, kind = REASON.get(snes.reason, str(snes.reason)), KINDS.get(snes.reason, "iterations")
    preset = "" if true_hessian else "another preset (newton), "
    advice = f'a smaller time.step, {preset}a looser solver.error, or safety.on_failure = "substep"'
    if kind == "linear solve":
        reason += f" (KSP {KSP_REASON.get(ksp.reason, str(ksp.reason))} after {ksp.its} its)"
        advice = "a looser -ksp_rtol, a larger -ksp_max_it, or another -pc_type"
    return StepFailed(
        f"did not converge: {reason} after {iterations} iterations, "
        f"residual |F| = {now.residual:.2e}, relative error {now.error:.2e}{worst}; try {advice}",
        kind,
    )


def no_minimum(now: Outcome, worst: str) -> StepFailed:
    """Return the failure of a step whose iterates all were doubtful."""
    seen = (
        "a saddle or a fold"
        if np.isinf(now.error)
        else "a point farther from its solution than it seemed"
    )
    return StepFailed(
        f"did not come to a minimum: it came to {seen} {now.doubts} times, "
        f"residual |F| = {now.residual:.2e}{worst}; "
        "try a smaller time.step, or another preset (newton)",
        "no minimum",
    )


def where_worst(functional: StepFunctional, iterate: Iterate) -> str:
    """Return words on the node of the greatest F and on inverted cells (collective)."""
    comm, lattice = functional.comm, functional.lattice
    node = node_of_greatest(comm, lattice, *functional.pull(iterate.f))
    return f", worst at {node}{describe_inverted(comm, lattice, iterate.q)}"
