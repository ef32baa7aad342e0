"""Solids known by the distance to their surface: of closed meshes, and of functions of the user's own."""

from abc import abstractmethod
from weakref import finalize

import numpy as np
import trimesh
from trimesh.triangles import closest_point, points_to_barycentric

from msmpetsc.backend.arrays import Floats, Indices, Positions, Rows, like, to_host
from msmpetsc.contact.obstacles.solids import TINY, Solid
from msmpetsc.errors import InputError
from msmpetsc.extensions import DistanceFunction
from msmpetsc.geometry.surface import Surface

POINTS = 65  # of the grid that shows a function's surface, along each axis
BEYOND = 1.0  # around the bodies, of their longest side: so far it is shown
NEAR = 1e-4  # of the depth: over a shorter way a depth's slope gives more digits of its change than two depths
ON_AN_EDGE = 1e-9  # barycentric
ROUNDED = 1e-14  # of the largest coordinate: a nearest point that is no farther gives no direction


class DistanceSolid(Solid):
    """A solid given by distances, on the CPU; a step often needs the same positions again."""

    def __init__(self) -> None:
        self._last: tuple[Positions, Floats, Indices] | None = None

    def depths(self, q: Positions, sides: Indices | None = None) -> tuple[Floats, Indices]:
        on_host = to_host(q)
        if self._last is None or not np.array_equal(self._last[0], on_host):
            self._last = (on_host.copy(), *self._find(on_host))
        _, depths, face = self._last
        return like(q, depths.copy()), like(q, face.copy())

    def normals(self, q: Positions, face: Indices) -> Rows:
        return like(q, self._behind(to_host(q), to_host(face))[1])

    def deeper(self, q: Positions, moved: Rows, face: Indices) -> Floats:
        """Return how much deeper positions within lie than ``moved`` (n, 3) [m] before, (n,) [m].

        Over a short way it comes by the trapezoidal rule, wrong by |moved|^3 / (12 r^2) where the
        surface bends by 1 / r.
        """
        face, way = to_host(face), to_host(moved)
        (depth, normal), (depth_before, normal_before) = (
            self._behind(to_host(x), face) for x in (q, q - moved)
        )
        near = np.linalg.norm(way, axis=1) < NEAR * np.maximum(depth, depth_before)
        near &= (normal * normal_before).sum(axis=1) > 0
        slope = -0.5 * (way * (normal + normal_before)).sum(axis=1)
        return like(q, np.where(near, slope, depth - depth_before))

    @abstractmethod
    def surface(self, low: Positions, high: Positions) -> Surface:
        """Return its surface, for pictures, around bodies that are between two corners (3,) [m]."""

    @abstractmethod
    def _find(self, q: Positions) -> tuple[Floats, Indices]:
        """Return depths and faces (n,) of positions (n, 3)."""

    @abstractmethod
    def _behind(self, q: Positions, face: Indices) -> tuple[Floats, Rows]:
        """Return how far positions (n, 3) within lie behind faces (n,), (n,) [m], and the unit normals (n, 3)."""


class FunctionSolid(DistanceSolid):
    """The solid in which a signed distance function of the user's is negative.

    key : of its table in the scene, for messages
    """

    def __init__(self, function: DistanceFunction, key: str):
        super().__init__()
        self.function, self.key = function, key

    def distances(self, q: Positions) -> tuple[Floats, Rows]:
        """Return the signed distances (n,) [m] of positions (n, 3) [m], and their gradients (n, 3).

        Raises InputError where the function returns anything else.
        """
        if not len(q):
            return np.zeros(0), np.zeros((0, 3))
        with np.errstate(all="warn"):  # it is the user's own
            answer = self.function(q.copy())
        try:
            distance, gradient = (np.asarray(part, float) for part in answer)
            distance, gradient = (
                np.broadcast_to(distance, len(q)),
                np.broadcast_to(gradient, q.shape),
            )
        except (TypeError, ValueError):
            raise InputError(
                f"{self.key}.function: returned no distances of shape {(len(q),)} and gradients of shape {q.shape}"
            ) from None
        if not (np.isfinite(distance).all() and np.isfinite(gradient).all()):
            raise InputError(f"{self.key}.function: returned numbers that are not finite")
        return distance, gradient

    def surface(self, low: Positions, high: Positions) -> Surface:
        """Return its surface by marching cubes, open where it goes on beyond what is shown."""
        import igl

        margin = BEYOND * (high - low).max()
        axes = [
            np.linspace(*ends, POINTS) for ends in zip(low - margin, high + margin, strict=True)
        ]
        grid = (
            np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
            .transpose(2, 1, 0, 3)
            .reshape(-1, 3)
        )  # x runs first
        distance = np.ascontiguousarray(self.distances(grid)[0])
        points, triangles, _ = igl.marching_cubes(distance, grid, POINTS, POINTS, POINTS)
        return Surface(points.reshape(-1, 3), triangles.reshape(-1, 3).astype(np.int64))

    def _find(self, q: Positions) -> tuple[Floats, Indices]:
        return -self.distances(q)[0], np.zeros(len(q), np.int64)

    def _behind(self, q: Positions, face: Indices) -> tuple[Floats, Rows]:
        distance, gradient = self.distances(q)
        return -distance, gradient / np.maximum(np.linalg.norm(gradient, axis=1), TINY)[:, None]


