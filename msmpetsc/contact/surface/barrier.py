"""Barrier between the triangles of surfaces, and its friction, by ipctk on a single rank.

Two parts of triangles closer than dhat have the energy kappa a b(d) (Li et al. 2020, Incremental
Potential Contact). Here a is an area of the surface and d the distance of the parts.
b = -2 ((d/dhat)^2 - 1)^2 ln(d/dhat) is smooth at dhat and unbounded at d = 0.

If several pairs share a place of contact, the place counts once (contact.surface.places). If all
pairs counted, aligned meshes would push each other aside. If the nearest pairs alone counted (Chen
et al. 2025, Offset Geometric Contact), line searches would fail as the nearest part changes.

Pairs in creases push from smaller distances (contact.surface.creases). Candidates and contacts are
therefore tuples with a set for each distance.

ipctk runs on a single thread, so that sums are reproducible. Its arrays are in Fortran's order.
"""

from dataclasses import dataclass
from itertools import compress
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Floats, Indices, Mask, Positions, Rows
from msmpetsc.comm import reduced
from msmpetsc.contact.friction import STICK
from msmpetsc.contact.surface.continuous_collision import candidates_on_paths
from msmpetsc.contact.surface.creases import creases, neighbours
from msmpetsc.contact.surface.places import CandidateSet, Places, without_fading_links
from msmpetsc.contact.surface.surface_friction import FrictionPairs, SurfaceFriction, friction_pairs
from msmpetsc.geometry.surface import Surface
from msmpetsc.lattice.lattice import Lattice
from msmpetsc.scene.obstacles import SelfContactTable

if TYPE_CHECKING:
    import ipctk
    from scipy.sparse import csc_matrix

# A set of candidates or contacts for each distance from which pairs push
CandidateSets: TypeAlias = tuple[CandidateSet, ...]
ContactSets: TypeAlias = "tuple[ipctk.NormalCollisions, ...]"

# Young's modulus over k_1 / h [-] (lattice.material)
PER_EDGE = 7 / 4


@dataclass(frozen=True)
class BarrierLaw:
    """Parameters of the barrier.

    distance  : dhat [m]
    stiffness : kappa [J/m^2]
    friction  : Coulomb's mu
    stick     : slip speed below which a contact sticks [m/s]
    """

    distance: float
    stiffness: float
    friction: float
    stick: float

    @classmethod
    def of_lattice(
        cls,
        distance: float,
        table: SelfContactTable,
        lattice: Lattice,
        time_step: float,
        side: float,
    ) -> "BarrierLaw":
        """Return the law of a lattice in steps of ``time_step`` [s] (collective).

        kappa / dhat^2 is a stiffness per area: the stiffness E / h of a layer of full cells, plus
        its inertia in a step, rho h / t^2. Ando (2024, A cubic barrier with elasticity-inclusive
        dynamic stiffness) computes both for each contact. Here the stiffest cell and the heaviest
        node give both for all contacts, so that the energy depends on positions alone.

        distance : dhat [m]
        side     : longest side of the smallest body [m]
        """
        comm, h = lattice.table.comm, lattice.cell_size
        mass = reduced(comm, float(lattice.mass.max(initial=0)), MPI.MAX)
        layer = (PER_EDGE * lattice.stiffest(comm) + mass / time_step**2) / h**2
        stick = table.friction_speed or STICK * side
        return cls(distance, float(distance**2 * layer), table.friction, stick)


