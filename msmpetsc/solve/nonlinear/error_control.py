"""Stopping rule of a step: the error of an iterate x, and the tolerance of the next linear solve.

The relative error of x is |x - x*|_M / |x - y|_M. First |x - x*|_M is bounded, then estimated:

1. |F(x)|_(M^-1) is an upper bound if E is convex between x and x*.
2. The Newton correction at x is the error up to terms of second order (error_estimate). Newton's
   linear solve computes the correction anyway. Other methods solve for the correction once the
   bound is near the goal.

The next linear solve reduces its residual by the factor

    rtol = min(ksp_rtol, max(theta, goal / (2 error), ksp_rtol / 1000))
    theta = (|F_k| / |F_(k-1)|)^2

(Eisenstat and Walker 1996, Choosing the Forcing Terms in an Inexact Newton Method, Choice 2; Kelley
1995, Iterative Methods for Linear and Nonlinear Equations, Eq. 6.20). Theta is the part of F that H
is expected to miss in the next F. The first solve of a step takes theta as measured at the last
first iteration after which a step went on.
"""

from dataclasses import dataclass, replace

import numpy as np
from petsc4py import PETSc

from msmpetsc.elasticity.locate import describe_inverted, node_of_greatest
from msmpetsc.errors import StepFailed
from msmpetsc.solve.nonlinear.curvature import Alarm, Compression, LowestCurvature
from msmpetsc.solve.nonlinear.error_estimate import ErrorEstimate
from msmpetsc.solve.nonlinear.functional import Iterate, Rounding, StepFunctional

