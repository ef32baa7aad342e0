"""When what a scene names is there, and how it moves: along straight lines between places given for times."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from msmpetsc.scene.schema import Keyframe

SAME = 1e-12  # relative: a number of steps may come out a little less than the time it was meant to be


def within(time: float, start: float, stop: float | None) -> bool:
    """start <= time < stop [s], whatever was rounded; stop None is never."""
    return time >= start * (1 - SAME) and (stop is None or time < stop * (1 - SAME))


@dataclass(frozen=True)
class Path:
    """Displacements (k, 3) [m] at ascending times (k,) [s], the first of them nothing at time 0."""

    times: np.ndarray
    displacements: np.ndarray

    @classmethod
    def through(cls, keyframes: Iterable[Keyframe]) -> "Path":
        """The path of a scene's obstacle or anchor."""
        stops = [(0.0, (0.0, 0.0, 0.0)), *((k.time, k.by) for k in keyframes)]
        return cls(np.array([time for time, _ in stops]), np.array([by for _, by in stops], float))

    @property
    def leads_away(self) -> bool:
        """From where it starts."""
        return len(self.times) > 1

    def at(self, time: float) -> np.ndarray:
        """Displacement (3,) [m]; after the last time that of the last."""
        return np.array([np.interp(time, self.times, along) for along in self.displacements.T])
