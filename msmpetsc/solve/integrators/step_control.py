"""How long the next step may be: a credit of error, which the motion earns and steps spend.

A run whose motion is of size U may end with its trajectory off by ``error`` U. Steps pay for that
with their local errors, from a credit that grows as the motion does, and with time:

    credit(t) = error / 2 (U(t) + 1/T integral_0^t U)

A step may spend what it earns itself and a share of what was saved, and always a part of what each step could, were
all as long as those so far. Steps are 2^level times as long as the scene's.
"""

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass

from msmpetsc.checkpoint import COUNT, LENGTH, Range

SHARE = 1 / 8  # of what was saved, that a step may spend
FAIR = 0.25  # of an equal share of all credit among all steps: a step may spend that in any case
EXCESS = 2.0  # times what a step may spend: it is taken all the same, the next one is shorter
EASE = 1.0  # of what a step twice as long may spend: what it would take, before it is tried
CALM = 2  # steps that would have let the next be twice as long, before it is


@dataclass(frozen=True)
class Measure:
    """What a step showed [m]: its local error, and the size of the motion so far, both root mean squares by mass."""

    error: float
    motion: float


class StepControl:
    """Chooses levels and keeps the account of one run. The same numbers on all ranks lead to the same choices.

    order           : of the integrator
    error           : asked of the trajectory, relative to the size of the motion
    step, duration  : a step of level 0, and the whole run [s]
    lowest, highest : levels
    level           : wanted next
    spent           : sum of local errors [m]
    steps, time     : number of the steps that they are of, and their length [s]
    """

    def __init__(self, order: int, error: float, step: float, duration: float, levels: tuple[int, int]):
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
        is_calm = measure.error * growth <= EASE * self.allowed(longer, measure)
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

    events : times [s] at which something begins, ends or turns, as near as ``NEAREST`` levels below a step
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
        """[s]"""
        return tick / 2.0**-self.lowest * self.step

    def fitting(self, tick: int, level: int) -> int:
        """The highest level, not above the one wanted, of a step that may start at a tick."""
        limit = next((event for event in self.events if event > tick), self.ticks)
        while level > self.lowest and (tick % self.length(level) or tick + self.length(level) > limit):
            level -= 1
        return level

    def is_event(self, tick: int) -> bool:
        """Whether something begins, ends or turns at a tick."""
        return tick in self.events
