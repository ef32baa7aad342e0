"""Solids given by the distance to their surface: closed meshes, and users' distance functions."""

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

# grid points per axis for the surface of a function [-]; for pictures only
POINTS = 65
# longest displacement for the trapezoidal rule [fraction of the depth]; over a longer
# displacement a difference of depths has more digits
SHORT = 1e-4
# barycentric coordinate that counts as zero [-]; the point is then on an edge
ON_AN_EDGE = 1e-9
# largest depth at which a point counts as on the surface [fraction of the largest
# coordinate]; close to rounding
ROUNDED = 1e-14


class DistanceSolid(Solid):
    """A solid given by distances, computed on the CPU."""

    def depths(self, q: Positions, sides: Indices | None = None) -> tuple[Floats, Indices]:
        depths, face = self._find(to_host(q))
        return like(q, depths), like(q, face)

    def normals(self, q: Positions, face: Indices) -> Rows:
        return like(q, self._behind(to_host(q), to_host(face))[1])

    def depth_change(self, q: Positions, moved: Rows, face: Indices) -> Floats:
        """Return the change of depth (n,) [m] from q - moved to q, in the solid.

        A short displacement uses the trapezoidal rule. With the surface's radius of curvature r,
        its error is |moved|^3 / (12 r^2).
        """
        face = to_host(face)
        displacement = to_host(moved)
        depth, normal = self._behind(to_host(q), face)
        depth_before, normal_before = self._behind(to_host(q - moved), face)
        is_short = np.linalg.norm(displacement, axis=1) < SHORT * np.maximum(depth, depth_before)
        is_short &= (normal * normal_before).sum(axis=1) > 0
        trapezoid = -0.5 * (displacement * (normal + normal_before)).sum(axis=1)
        return like(q, np.where(is_short, trapezoid, depth - depth_before))

    @abstractmethod
    def surface(self, low: Positions, high: Positions) -> Surface:
        """Return the solid's surface for pictures, near bodies between two corners (3,) [m]."""

    @abstractmethod
    def _find(self, q: Positions) -> tuple[Floats, Indices]:
        """Return depths (n,) [m] and faces (n,) of positions (n, 3) [m]."""

    @abstractmethod
    def _behind(self, q: Positions, face: Indices) -> tuple[Floats, Rows]:
        """Return depths (n,) [m] and unit normals (n, 3) of positions (n, 3) behind faces (n,)."""


class FunctionSolid(DistanceSolid):
    """The solid in which a user's signed distance function is negative.

    key : key of its table in the scene, for messages
    """

    def __init__(self, function: DistanceFunction, key: str):
        self.function, self.key = function, key

    def distances(self, q: Positions) -> tuple[Floats, Rows]:
        """Return the signed distances (n,) [m] of positions (n, 3) [m], and their gradients (n, 3).

        Raises InputError if the function's result has the wrong shape or is not finite.
        """
        if not len(q):
            return np.zeros(0), np.zeros((0, 3))
        # A user's function may divide by zero: its result is checked below.
        with np.errstate(all="warn"):
            answer = self.function(q.copy())
        try:
            distance, gradient = (np.asarray(part, float) for part in answer)
            distance = np.broadcast_to(distance, len(q))
            gradient = np.broadcast_to(gradient, q.shape)
        except (TypeError, ValueError):
            raise InputError(
                f"{self.key}.function: returned no distances of shape {(len(q),)} "
                f"and gradients of shape {q.shape}"
            ) from None
        if not (np.isfinite(distance).all() and np.isfinite(gradient).all()):
            raise InputError(f"{self.key}.function: returned numbers that are not finite")
        return distance, gradient

    def surface(self, low: Positions, high: Positions) -> Surface:
        """Return the surface by marching cubes, up to the bodies' longest side away from them."""
        import igl

        margin = (high - low).max()
        axes = [
            np.linspace(*ends, POINTS) for ends in zip(low - margin, high + margin, strict=True)
        ]
        # igl expects x fastest.
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        grid = grid.transpose(2, 1, 0, 3).reshape(-1, 3)
        distance = np.ascontiguousarray(self.distances(grid)[0])
        points, triangles, _ = igl.marching_cubes(distance, grid, POINTS, POINTS, POINTS)
        return Surface(points.reshape(-1, 3), triangles.reshape(-1, 3).astype(np.int64))

    def _find(self, q: Positions) -> tuple[Floats, Indices]:
        return -self.distances(q)[0], np.zeros(len(q), np.int64)

    def _behind(self, q: Positions, face: Indices) -> tuple[Floats, Rows]:
        distance, gradient = self.distances(q)
        return -distance, gradient / np.maximum(np.linalg.norm(gradient, axis=1), TINY)[:, None]


