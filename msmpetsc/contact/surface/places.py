"""Places of contact between triangles, each of which counts once in the barrier.

IPC's barrier of a vertex v is the sum of b(v, f) over candidate triangles f. Over a flat patch this
sum counts a place several times: triangles beside the nearest triangle have their nearest points
on shared edges. The energy of v is therefore

    a_v / 4 (sum_f b(v, f) - sum_e b(v, e)),

where a_v is the area of v. The second sum is over links, which are edges shared by two candidate
triangles, in a maximum spanning forest of these triangles. A link's b is at most the b of either
triangle. The energy is thus

- at least the energy of the nearest triangle: never negative, and unbounded at distance 0;
- continuous, because it is the minimum, over all forests, of smooth sums;
- the energy of the nearest triangle alone if v is over a flat or convex patch.

The energy of an edge and its candidate edges is analogous; its links are shared vertices. Links
join candidates alone. Links of all triangles of the mesh would also subtract triangles that are no
candidates, as in creases. The energy could then be negative.

Exactly over an edge or a vertex b has no second derivative. Meshes that lie vertex over vertex are
common. So places are chosen at points that are displaced at random, by some 1e-6 dhat.
"""

from dataclasses import dataclass
from functools import cached_property
from operator import attrgetter
from typing import TYPE_CHECKING, Any

import numpy as np

from msmpetsc.backend.arrays import Floats, Indices, Positions
from msmpetsc.backend.kernel import njit
from msmpetsc.backend.trees import root
from msmpetsc.contact.surface.near_parts import (
    CROSSING,
    EDGE_VERTEX,
    EDGES,
    FACE_VERTEX,
    PARALLEL,
    Mesh,
    Parts,
    add_edges,
    add_faces,
)

if TYPE_CHECKING:
    import ipctk

# Least sum of weights at a place over the sum of their absolute values [-]; a smaller
# sum is rounding.
ROUNDING = 1e-9
# Greatest component of the displacements of points for the choice of places [dhat]
ASIDE = 1e-6


@dataclass(frozen=True)
class CandidateSet:
    """Candidate pairs, and the numbers (2, k) of their parts, which are read at the first use."""

    candidates: "ipctk.Candidates"

    def __len__(self) -> int:
        return len(self.candidates)

    @cached_property
    def faces(self) -> Indices:
        """Numbers (2, k) of triangles and vertices."""
        return _numbers(self.candidates.fv_candidates, "face_id", "vertex_id")

    @cached_property
    def edges(self) -> Indices:
        """Numbers (2, k) of first and second edges."""
        return _numbers(self.candidates.ee_candidates, "edge0_id", "edge1_id")


def _numbers(pairs: list[Any], *names: str) -> Indices:
    return np.array([np.fromiter(map(attrgetter(name), pairs), int, len(pairs)) for name in names])


class Places:
    """Places of contact on a mesh."""

    def __init__(self, mesh: "ipctk.CollisionMesh"):
        ends = mesh.rest_positions[mesh.edges]
        edge_areas = np.array([mesh.edge_area(i) for i in range(mesh.num_edges)])
        self.mesh = Mesh(
            np.ascontiguousarray(mesh.edges, int),
            np.ascontiguousarray(mesh.faces, int),
            np.ascontiguousarray(mesh.faces_to_edges, int),
            0.25 * mesh.vertex_areas,
            0.25 * edge_areas,
            ((ends[:, 1] - ends[:, 0]) ** 2).sum(axis=1),
            mesh.num_vertices + mesh.num_edges + mesh.num_faces,
        )
        self.aside = ASIDE * np.random.default_rng(0).uniform(-1, 1, mesh.rest_positions.shape)
        self._shape = EDGES + 1, self.mesh.size, self.mesh.size, CROSSING + 1

    def build(
        self, pairs: CandidateSet, points: Positions, distance: float
    ) -> "ipctk.NormalCollisions":
        """Return the places of pairs nearer than ``distance`` [m] at points (p, 3) [m]."""
        import ipctk

        parts = Parts.empty(4 * pairs.faces.shape[1] + 5 * pairs.edges.shape[1])
        at, square = np.ascontiguousarray(points + distance * self.aside), distance**2
        count = add_faces(pairs.faces, self.mesh, at, square, parts)
        count = add_edges(pairs.edges, self.mesh, at, square, parts, count)
        weight, pair = parts.weight[:count], parts.pair[:count]
        links = np.flatnonzero(pair >= 0)
        order = links[np.argsort(-parts.value[links], kind="stable")]
        shared = np.unique(parts.shared[:count], return_inverse=True)[1]
        _keep_forest(order, pair, shared, weight)
        counted = np.flatnonzero(weight)
        # The kind leads a place's number, so places are sorted by kind.
        places, of = np.unique(parts.place[counted], return_inverse=True)
        weight = weight[counted]
        sums, sizes = (np.bincount(of, some, len(places)) for some in (weight, np.abs(weight)))
        kept = np.abs(sums) > ROUNDING * sizes
        kinds = np.unravel_index(places[kept], self._shape)[0]
        every = list(map(self._collision, places[kept].tolist(), sums[kept].tolist()))
        first, second, third = np.cumsum(np.bincount(kinds, minlength=4))[:3]
        collisions = ipctk.NormalCollisions()
        collisions.vv_collisions, collisions.ev_collisions = every[:first], every[first:second]
        collisions.fv_collisions, collisions.ee_collisions = every[second:third], every[third:]
        return collisions

    def _collision(self, place: int, weight: float) -> "ipctk.NormalCollision":
        """Return the place of a number in ipctk's form."""
        import ipctk

        kind, first, second, case = map(int, np.unravel_index(place, self._shape))
        if kind == EDGES:
            fades = PARALLEL * self.mesh.squares[first] * self.mesh.squares[second]
            types = ipctk.EdgeEdgeDistanceType
            pair = ipctk.EdgeEdgeNormalCollision(first, second, fades, types(case))
        elif kind == FACE_VERTEX:
            pair = ipctk.FaceVertexNormalCollision(first, second)
        elif kind == EDGE_VERTEX:
            pair = ipctk.EdgeVertexNormalCollision(first, second)
        else:
            pair = ipctk.VertexVertexNormalCollision(first, second)
        pair.weight = weight
        return pair


def without_fading_links(pairs: "ipctk.NormalCollisions") -> "ipctk.NormalCollisions":
    """Return the pairs without links of nearly parallel edges.

    ipctk does not project the Hessians of these links. The projections of other links are nearly 0.
    """
    kept = type(pairs)()
    kept.vv_collisions, kept.ev_collisions = pairs.vv_collisions, pairs.ev_collisions
    kept.fv_collisions = pairs.fv_collisions
    kept.ee_collisions = [pair for pair in pairs.ee_collisions if pair.weight > 0]
    return kept


@njit()
def _keep_forest(order: Indices, pair: Indices, shared: Indices, weight: Floats) -> None:
    """Negate the weights of links in the maximum spanning forest, and set other weights to 0.

    This is Kruskal's algorithm. Weights of nearest places stay.

    order  : parts that may be links, the greatest b first; a link has the lesser b of its two parts
    shared : numbers from 0 on
    """
    parent, last = np.arange(len(pair)), np.full(len(pair), -1)
    for part in order:
        linked = last[shared[part]]
        first = second = root(parent, pair[part])
        if linked >= 0:
            second = root(parent, linked)
        weight[part] *= 0.0 if first == second else -1.0
        parent[first], last[shared[part]] = second, pair[part]