class Barrier:
    """Barrier of a surface, as a function of positions S (p, 3) [m] of the surface's points.

    bodies       : number of points of bodies, which come first; obstacles do not meet each other
    meets_itself : False if bodies meet obstacles alone
    edge         : mean length of the bodies' edges at rest [m]
    """

    def __init__(self, surface: Surface, law: BarrierLaw, bodies: int, meets_itself: bool = True):
        # From the extra "contact"
        import ipctk

        ipctk.set_num_threads(1)
        ipctk.set_logger_level(ipctk.LoggerLevel.off)
        self.ipctk, self.law = ipctk, law
        triangles = np.asfortranarray(surface.triangles, np.int32)
        edges = np.asfortranarray(ipctk.edges(triangles), np.int32)
        self.mesh = ipctk.CollisionMesh(np.asfortranarray(surface.points), edges, triangles)
        obstacles = len(surface.points) - bodies
        if not meets_itself:
            self.mesh.can_collide = ipctk.make_vertex_patches_filter(
                np.repeat([0, 1], [bodies, obstacles])
            )
        elif obstacles:
            self.mesh.can_collide = ipctk.make_static_obstacle_filter(bodies)
        self.places = Places(self.mesh)
        ends = surface.points[edges[edges.max(axis=1) < bodies]]
        self.edge = float(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).mean())
        self.ccd = ipctk.AdditiveCCD()
        self.distances, self.potentials = [law.distance], [self._potential(law.distance)]
        # Pairs of creases for each distance; dhat, the first, has none
        self.creases: CandidateSets = (CandidateSet(ipctk.Candidates()),)

    def _potential(self, distance: float) -> "ipctk.BarrierPotential":
        """Return the barrier of a distance [m], with the law's stiffness per area."""
        stiffness = self.law.stiffness * (distance / self.law.distance) ** 2
        return self.ipctk.BarrierPotential(
            self.ipctk.NormalizedClampedLogBarrier(), distance, stiffness
        )

    def leave_out_neighbours(self, points: Positions) -> int:
        """Let pairs in creases push from smaller distances. Return the number of pairs too close.

        points : (p, 3) at rest [m]
        """
        pairs = neighbours(
            self.candidates(points, 0.0)[0].candidates, self.mesh, points, self.law.distance
        )
        if pairs:
            self.mesh.can_collide = self.mesh.can_collide & self.ipctk.make_sparse_filter(
                pairs, True
            )
        sets, dropped = creases(pairs, self.mesh, points, self.law.distance)
        self.creases += tuple(map(CandidateSet, sets.values()))
        self.distances += sets
        self.potentials += [self._potential(distance) for distance in sets]
        return dropped

    def crossings(self) -> Indices:
        """Return the triangles (k,) that cross another triangle at rest, ascending."""
        ipctk, mesh, points = self.ipctk, self.mesh, self.mesh.rest_positions
        phase = ipctk.LBVH()
        phase.can_vertices_collide = mesh.can_collide
        phase.build(points, mesh.edges, mesh.faces)
        cut, crossing = set(), set()
        for pair in phase.detect_edge_face_candidates():
            edge, face = mesh.edges[pair.edge_id], mesh.faces[pair.face_id]
            if not set(edge) & set(face) and ipctk.is_edge_intersecting_triangle(
                *points[edge], *points[face]
            ):
                crossing.add(pair.edge_id)
                cut.add(pair.face_id)
        cut |= set(
            np.flatnonzero(np.isin(mesh.faces_to_edges, list(crossing)).any(axis=1)).tolist()
        )
        return np.array(sorted(cut), np.int64)

    def touching(self, owner: Indices) -> list[tuple[int, int]]:
        """Return the pairs of bodies that are closer than dhat at rest.

        owner : (p,) number of each point's body
        """
        mesh, points, body_pairs = self.mesh, self.mesh.rest_positions, set()
        near = self.candidates(points, 0.0)[0].candidates
        for pair in (*near.fv_candidates, *near.ee_candidates):
            first, _, second, _ = owner[pair.vertex_ids(mesh.edges, mesh.faces)]
            far = pair.compute_distance(points, mesh.edges, mesh.faces) >= self.law.distance**2
            if first != second and not far:
                body_pairs.add((int(min(first, second)), int(max(first, second))))
        return sorted(body_pairs)

    def candidates(
        self, points: Positions, margin: float, moved: Rows | None = None
    ) -> CandidateSets:
        """Return the pairs that may come closer than dhat, and all pairs of creases.

        Each point may move by ``margin`` [m] from its place or from its straight path.

        points : (p, 3) [m]
        moved  : (p, 3) displacements along the paths [m]; None if points stay
        """
        near = self.law.distance + 2 * margin
        pairs = CandidateSet(candidates_on_paths(self.mesh, points, near, moved))
        return pairs, *self.creases[1:]

    def around(self, touched: Mask, points: Positions, margin: float) -> CandidateSets:
        """Return the candidate pairs of parts around points in contact.

        An edge or triangle counts if a corner is in ``touched`` or shares an edge with a touched
        point. The pairs are valid while points are at most ``margin`` [m] from ``points``.

        touched : (p,) bool, the points in contact
        points  : S (p, 3) [m]
        """
        ipctk, corners, near = self.ipctk, (self.mesh.edges, self.mesh.faces), touched.copy()
        near[corners[0][touched[corners[0]].any(axis=1)]] = True
        near_edges, near_faces = (near[of].any(axis=1) for of in corners)
        edges, faces = np.flatnonzero(near_edges), np.flatnonzero(near_faces)
        phase, candidates = ipctk.LBVH(), ipctk.Candidates()
        phase.can_vertices_collide = self.mesh.can_collide
        parts = (
            np.asfortranarray(of[chosen])
            for of, chosen in zip(corners, (edges, faces), strict=True)
        )
        phase.build(np.asfortranarray(points), *parts, 0.5 * self.law.distance + margin)
        ends = [(pair.edge0_id, pair.edge1_id) for pair in phase.detect_edge_edge_candidates()]
        candidates.ee_candidates = [ipctk.EdgeEdgeCandidate(edges[i], edges[j]) for i, j in ends]
        met = [(pair.face_id, pair.vertex_id) for pair in phase.detect_face_vertex_candidates()]
        candidates.fv_candidates = [ipctk.FaceVertexCandidate(faces[i], j) for i, j in met]
        sets = [candidates]
        for crease in self.creases[1:]:
            (face, vertex), pairs = crease.faces, crease.candidates
            meet, cross = near_faces[face] | near[vertex], near_edges[crease.edges].any(axis=0)
            sets.append(ipctk.Candidates())
            sets[-1].fv_candidates = list(compress(pairs.fv_candidates, meet))
            sets[-1].ee_candidates = list(compress(pairs.ee_candidates, cross))
        return tuple(map(CandidateSet, sets))

    def contacts(self, sets: CandidateSets, points: Positions) -> ContactSets:
        """Return the pairs that push at points (p, 3) [m]."""
        kinds = zip(sets, self.distances, strict=True)
        return tuple(self.places.build(pairs, points, distance) for pairs, distance in kinds)

    def _pushing(
        self, contacts: ContactSets
    ) -> "list[tuple[ipctk.BarrierPotential, ipctk.NormalCollisions]]":
        """Return the sets that are not empty, each with its barrier."""
        kinds = zip(self.potentials, contacts, strict=False)
        return [(potential, pairs) for potential, pairs in kinds if not pairs.empty()]

    def energy(self, contacts: ContactSets, points: Positions) -> float:
        """Return the energy [J] of contacts at points S (p, 3) [m]."""
        at = np.asfortranarray(points)
        return float(
            sum(potential(pairs, self.mesh, at) for potential, pairs in self._pushing(contacts))
        )

    def gradient(self, contacts: ContactSets, points: Positions) -> Rows:
        """Return the gradient (p, 3) [N] of the energy."""
        gradient, at = np.zeros(points.size), np.asfortranarray(points)
        for potential, pairs in self._pushing(contacts):
            gradient += potential.gradient(pairs, self.mesh, at)
        return gradient.reshape(-1, 3)

    def hessian(
        self, contacts: ContactSets, points: Positions, projected: bool
    ) -> "list[csc_matrix]":
        """Return the Hessian's terms (3p, 3p) [N/m], a term for each set that is not empty.

        projected : project the Hessian of each pair to be positive semidefinite
        """
        kinds, at = self.ipctk.PSDProjectionMethod, np.asfortranarray(points)
        if not projected:
            return [
                potential.hessian(pairs, self.mesh, at, kinds.NONE)
                for potential, pairs in self._pushing(contacts)
            ]
        pushing = [
            (potential, without_fading_links(pairs)) for potential, pairs in self._pushing(contacts)
        ]
        return [
            potential.hessian(pairs, self.mesh, at, kinds.CLAMP) for potential, pairs in pushing
        ]

    def friction(
        self, contacts: ContactSets, points: Positions, start: Positions, stick: float
    ) -> SurfaceFriction | None:
        """Return Coulomb friction with the normal forces at points (p, 3) [m]; None without pairs.

        start : (p, 3) positions of points without slip [m]
        stick : slip below which a pair sticks [m]
        """
        pairs = self._friction_pairs(contacts, points)
        if not len(pairs.push):
            return None
        limit, slips = self.law.friction * pairs.push, pairs.slips(points)
        return SurfaceFriction(limit, stick, np.zeros((1, 3)), start, pairs.numbers, slips)

    def friction_limits(self, contacts: ContactSets, points: Positions) -> tuple[Indices, Floats]:
        """Return the points (a, 4) of pairs, -1 for none, and mu N (a,) [N], at points (p, 3)."""
        pairs = self._friction_pairs(contacts, points)
        return pairs.numbers, self.law.friction * pairs.push

    def _friction_pairs(self, contacts: ContactSets, points: Positions) -> FrictionPairs:
        """Return the pairs with friction at points (p, 3) [m]."""
        collisions, at = [], np.asfortranarray(points)
        for potential, pairs in self._pushing(contacts):
            collisions.append(self.ipctk.TangentialCollisions())
            collisions[-1].build(self.mesh, at, pairs, potential, self.law.friction)
        return friction_pairs(collisions, self.mesh)

    def least(self, contacts: ContactSets, points: Positions) -> float:
        """Return the least distance [m] of contacts; infinite without contacts."""
        at = self.mesh, np.asfortranarray(points)
        squares = [pairs.compute_minimum_distance(*at) for _, pairs in self._pushing(contacts)]
        return float(np.sqrt(min(squares, default=np.inf)))

    def nearest(self, contacts: ContactSets, points: Positions) -> Indices:
        """Return the numbers (k,) of the closest pair's points; empty without contacts."""
        parts, at = (self.mesh.edges, self.mesh.faces), np.asfortranarray(points)
        pairs = [near[i] for _, near in self._pushing(contacts) for i in range(len(near))]
        nearest = min(pairs, key=lambda pair: pair.compute_distance(at, *parts), default=None)
        numbers = [] if nearest is None else [i for i in nearest.vertex_ids(*parts) if i >= 0]
        return np.array(numbers, np.int64)
