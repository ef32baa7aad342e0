"""Steps as long as the motion allows: an integrator of steps of many lengths, powers of two apart.

What a step adds to the error of the trajectory is its local error: from positions q and velocities v at its two ends,

    implicit Euler  t/2 (v_(n+1) - v_n)                            = t^2/2 a  + O(t^3)
    BDF2            8/5 (q_(n+1) - q_n - t/2 (v_n + v_(n+1)))      = 2/9 t^3 da/dt + O(t^4)

Means of these over neighbours, and what the README counts besides, ``StepControl`` adds up.

A run whose motion is of size U may end with its trajectory off by ``error`` U. Steps pay for that
with their local errors, from a credit that grows as the motion does, and with time:

    credit(t) = error / 2 (U(t) + 1/T integral_0^t U)

All methods are collective.
"""

import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from mpi4py import MPI
from scipy.sparse import csr_array

from msmpetsc.backend.arrays import Positions, Rows, like, to_host
from msmpetsc.checkpoint import COUNT, LENGTH, Checkpoint, Range
from msmpetsc.comm import log
from msmpetsc.errors import StepFailed
from msmpetsc.lattice.lattice import Lattice
from msmpetsc.scene.reading import Scene
from msmpetsc.scene.schema import Solver
from msmpetsc.scene.time import Time
from msmpetsc.solve.energy_balance import EnergyBalance
from msmpetsc.solve.integrators.integrator import Integrator, State
from msmpetsc.solve.linear.unknowns import with_ghosts
from msmpetsc.solve.nonlinear.step import StepResult
from msmpetsc.solve.work import Work

LOWEST, HIGHEST = -10, 6  # levels
KEPT = 4  # integrators of as many lengths, those used last
JUST_BEFORE = 1 - 1e-10  # an event: a step that ends there has nothing of it yet
SWEEPS = 4
SHARE = 1 / 8  # of what was saved, that a step may spend
FAIR = 0.25  # of an equal share of all credit among all steps: a step may spend that in any case
EXCESS = 2.0  # times what a step may spend: it is taken all the same, the next one is shorter
CALM = 2  # steps that would have let the next be twice as long, before it is


ORDERS = {"implicit-euler": 1, "bdf2": 2}


def local_error(order: int, q: Positions, v: Rows, x: Positions, w: Rows, time_step: float) -> Rows:
    """Local error (n, 3) [m] of a step of an order from q with velocity v to x with velocity w."""
    if order == 1:
        return 0.5 * time_step * (w - v)
    return 1.6 * (x - q - 0.5 * time_step * (v + w))


class NeighbourMean:
    """Averages vectors over nodes and their neighbours by springs, ``SWEEPS`` times. Collective."""

    def __init__(self, comm: MPI.Comm, lattice: Lattice):
        self.comm, self.lattice = comm, lattice
        ends, nodes = to_host(lattice.springs), np.arange(len(lattice.nodes))
        rows, columns = np.r_[ends[:, 0], ends[:, 1], nodes], np.r_[ends[:, 1], ends[:, 0], nodes]
        own = rows < lattice.owned  # all springs at them are known here
        shape = lattice.owned, len(nodes)
        joined = csr_array((np.ones(own.sum()), (rows[own], columns[own])), shape=shape)
        self.weights = csr_array(joined.multiply(1 / joined.sum(axis=1)[:, None]))

    def __call__(self, vectors: Rows) -> Rows:
        """Return the means of vectors (owned, 3)."""
        means = to_host(vectors)
        for _ in range(SWEEPS):
            means = self.weights @ with_ghosts(self.comm, self.lattice, means)
        return like(vectors, means)


def between(
    q_0: Positions, v_0: Rows, q_1: Positions, v_1: Rows, time_step: float, s: float
) -> tuple[Positions, Rows]:
    """Positions and velocities at a share s of a step, by Hermite's cubic between its ends; s may lie outside."""
    t, r = time_step, 1 - s
    q = (
        r * r * (1 + 2 * s) * q_0
        + s * r * r * t * v_0
        + s * s * (3 - 2 * s) * q_1
        - s * s * r * t * v_1
    )
    v = 6 * s * r / t * (q_1 - q_0) + r * (1 - 3 * s) * v_0 + s * (3 * s - 2) * v_1
    return q, v