class MeshSolid(DistanceSolid):
    """The inside of a closed surface. A position's face is the nearest triangle.

    The pseudonormal at the nearest triangle, edge or corner gives the sign of the distance. Source:
    Baerentzen and Aanaes 2005, Signed Distance Computation Using the Angle Weighted Pseudonormal.
    """

    def __init__(self, surface: Surface):
        # A scene without mesh obstacles starts without igl.
        import igl

        # trimesh's tolerances are absolute: scale the mesh to a size of about 1 by a
        # power of two, which rounds nothing
        size = 2.0 ** np.ceil(np.log2(np.ptp(surface.points, axis=0).max()))
        mesh = trimesh.Trimesh(
            surface.points / size, surface.triangles, process=True, validate=True
        )
        self.points = np.ascontiguousarray(mesh.vertices * size, float)
        self.triangles = np.ascontiguousarray(mesh.faces, np.int64)
        self._normals, self._of_corners = np.array(mesh.face_normals), np.array(mesh.vertex_normals)
        normals, _, of_edge = igl.per_edge_normals(
            self.points,
            self.triangles,
            igl.PerEdgeNormalsWeightingType.PER_EDGE_NORMALS_WEIGHTING_TYPE_UNIFORM,
        )
        # For each triangle the normals of the edges opposite to its corners.
        self._of_edges = normals[of_edge].reshape(3, -1, 3).swapaxes(0, 1)
        self._bounds = mesh.bounds * size
        tree = igl.AABB()
        tree.init(self.points, self.triangles)
        self._trees = [tree]
        # igl's binding reports a leak if the tree outlives Python.
        finalize(self, self._trees.clear)

    def surface(self, low: Positions, high: Positions) -> Surface:
        """Return the whole mesh, with outward triangles."""
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
        corners = self.points[self.triangles[face]]
        # scale each triangle to a size of about 1 for trimesh's tolerances
        size = np.ptp(corners, axis=1).max(axis=1)[:, None]
        unit, at = (corners - corners[:, :1]) / size[:, None], (q - corners[:, 0]) / size
        out = (closest_point(unit, at) - at) * size  # type: ignore[no-untyped-call]
        depth = np.linalg.norm(out, axis=1)
        on_surface = depth <= ROUNDED * np.abs(self._bounds).max()
        normals = out / np.maximum(depth, TINY)[:, None]
        return depth, np.where(on_surface[:, None], self._normals[face], normals)

    def _pseudonormals(self, on_surface: Positions, face: Indices) -> Rows:
        """Return outward pseudonormals (n, 3) at points (n, 3) [m] of triangles (n,)."""
        corners = self.points[self.triangles[face]]
        weights = points_to_barycentric(corners, on_surface)  # type: ignore[no-untyped-call]
        zero = weights < ON_AN_EDGE
        count = zero.sum(axis=1)
        normals = self._normals[face]
        edge, corner = count == 1, count > 1
        normals[edge] = self._of_edges[face[edge], zero[edge].argmax(axis=1)]
        normals[corner] = self._of_corners[
            self.triangles[face[corner], weights[corner].argmax(axis=1)]
        ]
        return normals
