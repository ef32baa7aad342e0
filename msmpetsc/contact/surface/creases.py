"""Pairs in creases of a surface, which push from distances smaller than dhat.

A crease has parts that are closer than dhat at rest and at most RINGS rings of triangles apart.
Each pair of a crease pushes from the greatest of dhat, dhat / 4, dhat / 16, ... that is at most
half of the pair's distance at rest. So the pair has no force at rest and still cannot cross. Parts
farther apart on the surface push from dhat, however close they are at rest.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import coo_array, csr_array, triu

from msmpetsc.backend.arrays import Indices, Positions

if TYPE_CHECKING:
    import ipctk

# Greatest number of rings of triangles between neighbours
RINGS = 3
# Ratio of successive distances [-]
FINER = 4
# Least ratio of a pair's distance at rest to the distance from which it pushes [-]
ROOM = 2.0
# Least distance at rest [dhat]; closer pairs are left out and may cross
NEAREST = 1e-3


def neighbours(
    candidates: "ipctk.Candidates", mesh: "ipctk.CollisionMesh", points: Positions, distance: float
) -> Mapping[tuple[int, int], bool]:
    """Return {(i, j): False}, i < j, for points of neighbours, in the form of ipctk's filter.

    Neighbours are candidate pairs that are closer than ``distance`` [m] at rest, with parts at most
    RINGS rings of triangles apart.

    points : (p, 3) [m] at rest
    """
    at = np.asfortranarray(points), mesh.edges, mesh.faces
    kinds = (
        (candidates.fv_candidates, [(0, 1), (0, 2), (0, 3), (0, 3)]),
        (candidates.ee_candidates, [(0, 2), (0, 3), (1, 2), (1, 3)]),
    )
    # (k, 4, 2) pairs of points, one of each part, of candidates that are near
    near = (
        np.reshape(
            [c.vertex_ids(*at[1:]) for c in kind if c.compute_distance(*at) < distance**2], (-1, 4)
        ).astype(int)[:, cross]
        for kind, cross in kinds
    )
    groups = np.concatenate(list(near))
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
    local = np.asarray(within.tocsr()[first, second]).reshape(-1, 4).any(axis=1)
    local = np.sort(groups[local].reshape(-1, 2), axis=1)
    return {(int(i), int(j)): False for i, j in np.unique(local, axis=0) if i < j}


def creases(
    near: Mapping[tuple[int, int], bool],
    mesh: "ipctk.CollisionMesh",
    points: Positions,
    distance: float,
) -> tuple[dict[float, "ipctk.Candidates"], int]:
    """Return the pairs of creases by their distance [m], and the number of pairs too close.

    The greatest distance comes first. A pair is a point and a triangle, or two edges. All points of
    its first part are neighbours of all points of its second part.

    near     : {(i, j): False} for points of neighbours
    points   : (p, 3) [m] at rest
    distance : dhat [m]
    """
    import ipctk

    if not near:
        return {}, 0
    ends, dropped = np.array(list(near)).T, 0
    sets: dict[float, ipctk.Candidates] = {}
    shape = (len(points),) * 2
    met = coo_array((np.ones(2 * len(near)), np.hstack([ends, ends[::-1]])), shape=shape).tocsr()
    faces, edges = (_incidence(part, len(points)) for part in (mesh.faces, mesh.edges))
    of_points, of_edges = (faces @ met).tocoo(), triu(edges @ met @ edges.T, 1, "coo")
    for name, kind, joined, most in (
        ("fv_candidates", ipctk.FaceVertexCandidate, of_points, 3),
        ("ee_candidates", ipctk.EdgeEdgeCandidate, of_edges, 4),
    ):
        rows, columns = (of[joined.data == most].tolist() for of in (joined.row, joined.col))
        pairs = list(map(kind, rows, columns))
        at = np.asfortranarray(points), mesh.edges, mesh.faces
        squares = np.array([pair.compute_distance(*at) for pair in pairs], float)
        ratios = np.sqrt(squares) / distance
        finer = np.ceil(np.log(ROOM / np.maximum(ratios, NEAREST)) / np.log(FINER)).clip(0)
        finer[ratios < NEAREST] = -1
        dropped += int((finer < 0).sum())
        for level in np.unique(finer[finer >= 0]):
            candidates = sets.setdefault(distance / FINER**level, ipctk.Candidates())
            setattr(candidates, name, [pairs[i] for i in np.flatnonzero(finer == level)])
    return dict(sorted(sets.items(), reverse=True)), dropped


def _incidence(parts: Indices, points: int) -> csr_array:
    """Return the incidence (k, points) of points in parts (k, n)."""
    rows = np.repeat(np.arange(len(parts)), parts.shape[1])
    return csr_array((np.ones(parts.size), (rows, parts.ravel())), shape=(len(parts), points))
