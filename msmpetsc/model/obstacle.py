"""Solids that nodes stay out of: convex, so that a few planes say what is inside."""

from dataclasses import dataclass

import numba
import numpy as np

from msmpetsc import scene
from msmpetsc.model.motion import Path, within
from msmpetsc.place.arrays import beside
from msmpetsc.place.each import each


@dataclass(frozen=True)
class Obstacle:
    """The points behind all faces: one face is a plane, six are a box.

    points, normals : (f, 3) a point of each face at time 0 [m], its unit normal towards the free side
    path            : how it moves
    start, stop     : it is there while start <= time < stop [s]; None: to the end
    """

    points: np.ndarray
    normals: np.ndarray
    path: Path
    start: float = 0.0
    stop: float | None = None

    @classmethod
    def of(cls, told: scene.Obstacle) -> "Obstacle":
        """The obstacle of a scene."""
        if told.shape == "box":
            points = np.repeat(np.array(told.box), 3, axis=0)  # the faces that meet at each of the two corners
            normals = np.concatenate([-np.eye(3), np.eye(3)])
        else:
            points, normals = np.array([told.point]), np.array([told.normal])
        return cls(points, normals, Path.through(told.path), told.start, told.stop)

    def acts_at(self, time: float) -> bool:
        return within(time, self.start, self.stop)

    def points_at(self, time: float) -> np.ndarray:
        """A point of each face (f, 3) [m] at a time."""
        return self.points + beside(self.points, self.path.at(time)) if self.path.leads_away else self.points


@numba.njit(cache=True)
def depth(x: np.ndarray, points: np.ndarray, normals: np.ndarray) -> tuple[float, int]:
    """How deep x (3,) lies in the solid [m], and the face that is nearest; not positive outside."""
    least, face = np.inf, 0
    for f in range(len(points)):
        behind = 0.0
        for c in range(3):
            behind -= normals[f, c] * (x[c] - points[f, c])
        if behind < least:
            least, face = behind, f
    return least, face


@each
def _depth_of(first, count, step, q, points, normals, least, face):
    for i in range(first, count, step):
        least[i], face[i] = depth(q[i], points, normals)


def depths(q: np.ndarray, points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``depth`` of positions (n, 3): (n,) [m], and the nearest faces (n,)."""
    least, face = np.empty(len(q), like=q), np.empty(len(q), np.int64, like=q)
    _depth_of(len(q), q, points, normals, least, face)
    return least, face
