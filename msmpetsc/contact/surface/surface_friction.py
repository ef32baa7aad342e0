"""Friction between parts of surfaces in one step, with the law of contact.friction.

The contact points, normal and normal force of a pair are fixed in a solve (Li et al. 2020,
Incremental Potential Contact, section 5.3). So the slip of a pair is linear in the points.
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import bsr_array, csr_array
from scipy.sparse.csgraph import connected_components

from msmpetsc.backend.arrays import Floats, Indices, Positions, Rows
from msmpetsc.contact.friction import Friction, squares

if TYPE_CHECKING:
    import ipctk


@dataclass(frozen=True)
class FrictionPairs:
    """Pairs of parts that press on each other.

    numbers : (a, 4) points of each pair: of its first part, then of its second; -1 for none
    weights : (a, 4) weights of these points in the vector from the second part to the first
    push    : (a,) normal force N [N]
    """

    numbers: Indices
    weights: Rows
    push: Floats

    def slips(self, points: Positions) -> bsr_array:
        """Return the matrix (3a, 3p) from displacements to slips, for normals at points (p, 3)."""
        gap = np.einsum("ai,aic->ac", self.weights, points[self.numbers])
        normal = gap / np.linalg.norm(gap, axis=1)[:, None]
        plane = np.eye(3) - squares(normal)
        of_pair, corner = np.nonzero(self.numbers >= 0)
        begin = np.append(0, np.cumsum((self.numbers >= 0).sum(axis=1)))
        blocks = self.weights[of_pair, corner, None, None] * plane[of_pair]
        shape = 3 * len(self.numbers), points.size
        return bsr_array((blocks, self.numbers[of_pair, corner], begin), shape=shape)


@dataclass(frozen=True)
class SurfaceFriction(Friction):
    """Friction of pairs of a surface's parts.

    start : (p, 3) positions of points without slip [m]
    pairs : (a, 4) points of each pair, -1 for none (``FrictionPairs``)
    slips : (3a, 3p) matrix that maps displacements of all points to slips of pairs
    """

    start: Positions
    pairs: Indices
    slips: bsr_array

    def along(self, moved: Rows) -> Rows:
        slip: Rows = (self.slips @ moved.ravel()).reshape(-1, 3)
        return slip

    def slip(self, q: Positions) -> tuple[Rows, Floats]:
        u = self.begin + self.along(q - self.start)
        return u, np.linalg.norm(u, axis=1)

    def after(self, last: "SurfaceFriction | None", points: Positions) -> "SurfaceFriction":
        """Return friction that continues the last step's friction at points (p, 3) [m]."""
        return (
            replace(self, begin=self.values_of(last.pairs, last.elastic_slip(points, self.stick)))
            if last
            else self
        )

    def values_of(self, pairs: Indices, values: Rows) -> Rows:
        """Return values (a, ...) for this friction's pairs; 0 for pairs that are not in ``pairs``.

        pairs  : (k, 4) points of known pairs
        values : (k, ...) their values
        """
        known = dict(zip(map(tuple, pairs.tolist()), values, strict=True))
        nothing = np.zeros(values.shape[1:])
        return np.array([known.get(tuple(pair), nothing) for pair in self.pairs.tolist()])

    def gradient(self, points: Positions) -> Rows:
        """Return the gradient (p, 3) [N] at points (p, 3) [m]."""
        gradient: Rows = (self.slips.T @ self.force(points).ravel()).reshape(-1, 3)
        return gradient

    def hessian(self, points: Positions, duals: Rows | None = None) -> csr_array:
        """Return the Hessian (3p, 3p) [N/m] at points (p, 3) [m].

        duals : (a, 3) duals of friction; None for the true Hessian
        """
        blocks = self.curvature(points, np.eye(3)[None], duals)
        middle = bsr_array((blocks, np.arange(len(blocks)), np.arange(len(blocks) + 1)))
        return csr_array(self.slips.T @ (middle @ self.slips))


def friction_pairs(
    collisions: "list[ipctk.TangentialCollisions]", mesh: "ipctk.CollisionMesh"
) -> FrictionPairs:
    """Return the pairs that push in several sets. Links of negative weight reduce their pushes.

    Two vertices, or two edges, are ordered by their first points, since ipctk's order varies.
    """
    point, edge, face = np.arange(mesh.num_vertices)[:, None], mesh.edges, mesh.faces
    numbers, weights, push = [np.empty((0, 4), int)], [np.empty((0, 4))], [np.empty(0)]
    for built in collisions:
        # Each kind is a copy: a loop over ``built`` itself may crash (ipctk 1.6)
        for pairs, *parts in (
            (built.vv_collisions, ("vertex0_id", point), ("vertex1_id", point)),
            (built.ev_collisions, ("vertex_id", point), ("edge_id", edge)),
            (built.ee_collisions, ("edge0_id", edge), ("edge1_id", edge)),
            (built.fv_collisions, ("vertex_id", point), ("face_id", face)),
        ):
            if not pairs:
                continue
            (first, of_first), (second, of_second) = (
                (corners, corners[[getattr(pair, name) for pair in pairs]])
                for name, corners in parts
            )
            sides = np.split(
                np.array([pair.closest_point for pair in pairs]), [of_first.shape[1] - 1], axis=1
            )
            one, other = (np.column_stack([1 - side.sum(axis=1), side]) for side in sides)
            if first is second:
                turned = (of_first[:, 0] > of_second[:, 0])[:, None]
                of_first, of_second = (
                    np.where(turned, of_second, of_first),
                    np.where(turned, of_first, of_second),
                )
                one, other = np.where(turned, other, one), np.where(turned, one, other)
            missing = (0, 0), (0, 4 - of_first.shape[1] - of_second.shape[1])
            numbers.append(np.pad(np.hstack([of_first, of_second]), missing, constant_values=-1))
            weights.append(np.pad(np.hstack([one, -other]), missing))
            push.append(np.array([pair.weight * pair.normal_force_magnitude for pair in pairs]))
    every, pushes = np.concatenate(numbers), np.concatenate(push)
    kept = pushes > 0
    lessened = _less_links(every, pushes, mesh.num_vertices)
    return FrictionPairs(every[kept], np.concatenate(weights)[kept], lessened[kept])


def _less_links(numbers: Indices, push: Floats, points: int) -> Floats:
    """Return pushes (a,) [N], scaled so that their positive part keeps the sum of each patch.

    numbers : (a, 4) points of each pair, -1 for none; pairs that share points form a patch
    push    : (a,) normal forces [N], negative for links
    """
    pair, corner = np.nonzero(numbers >= 0)
    touching = csr_array(
        (np.ones(len(pair)), (pair, numbers[pair, corner])), shape=(len(push), points)
    )
    patch = connected_components(touching @ touching.T)[1]
    given, taken = (np.bincount(patch, np.maximum(part, 0)) for part in (push, -push))
    lessened: Floats = push * np.maximum(1 - taken / np.where(given > 0, given, 1), 0)[patch]
    return lessened
