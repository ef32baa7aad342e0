"""How what a scene leads moves: along straight lines between places given for times."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from msmpetsc.scene import Keyframe


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

    def at(self, time: float) -> np.ndarray:
        """Displacement (3,) [m]; after the last time that of the last."""
        return np.array([np.interp(time, self.times, along) for along in self.displacements.T])
