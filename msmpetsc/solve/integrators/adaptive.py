"""Adaptive time steps: choose step lengths, powers of two apart, for a given trajectory error.

The local error of a step follows from positions q and velocities v at its ends:

    implicit Euler  t/2 (v_(n+1) - v_n)                            = t^2/2 a  + O(t^3)
    BDF2            8/5 (q_(n+1) - q_n - t/2 (v_n + v_(n+1)))      = 2/9 t^3 da/dt + O(t^4)

A BDF2 step without history has a further error (solve.integrators.bdf2).
``StepControl`` sums the root mean squares of local errors. It also counts errors from impacts and
from changes of penalty forces (scripts/docs/pages/time-steps.md).

If U is the size of the motion, the trajectory error of the run may reach ``error`` U. Each step
spends its local error from a credit that grows with the motion and with time:

    credit(t) = error / 2 (U(t) + 1/T integral_0^t U)

All methods are collective.
"""

import math
import sys
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from msmpetsc.backend.arrays import Positions, Rows
from msmpetsc.checkpoint import COUNT, LENGTH, Checkpoint, Range
from msmpetsc.comm import log, reduced
from msmpetsc.constraints.time_functions import AT_EVENT
from msmpetsc.errors import StepFailed
from msmpetsc.scene.schema import Solver
from msmpetsc.scene.time import Time
from msmpetsc.solve.energy_balance import EnergyBalance
from msmpetsc.solve.integrators.integrator import Integrator, State
from msmpetsc.solve.nonlinear.step import StepResult
from msmpetsc.solve.recovery import take_step
from msmpetsc.solve.work import Work

# levels of the shortest and the longest step, 1/1024 and 64 times the scene's step
LOWEST, HIGHEST = -10, 6
# end of a step before an event [time of the event]; the event must not act yet
JUST_BEFORE = 1 - 0.5 * AT_EVENT
# part of the saved credit that a step may spend [-]; savings must last for an impact
SAVINGS_SHARE = 1 / 8
# part of an equal share of all credit that any step may spend [-]; the run must advance
FAIR_SHARE = 0.25
# largest accepted error [allowed error]; an excess shortens the next step
EXCESS = 2.0
# number of steps in a row that allow a longer step before the step grows [-]; step
# lengths must not alternate
CALM = 2


# integrator -> order of its error
ORDERS = {"implicit-euler": 1, "bdf2": 2}


def local_error(order: int, q: Positions, v: Rows, x: Positions, w: Rows, time_step: float) -> Rows:
    """Return the local error (n, 3) [m] of a step.

    order : order of the integrator, 1 or 2
    q, v  : (n, 3) [m], [m/s] at the start of the step
    x, w  : (n, 3) [m], [m/s] at its end
    """
    if order == 1:
        return 0.5 * time_step * (w - v)
    return 1.6 * (x - q - 0.5 * time_step * (v + w))


def between(
    q_0: Positions, v_0: Rows, q_1: Positions, v_1: Rows, time_step: float, s: float
) -> tuple[Positions, Rows]:
    """Return positions and velocities within a step, by Hermite's cubic between the step's ends.

    s : position within the step, 0 at its start and 1 at its end; other values extrapolate
    """
    t, r = time_step, 1 - s
    q = r * r * (1 + 2 * s) * q_0 + s * r * r * t * v_0
    q = q + s * s * (3 - 2 * s) * q_1 - s * s * r * t * v_1
    v = 6 * s * r / t * (q_1 - q_0) + r * (1 - 3 * s) * v_0 + s * (3 * s - 2) * v_1
    return q, v


@dataclass(frozen=True)
class Measure:
    """Local error of a step and size of the motion so far [m], root mean squares by mass."""

    error: float
    motion: float


