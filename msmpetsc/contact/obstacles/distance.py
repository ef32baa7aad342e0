"""Solids given by a signed distance: closed meshes and functions of the user."""

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

# Grid points along each axis that show the surface of a function
POINTS = 65
# Margin around the bodies within which the surface is shown, in their longest side
BEYOND = 1.0
# Displacement over depth below which the slope gives the change of depth with more
# digits
NEAR = 1e-4
# Barycentric coordinate below which a point is on an edge
ON_AN_EDGE = 1e-9
# Distance to the nearest point, over the largest coordinate, below which it has no
# direction
ROUNDED = 1e-14


class DistanceSolid(Solid):
    """Solid given by distances, on the CPU.

    the last depths are kept, as a step asks for them again.
    """

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
        """Return the change of depth (n,) [m] of inner positions over displacements ``moved`` (n,
        3).

        A small change is found by the trapezoidal rule, with an error of |moved|^3 / (12 r^2) at a
        surface of curvature 1 / r.
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
        """Return the surface, for pictures, around bodies between two corners (3,) [m]."""

    @abstractmethod
    def _find(self, q: Positions) -> tuple[Floats, Indices]:
        """Return depths (n,) [m] and faces (n,) of positions (n, 3) [m]."""

    @abstractmethod
    def _behind(self, q: Positions, face: Indices) -> tuple[Floats, Rows]:
        """Return depths (n,) [m] of positions (n, 3) behind faces (n,), and normals (n, 3)."""


class FunctionSolid(DistanceSolid):
    """Solid in which a signed distance function of the user is negative.

    key : of its table in the scene, for messages
    """

    def __init__(self, function: DistanceFunction, key: str):
        super().__init__()
        self.function, self.key = function, key

    def distances(self, q: Positions) -> tuple[Floats, Rows]:
        """Return the signed distances (n,) [m] of positions (n, 3) [m], and their gradients (n, 3).

        Raises InputError if the function returns other shapes or numbers that are not finite.
        """
        if not len(q):
            return np.zeros(0), np.zeros((0, 3))
        # Warnings of the user's function are the user's
        with np.errstate(all="warn"):
            answer = self.function(q.copy())
        try:
            distance, gradient = (np.asarray(part, float) for part in answer)
            distance, gradient = (
                np.broadcast_to(distance, len(q)),
                np.broadcast_to(gradient, q.shape),
            )
        except (TypeError, ValueError):
            raise InputError(
                f"{self.key}.function: returned no distances of shape {(len(q),)} and "
                f"gradients of shape {q.shape}"
            ) from None
        if not (np.isfinite(distance).all() and np.isfinite(gradient).all()):
            raise InputError(f"{self.key}.function: returned numbers that are not finite")
        return distance, gradient

    def surface(self, low: Positions, high: Positions) -> Surface:
        """Return the surface by marching cubes, open at the end of the part that is shown."""
        import igl

        margin = BEYOND * (high - low).max()
        axes = [
            np.linspace(*ends, POINTS) for ends in zip(low - margin, high + margin, strict=True)
        ]
        # x runs first
        grid = (
            np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
            .transpose(2, 1, 0, 3)
            .reshape(-1, 3)
        )
        distance = np.ascontiguousarray(self.distances(grid)[0])
        points, triangles, _ = igl.marching_cubes(distance, grid, POINTS, POINTS, POINTS)
        return Surface(points.reshape(-1, 3), triangles.reshape(-1, 3).astype(np.int64))

    def _find(self, q: Positions) -> tuple[Floats, Indices]:
        return -self.distances(q)[0], np.zeros(len(q), np.int64)

    def _behind(self, q: Positions, face: Indices) -> tuple[Floats, Rows]:
        distance, gradient = self.distances(q)
        return -distance, gradient / np.maximum(np.linalg.norm(gradient, axis=1), TINY)[:, None]


class MeshSolid(DistanceSolid):
    """Inside of a closed surface; the face of a point is the nearest triangle.

    A point is inside by the pseudonormal of the nearest triangle, edge or corner
    (Baerentzen and Aanaes 2005, Signed Distance Computation Using the Angle Weighted Pseudonormal).
    """

    def __init__(self, surface: Surface):
        # Other scenes do not need igl
        import igl

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
        # Normals of the edges opposite to the corners of each triangle
        self._of_edges = normals[of_edge].reshape(3, -1, 3).swapaxes(0, 1)
        self._bounds = np.array(mesh.bounds)
        tree = igl.AABB()
        tree.init(self.points, self.triangles)
        self._trees = [tree]
        # igl's binding complains of trees that are left at the end of Python
        finalize(self, self._trees.clear)

    def surface(self, low: Positions, high: Positions) -> Surface:
        """Return the mesh, all triangles wound outwards."""
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
        """Return outward directions (n, 3) at points (n, 3) of triangles (n,)."""
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
