"""What stands beside the body at a time: obstacles, arrows for the forces, and the parts that are fixed.

Geometry only, in the scene's axes [m]; it comes from the scene and the lattice of a result, nothing is drawn here.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from msmpetsc.constraints.loads import Motion, total_of, within
from msmpetsc.geometry.inside import inside_bodies
from msmpetsc.geometry.surface import Surface, bounds_of
from msmpetsc.scene.bodies import OfBody
from msmpetsc.scene.schema import SceneFile
from msmpetsc.view.camera import Camera, unit

ARROW = 0.2  # length of an arrow, of the body's longest side
NEAR = 0.5  # an obstacle farther than this from all bodies is left out, of their longest extent
CUT = 1.3  # a longer box is cut to this, of the bodies' extent
MARGIN = 0.08  # around the bodies, of their longest extent
GROUND = 1.6  # of the bodies' longest extent: as far from their middle a ground is drawn
THICKNESS = 0.02  # of a plate of glass, of the bodies' longest extent


@dataclass(frozen=True)
class Ground:
    """A plane that the body stands on or lies against: corners (4, 3) around the disk drawn, unit normal (3,)."""

    corners: np.ndarray
    normal: np.ndarray

    def below(self, points: np.ndarray) -> np.ndarray:
        """Return the points of the plane that points (n, 3) are above."""
        return points - np.outer((points - self.corners[0]) @ self.normal, self.normal)


@dataclass(frozen=True)
class Ball:
    """A sphere: center (3,), radius [m], and corners (8, 3) of the part of its bounding box that is worth showing."""

    center: np.ndarray
    radius: float
    seen: np.ndarray


@dataclass(frozen=True)
class Shape:
    """A mesh: number of its obstacle, how far it has moved (3,) [m], its surface, and corners (8, 3) as of a Ball."""

    number: int
    by: np.ndarray
    surface: Surface
    seen: np.ndarray


@dataclass(frozen=True)
class Overlays:
    """What stands beside the body in one panel.

    grounds : planes drawn as they are
    glass   : (8, 3) corners each, of boxes and of planes that would hide the body; corner number 4i + 2j + k
    arrows  : (2, 3) each, tail and tip
    balls   : of spheres, seen through like glass
    shapes  : of meshes and functions
    """

    grounds: list[Ground]
    glass: list[np.ndarray]
    arrows: list[np.ndarray]
    balls: list[Ball]
    shapes: list[Shape]

    @property
    def _seen(self) -> list[np.ndarray]:
        return [*(ball.seen for ball in self.balls), *(shape.seen for shape in self.shapes)]

    @property
    def sharp(self) -> list[np.ndarray]:
        """Points (n, 3) [m] of what must be in the picture with a margin: all but grounds."""
        return [*self.glass, *self.arrows, *self._seen]

    @property
    def corners(self) -> np.ndarray:
        """Corners (n, 3) of all obstacles, of what of a ball or a mesh is to be seen [m]."""
        return np.concatenate(
            [np.empty((0, 3)), *(ground.corners for ground in self.grounds), *self.glass, *self._seen]
        )


@dataclass(frozen=True)
class Rest:
    """The bodies at rest: nodes (n, 3) [m], cells (c, 8) of them, surface points (v, 3) [m].

    body_of_node, body_of_point : numbers (n,), (v,) of their bodies
    """

    nodes: np.ndarray
    cells: np.ndarray
    points: np.ndarray
    body_of_node: np.ndarray
    body_of_point: np.ndarray

    @property
    def bounds(self) -> np.ndarray:
        """Corners (b, 2, 3) of the bounding box of each body's surface [m]."""
        of_bodies = (self.points[self.body_of_point == number] for number in range(self.body_of_point.max() + 1))
        return np.array([(points.min(axis=0), points.max(axis=0)) for points in of_bodies])

    def find(self, table: OfBody) -> np.ndarray:
        """Tell which nodes (n,) the region of a scene's table means.

        There are none if it is painted in a file, which the result does not hold.
        """
        region = table.table.region
        if region.painted is None:
            low, high = np.moveaxis(self.bounds[self.body_of_node], 1, 0)  # what sticks out is where its body is
            nodes = np.clip(self.nodes, low, high)
            return inside_bodies(region, nodes, self.bounds, self.body_of_node, table.body)
        where = np.zeros(len(self.nodes), bool)
        where[self.cells[self._painted_cells(table)]] = True
        return where

    @property
    def middles(self) -> np.ndarray:
        """Centres (c, 3) of the cells [m]."""
        return self.nodes[self.cells].mean(axis=1)

    def find_cells(self, table: OfBody) -> np.ndarray:
        """Tell which cells (c,) the region of a table means, by their centres; none if it is painted in a file."""
        region = table.table.region
        if region.painted is None:
            return inside_bodies(region, self.middles, self.bounds, self.body_of_node[self.cells[:, 0]], table.body)
        where = np.zeros(len(self.cells), bool)
        where[self._painted_cells(table)] = True
        return where

    def painted_points(self, table: OfBody) -> np.ndarray:
        """Return the numbers of a table's painted points among all; none if they are listed in a file."""
        painted = table.table.region.painted
        if not isinstance(painted, tuple):
            return np.empty(0, int)
        return np.flatnonzero(self.body_of_point == (table.body or 0))[list(painted)]

    def _painted_cells(self, table: OfBody) -> np.ndarray:
        """Return the numbers of the cells of the table's body around painted points."""
        own = np.flatnonzero(self.body_of_node[self.cells[:, 0]] == (table.body or 0))
        # cubes: the nearest is around it
        return own[KDTree(self.middles[own]).query(self.points[self.painted_points(table)], p=np.inf)[1]]


