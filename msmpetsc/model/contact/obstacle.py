"""Solids that nodes stay out of: convex, so that a few planes say what is inside."""

from dataclasses import dataclass

import numba
import numpy as np

from msmpetsc.backend.arrays import like
from msmpetsc.backend.kernel import kernel
from msmpetsc.model.paths import Path, within
from msmpetsc.scene import schema as scene

OPPOSITE = -1 + 1e-9  # cosine of two faces that look away from each other
ROUNDED = 1e-12  # of a node's way: a plate as thin as that is not passed either


@dataclass(frozen=True)
class Obstacle:
    """The points behind all faces: one face is a plane, six are a box.

    points, normals : (f, 3) a point of each face at time 0 [m], its unit normal towards the free side
    path            : how it moves
    start, stop     : it is there while start <= time < stop [s]; None: to the end
    key             : of its table in the scene, for what is told
    """

    points: np.ndarray
    normals: np.ndarray
    path: Path
    start: float = 0.0
    stop: float | None = None
    key: str = "obstacle"

    @classmethod
    def of(cls, told: scene.Obstacle, key: str = "obstacle") -> "Obstacle":
        """The obstacle of a scene."""
        if told.shape == "box":
            points = np.repeat(np.array(told.box), 3, axis=0)  # the faces that meet at each of the two corners
            normals = np.concatenate([-np.eye(3), np.eye(3)])
        else:
            points, normals = np.array([told.point]), np.array([told.normal])
        return cls(points, normals, Path.through(told.path), told.start, told.stop, key)

    def acts_at(self, time: float) -> bool:
        return within(time, self.start, self.stop)

    def points_at(self, time: float) -> np.ndarray:
        """A point of each face (f, 3) [m] at a time."""
        return self.points + like(self.points, self.path.at(time)) if self.path.leads_away else self.points

    @property
    def has_sides(self) -> bool:
        """Whether it matters by which of its faces a node came in."""
        return len(self.normals) > 1

    def sides(
        self, q: np.ndarray, end: np.ndarray, time: float, time_step: float, before: np.ndarray | None = None
    ) -> np.ndarray:
        """``side_of`` nodes that move straight from q to ``end`` (n, 3) [m] in the step that ends at ``time``, (n,).

        before : (n,) those they had when it began. What the obstacle appears around is met by the face nearest to it.
        """
        found = no_sides(q)
        if not self.acts_at(time):
            return found
        begin = max(time - time_step, 0.0)
        if not self.acts_at(begin):
            q, begin = end, time
        _sides_of(
            len(q), q, end, self.points_at(begin), self.points_at(time), self.normals,
            no_sides(q) if before is None else before, found,
        )  # fmt: skip
        return found


@numba.njit(cache=True)
def behind(x: np.ndarray, points: np.ndarray, normals: np.ndarray, face: int) -> float:
    """How far x (3,) lies behind a face [m]; negative in front of it."""
    distance = 0.0
    for c in range(3):
        distance -= normals[face, c] * (x[c] - points[face, c])
    return distance


@numba.njit(cache=True)
def depth(x: np.ndarray, points: np.ndarray, normals: np.ndarray, side: int) -> tuple[float, int]:
    """How deep x (3,) lies behind the face of its ``side``, and that face; without a side, how deep in the solid [m],
    and the face that is nearest; not positive outside."""
    if side > 0:
        return behind(x, points, normals, side - 1), side - 1
    least, face = np.inf, 0
    for f in range(len(points)):
        distance = behind(x, points, normals, f)
        if distance < least:
            least, face = distance, f
    return least, face


@kernel
def _depth_of(first, count, step, q, points, normals, sides, least, face):
    for i in range(first, count, step):
        least[i], face[i] = depth(q[i], points, normals, sides[i])


def depths(
    q: np.ndarray, points: np.ndarray, normals: np.ndarray, sides: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """``depth`` of positions (n, 3) with their ``sides`` (n,): (n,) [m], and the faces (n,)."""
    least, face = np.empty(len(q), like=q), np.empty(len(q), np.int64, like=q)
    _depth_of(len(q), q, points, normals, no_sides(q) if sides is None else sides, least, face)
    return least, face


def no_sides(q: np.ndarray) -> np.ndarray:
    """Of nodes (n, 3) that are in contact with nothing, (n,)."""
    return np.zeros(len(q), np.int8, like=q)


@numba.njit(cache=True)
def _stays(x: np.ndarray, points: np.ndarray, normals: np.ndarray, face: int) -> bool:
    """Whether x lies behind a face and has not slid off it past another, the opposite one aside: that of a thin plate
    may be passed."""
    if behind(x, points, normals, face) <= 0.0:
        return False
    for f in range(len(points)):
        along = 0.0
        for c in range(3):
            along += normals[f, c] * normals[face, c]
        if along > OPPOSITE and behind(x, points, normals, f) <= 0.0:
            return False
    return True


@numba.njit(cache=True)
def side_of(
    x: np.ndarray, end: np.ndarray, points: np.ndarray, points_end: np.ndarray, normals: np.ndarray, side: int
) -> int:
    """1 + the face by which a node is in contact on its straight way from x to ``end`` (3,), 0 if it meets none.

    points, points_end : (f, 3) where the faces are meanwhile; as seen from the solid, too, the way is straight
    side               : by which it was before: it keeps that until it is out of the solid
    """
    if side > 0 and _stays(x, points, normals, side - 1):
        return side
    inside, face = depth(x, points, normals, 0)
    if inside > 0.0:
        return face + 1
    enter, leave, side = -1.0, 1.0, 0  # shares of the way
    for f in range(len(points)):
        here, there = behind(x, points, normals, f), behind(end, points_end, normals, f)
        if here <= 0.0:
            if there < 0.0 or there == here:
                return 0
            share = here / (here - there)
            if share > enter:
                enter, side = share, f + 1
        elif there <= 0.0:
            leave = min(leave, here / (here - there))
    return side if enter <= leave + ROUNDED else 0


@kernel
def _sides_of(first, count, step, q, end, points, points_end, normals, sides, found):
    for i in range(first, count, step):
        found[i] = side_of(q[i], end[i], points, points_end, normals, sides[i])
