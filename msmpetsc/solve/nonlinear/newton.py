"""Newton's method for a step, with the true Hessian H of g, CG, and a line search on g:

    H(x_k) y = F(x_k)                by CG, to the digits that the step still lacks
    y <- y, shortened so that the surface crosses nothing
    x_(k+1) = x_k - s y              g(x_(k+1)) <= g(x_k) - ALPHA s y . F(x_k)     (Armijo)

until the error of x_k is below the goal (error_control). If y leads nodes into obstacles, a full
step that stops these nodes is tried first.

Under compression H may be indefinite. CG then stops with the descent direction found so far. The
next iteration takes the projected Hessian, without negative parts, and a new preconditioner.
Otherwise iterations might close and open a gap between surfaces again and again. If CG's first
direction has a negative curvature, no s lowers g, and y is computed again with the projected
Hessian.
"""

import sys
from dataclasses import dataclass, replace

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.backend.arrays import Array, Positions
from msmpetsc.comm import reduced
from msmpetsc.solve.nonlinear.curvature import Alarm
from msmpetsc.solve.nonlinear.error_control import Outcome
from msmpetsc.solve.nonlinear.functional import Iterate
from msmpetsc.solve.nonlinear.jacobian import FrictionDuals
from msmpetsc.solve.nonlinear.method import REASON, StepMethod
from msmpetsc.solve.petsc.events import LOCAL

# Growth of |F| in the first iteration of a static state beyond which softer solids are
# solved first [-]; also the ratio of lambda from a softer solid to the next
SOFTER = 9.0
# Share of the slope by which a step must lower g [-] (Armijo)
ALPHA = 1e-4
# Greatest ratio of the next step length to the last in a line search [-]; ratio if g
# does not bend upwards
MOST, LEAST = 0.9, 0.1
# Least step length [-]: rounding of x
SHORTEST = sys.float_info.epsilon
# Options of PETSc's own convergence test of a linear solve
TESTS = (
    "ksp_convergence_test",
    "ksp_converged_use_initial_residual_norm",
    "ksp_converged_use_min_initial_residual_norm",
    "ksp_converged_maxits",
)
KSP = PETSc.KSP.ConvergedReason
# Reasons of KSP without a usable direction
USELESS = (
    KSP.DIVERGED_NANORINF,
    KSP.DIVERGED_PCSETUP_FAILED,
    KSP.DIVERGED_BREAKDOWN,
    KSP.DIVERGED_NULL,
)


