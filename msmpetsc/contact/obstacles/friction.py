"""Coulomb's friction of nodes on obstacles, and its law.

Friction opposes the slip u with mu N once |u| passes a small e. Its potential is mu N f(|u|) with
f(u) = u^2 / e - u^3 / (3 e^2) + e / 3 for u < e, and f(u) = u beyond (Li et al. 2020, Incremental
Potential Contact, Eq. 12 to 15). N is known before the step is solved, so the potential is convex.

In that paper the slip is that of one step, so that a sticking node creeps. Here the slip goes on
from step to step as an elastic slip of e at most (Simo and Laursen 1992, An augmented Lagrangian
treatment of contact problems involving friction). So a sticking node stays in place.

Newton's method has a dual for each slip: its force p / (mu N) = (f'/u) u is an unknown of its own,
and the equation is linearised in both (Chan, Golub and Mulet 1999, A nonlinear primal-dual method
for total variation-based image restoration, SIAM J. Sci. Comput. 20). Beyond its stick a slip has
no curvature along itself, so a step by the true Hessian may reverse the slip, far too far. The
primal-dual Hessian has curvature along the slip while p points elsewhere. It is the true Hessian
once p is the slip's own force.

Explicit substeps treat friction as a change of velocity.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from msmpetsc.backend.arrays import Floats, Indices, Positions, Rows, like
from msmpetsc.contact.obstacles.solids import TINY

# Stick speed, in longest sides of the smallest body per second
STICK = 1e-2
# f' below which friction counts as none; the square of a quotient by it is still finite
WEAK = 1e-100

Pressed = tuple[Indices, Floats, Rows]


@dataclass(frozen=True)
class Friction:
    """Friction of one step: base of node friction and surface friction.

    limit : (a,) mu N [N]
    stick : e [m]
    begin : (a or 1, 3) elastic slips at the start of the step [m]
    """

    limit: Floats
    stick: float
    begin: Rows

    def along(self, moved: Rows) -> Rows:
        """Return the slips (a, 3) [m] of displacements (n, 3) [m]."""
        raise NotImplementedError

    def slip(self, q: Positions) -> tuple[Rows, Floats]:
        """Return the slips u (a, 3) [m] of positions (n, 3) [m] and their lengths (a,) [m]."""
        raise NotImplementedError

    def change(self, q: Positions, base: Positions, moved: Rows | None = None) -> float:
        """Return mu N (f(u) - f(u_0)) [J] from base to q, with all digits of a small change.

        moved : (n, 3) [m] q - base, if more digits of it are known
        """
        (u, length), (u_0, length_0), e = self.slip(q), self.slip(base), self.stick
        moved = self.along(q - base if moved is None else moved)
        longer = (moved * (u + u_0)).sum(axis=1) / np.maximum(
            length + length_0, np.finfo(float).tiny
        )
        low, low_0 = np.minimum(length, e), np.minimum(length_0, e)
        beyond = np.maximum(length, e) - np.maximum(length_0, e)
        within = np.where(np.maximum(length, length_0) < e, longer, low - low_0)
        beyond = np.where(np.minimum(length, length_0) >= e, longer, beyond)
        return float(
            self.limit
            @ (
                within * ((low + low_0) / e - (low**2 + low * low_0 + low_0**2) / (3 * e**2))
                + beyond
            )
        )

    def slope(self, u: Floats) -> Floats:
        """Return f'(u) / u, (a,) [1/m]."""
        return np.where(
            u < self.stick, (2 - u / self.stick) / self.stick, 1 / np.maximum(u, self.stick)
        )

    def held(self, q: Positions, stick: float) -> Rows:
        """Return the elastic slips (a, 3) [m] at q (n, 3) for a step with e = ``stick`` [m]."""
        u, length = self.slip(q)
        return u * (stick / np.maximum(length, self.stick))[:, None]

    def released(self, q: Positions) -> float:
        """Return the energy [J] of elastic slips at the start of the step minus that at q."""
        ends = np.linalg.norm(self.begin, axis=1), np.minimum(self.slip(q)[1], self.stick)
        begin, end = (length**2 / self.stick - length**3 / (3 * self.stick**2) for length in ends)
        return float(self.limit @ (begin - end))

    def force(self, q: Positions) -> Rows:
        """Return the gradient by the slip, mu N f'(|u|) u / |u| (a, 3) [N]."""
        u, length = self.slip(q)
        return (self.limit * self.slope(length))[:, None] * u

    def no_duals(self) -> Rows:
        """Return the duals (a, 3) with which ``curvature`` is that of the secants.

        As f is concave in u^2, the parabolas of the secants are nowhere below the potential.
        """
        return np.zeros((len(self.limit), 3), like=self.limit)

    def duals_after(self, q: Positions, base: Positions, duals: Rows | None) -> Rows:
        """Return the duals (a, 3), at most 1 long, after the full step from base to q.

        duals : before the step; None for the forces of the slips
        """
        (u, _), (u_0, length_0) = self.slip(q), self.slip(base)
        slope, tiny = self.slope(length_0), np.finfo(float).tiny
        before = slope[:, None] * u_0 if duals is None else duals
        along = (u_0 * (u - u_0)).sum(axis=1) / np.maximum(length_0, tiny)
        turned = self._bend(length_0) / np.maximum(slope * length_0, tiny) * along
        return shortened(slope[:, None] * u + turned[:, None] * before)

    def curvature(self, q: Positions, plane: Rows, duals: Rows | None) -> Rows:
        """Return mu N (f'/u (I - n n^T) + (f'' - f'/u) (w d^T + d w^T) / 2), (a, 3, 3) [N/m].

        d is the slip's direction. w = p / f' is the dual, at most 1 long, so that no block is
        negative.

        plane : I - n n^T (a or 1, 3, 3)
        duals : p (a, 3); None for the slip's own force, w = d, which gives the Hessian
        """
        u, length = self.slip(q)
        slope = self.slope(length)
        d = u / np.maximum(length, np.finfo(float).tiny)[:, None]
        w = d if duals is None else shortened(duals / np.maximum(slope * length, WEAK)[:, None])
        mixed = 0.5 * (w[:, :, None] * d[:, None, :] + d[:, :, None] * w[:, None, :])
        blocks: Rows = slope[:, None, None] * plane + self._bend(length)[:, None, None] * mixed
        return self.limit[:, None, None] * blocks

    def _bend(self, u: Floats) -> Floats:
        """Return f'' - f' / u (a,) [1/m], which is not positive."""
        bend: Floats = np.where(u < self.stick, 2 * (1 - u / self.stick) / self.stick, 0.0)
        bend -= self.slope(u)
        return bend


