"""Forces on nodes, anchors, and the prescribed motion of anchors and obstacles."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from msmpetsc.backend.arrays import Floats, Indices, Mask, Positions, Rows, like
from msmpetsc.errors import InputError
from msmpetsc.extensions import ForceFunction
from msmpetsc.scene.motion import ForceTable, Pose
from msmpetsc.scene.values import Vector

# for type checkers only: pictures need this file, and no MPI or trimesh
if TYPE_CHECKING:
    from mpi4py import MPI

    from msmpetsc.lattice.embedded_surface import SurfacePart

# relative tolerance of times [-]; a multiple of the time step may be rounded down
SAME_TIME = 1e-12
# relative distance to an event within which an end of an interval means the event [-];
# adaptive steps end just before events
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
        return np.array([np.interp(time, self.times, column) for column in self.vectors.T])

    def mean(self, begin: float, end: float, start: float, stop: float | None) -> Floats:
        """Return the mean (c,) from begin to end [s] of the function, 0 outside start to stop.

        A stop of None is infinite.
        """
        kinks = np.array([start, *self.times, np.inf if stop is None else stop])
        for kink in kinks:
            begin, end = (
                kink if abs(kink - time) <= AT_EVENT * abs(time) else time for time in (begin, end)
            )
        first, last = max(begin, kinks[0]), min(end, kinks[-1])
        if not first < last:
            return np.zeros(self.vectors.shape[1])
        times = [first, *self.times[(first < self.times) & (self.times < last)], last]
        shares = np.diff((np.array(times) - begin) / (end - begin))
        values = np.array([self.value_at(time) for time in times])
        mean: Floats = shares @ (0.5 * (values[:-1] + values[1:]))
        return mean


@dataclass(frozen=True)
class Motion(Lines):
    """A rigid motion over time: displacements [m] and rotation vectors [rad], side by side (k, 6).

    The first time is 0, with the zero vector.

    center : (3,) centre of rotation at rest [m]
    """

    center: Floats

    @classmethod
    def through(cls, poses: Iterable[Pose], center: ArrayLike | None = None) -> "Motion":
        """Return the motion along a scene's path. A path without a center has no rotations."""
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


# the function 1
ALWAYS = Lines(np.zeros(1), np.ones((1, 1)))


def total_of(total: Vector | ForceTable | float) -> Lines:
    """Return a scene's load over time, [N] or [Pa]; a constant load has a single time."""
    if isinstance(total, ForceTable):
        return Lines(np.array(total.times), np.array(total.values).reshape(len(total.times), -1))
    return Lines(np.zeros(1), np.array(total, ndmin=1)[None])


@dataclass(frozen=True, kw_only=True)
class Timed:
    """A load that acts while start <= time < stop [s]; a stop of None is infinite."""

    start: float = 0.0
    stop: float | None = None

    def acts_at(self, time: float) -> bool:
        """Return whether the load acts at a time [s]."""
        return within(time, self.start, self.stop)

    @property
    def events(self) -> list[float]:
        """Return the times [s] at which the load begins, ends or changes its slope."""
        return [self.start, *([] if self.stop is None else [self.stop])]


@dataclass(frozen=True)
class Anchor(Timed):
    """Nodes with a prescribed displacement along a path, until the anchor releases them.

    where : (l, 3) bool, the prescribed components of the nodes, ghosts included
    """

    where: Mask
    path: Motion


@dataclass(frozen=True, kw_only=True)
class Varying(Timed):
    """A load with a total over time."""

    total: Lines

    def state_at(self, time: float) -> Floats:
        """Return the total at a time [s]; zeros if the load does not act."""
        return self.acts_at(time) * self.total.value_at(time)

    def mean(self, begin: float, end: float) -> Floats:
        """Return the mean of the total from begin to end [s]."""
        return self.total.mean(begin, end, self.start, self.stop)

    @property
    def events(self) -> list[float]:
        """Return the times [s] at which the load begins, ends or changes its slope."""
        return [*super().events, *self.total.times.tolist()]


@dataclass(frozen=True)
class Load(Varying):
    """A force on nodes, a share of a total.

    share : (owned, 1) share of each node in the total [-]; mass [kg] of gravity, area [m^2] of
            tractions
    total : total force [N]; the acceleration [m/s^2] of gravity, a traction [Pa]
    """

    share: Rows


@dataclass(frozen=True)
class Pressure(Varying):
    """A pressure [Pa] on a part of the surface, positive if it pushes into the body."""

    part: "SurfacePart"


@dataclass(frozen=True)
class OwnForce(Varying):
    """A force that a user's function defines (extensions.register_force).

    key      : key of its table in the scene, for messages
    function : from positions (k, 3) [m], velocities (k, 3) [m/s] and time [s] to (k, 3) [N/kg]
    rows     : (k,) owned nodes in its region
    mass     : (k,) their masses [kg]
    total    : factor of the function [-]
    """

    key: str
    function: ForceFunction
    rows: Indices
    mass: Floats
    total: Lines = field(default=ALWAYS, kw_only=True)

    def force_at(self, q: Positions, v: Rows, time: float) -> Rows:
        """Return the force (owned, 3) [N] at positions q and velocities v (owned, 3).

        Raises InputError if the function's result has a wrong shape or is not finite.
        """
        force = np.zeros((len(q), 3))
        if not len(self.rows):
            return force
        # A user's function may divide by zero: its result is checked below.
        with np.errstate(all="warn"):
            per_mass = np.asarray(self.function(q[self.rows], v[self.rows], time), float)
        try:
            force[self.rows] = self.mass[:, None] * np.broadcast_to(per_mass, (len(self.rows), 3))
        except ValueError:
            words = f"returned numbers of shape {per_mass.shape}, not {(len(self.rows), 3)}"
            raise InputError(f"{self.key}.function: {words}") from None
        if not np.isfinite(force).all():
            raise InputError(
                f"{self.key}.function: returned numbers that are not finite (t = {time:.6g} s)"
            )
        return force


def shares_by_mass(comm: "MPI.Comm", where: Mask, mass: Floats) -> Rows:
    """Return each node's share (owned, 1) by mass of a force on ``where`` (owned,) (collective)."""
    loaded = np.where(where, mass, 0.0)
    share: Rows = loaded[:, None] / comm.allreduce(loaded.sum())
    return share
