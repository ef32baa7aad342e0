"""Pairs of a surface's parts in its creases, which push each other from smaller distances than others do.

Neighbours that are nearer than dhat at rest may not push from there (self_contact.neighbours). Each of their pairs
pushes from the greatest of dhat, dhat / 4, dhat / 16, ... that is no more than half of its distance at rest: there it
does nothing, and yet it does not cross.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import coo_array

if TYPE_CHECKING:
    import ipctk

FINER = 4  # a distance over the next smaller one
ROOM = 2.0  # of a pair at rest, in distances that it pushes from
NEAREST = 1e-3  # of dhat: pairs nearer than that at rest may cross


def creases(
    apart: Mapping[tuple[int, int], bool], mesh: "ipctk.CollisionMesh", points: np.ndarray, distance: float
) -> tuple[dict[float, "ipctk.Candidates"], int]:
    """Return by distance [m], the greatest first, the pairs that are left out, and how many are too near for any.

    apart    : {(i, j): False} of the points that may not meet
    points   : (p, 3) [m] at rest
    distance : dhat [m]
    """
    import ipctk

    points, pairs = np.asfortranarray(points), _left_out(apart, mesh, len(points))
    squares = [pair.compute_distance(points, mesh.edges, mesh.faces) for pair in pairs]
    lengths = np.sqrt(np.array(squares, float)) / distance
    finer = np.ceil(np.log(ROOM / np.maximum(lengths, NEAREST)) / np.log(FINER)).clip(0).astype(int)
    finer[lengths < NEAREST] = -1
    sets = {}
    for level in np.unique(finer[finer >= 0]):
        candidates = sets[distance / FINER ** int(level)] = ipctk.Candidates()
        chosen = [pairs[i] for i in np.flatnonzero(finer == level)]
        candidates.fv_candidates = [pair for pair in chosen if isinstance(pair, ipctk.FaceVertexCandidate)]
        candidates.ee_candidates = [pair for pair in chosen if isinstance(pair, ipctk.EdgeEdgeCandidate)]
    return sets, int((finer < 0).sum())


def together(sets: list["ipctk.Candidates"]) -> "ipctk.Candidates":
    """Return all pairs of some sets."""
    import ipctk

    candidates = ipctk.Candidates()
    candidates.fv_candidates = [pair for kept in sets for pair in kept.fv_candidates]
    candidates.ee_candidates = [pair for kept in sets for pair in kept.ee_candidates]
    return candidates


def _left_out(
    apart: Mapping[tuple[int, int], bool], mesh: "ipctk.CollisionMesh", points: int
) -> list["ipctk.FaceVertexCandidate | ipctk.EdgeEdgeCandidate"]:
    """Return the pairs that share no point and of which no point of one may meet any of the other: a point and a
    triangle, and two edges."""
    import ipctk

    if not apart:
        return []
    ends = np.array(list(apart)).T
    met = coo_array((np.ones(2 * ends.shape[1]), np.hstack([ends, ends[::-1]])), shape=(points, points)).tocsr()
    faces, edges = (_corners(part, points) for part in (mesh.faces, mesh.edges))
    of_point, of_edge = (faces @ met).tocoo(), (edges @ met @ edges.T).tocoo()
    all_three, all_four = of_point.data == 3, (of_edge.data == 4) & (of_edge.row < of_edge.col)
    face_points = zip(of_point.row[all_three].tolist(), of_point.col[all_three].tolist(), strict=True)
    edge_edges = zip(of_edge.row[all_four].tolist(), of_edge.col[all_four].tolist(), strict=True)
    return [ipctk.FaceVertexCandidate(*pair) for pair in face_points] + [
        ipctk.EdgeEdgeCandidate(*pair) for pair in edge_edges
    ]


def _corners(parts: np.ndarray, points: int) -> coo_array:
    """Return which of the points are corners of parts (k, c), (k, points)."""
    rows = np.repeat(np.arange(len(parts)), parts.shape[1])
    return coo_array((np.ones(parts.size), (rows, parts.ravel())), shape=(len(parts), points)).tocsr()
