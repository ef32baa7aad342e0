"""Pairs of a surface's parts in its creases, which push each other from smaller distances.

Parts that are closer than dhat at rest and at most a few rings of triangles apart are one piece of
surface. Each of their pairs pushes from the greatest of dhat, dhat / 4, dhat / 16, ... that is at
most half of its distance at rest. So the pair does nothing at rest and still cannot cross. Parts
farther apart on the surface push from dhat, however close they are at rest.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.sparse import coo_array

from msmpetsc.backend.arrays import Indices, Positions

if TYPE_CHECKING:
    import ipctk

# Most rings of triangles between neighbours
RINGS = 3
# Ratio of successive distances
FINER = 4
# Least ratio of a pair's distance at rest to the distance from which it pushes
ROOM = 2.0
# Share of dhat; pairs that are closer at rest may cross
NEAREST = 1e-3


def neighbours(
    candidates: "ipctk.Candidates", mesh: "ipctk.CollisionMesh", points: Positions, distance: float
) -> Mapping[tuple[int, int], bool]:
    """Return {(i, j): False}, i < j, for points of neighbours, which push from smaller distances.

    Neighbours are candidate pairs closer than ``distance`` [m] at rest, with parts at most RINGS
    rings of triangles apart.
    """
    of_points = _cross_pairs(
        candidates.fv_candidates, mesh, points, distance, [(0, 1), (0, 2), (0, 3), (0, 3)]
    )
    of_edges = _cross_pairs(
        candidates.ee_candidates, mesh, points, distance, [(0, 2), (0, 3), (1, 2), (1, 3)]
    )
    groups = np.concatenate([of_points, of_edges])
    if len(groups) == 0:
        return {}
    edges = np.concatenate(
        [mesh.edges, mesh.edges[:, ::-1], np.repeat(np.arange(len(points))[:, None], 2, axis=1)]
    )
    ring = coo_array((np.ones(len(edges)), edges.T), shape=(len(points),) * 2).tocsr()
    within = ring
    for _ in range(RINGS - 1):
        within = within @ ring
    first, second = groups.reshape(-1, 2).T
    near = np.asarray(within.tocsr()[first, second]).reshape(-1, 4) > 0
    local = np.sort(groups[near.any(axis=1)].reshape(-1, 2), axis=1)
    return {(int(i), int(j)): False for i, j in np.unique(local, axis=0) if i < j}


def _cross_pairs(
    kind: list[Any], mesh: Any, points: Positions, distance: float, cross: list[Any]
) -> Indices:
    """Return pairs (k, 4, 2) of points, one of either part, for each candidate closer than
    ``distance``.

    cross : places of the points in a candidate; a point and a triangle have three pairs, one twice
    """
    points, edges, faces = np.asfortranarray(points), mesh.edges, mesh.faces
    near = [
        c.vertex_ids(edges, faces)
        for c in kind
        if c.compute_distance(points, edges, faces) < distance**2
    ]
    return np.array(near, np.int64).reshape(-1, 4)[:, cross]


def creases(
    near: Mapping[tuple[int, int], bool],
    mesh: "ipctk.CollisionMesh",
    points: Positions,
    distance: float,
) -> tuple[dict[float, "ipctk.Candidates"], int]:
    """Return the pairs of creases by their distance [m], and the number of pairs too close for any.

    The greatest distance comes first.

    near     : {(i, j): False} of the points of neighbours
    points   : (p, 3) [m] at rest
    distance : dhat [m]
    """
    import ipctk

    points, pairs = np.asfortranarray(points), _left_out(near, mesh, len(points))
    squares = [pair.compute_distance(points, mesh.edges, mesh.faces) for pair in pairs]
    lengths = np.sqrt(np.array(squares, float)) / distance
    finer = np.ceil(np.log(ROOM / np.maximum(lengths, NEAREST)) / np.log(FINER)).clip(0).astype(int)
    finer[lengths < NEAREST] = -1
    sets = {}
    for level in np.unique(finer[finer >= 0]):
        candidates = sets[distance / FINER ** int(level)] = ipctk.Candidates()
        chosen = [pairs[i] for i in np.flatnonzero(finer == level)]
        candidates.fv_candidates = [
            pair for pair in chosen if isinstance(pair, ipctk.FaceVertexCandidate)
        ]
        candidates.ee_candidates = [
            pair for pair in chosen if isinstance(pair, ipctk.EdgeEdgeCandidate)
        ]
    return sets, int((finer < 0).sum())


def _left_out(
    near: Mapping[tuple[int, int], bool], mesh: "ipctk.CollisionMesh", points: int
) -> list["ipctk.FaceVertexCandidate | ipctk.EdgeEdgeCandidate"]:
    """Return the pairs of parts, a point and a triangle or two edges, whose points are neighbours.

    Each point of one part is a neighbour of each point of the other part.
    """
    import ipctk

    if not near:
        return []
    ends = np.array(list(near)).T
    met = coo_array(
        (np.ones(2 * ends.shape[1]), np.hstack([ends, ends[::-1]])), shape=(points, points)
    ).tocsr()
    # (k, points) incidence of points in triangles, and in edges
    corners = []
    for part in (mesh.faces, mesh.edges):
        rows = np.repeat(np.arange(len(part)), part.shape[1])
        corners.append(
            coo_array((np.ones(part.size), (rows, part.ravel())), shape=(len(part), points)).tocsr()
        )
    faces, edges = corners
    of_point, of_edge = (faces @ met).tocoo(), (edges @ met @ edges.T).tocoo()
    all_three, all_four = of_point.data == 3, (of_edge.data == 4) & (of_edge.row < of_edge.col)
    of_points = map(
        ipctk.FaceVertexCandidate,
        of_point.row[all_three].tolist(),
        of_point.col[all_three].tolist(),
    )
    return [
        *of_points,
        *map(
            ipctk.EdgeEdgeCandidate, of_edge.row[all_four].tolist(), of_edge.col[all_four].tolist()
        ),
    ]
