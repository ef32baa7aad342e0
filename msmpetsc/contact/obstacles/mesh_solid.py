"""The inside of a closed surface mesh as a solid."""

from weakref import finalize

import igl
import numpy as np
import trimesh
from trimesh.triangles import closest_point, points_to_barycentric

from msmpetsc.backend.arrays import Floats, Indices, Positions, Rows
from msmpetsc.contact.obstacles.distance import DistanceSolid
from msmpetsc.contact.obstacles.solids import TINY
from msmpetsc.geometry.surface import Surface

ON_AN_EDGE = 1e-9  # barycentric
ROUNDED = 1e-14  # of the largest coordinate: a nearest point that is no farther gives no direction


class MeshSolid(DistanceSolid):
    """The inside of a closed surface; its face is the nearest triangle.

    The pseudonormal of the nearest triangle, edge or corner tells what is inside (Baerentzen and
    Aanaes 2005, Signed Distance Computation Using the Angle Weighted Pseudonormal).
    """

    def __init__(self, surface: Surface):
        super().__init__()
        mesh = trimesh.Trimesh(surface.points, surface.triangles, process=True, validate=True)
        self.points = np.ascontiguousarray(mesh.vertices, float)
        self.triangles = np.ascontiguousarray(mesh.faces, np.int64)
        self._normals, self._of_corners = np.array(mesh.face_normals), np.array(mesh.vertex_normals)
        normals, _, of_edge = igl.per_edge_normals(
            self.points, self.triangles, igl.PerEdgeNormalsWeightingType.PER_EDGE_NORMALS_WEIGHTING_TYPE_UNIFORM
        )
        self._of_edges = normals[of_edge].reshape(3, -1, 3).swapaxes(0, 1)  # of each triangle, facing its corners
        self._bounds = np.array(mesh.bounds)
        tree = igl.AABB()
        tree.init(self.points, self.triangles)
        self._trees = [tree]
        finalize(self, self._trees.clear)  # at the end of Python, too, where igl's binding complains of what is left

    def surface(self, low: Positions, high: Positions) -> Surface:
        """Return the whole mesh, each triangle wound outwards."""
        return Surface(self.points, self.triangles)

    def _find(self, q: Positions) -> tuple[Floats, Indices]:
        beyond = np.linalg.norm(q - np.clip(q, *self._bounds), axis=1)
        depths, face = -beyond, np.zeros(len(q), np.int64)
        rows = np.flatnonzero(beyond == 0)
        if len(rows):
            x = np.ascontiguousarray(q[rows])
            squares, face[rows], nearest = self._trees[0].squared_distance(self.points, self.triangles, x)
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
        normals[corner] = self._of_corners[self.triangles[face[corner], weights[corner].argmax(axis=1)]]
        return normals