@dataclass(frozen=True)
class Measure:
    """What a step showed [m]: its local error, and the size of the motion so far, both root mean squares by mass."""

    error: float
    motion: float


class StepControl:
    """Chooses levels, of steps 2^level times the scene's, and keeps the account of one run. Ranks choose alike.

    order           : of the integrator
    error           : asked of the trajectory, relative to the size of the motion
    step, duration  : a step of level 0, and the whole run [s]
    lowest, highest : levels
    level           : wanted next
    spent           : sum of local errors [m]
    steps, time     : number of the steps that they are of, and their length [s]
    """

    def __init__(
        self, order: int, error: float, step: float, duration: float, levels: tuple[int, int]
    ):
        self.order, self.asked, self.step, self.duration = order, error, step, duration
        self.lowest, self.highest = levels
        self.level, self.calm = min(0, self.highest), 0
        self.motion = self.passed = self.spent = 0.0  # [m], [m] mean over the duration, [m]
        self.steps, self.time = 0, 0.0

    @property
    def estimate(self) -> float:
        """Estimated error of the trajectory so far, relative to the size of the motion."""
        return self.spent / self.motion if self.motion > 0 else 0.0

    def allowed(self, level: int, measure: Measure) -> float:
        """What a step of a level may spend [m]."""
        motion, part = max(self.motion, measure.motion), self.step * 2.0**level / self.duration
        saved = 0.5 * self.asked * (motion + self.passed) - self.spent
        fair = self.asked * motion * self.time / self.duration / max(self.steps, 1)
        return max(0.5 * self.asked * motion * part + SHARE * max(saved, 0.0), FAIR * fair)

    def accepts(self, level: int, measure: Measure) -> bool:
        """Whether a step of a level stands as it is; else the level for another try is set."""
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
        """Want a level lower than this one, whose step failed; whether there is any."""
        self.level, self.calm = max(self.lowest, level - by), 0
        return level > self.lowest

    def pay(self, level: int, measure: Measure) -> None:
        """Enter a step that stands, and choose the level that comes next."""
        allowed = self.allowed(level, measure)
        longer, growth = self.level + 1, 2.0 ** ((self.order + 1) * (self.level + 1 - level))
        is_calm = measure.error * growth <= self.allowed(longer, measure)
        self.motion = max(self.motion, measure.motion)
        self.passed += self.motion * self.step * 2.0**level / self.duration
        self.spent, self.steps = self.spent + measure.error, self.steps + 1
        self.time += self.step * 2.0**level
        if measure.error > allowed:
            self.shorten(level)
            return
        self.calm = self.calm + 1 if is_calm else 0
        if self.calm >= CALM and self.level < self.highest:
            self.level, self.calm = longer, 0

    @property
    def state(self) -> dict[str, Range]:
        """Attributes that a checkpoint holds."""
        lengths = dict.fromkeys(("time", "motion", "passed", "spent"), LENGTH)
        return {"level": (self.lowest, self.highest), "calm": (0, CALM), "steps": COUNT, **lengths}


class Ticks:
    """Times of steps, counted in ticks: the shortest step. A step of a level starts at a multiple of its own length,
    so that frames lie at ends of steps or within one; none goes beyond a known event, nor the end of the run.

    events : ticks at which something begins, ends or turns, of times [s] as near as ``NEAREST`` levels below a step
    """

    NEAREST = 4

    def __init__(self, step: float, steps: int, lowest: int, events: Sequence[float]):
        self.step, self.lowest, self.ticks = step, lowest, steps << -lowest
        unit = max(lowest, -self.NEAREST)
        ends = {round(time / step * 2.0**-unit) << (unit - lowest) for time in events}
        self.events = sorted(tick for tick in ends if 0 < tick < self.ticks)

    def length(self, level: int) -> int:
        """Ticks of a step."""
        return 1 << (level - self.lowest)

    def time(self, tick: int) -> float:
        """Time of a tick [s]."""
        return tick / 2.0**-self.lowest * self.step

    def fitting(self, tick: int, level: int) -> int:
        """The highest level, not above the one wanted, of a step that may start at a tick."""
        limit = next((event for event in self.events if event > tick), self.ticks)
        while level > self.lowest and (
            tick % self.length(level) or tick + self.length(level) > limit
        ):
            level -= 1
        return level