class MeshSolid(DistanceSolid):
    """The inside of a closed surface; its face is the nearest triangle.

    The pseudonormal of the nearest triangle, edge or corner tells what is inside (Baerentzen and
    Aanaes 2005, Signed Distance Computation Using the Angle Weighted Pseudonormal).
    """

    def __init__(self, surface: Surface):
        import igl  # which other scenes do not need

        super().__init__()
        mesh = trimesh.Trimesh(surface.points, surface.triangles, process=True, validate=True)
        self.points = np.ascontiguousarray(mesh.vertices, float)
        self.triangles = np.ascontiguousarray(mesh.faces, np.int64)
        self._normals, self._of_corners = np.array(mesh.face_normals), np.array(mesh.vertex_normals)
        normals, _, of_edge = igl.per_edge_normals(
            self.points,
            self.triangles,
            igl.PerEdgeNormalsWeightingType.PER_EDGE_NORMALS_WEIGHTING_TYPE_UNIFORM,
        )
        self._of_edges = (
            normals[of_edge].reshape(3, -1, 3).swapaxes(0, 1)
        )  # of each triangle, facing its corners
        self._bounds = np.array(mesh.bounds)
        tree = igl.AABB()
        tree.init(self.points, self.triangles)
        self._trees = [tree]
        finalize(
            self, self._trees.clear
        )  # at the end of Python, too, where igl's binding complains of what is left

    def surface(self, low: Positions, high: Positions) -> Surface:
        """Return the whole mesh, each triangle wound outwards."""
        return Surface(self.points, self.triangles)

    def _find(self, q: Positions) -> tuple[Floats, Indices]:
        beyond = np.linalg.norm(q - np.clip(q, *self._bounds), axis=1)
        depths, face = -beyond, np.zeros(len(q), np.int64)
        rows = np.flatnonzero(beyond == 0)
        if len(rows):
            x = np.ascontiguousarray(q[rows])
            squares, face[rows], nearest = self._trees[0].squared_distance(
                self.points, self.triangles, x
            )
            within = ((nearest - x) * self._pseudonormals(nearest, face[rows])).sum(axis=1) > 0
            depths[rows] = np.where(within, 1, -1) * np.sqrt(squares)
        return depths, face

    def _behind(self, q: Positions, face: Indices) -> tuple[Floats, Rows]:
        out = closest_point(self.points[self.triangles[face]], q) - q  # type: ignore[no-untyped-call]  # trimesh's
        depth = np.linalg.norm(out, axis=1)
        on_surface = depth <= ROUNDED * np.abs(self._bounds).max()
        normals = out / np.maximum(depth, TINY)[:, None]
        return depth, np.where(on_surface[:, None], self._normals[face], normals)

    def _pseudonormals(self, on_surface: Positions, face: Indices) -> Rows:
        """Return directions (n, 3) outwards at points (n, 3) of triangles (n,)."""
        corners = self.points[self.triangles[face]]
        weights = points_to_barycentric(corners, on_surface)  # type: ignore[no-untyped-call]  # trimesh's
        zero = weights < ON_AN_EDGE
        count, normals = zero.sum(axis=1), self._normals[face]
        edge, corner = count == 1, count > 1
        normals[edge] = self._of_edges[face[edge], zero[edge].argmax(axis=1)]
        normals[corner] = self._of_corners[
            self.triangles[face[corner], weights[corner].argmax(axis=1)]
        ]
        return normals
