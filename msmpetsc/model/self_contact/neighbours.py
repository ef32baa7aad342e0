"""Neighbours on a surface: points of it that are near each other at rest only because the surface is folded there.

At a sharp crease, or between needle-shaped triangles, parts of the surface that share no point are nearer than dhat at
rest. They would push each other from the start, and bend what should be at rest. A few rings of triangles apart at the
most, they are one piece of surface, and pairs of their points are left out here: they push from smaller distances
(self_contact.creases). Others as near at rest do push.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.sparse import coo_array

if TYPE_CHECKING:
    import ipctk

RINGS = 3  # of triangles


def neighbours(
    candidates: "ipctk.Candidates", mesh: "ipctk.CollisionMesh", points: np.ndarray, distance: float
) -> Mapping[tuple[int, int], bool]:
    """Return {(i, j): False}, i < j, of the points that may not meet, of candidates nearer than ``distance`` [m] at
    rest."""
    pairs = [_cross_pairs(kind, mesh, points, distance, split) for kind, split in _kinds(candidates)]
    groups = np.concatenate([np.empty((0, 4, 2), np.int64), *pairs])
    if len(groups) == 0:
        return {}
    edges = np.concatenate([mesh.edges, mesh.edges[:, ::-1], np.repeat(np.arange(len(points))[:, None], 2, axis=1)])
    ring = coo_array((np.ones(len(edges)), edges.T), shape=(len(points),) * 2).tocsr()
    within = ring
    for _ in range(RINGS - 1):
        within = within @ ring
    first, second = groups.reshape(-1, 2).T
    near = np.asarray(within.tocsr()[first, second]).reshape(-1, 4) > 0
    local = np.sort(groups[near.any(axis=1)].reshape(-1, 2), axis=1)
    return {(int(i), int(j)): False for i, j in np.unique(local, axis=0) if i < j}


def _kinds(candidates: "ipctk.Candidates") -> list[tuple[list, int]]:
    """Return the pairs of a point and a triangle and those of two edges, and of how many points the first part is."""
    return [(candidates.fv_candidates, 1), (candidates.ee_candidates, 2)]


def _cross_pairs(kind: list[Any], mesh: Any, points: np.ndarray, distance: float, split: int) -> np.ndarray:
    """Return of each near candidate the pairs (k, 4, 2) of a point of the first and one of the second part; of a point
    and a triangle there are three, one of them twice."""
    points, edges, faces = np.asfortranarray(points), mesh.edges, mesh.faces
    near = [c.vertex_ids(edges, faces) for c in kind if c.compute_distance(points, edges, faces) < distance**2]
    ids = np.array(near, np.int64).reshape(-1, 4)
    chosen = [(0, 1), (0, 2), (0, 3), (0, 3)] if split == 1 else [(0, 2), (0, 3), (1, 2), (1, 3)]
    return ids[:, chosen]
