"""Stopping rule of a step: the error that x is known to have, and how closely the next linear solve must be made.

The error of x is |x - x*|_M / |x - y|_M, estimated (solve.nonlinear.estimate). |F(x)|_(M^-1) / |x - y|_M bounds it
wherever E is convex between x and x*. Where the bound will do already, or no estimate can be had, the bound is the
error.
"""

from dataclasses import dataclass

import numpy as np

from msmpetsc.model.checkpoint import Checkpoint
from msmpetsc.solve.nonlinear.curvature import Alarm, LowestCurvature
from msmpetsc.solve.nonlinear.estimate import ErrorEstimate
from msmpetsc.solve.nonlinear.functional import Iterate, StepFunctional
from msmpetsc.solve.nonlinear.rounding import Rounding

DEFAULT_ERROR = 1e-3
FULL_STEP_ERROR = 1e-5  # below it g, quadratic in the error, has no digits left to tell by
KNOWN = 0.8  # of the error that would do: one that is known to be less needs no closer estimate
FIRST_RATIO = 5.0  # of the bound on the error to the error, before any was estimated
LEAST_RATIO = 10.0  # taken, however near they were: an estimate that comes too early is the next solve's start
EARLY = 2.0  # a step is first estimated when its error is thought to be this many times what would do
LOOSEST = 0.3  # ksp_rtol
SHARE = 0.5  # of the error that would do, left to the linear solve
CLOSER, CLOSEST = 0.1, 1e-3  # of the error that was enough to doubt: asked for next, and at the most


@dataclass
class StepError:
    """Error of the step in progress.

    goal        : relative error to come to; 0 where a budget of iterations ends the step
    error       : of the last iterate, estimated or bounded
    bound       : on it
    residual    : |F|_(M^-1) of the last iterate
    early       : how many times the goal an error may be to be estimated
    corrected   : the last iterate's error was estimated, so that its Newton correction is known
    alarm       : where something has shown a negative curvature
    at_rounding : F is nothing but rounding
    doubts      : how often the step came to a point that is no minimum, or farther from one than it seemed
    """

    goal: float
    error: float = np.inf
    bound: float = np.inf
    residual: float = np.inf
    early: float = EARLY
    corrected: bool = False
    alarm: Alarm = Alarm.NOWHERE
    at_rounding: bool = False
    doubts: int = 0


class ErrorControl:
    """Judges the iterates of one stepper. All methods that are given an iterate are collective.

    error    : relative error at which a step is done; None where a budget of iterations ends it
    tightest : ksp_rtol that no linear solve goes below
    """

    def __init__(
        self,
        functional: StepFunctional,
        estimate: ErrorEstimate,
        curvature: LowestCurvature,
        rounding: Rounding,
        error: float | None,
        tightest: float,
    ):
        self.functional, self.estimate, self.curvature, self.rounding = functional, estimate, curvature, rounding
        self.target, self.tightest = error or 0.0, tightest
        self.ratio = FIRST_RATIO  # of bound to error in the last estimate
        self.now = StepError(self.target)

    def begin(self) -> None:
        """Know nothing yet of a new step."""
        self.now = StepError(self.target)

    def judge(self, iterate: Iterate) -> None:
        """Know the error of an iterate; only a bound on it while that is far too large."""
        now, functional = self.now, self.functional
        now.corrected, now.alarm = False, min(now.alarm, Alarm.ON_THE_WAY)
        now.residual, distance = functional.dual_norm(iterate.f), functional.distance(iterate.q)
        now.at_rounding = self.rounding.is_all_of(iterate.f)
        now.error = self._error(iterate, distance)

    def _error(self, iterate: Iterate, distance: float) -> float:
        now = self.now
        if not distance > 0 or not np.isfinite(now.residual):  # the start x = y tells nothing yet
            return 0.0 if now.at_rounding else np.inf
        now.bound = now.residual / distance
        if now.bound > max(self.ratio, LEAST_RATIO) * now.early * now.goal and not now.at_rounding:
            return now.bound
        if now.bound <= now.goal:
            lowest = self.curvature.compression(iterate.q).least_curvature
            if lowest > 0 and now.bound <= now.goal * lowest:
                return now.bound / lowest
        return self._estimated(iterate, distance, now.goal)

    def _estimated(self, iterate: Iterate, distance: float, goal: float) -> float:
        """The error against x less its correction: where x has not come far, |x - y|_M is not yet |x* - y|_M."""
        now = self.now
        enough = EARLY * goal * distance if goal else np.inf
        length = self.estimate(iterate, now.residual, enough, KNOWN * goal * distance)
        if not np.isfinite(length):
            now.alarm = Alarm.HERE
            return now.bound
        if self.estimate.missing is None:
            self.ratio = max(now.bound * distance / length, 1.0) if length > 0 else 1.0
        now.early, now.corrected = 1.0, True
        return self.rounding.relative(length, self.functional.distance(iterate.q, self.estimate.correction))

    def estimate_last(self, iterate: Iterate) -> None:
        """Estimate the error of the iterate that a budget ends at, unless that was done."""
        if not self.now.corrected:
            self.now.error = self._estimated(iterate, self.functional.distance(iterate.q), 0.0)

    @property
    def is_enough(self) -> bool:
        """Whether the last iterate's error is below the goal, or nothing but rounding is left."""
        return self.now.at_rounding or self.now.error <= self.now.goal

    @property
    def is_flat(self) -> bool:
        """Whether g falls by less than its rounding near the last iterate: any move is then called a fall."""
        now = self.now
        return now.bound < FULL_STEP_ERROR and (now.corrected or not now.doubts)

    def relative_tolerance(self) -> float:
        """ksp_rtol of the next linear solve: it need not gain more digits than are missing."""
        missing = self.now.bound / self.ratio
        return min(max(SHARE * self.now.goal / missing, self.tightest), LOOSEST)

    def doubt(self, has_moved: bool) -> bool:
        """Go on from a point that is no minimum, or farther from one than it seemed; whether there is more to gain.

        has_moved : the point was left; if not the goal becomes closer, until g has no digits left to tell by
        """
        now = self.now
        now.doubts += 1
        now.goal *= 1.0 if has_moved else CLOSER
        if not has_moved and now.goal < CLOSEST * self.target and np.isfinite(now.error):
            return False
        now.bound, now.corrected = np.inf, False
        return True

    def final_error(self, q: np.ndarray) -> float:
        """Relative error of the step that came to q (l, 3) [m], rounding included. Raises StepFailed."""
        return self.rounding.added_to(self.now.error, self.functional.distance(q), self.now.at_rounding)

    def save(self, checkpoint: Checkpoint) -> None:
        """Store what the next step's judgements depend on."""
        checkpoint.keep(numbers={"ratio": self.ratio})

    def restore(self, checkpoint: Checkpoint) -> None:
        """Go on from a checkpoint; from an empty one as if no step had been taken."""
        self.ratio = checkpoint.number("ratio", FIRST_RATIO, 0)