@dataclass(frozen=True)
class SurfaceAtRest(Rest):
    """Bodies known by their surfaces alone: the nodes are the surface points, and there are no cells."""

    def find(self, table: OfBody) -> np.ndarray:
        """Tell which surface points (v,) the region of a table means; none if it is painted in a file."""
        region = table.table.region
        if region.painted is None:
            return inside_bodies(region, self.points, self.bounds, self.body_of_point, table.body)
        where = np.zeros(len(self.points), bool)
        where[self.painted_points(table)] = True
        return where


def overlays_at(
    scene: SceneFile,
    time: float,
    rest: Rest,
    position: np.ndarray,
    bodies: np.ndarray,
    camera: Camera,
    solids: Mapping[int, Surface],
) -> Overlays:
    """Return what stands beside the body at a time [s].

    position : (n, 3) of the nodes at that time [m]
    bodies   : (b, 3) surface points of all panels [m], which say how much of an obstacle is worth showing
    solids   : surfaces of obstacles that are meshes or functions, by their numbers
    """
    grounds, glass, balls = _obstacles(scene, time, bodies, camera)
    return Overlays(grounds, glass, _arrows(scene, time, rest, position), balls, _shapes(scene, time, bodies, solids))


def _obstacles(
    scene: SceneFile, time: float, bodies: np.ndarray, camera: Camera
) -> tuple[list[Ground], list[np.ndarray], list[Ball]]:
    grounds, glass, balls = [], [], []
    for obstacle in scene.obstacle:
        if not within(time, obstacle.start, obstacle.stop):
            continue
        by = Motion.through(obstacle.path).displacement_at(time)
        if obstacle.shape == "box":
            glass += _box(np.array(obstacle.box) + by, bodies)
            continue
        if obstacle.shape == "sphere":
            balls += _ball(np.array(obstacle.center) + by, obstacle.radius or 0.0, bodies)
            continue
        if obstacle.shape != "plane":
            continue
        point, normal = np.array(obstacle.point) + by, np.array(obstacle.normal)
        if ((bodies - point) @ normal).min() > NEAR * _reach(bodies):
            continue
        if normal @ camera.to_eye > 0 and normal @ camera.up > -1e-6:
            grounds.append(_ground(point, normal, bodies))
        else:
            glass.append(_plate(_patch(point, normal, bodies), THICKNESS * _reach(bodies)))
    return grounds, glass, balls


def _shapes(scene: SceneFile, time: float, bodies: np.ndarray, solids: Mapping[int, Surface]) -> list[Shape]:
    shapes = []
    for number, obstacle in enumerate(scene.obstacle):
        surface = solids.get(number)
        if surface is not None and len(surface.points) and within(time, obstacle.start, obstacle.stop):
            by = Motion.through(obstacle.path).displacement_at(time)
            seen = _box(bounds_of(surface) + by, bodies)
            shapes += [Shape(number, by, surface, corners) for corners in seen]
    return shapes


