"""Barrier between the triangles of one surface, and its friction, by ipctk (Li et al. 2020, Incremental Potential
Contact): all that is computed of points on one rank.

A pair of triangles' parts that are nearer than dhat has the energy  kappa a b(d),  a an area of the surface, d their
distance and b = -2 ((d/dhat)^2 - 1)^2 ln(d/dhat), which is smooth where it begins and without bound at d = 0. All such
pairs count, so that the energy is continuous: with fewer (Chen et al. 2025, Offset Geometric Contact) it jumps where
one comes to count or ceases to, and line searches end there.

ipctk is used on one thread, so that sums are the same each time; its arrays are of Fortran's order.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from msmpetsc.geometry.surface import Surface
from msmpetsc.model.self_contact.neighbours import neighbours

if TYPE_CHECKING:
    import ipctk
    from scipy.sparse import csc_matrix

KEPT = 0.9  # of the way to where surfaces meet
PIECE = 2.0  # edges that points move in one piece of a way
PIECES = 200  # of a way; what is longer is shortened


@dataclass(frozen=True)
class BarrierLaw:
    """Parameters of the barrier.

    distance  : dhat [m]
    stiffness : kappa [J/m^2]
    friction  : Coulomb's mu
    stick     : slip speed [m/s] below which friction fades to nothing
    """

    distance: float
    stiffness: float
    friction: float
    stick: float


class Barrier:
    """Barrier of a surface (p, 3), by the positions S (p, 3) [m] of its points.

    edge : mean length of the surface's edges at rest [m]
    """

    def __init__(self, surface: Surface, law: BarrierLaw):
        import ipctk  # of the extra "contact"

        ipctk.set_num_threads(1)
        ipctk.set_logger_level(ipctk.LoggerLevel.off)
        self.ipctk, self.law = ipctk, law
        triangles = np.asfortranarray(surface.triangles, np.int32)
        edges = np.asfortranarray(ipctk.edges(triangles), np.int32)
        self.mesh = ipctk.CollisionMesh(np.asfortranarray(surface.points), edges, triangles)
        ends = surface.points[edges]
        self.edge = float(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).mean())
        barrier = ipctk.NormalizedClampedLogBarrier()
        self.potential = ipctk.BarrierPotential(barrier, law.distance, law.stiffness)
        self.ccd = ipctk.AdditiveCCD()

    def leave_out_neighbours(self, points: np.ndarray) -> int:
        """Let no pairs of points count that are near at rest for being neighbours on the surface, points (p, 3) [m] at
        rest; how many these are."""
        pairs = neighbours(self.candidates(points, 0.0), self.mesh, points, self.law.distance)
        if pairs:
            self.mesh.can_collide = self.ipctk.make_sparse_filter(pairs, True)
        return len(pairs)

    def candidates(self, points: np.ndarray, reach: float) -> "ipctk.Candidates":
        """Return all pairs that may be nearer than dhat once each point has moved by no more than ``reach`` [m]."""
        candidates = self.ipctk.Candidates()
        candidates.build(self.mesh, np.asfortranarray(points), 0.5 * self.law.distance + reach, self.ipctk.LBVH())
        return candidates

    def clear_reach(self, candidates: "ipctk.Candidates", points: np.ndarray, reach: float) -> float:
        """Return how far [m], up to ``reach``, each point may move until a pair comes as near as dhat; 0 where one
        is."""
        near = self._pairs(candidates, points, self.law.distance + 2 * reach)
        return reach if near.empty() else max(0.5 * (self.least(near, points) - self.law.distance), 0.0)

    def contacts(self, candidates: "ipctk.Candidates", points: np.ndarray) -> "ipctk.NormalCollisions":
        """Return the pairs nearer than dhat."""
        return self._pairs(candidates, points, self.law.distance)

    def _pairs(self, candidates: Any, points: np.ndarray, distance: float) -> "ipctk.NormalCollisions":
        pairs = self.ipctk.NormalCollisions()
        pairs.use_area_weighting = True
        pairs.build(candidates, self.mesh, np.asfortranarray(points), distance)
        return pairs

    def energy(self, contacts: "ipctk.NormalCollisions", points: np.ndarray) -> float:
        """Return the barrier's energy [J]."""
        return self.potential(contacts, self.mesh, np.asfortranarray(points))

    def gradient(self, contacts: "ipctk.NormalCollisions", points: np.ndarray) -> np.ndarray:
        """Return its gradient (p, 3) [N]."""
        return self.potential.gradient(contacts, self.mesh, np.asfortranarray(points)).reshape(-1, 3)

    def hessian(self, contacts: "ipctk.NormalCollisions", points: np.ndarray, projected: bool) -> "csc_matrix":
        """Return its Hessian (3p, 3p) [N/m]; ``projected`` leaves out the negative part of each pair."""
        kinds = self.ipctk.PSDProjectionMethod
        kind = kinds.CLAMP if projected else kinds.NONE
        return self.potential.hessian(contacts, self.mesh, np.asfortranarray(points), kind)

    def least(self, contacts: "ipctk.NormalCollisions", points: np.ndarray) -> float:
        """Return the least distance [m]; infinite where no pair is nearer than dhat."""
        return float(np.sqrt(contacts.compute_minimum_distance(self.mesh, np.asfortranarray(points))))

    def free_share(self, start: np.ndarray, moved: np.ndarray, candidates: "ipctk.Candidates | None") -> float:
        """Return the share, up to 1, of a straight way that points go from start (p, 3) by ``moved`` (p, 3) [m]
        without any meeting.

        candidates : pairs that may meet on it; None: they are looked for piece by piece
        """
        moved = moved - moved.mean(axis=0)
        if candidates is not None:
            share = self._share(start, start + moved, candidates)
            return share if share >= 1 else KEPT * share
        farthest = float(np.sqrt((moved**2).sum(axis=1).max()))
        whole = max(int(np.ceil(farthest / (PIECE * self.edge))), 1)
        for piece in range(min(whole, PIECES)):
            begin, end = (start + i / whole * moved for i in (piece, piece + 1))
            swept = self.ipctk.Candidates()
            swept.build(self.mesh, *map(np.asfortranarray, (begin, end)), 0.0, self.ipctk.LBVH())
            share = self._share(begin, end, swept)
            if share < 1:
                return KEPT * (piece + share) / whole
        return 1.0 if whole <= PIECES else PIECES / whole

    def _share(self, start: np.ndarray, end: np.ndarray, candidates: "ipctk.Candidates") -> float:
        start, end = np.asfortranarray(start), np.asfortranarray(end)
        return candidates.compute_collision_free_stepsize(self.mesh, start, end, 0.0, self.ccd)


def crossings(surface: Surface) -> np.ndarray:
    """Return the triangles (k,) that edges of others cross or that have such an edge, ascending."""
    barrier = Barrier(surface, BarrierLaw(1.0, 1.0, 0.0, 1.0))
    ipctk, mesh = barrier.ipctk, barrier.mesh
    points = surface.points
    phase = ipctk.LBVH()
    phase.can_vertices_collide = mesh.can_collide
    phase.build(np.asfortranarray(points), mesh.edges, mesh.faces)
    cut, crossing = set(), set()
    for pair in phase.detect_edge_face_candidates():
        edge, face = mesh.edges[pair.edge_id], mesh.faces[pair.face_id]
        if not set(edge) & set(face) and ipctk.is_edge_intersecting_triangle(*points[edge], *points[face]):
            crossing.add(pair.edge_id)
            cut.add(pair.face_id)
    cut |= set(np.flatnonzero(np.isin(mesh.faces_to_edges, list(crossing)).any(axis=1)).tolist())
    return np.array(sorted(cut), np.int64)