class StepControl:
    """Choose the levels of steps and keep the error account of a run, alike on all ranks.

    A step of a level is 2^level times as long as the scene's step.

    asked           : error tolerance of the trajectory, relative to the size of the motion
    step, duration  : length of a step of level 0, and of the run [s]
    calm            : consecutive steps that would have allowed a longer step
    motion          : size of the motion so far [m]
    passed          : integral of the motion's size up to now, over the duration [m]
    spent           : sum of local errors [m]
    steps, time     : number of accepted steps, and their total length [s]
    """

    def __init__(
        self, order: int, error: float, step: float, duration: float, levels: tuple[int, int]
    ):
        self.order, self.asked, self.step, self.duration = order, error, step, duration
        self.lowest, self.highest = levels
        self.level, self.calm = min(0, self.highest), 0
        self.motion = self.passed = self.spent = 0.0
        self.steps, self.time = 0, 0.0

    @property
    def estimate(self) -> float:
        """Return the estimated error of the trajectory, relative to the size of the motion."""
        return self.spent / self.motion if self.motion > 0 else 0.0

    def allowed(self, level: int, measure: Measure) -> float:
        """Return the error [m] that a step of a level may have."""
        motion = max(self.motion, measure.motion)
        part = self.step * 2.0**level / self.duration
        saved = 0.5 * self.asked * (motion + self.passed) - self.spent
        fair = self.asked * motion * self.time / self.duration / max(self.steps, 1)
        earned = 0.5 * self.asked * motion * part
        return max(earned + SAVINGS_SHARE * max(saved, 0.0), FAIR_SHARE * fair)

    def accepts(self, level: int, measure: Measure) -> bool:
        """Return whether a step of a level is accepted; if not, lower the level."""
        allowed = self.allowed(level, measure)
        if level == self.lowest or measure.error <= EXCESS * allowed:
            return True
        halvings = 1
        excess = measure.error / max(allowed, sys.float_info.min)
        if 1 < excess < math.inf:
            halvings = max(1, round(math.log2(excess) / (self.order + 1)))
        self.shorten(level, halvings)
        return False

    def shorten(self, level: int, by: int = 1) -> bool:
        """Lower the level below the level of a failed step; return whether a lower level exists."""
        self.level, self.calm = max(self.lowest, level - by), 0
        return level > self.lowest

    def pay(self, level: int, measure: Measure) -> None:
        """Enter an accepted step into the error account, and choose the level of the next step."""
        allowed = self.allowed(level, measure)
        longer = self.level + 1
        growth = 2.0 ** ((self.order + 1) * (longer - level))
        is_calm = measure.error * growth <= self.allowed(longer, measure)
        self.motion = max(self.motion, measure.motion)
        self.passed += self.motion * self.step * 2.0**level / self.duration
        self.spent += measure.error
        self.steps += 1
        self.time += self.step * 2.0**level
        if measure.error > allowed:
            self.shorten(level)
            return
        self.calm = self.calm + 1 if is_calm else 0
        if self.calm >= CALM and self.level < self.highest:
            self.level, self.calm = longer, 0

    @property
    def state(self) -> dict[str, Range]:
        """Return the attributes that a checkpoint holds, with their ranges."""
        lengths = dict.fromkeys(("time", "motion", "passed", "spent"), LENGTH)
        return {"level": (self.lowest, self.highest), "calm": (0, CALM), "steps": COUNT, **lengths}


class Ticks:
    """Count time in ticks, the length of the shortest step.

    A step of a level starts at a multiple of its own length, so that no frame lies in two steps. No
    step crosses an event or the end of the run.

    events : ticks of the events in order, rounded to a step ``NEAREST`` levels below the scene's
             step
    ticks  : number of ticks of the run
    """

    NEAREST = 4

    def __init__(self, step: float, steps: int, lowest: int, events: Sequence[float]):
        self.step, self.lowest, self.ticks = step, lowest, steps << -lowest
        unit = max(lowest, -self.NEAREST)
        ends = {round(time / step * 2.0**-unit) << (unit - lowest) for time in events}
        self.events = sorted(tick for tick in ends if 0 < tick < self.ticks)

    def length(self, level: int) -> int:
        """Return the length of a step of a level in ticks."""
        return 1 << (level - self.lowest)

    def time(self, tick: int) -> float:
        """Return the time [s] of a tick."""
        return tick / 2.0**-self.lowest * self.step

    def is_event(self, tick: int) -> bool:
        """Return whether a tick is an event."""
        return bisect_left(self.events, tick) < bisect_right(self.events, tick)

    def fitting(self, tick: int, level: int) -> int:
        """Return the highest level, at most ``level``, of a step that may start at a tick."""
        after = bisect_right(self.events, tick)
        limit = self.events[after] if after < len(self.events) else self.ticks
        while level > self.lowest and (
            tick % self.length(level) or tick + self.length(level) > limit
        ):
            level -= 1
        return level