@dataclass(eq=False)
class Newton(StepMethod):
    """Newton's method as the context of a SNES of type python. All methods are collective."""

    def __post_init__(self) -> None:
        super().__post_init__()
        # The search direction is also the correction of the error estimate
        self.y, self.end = self.control.estimate.correction, self.functional.vectors.take()
        # SNES would create a vector of its own
        self.snes.setFunction(None, self.control.estimate.residual)
        self.friction = FrictionDuals()
        self.is_tested = self._is_tested()
        if self.is_tested:
            self.ksp.setComputeSingularValues(True)
            self.ksp.setConvergenceTest(self.control.estimate.test)
        self.most_its = self.ksp.getTolerances()[3]
        # Whether an old preconditioner limits the iterations of a linear solve
        self.limits_its = not self.options.is_given("ksp_max_it")
        # V U' of the cells of a softer solid, for the first Hessian of the next solve
        self.slopes: Array | None = None
        # Whether the solve may end after an iteration in which |F| grows by SOFTER,
        # whether it did so, and |F| at its start
        self.ends_on_overshoot, self.overshot, self.begun = False, False, np.inf
        self._given: tuple[Iterate, Outcome] | None = None

    def begin(self) -> None:
        """Begin the step that the functional has begun."""
        self.friction.begin(self.functional.problem.contact)
        self.slopes = None

    def _is_tested(self) -> bool:
        """Return whether linear solves, by CG, also test the error of x."""
        is_cg = self.ksp.getType() == PETSc.KSP.Type.CG
        is_natural = self.ksp.getNormType() == PETSc.KSP.NormType.NATURAL
        return is_cg and is_natural and not any(map(self.options.is_given, TESTS))

    def minimise(self, start: Iterate, outcome: Outcome) -> tuple[Iterate, Outcome]:
        """Return the iterate at which the loop ends, and its outcome (StepMethod.minimise)."""
        self._given = start, outcome
        self.snes.solve(None, self.end)
        iterate, outcome = self._given
        return iterate, outcome if self.overshot else self.finish(iterate, outcome)

    def solve(self, snes: PETSc.SNES, _: PETSc.Vec, x: PETSc.Vec) -> None:
        """Run the loop of the method; PETSc calls it in SNESSolve."""
        assert self._given is not None
        now, outcome = self._given
        projected, its = self.preset.projected > 0, 0
        outcome = self._judge(now, replace(outcome, residual=np.inf), projected)
        while not (reason := self._reason(snes, its, now, outcome)):
            tells_error = self._tells_error(now, outcome, projected)
            self._linearise(now, tells_error, projected)
            if its == 0 and (monitor := self.functional.problem.system_monitor):
                monitor(now, self.jacobian)
            outcome = self._solve(now, outcome, tells_error)
            if self.ksp.reason in USELESS:
                reason = REASON.DIVERGED_LINEAR_SOLVE
                break
            if outcome.is_converged:
                reason = REASON.CONVERGED_SNORM_RELATIVE
                break
            lower = self._lower(now, outcome.is_flat)
            if lower is None and projected:
                reason = REASON.DIVERGED_LINE_SEARCH
                break
            if lower is None:
                projected = True
                continue
            if its == 0:
                self.control.missed = self._missed(lower.f, outcome)
            its += 1
            projected = outcome.alarm is Alarm.HERE or its < self.preset.projected
            now, outcome = lower, self._judge(lower, outcome, projected)
        self.iterations += its
        self._given = now, outcome
        now.x.copy(x)
        snes.setConvergedReason(reason)

    def _reason(self, snes: PETSc.SNES, its: int, now: Iterate, outcome: Outcome) -> int:
        """Monitor an iterate, and return PETSc's reason to end at it; 0 to go on."""
        snes.setIterationNumber(its)
        snes.monitor(its, now.f.norm())
        if its == 0:
            self.begun = outcome.residual
        self.overshot = (
            self.ends_on_overshoot and its == 1 and outcome.residual > SOFTER * self.begun
        )
        if self.overshot:
            return int(REASON.CONVERGED_ITS)
        most = snes.getTolerances()[3]
        return self.reason_to_end(its, outcome) or (
            int(REASON.DIVERGED_MAX_IT) if its == most else 0
        )

    def _judge(self, iterate: Iterate, before: Outcome, projected: bool) -> Outcome:
        """Return the outcome at an iterate; estimate the error if the linear solve will not."""
        outcome = self.control.judge(iterate, before)
        if self._can_tell_error(projected):
            return outcome
        return self.control.estimated_if_near(iterate, outcome)

    def _can_tell_error(self, projected: bool) -> bool:
        """Return whether the next linear solve has the true elastic Hessian and the error test."""
        return self.is_tested and not projected and self.slopes is None

    def _tells_error(self, now: Iterate, outcome: Outcome, projected: bool) -> bool:
        """Return whether the next linear solve tests the error of x.

        With contact the solve tests the error only near the goal. Farther away, duals replace the
        true curvature of friction.
        """
        is_near = now.contact is None or self.control.is_near(outcome)
        return is_near and self._can_tell_error(projected)

    def _linearise(self, now: Iterate, is_true: bool, projected: bool) -> None:
        """Linearise F at an iterate.

        is_true   : whether friction has its true curvature, not its duals
        projected : whether H is taken without its negative parts
        """
        with LOCAL:
            duals = None if is_true else self.friction.duals
            self.jacobian.linearise(now, projected, duals)
            if self.slopes is not None and not projected:
                self.jacobian.hessian.take_slopes(self.slopes)
            self.slopes = None

    def _solve(self, now: Iterate, outcome: Outcome, tells_error: bool) -> Outcome:
        """Solve H y = F; return the outcome, with the error of x if the solve has measured it.

        tells_error : whether the solve may end as soon as it shows that the error is acceptable
        """
        self.adapt(outcome)
        rtol = self.ksp.getTolerances()[0]
        if self.limits_its:
            most = self.jacobian.preconditioner.most_iterations(rtol)
            self.ksp.setTolerances(max_it=most or self.most_its)
        self.ksp.setOperators(self.jacobian.operator)
        self.control.estimate.begin(outcome.goal * outcome.distance if tells_error else 0.0)
        self.ksp.solve(now.f, self.y)
        if self.ksp.reason == KSP.DIVERGED_INDEFINITE_MAT:
            self.jacobian.preconditioner.renew()
            return replace(outcome, alarm=Alarm.HERE, corrected=False)
        reached = self.control.estimate.reached(self.ksp) if self.is_tested else rtol
        self.jacobian.preconditioner.learn(self.ksp.its, reached)
        if self.control.estimate.is_accepted:
            return self.control.measured(now, outcome, self._trust(now, outcome))
        return replace(outcome, corrected=tells_error and self.ksp.reason > 0)

    def _trust(self, now: Iterate, outcome: Outcome) -> float:
        """Return a lower bound of |y|_M over the error; 0 if y does not bound the error.

        Let H miss theta |F(x)| of F(x - y). Then Newton's corrections shrink by about theta, and
        the error is at most |y|_M / (1 - theta) (Deuflhard 2011, Newton Methods for Nonlinear
        Problems, Sect. 2.1). Contact has kinks that no H predicts. With contact, |y|_M counts as
        the error.
        """
        if now.contact:
            return 1.0
        functional, x, f = self.functional, self.end, self.functional.vectors.take()
        x.waxpy(-1.0, self.y, now.x)
        with LOCAL:
            functional.evaluate(x, f)
        theta = self._missed(f, outcome)
        functional.vectors.give_back(f)
        return max(1 - theta, 0.0)

    def _missed(self, f: PETSc.Vec, outcome: Outcome) -> float:
        """Return theta = |f - (F - H y)| / |F|, the part of F at the next iterate that H missed.

        f       : F at the next iterate [kg m]
        outcome : outcome at the iterate of F
        """
        functional, residual = self.functional, self.control.estimate.residual
        self.ksp.buildResidual(residual)
        change = functional.vectors.take()
        change.waxpy(-1.0, residual, f)
        missed = functional.dual_norm(change) / outcome.residual
        functional.vectors.give_back(change)
        return missed

    def _lower(self, now: Iterate, flat: bool) -> Iterate | None:
        """Return an iterate of lower g: a full step bent at obstacles, or a step along y.

        flat : whether g is so close to its minimum that its change has no digits; then take a full
               step

        Return None if no step along y lowers g.
        """
        lower, bent = None, self._bent(now)
        if bent is not None:
            lower = self._search(now, bent, 1.0, flat)
            self.functional.vectors.give_back(bent)
        lower = lower or self._search(now, self.y, SHORTEST, flat)
        if lower is None:
            self.friction.update(now.contact, now.contact, False)
        return lower

    def _search(self, now: Iterate, y: PETSc.Vec, shortest: float, flat: bool) -> Iterate | None:
        """Return the first iterate x - s y with sufficient descent; None if s gets too short.

        First y is shortened so that the surface crosses nothing.

        shortest : least s
        """
        self._limit(now, y)
        slope, s = -y.dot(now.f), 1.0
        while slope <= 0 and s >= shortest:
            x = self.functional.vectors.take()
            x.waxpy(-s, y, now.x)
            with LOCAL:
                end = self.functional.iterate(x)
                change = -np.inf if flat else self.functional.change(end, now)[0]
            if change <= ALPHA * s * slope:
                self.friction.update(end.contact, now.contact, s == 1.0)
                return end
            s = shorter(s, change, slope, -y.dot(end.f))
        return None

    def _limit(self, now: Iterate, y: PETSc.Vec) -> None:
        """Shorten y so that the surface crosses nothing."""
        if self.functional.surface is None:
            return
        with LOCAL:
            share = self.functional.collision_free_step(now.q, self._end(now, y))
        if share < 1.0:
            y.scale(share)

    def _end(self, now: Iterate, y: PETSc.Vec) -> Positions:
        """Return the positions (l, 3) [m] at x - y."""
        self.end.waxpy(-1.0, y, now.x)
        return self.functional.positions(self.end)

    def _bent(self, now: Iterate) -> PETSc.Vec | None:
        """Return y bent so that nodes stop at obstacles that they would enter; None if none would.

        H at x lacks obstacles that nodes do not touch yet. If the line search shortened the whole
        step for these nodes, each iteration would bring few nodes into contact.
        """
        if now.contact is None or not now.contact.step.states:
            return None
        functional = self.functional
        with LOCAL:
            end = self._end(now, self.y)
            stopped = now.contact.stopped(end)
        if not reduced(functional.comm, stopped is not None, MPI.LOR):
            return None
        bent = functional.vectors.take()
        functional.unknowns.from_nodes(end if stopped is None else stopped, bent)
        bent.aypx(-1.0, now.x)
        return bent


def shorter(s: float, change: float, slope: float, end_slope: float) -> float:
    """Return the next step length of a line search, after a step of length s was too long.

    The length minimises g along the direction in a model with a force from s_0 on, as of an
    obstacle that nodes enter:

        g(s) - g(0) = slope s + K / 2 max(s - s_0, 0)^2

    The change of g and its slope at s give K and s_0. For a quadratic g, s_0 is 0 and the length is
    exact.

    change    : change of g at s
    slope     : derivative of g by the step length at 0
    end_slope : derivative of g by the step length at s
    """
    rise, bend = change - slope * s, end_slope - slope
    best = s - 2 * rise / bend * end_slope / bend if end_slope > 0 else 0.0
    return min(best, MOST * s) if best > 0 else LEAST * s
