"""Where the eye of a picture stands. It looks without perspective, so all lengths can be compared."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

YAW, ELEVATION = np.radians(25), np.radians(14)  # how far the eye stands to the side, and above, if nothing is said


@dataclass(frozen=True)
class Camera:
    """right, away, up: (3,) each, the unit vectors of a person who stands upright and faces the body.

    elevation: how far above that person's horizon the eye is [rad]
    """

    right: np.ndarray
    away: np.ndarray
    up: np.ndarray
    elevation: float

    @property
    def to_eye(self) -> np.ndarray:
        """(3,) unit vector from the body to the eye."""
        return np.sin(self.elevation) * self.up - np.cos(self.elevation) * self.away

    @property
    def upward(self) -> np.ndarray:
        """(3,) unit vector that points upwards in the picture."""
        return np.cos(self.elevation) * self.up + np.sin(self.elevation) * self.away

    def flat(self, points: np.ndarray) -> np.ndarray:
        """(n, 2) where points (n, 3) are seen: to the right and upwards [m]."""
        return points @ np.array([self.right, self.upward]).T


def place_camera(points: np.ndarray, gravity: Sequence[float] | None, eye: Sequence[float] | None = None) -> Camera:
    """A camera in the direction `eye` (3,) of points (n, 3), of any length; up is against gravity, z without it.

    Without eye, or with one straight above or below, the longer horizontal extent lies across the picture.
    """
    up = unit(-np.array(gravity)) if gravity and any(gravity) else np.array([0.0, 0.0, 1.0])
    if eye is None:
        right, away = _across(points, up)
        right, away = np.cos(YAW) * right + np.sin(YAW) * away, np.cos(YAW) * away - np.sin(YAW) * right
        return Camera(right, away, up, ELEVATION)
    height = unit(eye) @ up
    beside = unit(eye) - height * up
    if np.linalg.norm(beside) < 1e-6:
        return Camera(*_across(points, up), up, np.copysign(np.pi / 2, height))
    away = -unit(beside)
    return Camera(np.cross(away, up), away, up, np.arcsin(height))


def _across(points: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Right and away: of the axes that are not up, made horizontal, the one along which the points reach farther."""
    axes = np.delete(np.eye(3), np.argmax(abs(up)), axis=0)
    axes = np.array([unit(axis - (axis @ up) * up) for axis in axes])
    right = axes[np.argmax(np.ptp(points @ axes.T, axis=0))]
    return right, np.cross(up, right)


def unit(vector: Sequence[float]) -> np.ndarray:
    vector = np.asarray(vector, float)
    vector = vector / np.abs(vector).max()  # the squares of very large or small components leave the range
    return vector / np.linalg.norm(vector)