def _reach(bodies: np.ndarray) -> float:
    return np.ptp(bodies, axis=0).max()


def _sides(normal: np.ndarray) -> np.ndarray:
    """Return two unit vectors (2, 3) of a plane, the first along an axis of the scene if it can."""
    across = min(np.eye(3), key=lambda axis: abs(axis @ normal))
    first = unit(across - (across @ normal) * normal)
    return np.array([first, np.cross(normal, first)])


def _ground(point: np.ndarray, normal: np.ndarray, bodies: np.ndarray) -> Ground:
    """Return what is drawn of a plane below bodies: wherever the eye is, the same."""
    middle = (bodies.min(axis=0) + bodies.max(axis=0)) / 2
    middle = middle - ((middle - point) @ normal) * normal
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) @ _sides(normal)
    return Ground(middle + GROUND * _reach(bodies) * corners, normal)


def _patch(point: np.ndarray, normal: np.ndarray, bodies: np.ndarray) -> Ground:
    """Return the rectangle of a plane that the bodies stand before, with a margin."""
    sides = _sides(normal)
    reached, margin = bodies @ sides.T, MARGIN * _reach(bodies)
    (left, low), (right, high) = reached.min(axis=0) - margin, reached.max(axis=0) + margin
    corners = np.array([(left, low), (right, low), (right, high), (left, high)]) @ sides
    return Ground(corners + (point @ normal) * normal, normal)


def _plate(patch: Ground, thickness: float) -> np.ndarray:
    """Return the corners (8, 3) of a plate on the side of the plane where no body is."""
    front = patch.corners[[0, 1, 3, 2]]
    return np.concatenate([front, front - thickness * patch.normal])


def _box(box: np.ndarray, bodies: np.ndarray) -> list[np.ndarray]:
    """Return the corners (8, 3) of a box (2, 3), cut where it is much longer than the bodies; none if far away."""
    low, high = bodies.min(axis=0), bodies.max(axis=0)
    extent = high - low
    margin = (CUT - 1) / 2 * extent
    long = box[1] - box[0] > CUT * extent
    box = np.where(long, np.clip(box, low - margin, high + margin), box)
    gap = np.maximum(box[0] - high, low - box[1]).max()
    if gap > NEAR * _reach(bodies) or (box[0] >= box[1]).any():
        return []
    return [np.array([(box[i, 0], box[j, 1], box[k, 2]) for i in (0, 1) for j in (0, 1) for k in (0, 1)])]


def _ball(center: np.ndarray, radius: float, bodies: np.ndarray) -> list[Ball]:
    """Return a sphere, of which no more is shown than of a box; none if it is far from the bodies."""
    gap = np.linalg.norm(center - np.clip(center, bodies.min(axis=0), bodies.max(axis=0))) - radius
    seen = _box(np.array([center - radius, center + radius]), bodies)
    return [Ball(center, radius, seen[0])] if seen and gap <= NEAR * _reach(bodies) else []


def _arrows(scene: SceneFile, time: float, rest: Rest, position: np.ndarray) -> list[np.ndarray]:
    length = ARROW * np.ptp(rest.bounds, axis=1).max()
    arrows = []
    for table in scene.tables("force"):
        force = table.table
        total = total_of(force.total or (0.0, 0.0, 0.0)).value_at(time)  # a function has no one direction
        if within(time, force.start, force.stop) and any(total) and (where := rest.find(table)).any():
            tail = position[where].mean(axis=0)
            arrows.append(np.array([tail, tail + length * unit(total)]))
    return arrows


def fixed_nodes(scene: SceneFile, time: float, rest: Rest) -> np.ndarray:
    """Tell which nodes (n,) are pinned or anchored at a time [s]."""
    holding = list(scene.tables("pin"))
    holding += [anchor for anchor in scene.tables("anchor") if within(time, 0.0, anchor.table.stop)]
    return np.any([np.zeros(len(rest.nodes), bool), *map(rest.find, holding)], axis=0)
