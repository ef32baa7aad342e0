"""Surfaces of barrier obstacles: triangles that move and turn as the scene says."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import trimesh

from msmpetsc.backend.arrays import Floats, Positions, Rows
from msmpetsc.contact.obstacles.distance import DistanceSolid
from msmpetsc.contact.obstacles.moving_solid import Obstacle
from msmpetsc.geometry.prepare import merge
from msmpetsc.geometry.surface import Surface
from msmpetsc.scene.obstacles import BARRIER, ObstacleTable

# Longest edge of an obstacle [mean edges of the bodies]; larger triangles would push
# stiffly
LONGEST_EDGE = 4.0
# Number of triangles from which an obstacle is not split further
MOST_TRIANGLES = 10_000
# Subdivisions of an icosahedron; it then differs from the ball by 5e-4 of the radius
ROUND = 4
# Distance within which nodes move with an obstacle [cells]. The motion fades out over a
# further NEARBY displacements of the obstacle, or NEARBY cells if that is longer.
NEARBY = 4.0
# Least distance to divide by [cells]
TOUCHING = 1e-9


@dataclass
class ObstacleSurfaces:
    """Surfaces of obstacles on all ranks. The points of all surfaces form a single sequence.

    numbers   : (k,) numbers of the obstacles in the scene
    obstacles : the obstacles, with their paths
    solids    : surfaces of the obstacles at time 0
    straight  : times [s] between which points move on straight lines instead of their paths; None
                for never
    """

    numbers: list[int]
    obstacles: list[Obstacle]
    solids: list[Surface]
    straight: tuple[float, float] | None = None

    @cached_property
    def total(self) -> int:
        """Number of all points."""
        return sum(len(solid.points) for solid in self.solids)

    def moves(self, begin: float, end: float) -> bool:
        """Return whether any obstacle moves between two times [s]."""
        return any((o.path.value_at(begin) != o.path.value_at(end)).any() for o in self.obstacles)

    def points_at(self, time: float) -> Positions:
        """Return the points (o, 3) [m] at a time [s]."""
        if self.straight and self.straight[0] < time < self.straight[1]:
            begin, end = self.straight
            share = (time - begin) / (end - begin)
            return (1 - share) * self._on_path(begin) + share * self._on_path(end)
        return self._on_path(time)

    def _on_path(self, time: float) -> Positions:
        return self._posed([obstacle.path.value_at(time) for obstacle in self.obstacles])

    def _posed(self, poses: Sequence[Floats]) -> Positions:
        """Return the points (o, 3) [m] with each obstacle in a pose of its path."""
        posed = zip(self.obstacles, self.solids, poses, strict=True)
        points = [each.path.moved(solid.points, pose) for each, solid, pose in posed]
        return np.concatenate([np.empty((0, 3)), *points])

    def displacements(self, begin: float, end: float) -> Rows:
        """Return the points' displacements (o, 3) [m] between two times [s]."""
        return self.points_at(end) - self.points_at(begin)

    def displacements_before(self, begin: float, end: float) -> Rows:
        """Return displacements (o, 3) [m] in a step before ``begin``, extrapolated from the step.

        Poses at ``begin`` and ``end`` [s] are extrapolated linearly to the step before, so a kink
        of a path at ``begin`` has no effect.
        """
        poses = [(o.path.value_at(begin), o.path.value_at(end)) for o in self.obstacles]
        before = [2 * at_begin - at_end for at_begin, at_end in poses]
        return self._posed([at_begin for at_begin, _ in poses]) - self._posed(before)

    def sums(self, forces: Rows) -> Rows:
        """Return the total force (k, 3) [N] on each obstacle, from forces (o, 3) [N] on points."""
        owner = np.repeat(np.arange(len(self.solids)), [len(solid.points) for solid in self.solids])
        return np.stack([np.bincount(owner, along, len(self.solids)) for along in forces.T], axis=1)

    def distances(self, x: Positions, time: float) -> Rows:
        """Return lower bounds (n, k) [m] of the distances of x (n, 3) from the obstacles."""
        seen = [(o.solid, o.path.unmoved(x, o.path.value_at(time))) for o in self.obstacles]
        return np.maximum(np.stack([-solid.depths(at)[0] for solid, at in seen], axis=1), 0.0)

    def carried(
        self, q: Positions, moved: Rows, times: tuple[float, float], distances: Rows, cell: float
    ) -> Rows:
        """Return displacements (n, 3) [m] of nodes q (n, 3) [m] that obstacles carry along.

        A node at an obstacle moves with the obstacle. Between obstacles, inverse distances
        interpolate the displacements, so that a plate and a floor squeeze a body evenly. Farther
        off, displacements fade to ``moved``.

        moved     : (n, 3) displacements far from obstacles [m]
        times     : begin and end of the obstacles' motion [s]
        distances : (n, k) of each node from each obstacle [m]
        cell      : side of a cell [m]
        """
        weights, near = np.zeros((len(q), 1)), np.zeros((len(q), 1))
        carried = np.zeros_like(q)
        begin, end = times
        for path, distance in zip(
            (o.path for o in self.obstacles), distances.T[:, :, None], strict=True
        ):
            of_obstacle = path.moved(path.unmoved(q, path.value_at(begin)), path.value_at(end)) - q
            weight = 1 / np.maximum(distance, TOUCHING * cell)
            carried, weights = carried + weight * of_obstacle, weights + weight
            length = np.maximum(np.linalg.norm(of_obstacle, axis=1), cell)[:, None]
            near = np.maximum(near, (1 + (NEARBY * cell - distance) / (NEARBY * length)).clip(0, 1))
        return moved + near * (carried / weights - moved)


def obstacle_surfaces(
    tables: Sequence[ObstacleTable], obstacles: list[Obstacle], edge: float
) -> ObstacleSurfaces:
    """Return the surfaces of barrier obstacles.

    edge : mean length of the bodies' edges [m]
    """
    numbers = [number for number, table in enumerate(tables) if table.response == BARRIER]
    met = [obstacles[number] for number in numbers]
    whole = (_surface_of(tables[number], obstacles[number]) for number in numbers)
    return ObstacleSurfaces(numbers, met, [_split(solid, LONGEST_EDGE * edge) for solid in whole])


def _surface_of(table: ObstacleTable, obstacle: Obstacle) -> Surface:
    """Return the surface of an obstacle: its mesh, a box of twelve triangles, or an icosphere."""
    if isinstance(obstacle.solid, DistanceSolid):
        return obstacle.solid.surface(*np.zeros((2, 3)))
    if table.radius is not None:
        ball = trimesh.creation.icosphere(ROUND, table.radius)
        return Surface(ball.vertices + np.array(table.center), ball.faces)
    box = trimesh.creation.box(bounds=np.array(table.box))
    return Surface(box.vertices, box.faces)


def _split(surface: Surface, longest: float) -> Surface:
    """Return the surface, split until no edge is longer than ``longest`` [m].

    A split halves the longest edge of each long triangle. Splits end at MOST_TRIANGLES triangles.
    """
    points = surface.points
    triangles = surface.triangles
    while len(triangles) < MOST_TRIANGLES:
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
    # Merge the middles of edges that were halved from both sides
    return merge(Surface(points, triangles))
