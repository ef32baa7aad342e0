"""The orthographic camera of a picture, in which all lengths can be compared."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from msmpetsc.backend.arrays import Floats, Positions, Rows

YAW, ELEVATION = (
    math.radians(25),
    math.radians(14),
)  # how far the eye stands to the side, and above, if nothing is said


@dataclass(frozen=True)
class Camera:
    """The axes of an upright observer who faces the body, and the elevation of the view.

    right, away, up : (3,) each, unit vectors
    elevation       : of the eye above that person's horizon [rad]
    """

    right: Floats
    away: Floats
    up: Floats
    elevation: float

    @property
    def to_eye(self) -> Floats:
        """Unit vector (3,) from the body to the eye."""
        return math.sin(self.elevation) * self.up - math.cos(self.elevation) * self.away

    @property
    def upward(self) -> Floats:
        """Unit vector (3,) that points upwards in the picture."""
        return math.cos(self.elevation) * self.up + math.sin(self.elevation) * self.away

    def flat(self, points: Positions) -> Rows:
        """Return the projection (n, 2) of points (n, 3) to the right and upwards [m]."""
        return points @ np.stack([self.right, self.upward], axis=1)


def camera_facing(
    points: Positions, gravity: Sequence[float] | None, eye: Sequence[float] | None = None
) -> Camera:
    """Return a camera in direction `eye` (3,) of points (n, 3); up is against gravity, z without it.

    Without eye, or with one straight above or below, the longer horizontal extent lies across the picture.
    """
    up = unit(-np.array(gravity)) if gravity and any(gravity) else np.array([0.0, 0.0, 1.0])
    axes = np.delete(np.eye(3), np.argmax(abs(up)), axis=0)
    axes = np.array([unit(axis - (axis @ up) * up) for axis in axes])
    right = axes[np.argmax(np.ptp(points @ axes.T, axis=0))]
    away = np.cross(up, right)
    if eye is None:
        away = math.cos(YAW) * away - math.sin(YAW) * right
        return Camera(np.cross(away, up), away, up, ELEVATION)
    height = float(unit(eye) @ up)
    level = unit(eye) - height * up
    if np.linalg.norm(level) > 1e-6:
        away = -unit(level)
    return Camera(np.cross(away, up), away, up, math.atan2(height, np.linalg.norm(level)))


def unit(vector: ArrayLike) -> Floats:
    """Return a vector (3,) normalised to length 1."""
    given: Floats = np.asarray(vector, float)
    scaled: Floats = (
        given / np.abs(given).max()
    )  # squares of very large or small components leave the range
    return np.divide(scaled, np.linalg.norm(scaled))