class Adaptive(Integrator):
    """Take the scene's steps as adaptive steps, which may be shorter or longer.

    A state has the velocity (q_n - q_(n-1)) / t with the scene's step t. If the last step was
    longer than the scene's step, the state's time may lie beyond the frame. The history of a state
    is the start of the last step.

    integrator : integrator of the last step, of the level ``made``; None before the first step
    tick       : time of the state in ticks (Ticks)
    last       : level of the last accepted step
    coming     : least mean square [m^2] of the displacement until the next frame, as trials of the
                 present step predict it
    """

    uses_history = True

    def __init__(
        self,
        time: Time,
        solver: Solver,
        make: Callable[[Time, Solver], Integrator],
        balance: EnergyBalance,
    ):
        assert time.error is not None
        self.balance, self.comm = balance, balance.comm
        self.lattice, self.environment = balance.lattice, balance.environment
        self.make, self.solver = make, solver
        self.time, self.time_step = time, time.step
        self.order = ORDERS[time.integrator]
        steps = time.steps
        self.levels = LOWEST, HIGHEST
        self.control = StepControl(
            self.order, time.error, self.time_step, steps * self.time_step, self.levels
        )
        self.ticks = Ticks(self.time_step, steps, self.levels[0], self.environment.events())
        self.integrator: Integrator | None = None
        self.tick = self.last = self.made = 0
        self.coming = math.inf
        self.mass = reduced(self.comm, float(self.lattice.mass.sum()))

    def set_up(self) -> None:
        """Prepare the integrator of the first step, and log the range of step lengths."""
        self._of_level(self.control.level)
        shortest, longest = (self.time_step * 2.0**level for level in self.levels)
        log.info(
            "steps of %.3g to %.3g s, for an error of %.2g of the motion",
            shortest,
            longest,
            self.control.asked,
        )

    def _of_level(self, level: int) -> Integrator:
        """Return an integrator of a level: the present integrator, or a new integrator."""
        if self.integrator is None or level != self.made:
            self.destroy()
            time = self.time.model_copy(update={"step": self._length(level), "error": None})
            self.integrator, self.made = self.make(time, self.solver), level
            self.integrator.set_up()
        return self.integrator

    def _length(self, level: int) -> float:
        """Return the length [s] of a step of a level."""
        return self.time_step * 2.0**level

    def advance(self, state: State, time: float) -> tuple[StepResult, State]:
        """Take the steps up to ``time`` [s]; return the result at that time and the last state.

        Raises StepFailed.
        """
        wanted = round(time / self.time_step) * self.ticks.length(0)
        total = StepResult(state.q, state.q_previous, Work())
        # A recovered step advances the state, but not the ticks.
        self.tick = max(self.tick, wanted - self.ticks.length(0))
        while self.tick < wanted:
            result, state = self._step(state)
            total = replace(result, cost=total.cost + result.cost)
        if self.tick > wanted or not total.cost.steps:
            remaining = (self.tick - wanted) / self.ticks.length(self.last)
            total = self._within(total, state, remaining, time)
        return replace(total, time_error=self.control.estimate), state

    def _within(self, total: StepResult, state: State, remaining: float, time: float) -> StepResult:
        """Return the result at ``time`` [s], within the last step.

        Before the end of the step, the result has no inertia, friction and viscosity.

        remaining : part of the last step from ``time`` to the step's end, from 0 to 1
        """
        q, v = state.q, state.velocity(self.time_step)
        if remaining > 0:
            total = replace(total, contact=None, problem=None, load=None, viscous=None)
        if remaining > 0 and state.history:
            q, v = between(*state.history, q, v, self._length(self.last), 1 - remaining)
            prescribed = self.environment.anchors.prescribed(q, time)
            q = q if prescribed is None else prescribed
        self.balance.show(q, v, time, state.sides)
        return replace(total, position=q, previous=q - self.time_step * v)

    def _step(self, state: State) -> tuple[StepResult, State]:
        """Take the next step; repeat it shorter if its error is too large. Raises StepFailed."""
        restarts = self.ticks.is_event(self.tick)
        cost, self.coming = Work(), math.inf
        while True:
            longest = self.control.level
            # The history supports steps at most twice as long.
            if state.history is not None:
                longest = min(longest, self.last + 1)
            level = self.ticks.fitting(self.tick, longest)
            before = self._start_of(state, level, restarts)
            end = self._end_time(self.tick + self.ticks.length(level))
            try:
                result, after = take_step(self.balance, self._of_level(level), before, end)
                measure = self._measure(before, result, after, level)
                is_accepted = self.control.accepts(level, measure)
            except StepFailed:
                is_accepted = False
                if not self.control.shorten(level):
                    raise
            else:
                cost += result.cost
            if is_accepted:
                self.control.pay(level, measure)
                cost = replace(cost, steps=1, step_error=result.cost.step_error)
                return self._accepted(replace(result, cost=cost), before, after, level)

    def _start_of(self, state: State, level: int, restarts: bool) -> State:
        """Return the state from which a step of a level starts; ``restarts`` drops the history.

        If the last step had another level, its mean acceleration a gives the history. Then loads
        have changed the velocity in proportion to their impulse in the last step (Bdf2).
        """
        q, v, t, span = state.q, state.velocity(self.time_step), self._length(level), None
        history = None if restarts or self.order < 2 else state.history
        if history and level != self.last:
            span = self._length(self.last)
            a = (v - history[1]) / span
            history = q - t * v + 0.5 * t**2 * a, v - t * a
        return replace(state, q_previous=q - t * v, history=history, span=span)

    def _end_time(self, tick: int) -> float:
        """Return the end time [s] of a step that ends at a tick; just before it for an event."""
        return self.ticks.time(tick) * (JUST_BEFORE if self.ticks.is_event(tick) else 1.0)

    def _measure(self, before: State, result: StepResult, after: State, level: int) -> Measure:
        """Return the local error of a step and the size of the motion up to its end."""
        owned, t = slice(self.lattice.owned), self._length(level)
        mass, q, v = self.lattice.mass, before.q[owned], before.velocity(t)[owned]
        x, w = result.position[owned], (result.position - result.previous)[owned] / t
        end = self._end_time(self.tick + self.ticks.length(level))
        free = ~self.environment.anchors.fixed_at(end)[owned]
        struck = after.velocity(t)[owned] - w
        local = free * local_error(self.order, q, v, x, w, t)
        sums = [
            mass @ (local**2).sum(axis=1),
            mass @ ((x - self.lattice.nodes[owned]) ** 2).sum(axis=1),
        ]
        # The size of the motion is the distance from rest. For nodes at rest, it is the
        # displacement until the next frame.
        is_at_rest = (before.q[owned] == self.lattice.nodes[owned]).all(axis=1)[:, None]
        coming = is_at_rest * (self.time_step * w + 0.5 * self.time_step**2 / t * (w - v))
        # An impact or a change of contact force may come at any time within the step.
        late = t * (mass @ np.sqrt((free * struck**2).sum(axis=1)))
        if self.environment.obstacles.penalties:
            ends = (before.q[owned], before.sides), (x, after.sides)
            late += t**2 * (
                free.any(axis=1) @ self.environment.obstacles.change_of_push(*ends, end, t)
            )
        sums += [mass @ (coming**2).sum(axis=1), late]
        error, motion, coming, late = reduced(self.comm, list(map(float, sums))) / self.mass
        late += result.begun_error / math.sqrt(self.mass)
        if not self.control.motion:
            # Vibrations between frames make ``coming`` too large. The step's longest
            # trial, an implicit step, limits it.
            self.coming = min(self.coming, coming)
            motion = max(motion, self.coming)
            # Rounding is no motion, so its error counts as 0.
            if motion * self.mass <= result.moved_by_rounding**2:
                return Measure(0.0, 0.0)
        return Measure(math.sqrt(error) + late, math.sqrt(motion))

    def _accepted(
        self, result: StepResult, before: State, after: State, level: int
    ) -> tuple[StepResult, State]:
        """Return result and state after an accepted step, with q_(n-1) for the scene's step."""
        t, T = self._length(level), self.time_step
        self.tick += self.ticks.length(level)
        self.last = level
        history = after.history or (before.q, before.velocity(t))
        previous = result.position - T / t * (result.position - result.previous)
        result = replace(result, previous=previous)
        return result, replace(after, q_previous=after.q - T * after.velocity(t), history=history)

    @property
    def state(self) -> dict[str, Range]:
        return {"tick": (0, self.ticks.ticks), "last": self.levels}

    def save(self, checkpoint: Checkpoint) -> None:
        for part in (self, self.control):
            checkpoint.keep_counts(part)
        if self.integrator:
            self.integrator.save(checkpoint)

    def restore(self, checkpoint: Checkpoint, time: float) -> None:
        for part in (self, self.control):
            checkpoint.restore_counts(part)
        self._of_level(self.last).restore(checkpoint, self._end_time(self.tick))

    def sum_up(self) -> None:
        """Log the estimated error of the motion at the end of a run."""
        log.info(
            "the motion is some %.2g of its size off (time.error = %g)",
            self.control.estimate,
            self.control.asked,
        )

    def destroy(self) -> None:
        if self.integrator:
            self.integrator.destroy()
            self.integrator = None
