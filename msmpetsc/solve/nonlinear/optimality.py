"""Test whether an iterate is a minimum of g, and whether the estimate of its error is right.

F may be small at a point that is no minimum. The estimate of a step's error is the Newton
correction e at x. If the body is compressed, g may have a fold or a saddle between x and x - e. The
curvature of g may also change so much that e says little. So Hessian and error are examined once
more at x - e.
"""

from dataclasses import dataclass, replace

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.backend.arrays import Floats, Positions, greatest
from msmpetsc.comm import reduced
from msmpetsc.solve.nonlinear.curvature import LowestCurvature
from msmpetsc.solve.nonlinear.error_control import Outcome
from msmpetsc.solve.nonlinear.error_estimate import ErrorEstimate
from msmpetsc.solve.nonlinear.functional import Iterate, Rounding, StepFunctional

# Least eigenvalue of M^(-1) H below which the first estimate may have missed too much
# [-]
CONVEX = 0.5
# Ratio of the second correction to the first above which g is not quadratic [-]
SMALL = 0.3
# Factor on the error if the two corrections disagree [-]
DOUBTFUL = 30.0


@dataclass(frozen=True)
class Verdict:
    """Verdict on an iterate.

    error      : relative error of the iterate; infinite if no estimate is possible
    examined   : point at which g was examined, x or x - e
    direction  : (n,) direction of negative curvature; None if there is none
    is_minimum : whether the step may end at the iterate
    """

    error: float
    examined: Iterate
    direction: Floats | None = None
    is_minimum: bool = False


class Optimality:
    """Second-order test of a stepper's iterates. All methods are collective."""

    def __init__(
        self,
        functional: StepFunctional,
        estimate: ErrorEstimate,
        curvature: LowestCurvature,
        rounding: Rounding,
    ):
        self.functional, self.memory = functional, functional.memory
        self.estimate, self.curvature, self.rounding = estimate, curvature, rounding

    def examine(self, at: Iterate, outcome: Outcome, acceptable: float) -> Verdict:
        """Examine g at x - e, or at x if the iterate has no correction e; return the verdict.

        outcome    : outcome of the iterate, with its compression; ``corrected`` if e is known, as
                     estimate.correction
        acceptable : acceptable error |e|_M [m sqrt(kg)]
        """
        functional, estimate, compression = self.functional, self.estimate, outcome.compression
        assert compression is not None
        examined = self._corrected_iterate(at) if outcome.corrected else None
        corrected = examined is not None
        length = functional.norm(estimate.correction) if corrected else 0.0
        examined = examined or at
        estimate.linearise(examined)
        estimate.residual.aypx(-1.0, examined.f)
        # Change of F that H at the iterate does not predict
        bent = functional.dual_norm(estimate.residual)
        hint = estimate.correction if outcome.alarm else None
        value, direction = compression.least_curvature, None
        if value <= CONVEX:
            value, direction = self.curvature.lowest(examined.q, compression, outcome.alarm, hint)
        if value < 0:
            return Verdict(np.inf, examined, direction)
        value = min(value, 1.0)
        estimate.convexity = min(estimate.convexity, value)
        rest = functional.dual_norm(examined.f) / value
        # An upper bound if g is as convex on the path to the minimum
        if value > CONVEX and length + rest <= acceptable:
            return Verdict(self._relative(length + rest, examined), examined)
        if corrected and value <= CONVEX < estimate.lowest:
            # The estimate took the missing part of the error to be too small
            again = bool(np.isfinite(estimate(at)))
            return self.examine(at, replace(outcome, corrected=again), acceptable)
        estimated = estimate.correction_norm + estimate.missing
        if corrected and bent <= SMALL * estimated and value > CONVEX:
            return Verdict(self._relative(estimated, examined), examined)
        return Verdict(self._second_estimate(examined, length, rest, acceptable, value), examined)

    def _corrected_iterate(self, at: Iterate) -> Iterate | None:
        """Return the iterate x - e; None if the surface crosses itself on the path."""
        x, q, is_free = self._corrected(at)
        if not is_free:
            self.functional.vectors.give_back(x)
            return None
        return self.functional.iterate(x, self.functional.configuration(q))

    def _corrected(self, at: Iterate) -> tuple[PETSc.Vec, Positions, bool]:
        """Return the unknowns x - e, their positions (l, 3) [m], and whether the path is free.

        The caller gives the vector of unknowns back.
        """
        functional, x = self.functional, self.functional.vectors.take()
        x.waxpy(-1.0, self.estimate.correction, at.x)
        q = functional.positions(x)
        return x, q, functional.collision_free_step(at.q, q) == 1.0

    def _second_estimate(
        self, examined: Iterate, first: float, bound: float, acceptable: float, lowest: float
    ) -> float:
        """Return the relative error of the iterate by two corrections, the first of norm ``first``.

        If the surface crosses something along the second correction, g is not quadratic there, and
        the error may be far larger. If F is rounding alone, CG may break down. Then ``bound``
        replaces the second correction, but if ``lowest`` is at most CONVEX, the error is infinite.
        """
        functional, estimate, relative = self.functional, self.estimate, self._relative
        second = estimate(examined, max(acceptable - first, 0.0) if lowest > CONVEX else 0.0)
        if not np.isfinite(second):
            if lowest > CONVEX:
                return relative(first + bound, examined)
            # CG has met a negative curvature that the last search has missed
            self.curvature.forget()
            return np.inf
        if functional.surface is not None:
            end, _, is_free = self._corrected(examined)
            functional.vectors.give_back(end)
            if not is_free:
                return relative(first + DOUBTFUL * second, examined)
        if first > 0 and estimate.correction_norm > SMALL * first:
            return DOUBTFUL * relative(max(first, second), examined)
        return relative(first + second, examined)

    def _relative(self, length: float, iterate: Iterate) -> float:
        """Return the relative error of an iterate whose error has a length |e|_M [m sqrt(kg)]."""
        return self.rounding.relative(length, self.functional.distance(iterate.q))

    def lower_iterate(self, at: Iterate, verdict: Verdict) -> Iterate | None:
        """Return an iterate of lower g than an iterate that is no minimum; None if none is found.

        The result is the point examined, or a point farther along a direction of negative
        curvature.
        """
        falls = self.functional.change(verdict.examined, at)[0] < 0
        lower = verdict.examined if falls else None
        if verdict.direction is None:
            return lower
        return self._descend(lower or at, verdict.direction) or lower

    def _descend(self, at: Iterate, direction: Floats) -> Iterate | None:
        """Return an iterate of lower g along a direction (n,) of negative curvature.

        The first move is a cell. Moves are doubled while g falls, or halved and turned round until
        g falls. Return None if no move lowers g.
        """
        functional = self.functional
        longest = float(reduced(functional.comm, greatest(np.abs(direction)), MPI.MAX))
        move = functional.lattice.cell_size / longest
        x, best, lowest = functional.vectors.take(), 0.0, 0.0
        while functional.extent + abs(move) * longest > functional.extent:
            self.memory.write(x)[:] = self.memory.read(at.x) + move * direction
            q = functional.positions(x)
            is_free = functional.collision_free_step(at.q, q) == 1.0
            change = functional.change(functional.configuration(q), at)[0] if is_free else np.inf
            if change < lowest:
                best, lowest = move, change
                move *= 2
            elif best == 0.0:
                move /= -2
            else:
                break
        if best == 0.0:
            functional.vectors.give_back(x)
            return None
        self.memory.write(x)[:] = self.memory.read(at.x) + best * direction
        return functional.iterate(x)
