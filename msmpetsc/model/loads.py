"""What a scene does to nodes, and when: forces, anchors that lead them, and the motion of anchors and obstacles."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

from msmpetsc.scene.motion import Keyframe

SAME = 1e-12  # relative: a number of steps may come out a little less than the time it was meant to be


def within(time: float, start: float, stop: float | None) -> bool:
    """Return whether start <= time < stop [s], whatever was rounded; a stop of None never comes."""
    return time >= start * (1 - SAME) and (stop is None or time < stop * (1 - SAME))


@dataclass(frozen=True)
class Motion:
    """Displacements (k, 3) [m] at ascending times (k,) [s], straight lines between them; none at time 0, the first."""

    times: np.ndarray
    displacements: np.ndarray

    @classmethod
    def through(cls, keyframes: Iterable[Keyframe]) -> "Motion":
        """Return the motion of a scene's obstacle or anchor."""
        stops = [(0.0, (0.0, 0.0, 0.0)), *((k.time, k.by) for k in keyframes)]
        return cls(np.array([time for time, _ in stops]), np.array([by for _, by in stops], float))

    @property
    def leads_away(self) -> bool:
        """Whether the motion leaves where it starts."""
        return len(self.times) > 1

    def at(self, time: float) -> np.ndarray:
        """Return the displacement (3,) [m] at a time [s]; after the last time it is that of the last."""
        return np.array([np.interp(time, self.times, along) for along in self.displacements.T])


@dataclass(frozen=True)
class Anchor:
    """Nodes that a scene leads along a path, and lets go.

    where : (l,) bool, the nodes, ghosts included
    path  : how they move while time < stop [s]; a stop of None never comes
    """

    where: np.ndarray
    path: Motion
    stop: float | None

    def holds_at(self, time: float) -> bool:
        """Return whether the anchor has not let go at a time [s]."""
        return within(time, 0.0, self.stop)


@dataclass(frozen=True)
class Load:
    """A force of nodes: force (owned, 3) [N], acting while start <= time < stop [s]; None: to the end."""

    force: np.ndarray
    start: float
    stop: float | None

    def acts_at(self, time: float) -> bool:
        """Return whether the force acts at a time [s]."""
        return within(time, self.start, self.stop)


def spread_by_mass(comm: MPI.Comm, total: tuple[float, ...], where: np.ndarray, mass: np.ndarray) -> np.ndarray:
    """Spread a total force [N] over nodes in proportion to their mass, (owned, 3) [N] (collective).

    where, mass : (owned,) bool, the nodes; (owned,) [kg]
    """
    loaded = np.where(where, mass, 0.0)
    whole = comm.allreduce(loaded.sum())
    return loaded[:, None] / whole * np.asarray(total)
