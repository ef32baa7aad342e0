"""Obstacles and force arrows around the bodies at a time, in the scene's axes [m]."""

from dataclasses import dataclass, field
from itertools import product

import numpy as np

from msmpetsc.backend.arrays import Floats, Positions, Rows
from msmpetsc.constraints.time_functions import Motion, total_of, within
from msmpetsc.geometry.surface import bounds_of
from msmpetsc.view.camera import Camera, unit
from msmpetsc.view.drawable import Drawable

# length of an arrow, relative to the longest side of the largest body
ARROW = 0.2
# The following lengths are relative to the longest side of the box around all bodies.
# largest distance from the bodies of an obstacle that is shown
NEAR = 0.5
# largest side of a shown box, relative to the same side of the box around the bodies
CUT = 1.3
# margin around the bodies
MARGIN = 0.08
# radius of a ground
GROUND = 1.6


@dataclass(frozen=True)
class Ground:
    """A plane drawn as ground: corners (4, 3) around its disk, unit normal (3,)."""

    corners: Positions
    normal: Floats

    def below(self, points: Positions) -> Positions:
        """Return points (n, 3) projected onto the plane."""
        return points - np.outer((points - self.corners[0]) @ self.normal, self.normal)


@dataclass(frozen=True)
class Ball:
    """A sphere: center (3,), radius [m], and corners (8, 3) of the visible part of its box."""

    center: Floats
    radius: float
    seen: Positions


@dataclass(frozen=True)
class MeshObstacle:
    """An obstacle with a mesh: its number, and corners (8, 3) of the visible part of its box.

    turn, by : (3, 3) and (3,) [m]; a point x at time 0 is now at x @ turn + by
    """

    number: int
    turn: Rows
    by: Floats
    seen: Positions

    def moved(self, points: Positions) -> Positions:
        """Return the present positions of points (n, 3) [m] at time 0."""
        return np.asarray(points @ self.turn + self.by)


@dataclass(frozen=True)
class Overlays:
    """Obstacles and force arrows of a picture.

    grounds : planes that do not hide the bodies
    glass   : corners (8, 3) of boxes, and of planes that would hide the bodies; corner (i, j, k) is
              number 4i + 2j + k
    arrows  : tail and tip (2, 3) of each arrow
    balls   : spheres, drawn as glass
    meshes  : obstacles that are meshes or functions
    """

    grounds: list[Ground] = field(default_factory=list)
    glass: list[Positions] = field(default_factory=list)
    arrows: list[Positions] = field(default_factory=list)
    balls: list[Ball] = field(default_factory=list)
    meshes: list[MeshObstacle] = field(default_factory=list)

    @property
    def obstacles(self) -> Positions:
        """Corners (n, 3) of the visible parts of all obstacles except grounds [m]."""
        seen = [*(ball.seen for ball in self.balls), *(mesh.seen for mesh in self.meshes)]
        return np.concatenate([np.empty((0, 3)), *self.glass, *seen])


def overlays_at(subject: Drawable, index: int, bodies: Positions, camera: Camera) -> Overlays:
    """Return the obstacles and force arrows of a frame.

    bodies : surface points (b, 3) of all pictures [m]; obstacles are clipped near these points
    """
    time = float(subject.times[index])
    solids = subject.solids
    shown = Overlays(arrows=_arrows(subject, index))
    for number, obstacle in enumerate(subject.scene.obstacle):
        if not within(time, obstacle.start, obstacle.stop):
            continue
        path = Motion.through(obstacle.path, obstacle.center)
        pose = path.value_at(time)
        seen_from_it = path.unmoved(bodies, pose)
        if obstacle.shape == "box":
            shown.glass.extend(
                path.moved(corners, pose) for corners in _box(np.array(obstacle.box), seen_from_it)
            )
        elif obstacle.shape == "sphere":
            center = np.array(obstacle.center) + pose[:3]
            radius = obstacle.radius or 0.0
            seen = _box(np.array([center - radius, center + radius]), bodies)
            shown.balls.extend(Ball(center, radius, corners) for corners in seen)
        elif obstacle.shape == "plane":
            point, normal = np.array(obstacle.point) + pose[:3], np.array(obstacle.normal)
            _add_plane(shown, point, normal, bodies, camera)
        elif number in solids and len(solids[number].points):
            origin, *axes = path.moved(np.concatenate([np.zeros((1, 3)), np.eye(3)]), pose)
            corners = (
                path.moved(box, pose) for box in _box(bounds_of(solids[number]), seen_from_it)
            )
            shown.meshes.extend(
                MeshObstacle(number, np.array(axes) - origin, origin, seen) for seen in corners
            )
    return shown


def _add_plane(
    shown: Overlays, point: Floats, normal: Floats, bodies: Positions, camera: Camera
) -> None:
    """Add a plane near the bodies: as ground, or as a glass plate if it hides the bodies."""
    extent = np.ptp(bodies, axis=0).max()
    if ((bodies - point) @ normal).min() > NEAR * extent:
        return
    sides = _sides(normal)
    if normal @ camera.to_eye > 0 and normal @ camera.up > -1e-6:
        middle = (bodies.min(axis=0) + bodies.max(axis=0)) / 2
        middle = middle - ((middle - point) @ normal) * normal
        corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) @ sides
        shown.grounds.append(Ground(middle + GROUND * extent * corners, normal))
    else:
        across = bodies @ sides.T
        margin = MARGIN * extent
        plate = np.array([across.min(axis=0) - margin, across.max(axis=0) + margin])
        front = np.array([*product(*plate.T)]) @ sides + (point @ normal) * normal
        thickness = 0.02 * extent
        shown.glass.append(np.concatenate([front, front - thickness * normal]))


def _sides(normal: Floats) -> Rows:
    """Return two orthogonal unit vectors (2, 3) in a plane, the first along an axis if possible."""
    across = min(np.eye(3), key=lambda axis: abs(axis @ normal))
    first = unit(across - (across @ normal) * normal)
    return np.array([first, np.cross(normal, first)])


def _box(box: Positions, bodies: Positions) -> list[Positions]:
    """Return the corners (8, 3) of a box (2, 3), clipped near the bodies; [] if it is distant."""
    low, high = bodies.min(axis=0), bodies.max(axis=0)
    extent = high - low
    margin = (CUT - 1) / 2 * extent
    long = box[1] - box[0] > CUT * extent
    box = np.where(long, np.clip(box, low - margin, high + margin), box)
    gap = np.maximum(box[0] - high, low - box[1]).max()
    if gap > NEAR * extent.max() or (box[0] >= box[1]).any():
        return []
    return [np.array([*product(*box.T)])]


def _arrows(subject: Drawable, index: int) -> list[Positions]:
    """Return tail and tip (2, 3) of the arrow of each force that acts at a frame."""
    time = float(subject.times[index])
    rest = subject.rest
    length = ARROW * np.ptp(rest.bounds, axis=1).max()
    arrows = []
    for table in subject.scene.tables("force"):
        force = table.table
        # a force given by a function has no single direction, and so no arrow
        total = total_of(force.total or (0.0, 0.0, 0.0)).value_at(time)
        if (
            within(time, force.start, force.stop)
            and any(total)
            and (where := rest.find(table)).any()
        ):
            tail = subject.nodes(index)[where].mean(axis=0)
            arrows.append(np.array([tail, tail + length * unit(total)]))
    return arrows
