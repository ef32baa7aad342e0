"""Functions of time: totals of loads, rigid motions, and the interval in which a load acts."""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from msmpetsc.backend.arrays import Floats, Positions, Rows, like
from msmpetsc.scene.motion import ForceTable, Pose
from msmpetsc.scene.values import Vector

# relative tolerance of times [-]; a multiple of the time step may be rounded down
SAME_TIME = 1e-12
# relative distance within which the end of an interval counts as an event [-]; adaptive
# steps end just before events
AT_EVENT = 1e-11


def within(time: float, start: float, stop: float | None) -> bool:
    """Return whether start <= time < stop [s], up to rounding; a stop of None is infinite."""
    return time >= start * (1 - SAME_TIME) and (stop is None or time < stop * (1 - SAME_TIME))


@dataclass(frozen=True)
class Lines:
    """A piecewise linear function of time, constant before the first and after the last time.

    times   : (k,) ascending [s]
    vectors : (k, c) values at the times
    """

    times: Floats
    vectors: Rows

    def value_at(self, time: float) -> Floats:
        """Return the vector (c,) at a time [s]."""
        if len(self.times) == 1:
            constant: Floats = self.vectors[0].copy()
            return constant
        # np.interp copies its columns, so it gets the two rows around the time only
        last = max(int(self.times.searchsorted(time)), 1)
        near = slice(last - 1, last + 1)
        columns = self.vectors[near].T
        return np.array([np.interp(time, self.times[near], column) for column in columns])

    def mean(self, begin: float, end: float, start: float, stop: float | None) -> Floats:
        """Return the mean (c,) from begin to end [s].

        The function counts as 0 before ``start`` [s] and after ``stop`` [s]; None is infinite.
        """
        before, after = self.times.searchsorted([begin, end])
        inner = self.times[max(before - 1, 0) : after + 1].tolist()
        stop = np.inf if stop is None else stop
        for kink in (start, *inner, stop):
            begin, end = (
                kink if abs(kink - time) <= AT_EVENT * abs(time) else time for time in (begin, end)
            )
        first, last = max(begin, start), min(end, stop)
        if not first < last:
            return np.zeros(self.vectors.shape[1])
        times = [first, *(time for time in inner if first < time < last), last]
        mean = np.zeros(self.vectors.shape[1])
        for (begun, value), (ended, next_value) in pairwise((t, self.value_at(t)) for t in times):
            share = (ended - begun) / (end - begin)
            mean += 0.5 * share * (value + next_value)
        return mean


@dataclass(frozen=True)
class Motion(Lines):
    """A rigid motion over time: rows (k, 6) of displacement [m] and rotation vector [rad].

    The first time is 0, with the zero vector.

    center : (3,) centre of rotation at rest [m]
    """

    center: Floats

    @classmethod
    def through(cls, poses: Iterable[Pose], center: ArrayLike | None = None) -> "Motion":
        """Return the motion along a scene's path; ``center`` may be None if nothing rotates."""
        stops = [
            (0.0, np.zeros(6)),
            *((p.time, np.hstack([p.by, np.radians(p.turn)])) for p in poses),
        ]
        about = np.zeros(3) if center is None else np.array(center)
        return cls(
            np.array([time for time, _ in stops]), np.array([pose for _, pose in stops]), about
        )

    @property
    def is_moving(self) -> bool:
        """Return whether the motion has a pose after the first."""
        return len(self.times) > 1

    def displacement_at(self, time: float) -> Floats:
        """Return the displacement (3,) [m] of the center at a time [s]."""
        return self.value_at(time)[:3]

    def displacement_between(self, begin: float, end: float) -> Floats:
        """Return the displacement (3,) [m] of the center between two times [s]."""
        return self.displacement_at(end) - self.displacement_at(begin)

    def unmoved(self, q: Positions, pose: Floats) -> Positions:
        """Return the positions (n, 3) [m] at time 0 of points q (n, 3) in a pose (6,).

        This is the inverse of ``moved``.
        """
        rotation = Rotation.from_rotvec(pose[3:]).as_matrix()
        at_rest: Positions = (q - self.center - pose[:3]) @ rotation + self.center
        return at_rest

    def moved(self, x: Positions, pose: Floats) -> Positions:
        """Return the positions c + R (x - c) + by (n, 3) [m] of points x (n, 3) in a pose (6,)."""
        by, turn = like(x, pose[:3]), pose[3:]
        if not turn.any():
            return x + by
        center = like(x, self.center)
        rotation = like(x, Rotation.from_rotvec(turn).as_matrix())
        return (x - center) @ rotation.T + center + by


def total_of(total: Vector | ForceTable | float) -> Lines:
    """Return a scene's load over time, [N] or [Pa]; a constant load has a single time."""
    if isinstance(total, ForceTable):
        return Lines(np.array(total.times), np.array(total.values).reshape(len(total.times), -1))
    return Lines(np.zeros(1), np.array(total, ndmin=1)[None])


@dataclass(frozen=True, kw_only=True)
class Timed:
    """A load, anchor or obstacle that acts while start <= time < stop [s]; None is infinite."""

    start: float = 0.0
    stop: float | None = None

    def acts_at(self, time: float) -> bool:
        """Return whether the load, anchor or obstacle acts at a time [s]."""
        return within(time, self.start, self.stop)

    @property
    def events(self) -> list[float]:
        """Return the times [s] at which the action begins and ends."""
        return [self.start, *([] if self.stop is None else [self.stop])]
