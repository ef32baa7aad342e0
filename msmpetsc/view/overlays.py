"""Obstacles and force arrows around the bodies at a time, in the scene's axes [m]."""

from dataclasses import dataclass, field
from itertools import product

import numpy as np

from msmpetsc.backend.arrays import Floats, Positions, Rows
from msmpetsc.constraints.loads import Motion, total_of, within
from msmpetsc.geometry.surface import bounds_of
from msmpetsc.view.camera import Camera, unit
from msmpetsc.view.drawable import Drawable

ARROW = 0.2  # length of an arrow, of the body's longest side
NEAR = 0.5  # an obstacle farther than this from all bodies is left out, of their longest extent
CUT = 1.3  # a longer box is cut to this, of the bodies' extent
MARGIN = 0.08  # around the bodies, of their longest extent
GROUND = 1.6  # of the bodies' longest extent: as far from their middle a ground is drawn
THICKNESS = 0.02  # of a plate of glass, of the bodies' longest extent


@dataclass(frozen=True)
class Ground:
    """A plane drawn as ground: corners (4, 3) around its disk, unit normal (3,)."""

    corners: Positions
    normal: Floats

    def below(self, points: Positions) -> Positions:
        """Return the projection of points (n, 3) onto the plane."""
        return points - np.outer((points - self.corners[0]) @ self.normal, self.normal)


@dataclass(frozen=True)
class Ball:
    """A spherical obstacle: center (3,), radius [m], and corners (8, 3) of the visible part of its box."""

    center: Floats
    radius: float
    seen: Positions


@dataclass(frozen=True)
class MeshObstacle:
    """An obstacle with a surface: its number, and corners (8, 3) as of a Ball.

    turn, by : (3, 3) and (3,) [m]: it is at x @ turn + by of points x at time 0
    """

    number: int
    turn: Rows
    by: Floats
    seen: Positions

    def moved(self, points: Positions) -> Positions:
        """Return where points (n, 3) [m] of it at time 0 are."""
        return np.asarray(points @ self.turn + self.by)


@dataclass(frozen=True)
class Overlays:
    """Obstacles and force arrows of one picture.

    grounds : planes drawn as they are
    glass   : (8, 3) corners each, of boxes and of planes that would hide the body; corner number 4i + 2j + k
    arrows  : (2, 3) each, tail and tip
    balls   : of spheres, seen through like glass
    meshes  : obstacles that are meshes or functions
    """

    grounds: list[Ground] = field(default_factory=list)
    glass: list[Positions] = field(default_factory=list)
    arrows: list[Positions] = field(default_factory=list)
    balls: list[Ball] = field(default_factory=list)
    meshes: list[MeshObstacle] = field(default_factory=list)

    @property
    def obstacles(self) -> Positions:
        """Corners (n, 3) of all obstacles but grounds, as far as they are visible [m]."""
        seen = [*(ball.seen for ball in self.balls), *(mesh.seen for mesh in self.meshes)]
        return np.concatenate([np.empty((0, 3)), *self.glass, *seen])


def overlays_at(subject: Drawable, index: int, bodies: Positions, camera: Camera) -> Overlays:
    """Return the obstacles and force arrows of a frame.

    bodies : (b, 3) surface points of all pictures [m], which say how much of an obstacle is worth showing
    """
    time, solids = float(subject.times[index]), subject.solids
    shown = Overlays(
        arrows=[arrow for arrow in _arrows(subject, index) if _is_near(arrow[[0, 0]], bodies)]
    )
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
            center, radius = np.array(obstacle.center) + pose[:3], obstacle.radius or 0.0
            seen = _box(np.array([center - radius, center + radius]), bodies)
            shown.balls.extend(Ball(center, radius, corners) for corners in seen)
        elif obstacle.shape == "plane":
            _add_plane(
                shown,
                np.array(obstacle.point) + pose[:3],
                np.array(obstacle.normal),
                bodies,
                camera,
            )
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
    """Add a near plane, as ground or, where it hides the body, as a plate of glass."""
    if ((bodies - point) @ normal).min() > NEAR * _reach(bodies):
        return
    sides = _sides(normal)
    if normal @ camera.to_eye > 0 and normal @ camera.up > -1e-6:  # alike from anywhere
        middle = (bodies.min(axis=0) + bodies.max(axis=0)) / 2
        middle = middle - ((middle - point) @ normal) * normal
        corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) @ sides
        shown.grounds.append(Ground(middle + GROUND * _reach(bodies) * corners, normal))
    else:  # a plate where the bodies stand before the plane, with a margin
        reached, margin = bodies @ sides.T, MARGIN * _reach(bodies)
        plate = np.array([reached.min(axis=0) - margin, reached.max(axis=0) + margin])
        front = np.array([*product(*plate.T)]) @ sides + (point @ normal) * normal
        shown.glass.append(np.concatenate([front, front - THICKNESS * _reach(bodies) * normal]))


def _reach(bodies: Positions) -> float:
    return float(np.ptp(bodies, axis=0).max())


def _sides(normal: Floats) -> Rows:
    """Return two orthogonal unit vectors (2, 3) in a plane, the first along an axis if possible."""
    across = min(np.eye(3), key=lambda axis: abs(axis @ normal))
    first = unit(across - (across @ normal) * normal)
    return np.array([first, np.cross(normal, first)])


def _box(box: Positions, bodies: Positions) -> list[Positions]:
    """Return corners (8, 3) of a box (2, 3), clipped near the bodies; none for a distant box."""
    low, high = bodies.min(axis=0), bodies.max(axis=0)
    extent = high - low
    margin = (CUT - 1) / 2 * extent
    long = box[1] - box[0] > CUT * extent
    box = np.where(long, np.clip(box, low - margin, high + margin), box)
    if not _is_near(box, bodies) or (box[0] >= box[1]).any():
        return []
    return [np.array([*product(*box.T)])]


def _is_near(box: Positions, bodies: Positions) -> bool:
    """Return whether a box (2, 3) is near enough to the bodies to be shown beside them."""
    gap = np.maximum(box[0] - bodies.max(axis=0), bodies.min(axis=0) - box[1]).max()
    return bool(gap <= NEAR * _reach(bodies))


def _arrows(subject: Drawable, index: int) -> list[Positions]:
    time, rest = float(subject.times[index]), subject.rest
    length = ARROW * np.ptp(rest.bounds, axis=1).max()
    arrows = []
    for table in subject.scene.tables("force"):
        force = table.table
        total = total_of(force.total or (0.0, 0.0, 0.0)).value_at(
            time
        )  # a function has no one direction
        if (
            within(time, force.start, force.stop)
            and any(total)
            and (where := rest.find(table)).any()
        ):
            tail = subject.nodes(index)[where].mean(axis=0)
            arrows.append(np.array([tail, tail + length * unit(total)]))
    return arrows