# Relative error below which changes of g, quadratic in the error, have no digits [-]
FULL_STEP_ERROR = 1e-5
# Assumed ratio of the bound to the error before the first estimate [-]
FIRST_RATIO = 5.0
# Least goal, after a doubt [target]; also the least tolerance of a linear solve
# [ksp_rtol]
CLOSEST = 1e-3
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

    goal        : relative error at which the solve ends; 0 if a budget of iterations ends the solve
    error       : relative error of the iterate, estimated or bounded
    bound       : upper bound of the relative error, by |F|_(M^-1)
    residual    : |F|_(M^-1) of the iterate
    distance    : |x - y|_M of the iterate
    missed      : theta, the part of F that H is expected to miss in the next F
    corrected   : whether the error was estimated, so that the Newton correction is known
    alarm       : place where a solve has met a negative curvature
    at_rounding : whether F is rounding alone
    doubts      : number of points that were no minimum, or farther from the minimum than estimated
    compression : compression of the iterate; None if not yet computed
    """

    goal: float = 0.0
    error: float = np.inf
    bound: float = np.inf
    residual: float = np.inf
    distance: float = 0.0
    missed: float = 1.0
    corrected: bool = False
    alarm: Alarm = Alarm.NOWHERE
    at_rounding: bool = False
    doubts: int = 0
    compression: Compression | None = None

    @property
    def is_flat(self) -> bool:
        """Whether g is so close to its minimum that changes of g have no digits."""
        return self.bound < FULL_STEP_ERROR and (self.corrected or not self.doubts)

    @property
    def is_converged(self) -> bool:
        """Whether the error is below the goal or F is rounding."""
        return self.at_rounding or self.error <= self.goal


@dataclass(eq=False)
class ErrorControl:
    """Errors of the iterates of a stepper. All methods that take an iterate are collective.

    target : relative error at which a step is done; 0 if a budget of iterations ends the step
    rtol   : ksp_rtol, the loosest tolerance of a linear solve
    ratio  : ratio of bound to error in the last estimate
    missed : theta of the last first iteration after which a step went on; 1 before it
    """

    functional: StepFunctional
    estimate: ErrorEstimate
    curvature: LowestCurvature
    rounding: Rounding
    target: float
    rtol: float
    ratio: float = FIRST_RATIO
    missed: float = 1.0

    def judge(self, iterate: Iterate, before: Outcome) -> Outcome:
        """Return the outcome at an iterate, with an upper bound of its error."""
        residual = self.functional.dual_norm(iterate.f)
        distance = self.functional.distance(iterate.q)
        at_rounding = self.rounding.explains(iterate)
        alarm = min(before.alarm, Alarm.ON_THE_WAY)
        is_first = np.isinf(before.residual)
        missed = self.missed if is_first else (residual / before.residual) ** 2
        now = replace(
            before,
            residual=residual,
            distance=distance,
            missed=missed,
            corrected=False,
            alarm=alarm,
            at_rounding=at_rounding,
            compression=None,
        )
        # At the start x = y, the distance 0 gives no relative error
        if not distance > 0 or not np.isfinite(residual):
            return replace(now, error=0.0 if at_rounding else np.inf)
        bound = residual / distance
        now = replace(now, bound=bound, error=bound)
        if bound > now.goal:
            return now
        now = self.with_compression(iterate, now)
        assert now.compression is not None
        lowest = now.compression.least_curvature
        return replace(now, error=bound / lowest if lowest > 0 else np.inf)

    def is_near(self, now: Outcome) -> bool:
        """Return whether the error may be below the goal, by the last ratio of bound to error."""
        return now.at_rounding or now.bound <= self.ratio * now.goal

    def estimated_if_near(self, iterate: Iterate, now: Outcome) -> Outcome:
        """Return the outcome with an estimated error if the error may be below the goal."""
        if now.error <= now.goal or not self.is_near(now):
            return now
        return self.estimated(iterate, now, now.goal)

    def with_compression(self, iterate: Iterate, now: Outcome) -> Outcome:
        """Return the outcome with the compression of its iterate."""
        if now.compression:
            return now
        return replace(now, compression=self.curvature.compression(iterate))

    def estimated(self, iterate: Iterate, now: Outcome, goal: float) -> Outcome:
        """Return the outcome with an estimated error.

        The error is relative to |x - e - y|_M with the Newton correction e, since x may still be
        close to y.
        """
        length = self.estimate(iterate, goal * now.distance)
        if not np.isfinite(length):
            return replace(now, error=now.bound, alarm=Alarm.HERE)
        return self.measured(iterate, now)

    def measured(self, iterate: Iterate, now: Outcome, trust: float = 1.0) -> Outcome:
        """Return the outcome with the error that the last solve for the correction measured.

        trust : lower bound of the correction's norm over the error; 0 without a bound
        """
        estimate = self.estimate
        length = estimate.correction_norm + estimate.missing
        self.ratio = max(now.bound * now.distance / length, 1.0) if length > 0 else 1.0
        if not trust > 0:
            return replace(now, error=np.inf)
        distance = self.functional.distance(iterate.q, estimate.correction)
        return replace(now, error=self.rounding.relative(length / trust, distance), corrected=True)

    def tolerance(self, now: Outcome) -> float:
        """Return the tolerance of the linear solve at an iterate."""
        if not now.goal * now.bound > 0:
            return self.rtol
        needed = max(0.5 * now.goal * self.ratio / now.bound, now.missed)
        return min(max(needed, CLOSEST * self.rtol), self.rtol)

    def doubt(self, now: Outcome, has_moved: bool) -> Outcome | None:
        """Return the outcome from which a step goes on after a doubt.

        If the step has left a saddle, the goal stays. Otherwise the goal becomes the least goal: a
        second correction has shown that g is not quadratic, so an error bound of the same size says
        nothing. A step that cannot leave a saddle takes smaller goals still. Return None if the
        step has not moved, met no saddle, and has the least goal.

        has_moved : whether the step goes on from another point
        """
        is_saddle, goal = np.isinf(now.error), CLOSEST * self.target
        if is_saddle:
            goal = now.goal if has_moved else CLOSEST * now.goal
        elif not has_moved and now.goal <= goal:
            return None
        goal = min(goal, now.goal)
        return replace(now, goal=goal, doubts=now.doubts + 1, bound=np.inf, corrected=False)

    def forget(self) -> None:
        self.ratio, self.missed = FIRST_RATIO, 1.0


def not_converged(
    snes: PETSc.SNES, ksp: PETSc.KSP, now: Outcome, iterations: int, worst: str, true_hessian: bool
) -> StepFailed:
    """Return the failure of a SNES that did not converge in ``iterations``.

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
    """Return the failure of a step that found too many points that are no minimum."""
    seen = "a point farther from its solution than it seemed"
    if np.isinf(now.error):
        seen = "a saddle or a fold"
    return StepFailed(
        f"did not come to a minimum: it came to {seen} {now.doubts} times, "
        f"residual |F| = {now.residual:.2e}{worst}; "
        "try a smaller time.step, or another preset (newton)",
        "no minimum",
    )


def where_worst(functional: StepFunctional, iterate: Iterate) -> str:
    """Return a text on the node of the greatest |F| / m and on inverted cells (collective)."""
    comm, lattice = functional.comm, functional.lattice
    node = node_of_greatest(comm, lattice, *functional.pull(iterate.f))
    return f", worst at {node}{describe_inverted(comm, lattice, iterate.q)}"
