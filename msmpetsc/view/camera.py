"""The orthographic camera of a picture: equal lengths look equal everywhere in the picture."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from msmpetsc.backend.arrays import Floats, Positions, Rows

# default position of the eye, to the side and above [rad]
YAW = math.radians(25)
ELEVATION = math.radians(14)


@dataclass(frozen=True)
class Camera:
    """The axes of an upright observer who faces the body, and the elevation of the view.

    right, away, up : unit vectors (3,)
    elevation       : angle of the eye above the observer's horizon [rad]
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
        """Return points (n, 3) [m] projected onto the picture's axes, (n, 2) right and up [m]."""
        return points @ np.stack([self.right, self.upward], axis=1)


def camera_facing(
    points: Positions, gravity: Sequence[float] | None, eye: Sequence[float] | None = None
) -> Camera:
    """Return a camera that looks at points (n, 3) from the direction ``eye`` (3,).

    Up is opposite to gravity, or z without gravity. If ``eye`` is missing or vertical, the longer
    horizontal extent lies across the picture.
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
    # divided by the largest component first, so that no square over- or underflows
    scaled = np.divide(vector, np.abs(vector).max())
    return np.divide(scaled, np.linalg.norm(scaled))
