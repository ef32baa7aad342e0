"""Surfaces of obstacles that bodies meet as they meet each other: triangles that move and turn as the scene says."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import trimesh

from msmpetsc.backend.arrays import Positions, Rows
from msmpetsc.contact.obstacles.distance import DistanceSolid
from msmpetsc.contact.obstacles.moving_solid import Obstacle
from msmpetsc.geometry.surface import Surface
from msmpetsc.scene.obstacles import BARRIER, ObstacleTable
from msmpetsc.scene.reading import Scene

EDGES = 4.0  # of the bodies' surface: the longest of an obstacle, whose larger triangles would push stiffly
MOST = 10_000  # triangles of an obstacle, from which on it is not split
ROUND = 4  # times that an icosahedron's triangles are split: half a thousandth of its radius off the ball
# Cells, or ways where these are longer, beyond which nodes pass from an obstacle's way to their own
BESIDE = 4.0
# Cells: the least distance that inverse distances are of
TOUCHING = 1e-9


@dataclass
class ObstacleSurfaces:
    """Surfaces of obstacles, on all ranks, one after the other.

    numbers   : (k,) of the obstacles in the scene
    obstacles : these, and their paths
    solids    : their surfaces at time 0
    straight  : times [s] between which points go straight, whatever their paths; None: nowhere
    """

    numbers: list[int]
    obstacles: list[Obstacle]
    solids: list[Surface]
    straight: tuple[float, float] | None = None

    @cached_property
    def total(self) -> int:
        """The number of their points."""
        return sum(len(solid.points) for solid in self.solids)

    def moves(self, begin: float, end: float) -> bool:
        """Return whether any is not at one time [s] where it is at another."""
        return any((o.path.value_at(begin) != o.path.value_at(end)).any() for o in self.obstacles)

    def points_at(self, time: float) -> Positions:
        """Return the points (o, 3) [m] at a time [s]."""
        if self.straight and self.straight[0] < time < self.straight[1]:
            begin, end = self.straight
            share = (time - begin) / (end - begin)
            return (1 - share) * self._on_path(begin) + share * self._on_path(end)
        return self._on_path(time)

    def _on_path(self, time: float) -> Positions:
        paths = zip((obstacle.path for obstacle in self.obstacles), self.solids, strict=True)
        return np.concatenate(
            [path.moved(solid.points, path.value_at(time)) for path, solid in paths]
        )

    def way(self, begin: float, end: float) -> Rows:
        """Return how far the points go from one time [s] to another, (o, 3) [m]; (1, 3), nowhere, if none moves."""
        return (
            self.points_at(end) - self.points_at(begin)
            if self.moves(begin, end)
            else np.zeros((1, 3))
        )

    def sums(self, forces: Rows) -> Rows:
        """Return the sums (k, 3) [N] of forces (o, 3) [N] on the points of each."""
        owner = np.repeat(np.arange(len(self.solids)), [len(solid.points) for solid in self.solids])
        return np.stack([np.bincount(owner, along, len(self.solids)) for along in forces.T], axis=1)

    def distances(self, x: Positions, time: float) -> Rows:
        """Return lower bounds (n, k) [m] of the distances of x (n, 3) [m] from the obstacles at a time [s]."""
        seen = [(o.solid, o.path.unmoved(x, o.path.value_at(time))) for o in self.obstacles]
        return np.maximum(np.stack([-solid.depths(at)[0] for solid, at in seen], axis=1), 0.0)

    def carried(
        self, q: Positions, moved: Rows, times: tuple[float, float], distances: Rows, cell: float
    ) -> Rows:
        """Return how far nodes q (n, 3) [m] go between two times [s], (n, 3) [m]: with obstacles or by ``moved``.

        Nodes at an obstacle keep their place beside it. Between obstacles the ways are interpolated by inverse
        distances, so that a plate and a floor squeeze a body evenly; farther off, nodes pass to their own way.

        distances : of each node from each obstacle (n, k) [m]; nodes at 0 keep their place
        """
        weights, near = np.zeros((len(q), 1)), np.zeros((len(q), 1))
        way = np.zeros_like(q)
        begin, end = times
        for path, distance in zip(
            (o.path for o in self.obstacles), distances.T[:, :, None], strict=True
        ):
            of_obstacle = path.moved(path.unmoved(q, path.value_at(begin)), path.value_at(end)) - q
            weight = 1 / np.maximum(distance, TOUCHING * cell)
            way, weights = way + weight * of_obstacle, weights + weight
            length = np.maximum(np.linalg.norm(of_obstacle, axis=1), cell)[:, None]
            near = np.maximum(near, (1 + (BESIDE * cell - distance) / (BESIDE * length)).clip(0, 1))
        return moved + near * (way / weights - moved)


def obstacle_surfaces(scene: Scene, obstacles: list[Obstacle], edge: float) -> ObstacleSurfaces:
    """Return the surfaces that bodies meet whose own has edges of this mean length [m]."""
    numbers = [number for number, table in enumerate(scene.obstacle) if table.response == BARRIER]
    met = [obstacles[number] for number in numbers]
    whole = (_surface_of(scene.obstacle[number], obstacles[number]) for number in numbers)
    return ObstacleSurfaces(numbers, met, [_split(solid, EDGES * edge) for solid in whole])


def _surface_of(table: ObstacleTable, obstacle: Obstacle) -> Surface:
    """Return a mesh as it is, and a box and a ball of few triangles."""
    if isinstance(obstacle.solid, DistanceSolid):
        return obstacle.solid.surface(*np.zeros((2, 3)))
    if table.radius is not None:
        ball = trimesh.creation.icosphere(ROUND, table.radius)
        return Surface(ball.vertices + np.array(table.center), ball.faces)
    box = trimesh.creation.box(bounds=np.array(table.box))
    return Surface(box.vertices, box.faces)


def _split(surface: Surface, longest: float) -> Surface:
    """Return a surface with no edge longer than this [m], or of MOST triangles: halved is the longest of each."""
    points = surface.points
    triangles = surface.triangles
    while len(triangles) < MOST:
        lengths = np.linalg.norm(points[np.roll(triangles, -1, axis=1)] - points[triangles], axis=2)
        long = lengths.max(axis=1) > longest
        if not long.any():
            break
        first = lengths[long].argmax(axis=1)
        a, b, c = np.take_along_axis(triangles[long], (first[:, None] + np.arange(3)) % 3, axis=1).T
        ends, number = np.unique(np.sort([a, b], axis=0), axis=1, return_inverse=True)
        middle = len(points) + number.ravel()
        points = np.concatenate([points, points[ends].mean(axis=0)])
        halves = np.transpose([[a, middle, c], [middle, b, c]], (0, 2, 1)).reshape(-1, 3)
        triangles = np.concatenate([triangles[~long], halves])
    whole = trimesh.Trimesh(
        points, triangles
    )  # an edge halved twice, from either side, has one middle again
    return Surface(np.array(whole.vertices, float), np.array(whole.faces, np.int64))
