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

from msmpetsc.backend.arrays import Floats, Positions, greatest
from msmpetsc.solve.nonlinear.curvature import LowestCurvature
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
    """Verdict on an iterate."""

    error: float  # relative, of the iterate; infinite where no estimate can be had
    nearer: Iterate  # the point that was looked at
    direction: Floats | None = None  # (n,) of negative curvature; None where there is none
    curvature: float = 1.0  # of it, an eigenvalue of M^(-1) H
    is_minimum: bool = False  # that will do


class Minimum:
    """Examines the iterates that a stepper comes to. All methods are collective."""

    def __init__(
        self,
        functional: StepFunctional,
        estimate: ErrorEstimate,
        curvature: LowestCurvature,
        rounding: Rounding,
    ):
        self.functional, self.estimate, self.curvature, self.rounding = (
            functional,
            estimate,
            curvature,
            rounding,
        )
        self.memory, self.first = functional.memory, functional.vectors.take()

    def examine(self, at: Iterate, outcome: Outcome, enough: float) -> Verdict:
        """Examine an iterate, or rather the point that is the iterate less its estimated error.

        outcome : of the iterate, with its compression; corrected if estimate.correction is of the iterate
        enough  : the length of an error that will do, |e|_M
        """
        functional, estimate, compression = self.functional, self.estimate, outcome.compression
        assert compression is not None
        nearer = self._follow(at) if outcome.corrected else None
        corrected, first = nearer is not None, self.first
        estimate.correction.copy(first)
        if nearer is None:
            nearer = at
            first.set(0.0)
        estimate.linearise(nearer.q)
        estimate.residual.aypx(-1.0, nearer.f)
        # Change of F that H at the iterate does not predict
        bent = functional.dual_norm(estimate.residual)
        hint = estimate.correction if outcome.alarm else None
        value, direction = compression.least_curvature, None
        if value <= CONVEX:
            value, direction = self.curvature.lowest(nearer.q, compression, outcome.alarm, hint)
        if value < 0:
            return Verdict(np.inf, nearer, direction, value)
        value = min(value, 1.0)
        estimate.convexity = min(estimate.convexity, value)
        known = outcome.known(value)
        if value > CONVEX and np.isfinite(known) and known * outcome.distance <= enough:
            return Verdict(known, nearer)
        length, rest = functional.norm(first), functional.dual_norm(nearer.f) / value
        # A bound, if g is as convex from there on
        if value > CONVEX and length + rest <= KNOWN * enough:
            return Verdict(
                self.rounding.relative(length + rest, functional.distance(nearer.q)), nearer
            )
        if corrected and estimate.missing is not None and value <= CONVEX:
            closely = bool(np.isfinite(estimate(at, functional.dual_norm(at.f), np.inf)))
            return self.examine(at, replace(outcome, corrected=closely), enough)
        if corrected and bent <= SMALL * estimate.length and value > CONVEX:
            return Verdict(
                self.rounding.relative(estimate.length, functional.distance(nearer.q)), nearer
            )
        return Verdict(self._second_estimate(nearer, first, rest, enough, value), nearer)

    def _follow(self, at: Iterate) -> Iterate | None:
        """Return an iterate less its correction; None if the surface meets itself on the way."""
        x, q, is_free = self._end(at)
        if not is_free:
            self.functional.vectors.give_back(x)
            return None
        return self.functional.iterate(x, q)

    def _end(self, at: Iterate) -> tuple[PETSc.Vec, Positions, bool]:
        """Return the unknowns of an iterate less its correction, their positions (l, 3) [m], and whether the way there
        is free. The caller gives the vector of unknowns back."""
        functional, x = self.functional, self.functional.vectors.take()
        x.waxpy(-1.0, self.estimate.correction, at.x)
        q = functional.positions(x)
        return x, q, functional.free_share(at.q, q) == 1.0

    def _second_estimate(
        self, nearer: Iterate, correction: PETSc.Vec, bound: float, enough: float, lowest: float
    ) -> float:
        """Estimate the error of the iterate by both corrections, of which the first is ``correction``.

        If the second leads through the surface, g is no parabola over it, and the error may be far larger.
        Where the second cannot be had, as CG breaks down on an F of little but rounding, what
        bounds it has its place if the curvature allows; else the error is infinite.
        """
        functional, estimate, relative = self.functional, self.estimate, self.rounding.relative
        distance, first = functional.distance(nearer.q), functional.norm(correction)
        will_do = KNOWN * enough - first if lowest > CONVEX else 0.0
        second = estimate(nearer, bound, enough, will_do, lowest)
        if not np.isfinite(second):
            return relative(first + bound, distance) if lowest > CONVEX else np.inf
        if functional.surface is not None:
            end, _, is_free = self._end(nearer)
            functional.vectors.give_back(end)
            if not is_free:
                return relative(first + DOUBTFUL * second, distance)
        known = second - (estimate.missing or 0.0)
        if first > 0 and known > SMALL * first:
            return DOUBTFUL * relative(max(first, second), distance)
        if estimate.missing is not None:
            return relative(first + second, distance)
        correction.axpy(
            second / max(functional.norm(estimate.correction), sys.float_info.min),
            estimate.correction,
        )
        return relative(
            functional.norm(correction), functional.distance(nearer.q, estimate.correction)
        )

    def go_on(self, at: Iterate, verdict: Verdict) -> Iterate | None:
        """Return an iterate where g is lower than at one that is no minimum; None where there is none.

        It is the point examined, or lies from there along a direction of negative curvature, as far as doubling the
        move lets g fall.
        """
        falls = self.functional.change(verdict.nearer.q, at.q)[0] < 0
        lower = verdict.nearer if falls else None
        if verdict.direction is None:
            return lower
        return self._descend(lower or at, verdict.direction, verdict.curvature) or lower

    def _descend(self, at: Iterate, direction: Floats, curvature: float) -> Iterate | None:
        """Return an iterate along a direction (n,) of negative curvature; None if g does not fall that way."""
        functional, base = self.functional, at.q
        slope = functional.comm.allreduce(float(self.memory.read(at.f) @ direction))
        longest = float(functional.comm.allreduce(greatest(np.abs(direction)), MPI.MAX))
        move = FIRST_MOVE * functional.lattice.cell_size / longest
        if (
            slope > SLOPE * abs(curvature) * move
        ):  # else both ways lead down, and ranks must not differ
            move = -move
        x, best, lowest = functional.vectors.take(), 0.0, 0.0
        for _ in range(MOVES):
            self.memory.write(x)[:] = self.memory.read(at.x) + move * direction
            q = functional.positions(x)
            change = (
                functional.change(q, base)[0] if functional.free_share(base, q) == 1.0 else np.inf
            )
            if change < lowest:
                best, lowest = move, change
                move *= 2
            elif best == 0.0:
                move /= 2
            else:
                break
        if best == 0.0:
            functional.vectors.give_back(x)
            return None
        self.memory.write(x)[:] = self.memory.read(at.x) + best * direction
        return functional.iterate(x)
