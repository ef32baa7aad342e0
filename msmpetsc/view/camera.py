"""The camera of a picture. It looks without perspective, so all lengths can be compared."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

YAW, ELEVATION = np.radians(25), np.radians(14)  # how far the eye stands to the side, and above, if nothing is said


@dataclass(frozen=True)
class Camera:
    """The axes of a person who stands upright and faces the body, and how far above the horizon the eye is.

    right, away, up : (3,) each, unit vectors
    elevation       : of the eye above that person's horizon [rad]
    """

    right: np.ndarray
    away: np.ndarray
    up: np.ndarray
    elevation: float

    @property
    def to_eye(self) -> np.ndarray:
        """Unit vector (3,) from the body to the eye."""
        return np.sin(self.elevation) * self.up - np.cos(self.elevation) * self.away

    @property
    def upward(self) -> np.ndarray:
        """Unit vector (3,) that points upwards in the picture."""
        return np.cos(self.elevation) * self.up + np.sin(self.elevation) * self.away

    def flat(self, points: np.ndarray) -> np.ndarray:
        """Return where points (n, 3) are seen, (n, 2): to the right and upwards [m]."""
        return points @ np.array([self.right, self.upward]).T


def camera_facing(points: np.ndarray, gravity: Sequence[float] | None, eye: Sequence[float] | None = None) -> Camera:
    """Return a camera in the direction `eye` (3,) of points (n, 3), of any length; up is against gravity, z without it.

    Without eye, or with one straight above or below, the longer horizontal extent lies across the picture.
    """
    up = unit(-np.array(gravity)) if gravity and any(gravity) else np.array([0.0, 0.0, 1.0])
    if eye is None:
        right, away = _across(points, up)
        cosine, sine = np.cos(YAW), np.sin(YAW)
        return Camera(cosine * right + sine * away, cosine * away - sine * right, up, ELEVATION)
    height = unit(eye) @ up
    level = unit(eye) - height * up
    if np.linalg.norm(level) < 1e-6:
        return Camera(*_across(points, up), up, np.copysign(np.pi / 2, height))
    away = -unit(level)
    return Camera(np.cross(away, up), away, up, np.arcsin(height))


def _across(points: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return right and away: right is the horizontal axis along which the points reach farther."""
    axes = np.delete(np.eye(3), np.argmax(abs(up)), axis=0)
    axes = np.array([unit(axis - (axis @ up) * up) for axis in axes])
    right = axes[np.argmax(np.ptp(points @ axes.T, axis=0))]
    return right, np.cross(up, right)


def unit(vector: ArrayLike) -> np.ndarray:
    """Return the vector (3,) at length 1."""
    scaled = np.asarray(vector, float)
    scaled = scaled / np.abs(scaled).max()  # the squares of very large or small components leave the range
    return scaled / np.linalg.norm(scaled)
