"""Friction between parts of surfaces in one step, of the same law as an obstacle's (contact.obstacles.friction).

A pair of parts has its points of contact, its normal and its push from one moment (Li et al. 2020, Incremental
Potential Contact, section 5.3); its slip is then linear in the points.
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import bsr_array, coo_array, csr_array

from msmpetsc.backend.arrays import Floats, Indices, Mask, Positions, Rows
from msmpetsc.contact.obstacles.friction import Friction

if TYPE_CHECKING:
    import ipctk

    Tangential = list[ipctk.TangentialCollision]


@dataclass(frozen=True)
class SurfaceFriction(Friction):
    """Friction of pairs of a surface's parts.

    start : (p, 3) where points are if nothing slips [m]
    pairs : (a, 4) points of each, -1 for none (``ordered``)
    slips : (3a, 3p) of moves of all points the slip of each pair
    """

    start: Positions
    pairs: Indices
    slips: csr_array

    def along(self, moved: Rows) -> Rows:
        slip: Rows = (self.slips @ moved.ravel()).reshape(-1, 3)
        return slip

    def slip(self, q: Positions) -> tuple[Rows, Floats]:
        u = self.begin + self.along(q - self.start)
        return u, np.linalg.norm(u, axis=1)

    def after(self, last: "SurfaceFriction | None", points: Positions) -> "SurfaceFriction":
        """Return friction of a step from points (p, 3) [m] where ``last`` was that of the step before, if any."""
        return replace(self, begin=self.values_of(last.pairs, last.held(points, self.stick))) if last else self

    def values_of(self, pairs: Indices, values: Rows) -> Rows:
        """Return of values (k, 3) of other ``pairs`` (k, 4) those of these, (a, 3), 0 where there are none."""
        known = dict(zip(map(tuple, pairs.tolist()), values, strict=True))
        nothing = np.zeros(values.shape[1:])
        return np.array([known.get(tuple(pair), nothing) for pair in self.pairs.tolist()])

    def gradient(self, points: Positions) -> Rows:
        """Return the gradient (p, 3) [N] at the points."""
        gradient: Rows = (self.slips.T @ self.force(points).ravel()).reshape(-1, 3)
        return gradient

    def hessian(self, points: Positions, duals: Rows | None = None) -> csr_array:
        """Return the Hessian (3p, 3p) [N/m] at the points, as ``curvature`` has it of duals (a, 3)."""
        blocks = self.curvature(points, np.eye(3)[None], duals)
        middle = bsr_array((blocks, np.arange(len(blocks)), np.arange(len(blocks) + 1)))
        return csr_array(self.slips.T @ (middle @ self.slips))


def slips_of(tangential: "Tangential", mesh: "ipctk.CollisionMesh") -> csr_array:
    """Return the slips (3a, 3p) of pairs, each along the plane of its contact."""
    rows, columns, values, named = [], [], [], _named(tangential, mesh)
    for number, (pair, turned) in enumerate(zip(tangential, _turned(tangential, named), strict=True)):
        along = pair.tangent_basis @ (pair.tangent_basis.T @ pair.relative_velocity_jacobian())
        own = named[number, : pair.num_vertices()]
        rows.append(np.repeat(3 * number + np.arange(3), along.shape[1]))
        columns.append(np.tile((3 * own[:, None] + np.arange(3)).ravel(), 3))
        values.append(-along.ravel() if turned else along.ravel())
    at = np.concatenate(rows), np.concatenate(columns)
    return csr_array(coo_array((np.concatenate(values), at), shape=(3 * len(named), 3 * mesh.num_vertices)))


def limits_of(tangential: "Tangential", mesh: "ipctk.CollisionMesh") -> tuple[Indices, Floats]:
    """Return the points (a, 4) of pairs, -1 for none, and their mu N (a,) [N].

    Of two points or edges that one stands first whose first number is less, for ipctk has them as they were found.
    """
    named = _named(tangential, mesh)
    order = np.where((named[:, 3] < 0)[:, None], [1, 0, 2, 3], [2, 3, 0, 1])
    turned = np.take_along_axis(named, order, 1)
    pairs = np.where(_turned(tangential, named)[:, None], turned, named)
    return pairs, np.array([pair.mu_s * pair.weight * pair.normal_force_magnitude for pair in tangential])


def _named(tangential: "Tangential", mesh: "ipctk.CollisionMesh") -> Indices:
    """Return the points (a, 4) of pairs, -1 for none, as ipctk has them."""
    return np.array([pair.vertex_ids(mesh.edges, mesh.faces) for pair in tangential], int).reshape(-1, 4)


def _turned(tangential: "Tangential", named: Indices) -> Mask:
    """Return which pairs (a,) of two points or edges have the greater number first: what slips is then the other."""
    of_edges = np.array([hasattr(pair, "edge0_id") for pair in tangential], bool)
    second = np.where(of_edges, named[:, 2], named[:, 1])
    turned: Mask = (of_edges | (named[:, 2] < 0)) & (named[:, 0] > second)
    return turned
