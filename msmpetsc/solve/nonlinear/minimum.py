"""Examination of where a step ended: at a minimum of g, as near to it as was said, or at a point
where F is small and no more.

The estimate of a step's error is the Newton correction e at x. Where a body is compressed g may have a fold or a saddle
between x and x - e, or curve so much that e says little; so all is looked at once more at x - e, which is nearer.
"""

import sys
from dataclasses import dataclass, replace

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.backend.arrays import Floats, greatest
from msmpetsc.solve.nonlinear.curvature import Compression, LowestCurvature
from msmpetsc.solve.nonlinear.error_control import KNOWN, Outcome
from msmpetsc.solve.nonlinear.error_estimate import ErrorEstimate
from msmpetsc.solve.nonlinear.functional import Iterate, Rounding, StepFunctional

CONVEX = 0.5  # lowest eigenvalue of M^(-1) H: below it, the first estimate may have missed too much
SMALL = 0.3  # of the first correction: a second one that is more shows that g is no parabola there
DOUBTFUL = 30.0  # times what both say may be the error: 10 times were seen in a valley
SLOPE = 0.25  # over what the curvature makes of it on the first move: less, as of a symmetric body, may be rounding
FIRST_MOVE, MOVES = 1e-3, 24  # off a saddle [cells]; doubled while g falls, or halved until it does


@dataclass(frozen=True)
class Verdict:
    """Verdict on a point x."""

    error: float  # relative, of x; infinite where no estimate can be had
    direction: Floats | None = None  # (n,) of negative curvature; None where there is none
    curvature: float = 1.0  # of it, an eigenvalue of M^(-1) H
    is_minimum: bool = False  # that will do