class Adaptive(Integrator):
    """Takes the scene's steps in steps of its own, shorter or longer ones.

    States are of the scene's step, (q_n - q_(n-1)) / t the velocity, but may be of a later time:
    the end of a step longer than the scene's. Their history is where the last step began.

    make    : makes an integrator of steps of one length
    balance : examines the steps that stand
    tick    : of the state's time (Ticks)
    last    : level of the step taken last
    """

    looks_back = True

    def __init__(
        self, scene: Scene, make: Callable[[Time, Solver], Integrator], balance: EnergyBalance
    ):
        assert scene.time.error is not None
        self.balance, self.comm = balance, balance.comm
        self.lattice, self.environment = balance.lattice, balance.environment
        self.make, self.time, self.solver, self.time_step = (
            make,
            scene.time,
            scene.solver,
            scene.time.step,
        )
        self.order = ORDERS[scene.time.integrator]
        steps = scene.time.steps
        self.levels = LOWEST, HIGHEST  # of its steps
        self.control = StepControl(
            self.order, scene.time.error, self.time_step, steps * self.time_step, self.levels
        )
        self.ticks = Ticks(self.time_step, steps, self.levels[0], self.environment.events())
        self.mean = NeighbourMean(self.comm, self.lattice)
        self.kept: dict[int, Integrator] = {}  # by level, that used last at the end
        self.tick = self.last = 0
        self.mass = self.comm.allreduce(float(self.lattice.mass.sum()))

    def set_up(self) -> None:
        """Make ready the integrator of the first step, and say what is to come."""
        self._integrator(self.control.level)
        shortest, longest = (self.time_step * 2.0**level for level in self.levels)
        log.info(
            "steps of %.3g to %.3g s, for an error of %.2g of the motion",
            shortest,
            longest,
            self.control.asked,
        )

    def _integrator(self, level: int) -> Integrator:
        """Return a level's integrator, which forgets earlier steps if another was used last."""
        if level not in self.kept:
            time = self.time.model_copy(update={"step": self._length(level), "error": None})
            self.kept[level] = self.make(time, self.solver)
            self.kept[level].set_up()
            if self.tick:
                self.kept[level].forget()  # as one that was kept and not used last
        elif level != next(reversed(self.kept)):
            self.kept[level] = self.kept.pop(level)
            self.kept[level].forget()
        while len(self.kept) > KEPT:
            self.kept.pop(next(iter(self.kept))).destroy()
        return self.kept[level]

    def _length(self, level: int) -> float:
        """Length of a step [s]."""
        return self.time_step * 2.0**level

    def advance(self, state: State, time: float) -> tuple[StepResult, State]:
        """Take the steps up to ``time``; what a frame shows then. Raises StepFailed."""
        frame = round(time / self.time_step)
        wanted, total = frame * self.ticks.length(0), StepResult(state.q, state.q_previous, Work())
        self.tick = max(self.tick, wanted - self.ticks.length(0))  # after a recovered step
        while self.tick < wanted:
            result, state = self._step(state)
            total = replace(result, cost=total.cost + result.cost)
        if self.tick > wanted or not total.cost.steps:
            total = self._within(
                total, state, (self.tick - wanted) / self.ticks.length(self.last), time
            )
        return replace(total, time_error=self.control.estimate), state

    def _within(self, total: StepResult, state: State, share: float, time: float) -> StepResult:
        """Interpolate the result at a share of the last step before its end."""
        q, v = state.q, state.velocity(self.time_step)
        if share > 0 and state.history:
            q, v = between(*state.history, q, v, self._length(self.last), 1 - share)
            led = self.environment.anchors.prescribed(q, time)
            q = q if led is None else led
        self.balance.show(q, v, time, state.sides)
        return replace(total, position=q, previous=q - self.time_step * v)

    def _step(self, state: State) -> tuple[StepResult, State]:
        """Take the next step, again and shorter if its error is too large. Raises StepFailed."""
        restarts = self.tick in self.ticks.events
        cost = Work()
        while True:
            longest = self.control.level
            if state.history is not None:  # the step needs it: no more than twice as long
                longest = min(longest, self.last + 1)
            level = self.ticks.fitting(self.tick, longest)
            before, end = (
                self._begun(state, level, restarts),
                self._reached(self.tick + self.ticks.length(level)),
            )
            try:
                result, after = self.balance.step(self._integrator(level), before, end)
                measure = self._measure(before, result, after, level)
                stands = self.control.accepts(level, measure)
            except StepFailed:
                stands = False
                if not self.control.shorten(level):
                    raise
            else:
                cost += result.cost
            if stands:
                self.control.pay(level, measure)
                result = replace(
                    result, cost=replace(cost, steps=1, step_error=result.cost.step_error)
                )
                return self._taken(result, before, after, level)

    def _begun(self, state: State, level: int, restarts: bool) -> State:
        v = state.velocity(self.time_step)
        history = None if restarts or self.order < 2 else state.history
        if history and level != self.last:
            history = between(
                *history, state.q, v, self._length(self.last), 1 - 2.0 ** (level - self.last)
            )
        return replace(state, q_previous=state.q - self._length(level) * v, history=history)

    def _reached(self, tick: int) -> float:
        """Time of a step that ends at a tick [s]: just before what begins or ends there."""
        return self.ticks.time(tick) * (JUST_BEFORE if tick in self.ticks.events else 1.0)

    def _measure(self, before: State, result: StepResult, after: State, level: int) -> Measure:
        owned, t = slice(self.lattice.owned), self._length(level)
        mass, q, v = self.lattice.mass, before.q[owned], before.velocity(t)[owned]
        x, w = result.position[owned], (result.position - result.previous)[owned] / t
        end = self._reached(self.tick + self.ticks.length(level))
        free = mass * ~self.environment.anchors.fixed_at(end)[owned]
        struck = after.velocity(t)[owned] - w
        local = self.mean(local_error(self.order, q, v, x, w, t) * (free > 0)[:, None])
        sums = [
            mass @ (local**2).sum(axis=1),
            mass @ ((x - self.lattice.nodes[owned]) ** 2).sum(axis=1),
        ]
        coming = t * v
        if (
            not self.control.motion
        ):  # of a run that begins from rest: what will move until the next frame
            coming = self.time_step * w + 0.5 * self.time_step**2 / t * (w - v)
        late = t * (free @ np.sqrt((struck**2).sum(axis=1)))
        if self.environment.obstacles.penalties:
            ends = (before.q[owned], before.sides), (x, after.sides)
            late += t**2 * ((free > 0) @ self.environment.obstacles.change_of_push(*ends, end, t))
        sums += [mass @ (coming**2).sum(axis=1), late]
        error, motion, coming, late = (
            self.comm.allreduce(np.array([float(part) for part in sums])) / self.mass
        )
        return Measure(
            math.sqrt(error) + late, math.sqrt(max(motion, 0.0 if self.control.motion else coming))
        )

    def _taken(
        self, result: StepResult, before: State, after: State, level: int
    ) -> tuple[StepResult, State]:
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
        self.kept[next(reversed(self.kept))].save(checkpoint)  # that used last

    def restore(self, checkpoint: Checkpoint, time: float) -> None:
        for part in (self, self.control):
            checkpoint.restore_counts(part)
        self._integrator(self.last).restore(checkpoint, self._reached(self.tick))

    def forget(self) -> None:
        for integrator in self.kept.values():
            integrator.forget()

    def sum_up(self) -> None:
        """Say at the end of a run how far off the motion may be."""
        log.info(
            "the motion is some %.2g of its size off (time.error = %g)",
            self.control.estimate,
            self.control.asked,
        )

    def destroy(self) -> None:
        for integrator in self.kept.values():
            integrator.destroy()
