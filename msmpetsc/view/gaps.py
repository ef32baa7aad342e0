"""How far surface points are from what they may touch: obstacles, and other parts of the surface that face them.

It goes by positions and the scene alone, so that it is the same for obstacles that reflect and that press.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree
from trimesh.triangles import closest_point

from msmpetsc.backend.arrays import Floats, Indices, Positions, Rows
from msmpetsc.constraints.loads import Motion, within
from msmpetsc.geometry.surface import Surface
from msmpetsc.scene.obstacles import ObstacleTable

USUAL = 0.99  # share of the triangles whose size says how far off the middle of one may be that is near
CROSSED = 0.1  # of the reach: surfaces that crossed by less are taken for touching
TINY = 1e-300


@dataclass(frozen=True)
class SurfaceGaps:
    """A surface at rest, to tell later how near its parts come to each other.

    rest      : (v, 3) points [m]
    triangles : (f, 3)
    body      : (v,) numbers of the points' bodies
    reach     : gaps longer than this are not looked for [m]
    """

    rest: Positions
    triangles: Indices
    body: Indices
    reach: float

    def distances(self, points: Positions) -> Floats:
        """Return the distance (v,) [m] of points (v, 3) to the nearest triangle in front of each that faces it.

        It is infinite beyond the reach. What was near at rest does not count: the other side of a crease.
        """
        gaps = np.full(len(points), np.inf)
        number, which, normals = self._facing(points)
        if len(number):
            ways = closest_point(points[self.triangles[which]], points[number]) - points[number]
            ahead = (ways * normals[number]).sum(axis=1) > -CROSSED * self.reach
            np.minimum.at(gaps, number[ahead], np.linalg.norm(ways[ahead], axis=1))
        gaps[gaps > self.reach] = np.inf
        return gaps

    def _facing(self, points: Positions) -> tuple[Indices, Indices, Rows]:
        """Return pairs (k,), (k,) of a point and a triangle that face each other and may be within
        reach, and the points' normals (v, 3).

        Two faces do where their normals m, n have |m + n|^2 < 2. So that trees find few but such
        pairs, they have six axes, of place and normal, which are scaled to make that the radius.
        """
        corners = points[self.triangles]
        middles = corners.mean(axis=1)
        of_triangles = unit_vectors(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
        sums = [np.bincount(self.triangles.ravel(), np.repeat(along, 3), len(points)) for along in of_triangles.T]
        normals = unit_vectors(np.stack(sums, axis=1))
        near = self.reach + float(np.quantile(np.linalg.norm(corners - middles[:, None], axis=2).max(axis=1), USUAL))
        ours = KDTree(np.hstack([points, near * normals]))
        theirs = KDTree(np.hstack([middles, -near * of_triangles]))
        pairs = ours.sparse_distance_matrix(theirs, np.sqrt(2) * near, output_type="ndarray")
        number, which = pairs["i"], pairs["j"]
        at_rest = self.rest[number] - self.rest[self.triangles[which]].mean(axis=1)
        other = self.body[number] != self.body[self.triangles[which, 0]]
        new = other | (np.linalg.norm(at_rest, axis=1) > near)
        return number[new], which[new], normals


def unit_vectors(vectors: Rows) -> Rows:
    """Return vectors (k, 3) at length 1; those without a length stay 0."""
    units: Rows = vectors / np.maximum(np.linalg.norm(vectors, axis=1), TINY)[:, None]
    return units


def gaps_to_obstacles(
    obstacles: Sequence[ObstacleTable], solids: Mapping[int, Surface], points: Positions, time: float
) -> Floats:
    """Return the distance (n,) [m] of points (n, 3) to the nearest obstacle that is there at a time [s].

    It is negative within one, and infinite where there is none.

    solids : surfaces at time 0 of obstacles that are meshes or functions, by their numbers
    """
    gaps = np.full(len(points), np.inf)
    for number, obstacle in enumerate(obstacles):
        if within(time, obstacle.start, obstacle.stop):
            seen_from_it = points - Motion.through(obstacle.path).value_at(time)
            own = _gaps(obstacle, seen_from_it) if number not in solids else _gaps_to(solids[number], seen_from_it)
            gaps = np.minimum(gaps, own)
    return gaps


def _gaps(obstacle: ObstacleTable, points: Positions) -> Floats:
    """Return the distance (n,) [m] of points to an obstacle at time 0; infinite if unknown."""
    gaps: Floats = np.full(len(points), np.inf)
    if obstacle.center is not None:
        gaps = np.linalg.norm(points - np.array(obstacle.center), axis=1) - (obstacle.radius or 0.0)
    elif obstacle.point is not None:
        gaps = (points - np.array(obstacle.point)) @ np.array(obstacle.normal)
    elif obstacle.box is not None:
        low, high = np.array(obstacle.box)
        beyond = np.maximum(low - points, points - high)  # (n, 3) along the axes, negative within
        gaps = np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(axis=1), 0)
    return gaps


def _gaps_to(surface: Surface, points: Positions) -> Floats:
    """Return the distance (n,) [m] of points to a surface, negative behind its triangles."""
    if not len(surface.triangles):
        return np.full(len(points), np.inf)
    import igl  # for scenes with such obstacles

    kind = igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_PSEUDONORMAL
    gaps: Floats = igl.signed_distance(points, surface.points, surface.triangles, kind)[0]
    return gaps
