"""What a scene does to nodes, and when: forces, anchors that lead them, and the motion of anchors and obstacles."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from msmpetsc.backend.arrays import Floats, Indices, Mask, Positions, Rows, like
from msmpetsc.errors import InputError
from msmpetsc.extensions import ForceFunction
from msmpetsc.scene.motion import ForceTable, Pose
from msmpetsc.scene.values import Vector

if TYPE_CHECKING:
    from mpi4py import MPI

SAME = 1e-12  # relative: a number of steps may come out a little less than the time meant


def within(time: float, start: float, stop: float | None) -> bool:
    """Return whether start <= time < stop [s], whatever was rounded; a stop of None never comes."""
    return time >= start * (1 - SAME) and (stop is None or time < stop * (1 - SAME))


@dataclass(frozen=True)
class Lines:
    """Vectors (k, c) at ascending times (k,) [s], straight lines between them; before and after, the first and last."""

    times: Floats
    vectors: Rows

    def value_at(self, time: float) -> Floats:
        """Return the vector (c,) at a time [s]."""
        return np.array([np.interp(time, self.times, along) for along in self.vectors.T])


@dataclass(frozen=True)
class Motion(Lines):
    """Displacements [m] and rotation vectors [rad], side by side (k, 6); none at time 0, the first.

    center : (3,) about which it turns [m], at rest
    """

    center: Floats

    @classmethod
    def through(cls, poses: Iterable[Pose], center: ArrayLike | None = None) -> "Motion":
        """Return the motion along a scene's path; one without a center does not turn."""
        stops = [
            (0.0, np.zeros(6)),
            *((p.time, np.hstack([p.by, np.radians(p.turn)])) for p in poses),
        ]
        about = np.zeros(3) if center is None else np.array(center)
        return cls(
            np.array([time for time, _ in stops]), np.array([pose for _, pose in stops]), about
        )

    @property
    def leads_away(self) -> bool:
        """Return whether the motion leaves where it starts."""
        return len(self.times) > 1

    def displacement_at(self, time: float) -> Floats:
        """Return the displacement (3,) [m] of the center at a time [s]."""
        return self.value_at(time)[:3]

    def displacement_between(self, begin: float, end: float) -> Floats:
        """Return the way (3,) [m] that the motion makes good from one time [s] to another, but for turns."""
        return self.displacement_at(end) - self.displacement_at(begin)

    def unmoved(self, q: Positions, pose: Floats) -> Positions:
        """Return where points q (n, 3) [m] of a pose (6,) are at time 0: what ``moved`` takes."""
        at_rest: Positions = (q - self.center - pose[:3]) @ Rotation.from_rotvec(
            pose[3:]
        ).as_matrix() + self.center
        return at_rest

    def moved(self, x: Positions, pose: Floats) -> Positions:
        """Return where points x (n, 3) [m] are in a pose (6,): c + R (x - c) + by."""
        by, turn = like(x, pose[:3]), pose[3:]
        if not turn.any():
            return x + by
        center, rotation = like(x, self.center), like(x, Rotation.from_rotvec(turn).as_matrix())
        return (x - center) @ rotation.T + center + by


def total_of(total: Vector | ForceTable) -> Lines:
    """Return the total [N] of a scene's force over time; of one that is always the same a table of one time."""
    if isinstance(total, ForceTable):
        return Lines(np.array(total.times), np.array(total.values))
    return Lines(np.zeros(1), np.array([total]))


@dataclass(frozen=True, kw_only=True)
class Timed:
    """What acts while start <= time < stop [s]; a stop of None never comes."""

    start: float = 0.0
    stop: float | None = None

    def acts_at(self, time: float) -> bool:
        """Return whether it acts at a time [s]."""
        return within(time, self.start, self.stop)

    @property
    def events(self) -> list[float]:
        """Return the times [s] at which it begins, ends or turns."""
        return [self.start, *([] if self.stop is None else [self.stop])]

    def state_at(self, time: float) -> bool | tuple[float, ...]:
        """Return what tells the force at a time from that at another."""
        return self.acts_at(time)


@dataclass(frozen=True)
class Anchor(Timed):
    """Nodes that a scene leads along a path, and lets go.

    where : (l,) bool, the nodes, ghosts included
    """

    where: Mask
    path: Motion


@dataclass(frozen=True)
class Load(Timed):
    """A force of nodes.

    share : (owned, 1) of each node in the total [-]; of gravity its mass [kg]
    total : what they share [N]; of gravity the acceleration [m/s^2]
    """

    share: Rows
    total: Lines

    def force_at(self, time: float) -> Rows:
        """Return the force (owned, 3) [N] that acts at a time [s]."""
        return self.share * like(self.share, self.total.value_at(time))

    def state_at(self, time: float) -> bool | tuple[float, ...]:
        """Return the total, or False where it does not act."""
        return self.acts_at(time) and tuple(self.total.value_at(time).tolist())

    @property
    def events(self) -> list[float]:
        """Return the times [s] at which the force begins, ends or turns."""
        return [*super().events, *self.total.times.tolist()]


@dataclass(frozen=True)
class OwnForce(Timed):
    """A force that is a function of the user's (extensions.register_force).

    key      : of its table in the scene, for messages
    function : of positions (k, 3) [m], velocities (k, 3) [m/s] and time [s]; returns (k, 3) [N/kg]
    rows     : (k,) owned nodes in its region
    mass     : (k,) [kg]
    """

    key: str
    function: ForceFunction
    rows: Indices
    mass: Floats

    def force_at(self, q: Positions, v: Rows, time: float) -> Rows:
        """Return the force (owned, 3) [N] at positions and velocities (owned, 3). Raises InputError for no numbers."""
        force = np.zeros((len(q), 3))
        if not len(self.rows):
            return force
        with np.errstate(all="warn"):  # it is the user's own
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
    """Return the parts (owned, 1) that nodes (owned,) bool have of a force, by mass (collective)."""
    loaded = np.where(where, mass, 0.0)
    share: Rows = loaded[:, None] / comm.allreduce(loaded.sum())
    return share