@dataclass(frozen=True)
class NodeFriction(Friction):
    """Friction of nodes on an obstacle.

    nodes   : (a,) in contact
    normal  : (a, 3) of the faces
    carried : (a, 3) positions of the nodes without slip [m]
    """

    nodes: Indices
    normal: Rows
    carried: Positions

    def after(self, last: "NodeFriction | None", q: Positions) -> "NodeFriction":
        """Return friction that goes on from ``last``, that of the last step, at q (owned, 3) [m]."""
        held = np.zeros_like(q)
        if last:
            held[last.nodes] = last.held(q, self.stick)
        return replace(self, begin=self._tangential(held[self.nodes]))

    def along(self, moved: Rows) -> Rows:
        return self._tangential(moved[self.nodes])

    def slip(self, q: Positions) -> tuple[Rows, Floats]:
        u = self.begin + self._tangential(q[self.nodes] - self.carried)
        return u, np.linalg.norm(u, axis=1)

    def _tangential(self, moved: Rows) -> Rows:
        tangential: Rows = moved - (moved * self.normal).sum(axis=1)[:, None] * self.normal
        return tangential

    def add_gradient(self, q: Positions, gradient: Rows) -> None:
        """Add the forces (a, 3) [N] to the nodes' rows of ``gradient`` (owned or more, 3)."""
        gradient[self.nodes] += self.force(q)

    def blocks(self, q: Positions, duals: Rows | None) -> Rows:
        """Return the blocks (a, 3, 3) [N/m] of the nodes, by ``curvature``."""
        return self.curvature(q, like(q, np.eye(3)) - squares(self.normal), duals)


def squares(vectors: Rows) -> Rows:
    """Return v v^T (a, 3, 3) of vectors (a, 3)."""
    return vectors[:, :, None] * vectors[:, None, :]


def shortened(vectors: Rows) -> Rows:
    """Return vectors (a, 3) shortened to length 1 if they are longer."""
    short: Rows = vectors / np.maximum(np.linalg.norm(vectors, axis=1), 1.0)[:, None]
    return short


def smallest(bounds: Rows) -> float:
    """Return the longest side [m] of the smallest body, by bounds (b, 2, 3) [m] of all bodies."""
    return float((bounds[:, 1] - bounds[:, 0]).max(axis=1).min())


class Movers(NamedTuple):
    """Nodes whose velocities change.

    q        : (n, 3) positions of all nodes [m]
    v        : (n, 3) velocities of all nodes [m/s]
    rows     : of the nodes that move
    per_mass : (n,) 1 / mass [1/kg]
    gradient : (n or more, 3) grad E [N]
    """

    q: Positions
    v: Rows
    rows: Indices
    per_mass: Floats
    gradient: Rows


def apply_friction(nodes: Movers, pressed: Pressed, carried: Rows, impulse: float) -> None:
    """Apply Coulomb friction to nodes inside an obstacle, as a change of velocity.

    The tangential velocity relative to the obstacle falls by mu N dt / m, at most to 0. So sticking
    nodes do not creep, however long the substep.

    pressed : rows (a,) of the nodes inside, their depths (a,) [m] and normals (a, 3)
    carried : (3,) velocity of the obstacle [m/s]
    impulse : mu k dt [kg/s]; times the depth it is the impulse
    """
    v = nodes.v
    moves = np.zeros(len(v), bool, like=v)
    moves[nodes.rows] = True
    rows, depth, normal = pressed
    own = moves[rows]
    rows, depth, normal = rows[own], depth[own], normal[own]
    slip = v[rows] - carried
    slip -= (slip * normal).sum(axis=1)[:, None] * normal
    speed = np.maximum(np.linalg.norm(slip, axis=1), TINY)
    v[rows] -= np.minimum(1.0, impulse * depth * nodes.per_mass[rows] / speed)[:, None] * slip