class Minimum:
    """Examines the points that a stepper comes to. All methods are collective."""

    def __init__(
        self, functional: StepFunctional, estimate: ErrorEstimate, curvature: LowestCurvature, rounding: Rounding
    ):
        self.functional, self.estimate, self.curvature, self.rounding = functional, estimate, curvature, rounding
        self.unknowns, self.memory = functional.unknowns, functional.memory
        self.nearer, self.f, self.first = (estimate.correction.duplicate() for _ in range(3))

    def examine(self, x: PETSc.Vec, outcome: Outcome, compression: Compression, enough: float) -> Verdict:
        """Examine x, or rather the point that is x less its estimated error.

        outcome : what is known at x; whether estimate.correction is of x
        enough  : the length of an error that will do, |e|_M
        """
        functional, estimate = self.functional, self.estimate
        corrected, alarm = self._approach(x, outcome.corrected), outcome.alarm
        nearer = functional.evaluate(self.nearer, self.f)
        estimate.linearise(nearer.q)
        estimate.residual.aypx(-1.0, self.f)
        bent = functional.dual_norm(estimate.residual)  # what H at x did not know
        hint = estimate.correction if alarm else None
        value, direction = compression.least_curvature, None
        if value <= CONVEX:
            value, direction = self.curvature.lowest(nearer.q, compression, alarm, hint)
        if value < 0:
            return Verdict(np.inf, direction, value)
        value = min(value, 1.0)
        estimate.convexity = min(estimate.convexity, value)
        known = outcome.known(value)
        if value > CONVEX and np.isfinite(known) and known * outcome.distance <= enough:
            return Verdict(known)
        first, rest = functional.norm(self.first), functional.dual_norm(self.f) / value
        if value > CONVEX and first + rest <= KNOWN * enough:  # a bound, if g is as convex from there on
            return Verdict(self.rounding.relative(first + rest, functional.distance(nearer.q)))
        if corrected and estimate.missing is not None and value <= CONVEX:
            iterate = functional.evaluate(x, self.f)
            closely = bool(np.isfinite(estimate(iterate, functional.dual_norm(self.f), np.inf)))
            return self.examine(x, replace(outcome, corrected=closely), compression, enough)
        if corrected and bent <= SMALL * estimate.length and value > CONVEX:
            return Verdict(self.rounding.relative(estimate.length, functional.distance(nearer.q)))
        return Verdict(self._second_estimate(nearer, first, rest, enough, value))

    def _approach(self, x: PETSc.Vec, corrected: bool) -> bool:
        """Make the point to look at x less its correction; whether it is, or x itself, for the surface meets itself."""
        self.first.set(0.0)
        if corrected and self._follow(x, self.nearer):
            self.estimate.correction.copy(self.first)
            return True
        x.copy(self.nearer)
        return False

    def _follow(self, x: PETSc.Vec, end: PETSc.Vec) -> bool:
        """Write x less its correction into ``end``; return whether the surface meets itself nowhere on the way."""
        x.copy(end)
        end.axpy(-1.0, self.estimate.correction)
        positions = self.functional.positions
        return self.functional.surface is None or self.functional.free_share(positions(x), positions(end)) == 1.0

    def _second_estimate(self, nearer: Iterate, first: float, bound: float, enough: float, lowest: float) -> float:
        """Estimate the error of x by both corrections, of which the first has the length ``first``.

        If the second leads through the surface, g is no parabola over it, and the error may be far larger.
        Where the second cannot be had, as CG breaks down on an F of little but rounding, what
        bounds it has its place if the curvature allows; else the error is infinite.
        """
        functional, correction, relative = self.functional, self.estimate.correction, self.rounding.relative
        distance = functional.distance(nearer.q)
        will_do = KNOWN * enough - first if lowest > CONVEX else 0.0
        second = self.estimate(nearer, bound, enough, will_do, lowest)
        if not np.isfinite(second):
            return relative(first + bound, distance) if lowest > CONVEX else np.inf
        if not self._follow(self.nearer, self.f):
            return relative(first + DOUBTFUL * second, distance)
        known = second - (self.estimate.missing or 0.0)
        if first > 0 and known > SMALL * first:
            return DOUBTFUL * relative(max(first, second), distance)
        if self.estimate.missing is not None:
            return relative(first + second, distance)
        self.first.axpy(second / max(functional.norm(correction), sys.float_info.min), correction)
        return relative(functional.norm(self.first), functional.distance(nearer.q, correction))

    def go_on(self, x: PETSc.Vec, verdict: Verdict) -> bool:
        """Move x to the point examined if g is lower there; whether it has moved.

        From there it goes on along a direction of negative curvature, as far as doubling the move lets g fall.
        """
        functional = self.functional
        falls = functional.change(functional.positions(self.nearer), functional.positions(x))[0] < 0
        if falls:
            self.nearer.copy(x)
        if verdict.direction is None:
            return falls
        return self._descend(x, verdict.direction, verdict.curvature) or falls

    def _descend(self, x: PETSc.Vec, direction: Floats, curvature: float) -> bool:
        """Move x along a direction (n,) of negative curvature; whether g falls that way."""
        functional = self.functional
        base = functional.evaluate(x, self.f).q
        slope = functional.comm.allreduce(float(self.memory.read(self.f) @ direction))
        longest = float(functional.comm.allreduce(greatest(np.abs(direction)), MPI.MAX))
        move = FIRST_MOVE * functional.lattice.cell_size / longest
        if slope > SLOPE * abs(curvature) * move:  # else both ways lead down, and ranks must not differ
            move = -move
        best = lowest = 0.0
        for _ in range(MOVES):
            self.memory.write(self.f)[:] = self.memory.read(x) + move * direction
            q = functional.positions(self.f)
            change = functional.change(q, base)[0] if functional.free_share(base, q) == 1.0 else np.inf
            if change < lowest:
                best, lowest = move, change
                move *= 2
            elif best == 0.0:
                move /= 2
            else:
                break
        self.memory.write(x)[:] += best * direction
        return best != 0.0

    def destroy(self) -> None:
        for owned in (self.nearer, self.f, self.first):
            owned.destroy()
