"""Backward differentiation formula of second order, with the start of a history."""

from dataclasses import replace

import numpy as np

from msmpetsc.backend.arrays import Positions, Rows
from msmpetsc.constraints.forces import ExternalForces
from msmpetsc.contact.obstacles.reflection import StepTaken
from msmpetsc.solve.integrators.implicit import ImplicitEuler
from msmpetsc.solve.integrators.integrator import State
from msmpetsc.solve.nonlinear.step import StepResult
from msmpetsc.solve.work import Work


class Bdf2(ImplicitEuler):
    """Take steps by the backward differentiation formula of second order for q and v,

        q_(n+1) = (4 q_n - q_(n-1)) / 3 + tau v_(n+1)
        v_(n+1) = (4 v_n - v_(n-1)) / 3 + tau a_(n+1),    tau = 2/3 t

    (Hairer and Wanner, Solving Ordinary Differential Equations II, III.1), with

        y = (4 q_n - q_(n-1)) / 3 + tau (4 v_n - v_(n-1)) / 3.

    Let f_n be the mean of the loads over step n. In a free body m (v_n - v_(n-1)) = t f_n, if

        f_ext = (3 f_(n+1) - f_n) / 2.

    Friction extrapolates the normal forces of the last two states, and a user's force function is
    extrapolated likewise.
    """

    TAU_PER_STEP = 2 / 3
    uses_history = True

    def advance(self, state: State, time: float) -> tuple[StepResult, State]:
        """Take the step that ends at ``time`` [s] (collective). Raises StepFailed.

        A node that rebounds keeps its position. Its new history leads to this position, with the
        new velocity and with the node's present acceleration. Without this acceleration, an impact
        would add energy.
        """
        if self._let_go(time):
            state = replace(state, history=None)
        if state.history is None and self.retardation:
            return self._first_of_viscous(state, time)
        q, v, work_before = state.q, state.velocity(self.time_step), Work()
        begin, forces = time - self.time_step, self.environment.forces
        history, begun_error = state.history, 0.0
        if history is None:
            forces.begin_step(q, v, begin)
            load = forces.mean(begin, time)
            history, v, begun_error, work_before = self._history(state, load, time)
        forces.begin_step(q, v, begin, (*history, max(begin - self.time_step, 0.0)))
        before_last = begin - (state.span or self.time_step)
        load = forces.ahead(before_last, begin, time) if state.history else forces.mean(begin, time)
        q_0, v_0 = history
        carried = self._carried_time(self.tau)
        y = (4 * q - q_0 + carried * (4 * v - v_0)) / 3
        result, sides = self._solve(state, y, load, time, self.time_step, q_0)
        v_1 = (3 * result.position - 4 * q + q_0) / (2 * self.time_step)
        previous = result.position - self.time_step * v_1
        # acceleration times t^2
        a = 0.5 * (3 * v_1 - 4 * v + v_0) * self.time_step
        _, before, work = self.environment.obstacles.strike(
            result.position,
            previous,
            StepTaken(time, self.time_step, sides),
            self.stepper.lattice.fixed,
        )
        cost = replace(work_before + result.cost, step_error=result.cost.step_error, steps=1)
        result = replace(result, previous=previous, cost=cost, work=work, begun_error=begun_error)
        after = State(result.position, before, (q, v), sides)
        return result, self._with_rebounds(after, previous, a)

    def _with_rebounds(self, after: State, previous: Positions, a: Rows | float) -> State:
        """Return the state after a step with a history of rebounding nodes that leads to the state.

        previous : (l, 3) positions whose differences from ``after.q_previous`` tell rebounds [m]
        a        : (l, 3) acceleration in the step times t^2 [m]
        """
        if after.history is None or after.q_previous is previous:
            return after
        (q, v), before = after.history, after.q_previous
        struck = (before != previous).any(axis=1)[:, None]
        v_after = (after.q - before - a) / self.time_step
        history = np.where(struck, before + 0.5 * a, q), np.where(struck, v_after, v)
        return replace(after, history=history)

    def _first_of_viscous(self, state: State, time: float) -> tuple[StepResult, State]:
        """Take a viscous body's step without history by implicit Euler (collective).

        Viscosity may stop a motion within a small part of a step. A history with the mean
        acceleration of this part would lead the body far on.

        Raises StepFailed.
        """
        self._renew(self.time_step, time)
        result, after = super().advance(state, time)
        self._renew(self._first_tau(), time)
        history = state.q, state.velocity(self.time_step)
        return result, self._with_rebounds(replace(after, history=history), result.previous, 0.0)

    def _history(
        self, state: State, load: ExternalForces, time: float
    ) -> tuple[tuple[Positions, Rows], Rows, float, Work]:
        """Return a history for a state without history, the velocities, the error, and the work.

        The history leads to q and v with the acceleration a of an implicit Euler step of length
        tau. The error of this acceleration is of first order. Damping may stop a motion within a
        small part of the step. Therefore q_0 has the velocity at the step's end, and the part of a
        that strong damping leaves. Held components have the velocity of their path, and no
        acceleration.

        A mode of frequency w has a = a_n / (1 + (tau w)^2), with the acceleration a_n at q. The
        BDF2 step then moves it as if its acceleration were constant. The error [m sqrt(kg)] is
        nearly tau^2 |a|_M (1 - |a|_M^2 / a_n^T M a).
        """
        t, tau, q, v = self.time_step, self.tau, state.q, state.velocity(self.time_step)
        y = q + self._carried_time(tau) * v
        result, _ = self._solve(state, y, load, time - t + tau, tau)
        v_end = (result.position - q) / tau
        v = np.where(self.stepper.lattice.fixed, v_end, v)
        a = (v_end - v) / tau
        q_0 = q - t * v_end + t * (t / 2 + tau) / (1 + self.damping * tau) * a
        return (q_0, v - t * a), v, self._begun_error(result), result.cost

    def _begun_error(self, result: StepResult) -> float:
        """Return the error [m sqrt(kg)] of the history that ``_history`` makes from a result."""
        functional, problem = self.stepper.functional, result.problem
        assert problem is not None
        moved = functional.vectors.take()
        self.stepper.unknowns.from_nodes(result.position - problem.y, moved)
        functional.begin(replace(problem, y=problem.q, prescribed=None))
        # With y = q, F is -tau^2 M a_n.
        at_start = -functional.at(problem.q).f.dot(moved)
        length = functional.norm(moved)
        functional.vectors.give_back(moved)
        return length * (1 - min(length**2 / at_start, 1.0)) if at_start > 0 else length
