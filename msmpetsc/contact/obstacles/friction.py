"""Coulomb's friction of nodes on obstacles, and its law.

It opposes the slip u with mu N once |u| passes a small e, and has a potential, mu N f(|u|), with f(u) = u^2 / e -
u^3 / (3 e^2) + e / 3 for u < e and u beyond (Li et al. 2020, Incremental Potential Contact, Eq. 12 to 15), for N is
known before the step is solved. It is convex.

There the slip is that of one step, so that what holds creeps. Here it goes on from step to step, by e at most, as an
elastic slip does (Simo and Laursen 1992, An augmented Lagrangian treatment of contact problems involving friction):
what holds stays where it is.

Newton's method has the force p of a slip, in mu N, as an unknown of its own, the dual: p = (f'/u) u, linearised in both
(Chan, Golub and Mulet 1999, A nonlinear primal-dual method for total variation-based image restoration, SIAM J. Sci.
Comput. 20). Beyond its stick a slip has no curvature along itself: a step by the true Hessian may turn it round, far
too far. While p lies another way there is more, and where p is the slip's own force it is the true one.

Explicit substeps take friction as a change of velocity.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from msmpetsc.backend.arrays import Floats, Indices, Positions, Rows, like
from msmpetsc.contact.obstacles.solids import TINY

STICK = 1e-2  # of the smallest body, longest sides a second: what friction holds gives way so far in a step
WEAK = (
    1e-100  # f' below which it is as good as none; the square of what is divided by it has a number
)

Pressed = tuple[Indices, Floats, Rows]


@dataclass(frozen=True)
class Friction:
    """Friction of one step: what is the same of nodes on an obstacle and of parts of surfaces on each other.

    limit : (a,) mu N [N]
    stick : e [m]
    begin : (a or 1, 3) elastic slips with which the step begins [m]
    """

    limit: Floats
    stick: float
    begin: Rows

    def along(self, moved: Rows) -> Rows:
        """Return the slip (a, 3) [m] that positions' moves (n, 3) [m] are."""
        raise NotImplementedError

    def slip(self, q: Positions) -> tuple[Rows, Floats]:
        """Return the slip u (a, 3) of positions (n, 3) and its length (a,) [m]."""
        raise NotImplementedError

    def change(self, q: Positions, base: Positions, moved: Rows | None = None) -> float:
        """Return mu N (f(u) - f(u_0)) [J], by how far q is from base, so that a small change keeps its digits.

        moved : (n, 3) [m] q - base, where more digits of it are known
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
        """Return the elastic slips (a, 3) [m] that a step from positions q (n, 3) begins with, whose e is ``stick``."""
        u, length = self.slip(q)
        return u * (stick / np.maximum(length, self.stick))[:, None]

    def released(self, q: Positions) -> float:
        """Return how much less energy [J] elastic slips store at q than where the step begins."""
        ends = np.linalg.norm(self.begin, axis=1), np.minimum(self.slip(q)[1], self.stick)
        begin, end = (length**2 / self.stick - length**3 / (3 * self.stick**2) for length in ends)
        return float(self.limit @ (begin - end))

    def force(self, q: Positions) -> Rows:
        """Return the gradient by the slip, mu N f'(|u|) u / |u|, (a, 3) [N]."""
        u, length = self.slip(q)
        return (self.limit * self.slope(length))[:, None] * u

    def no_duals(self) -> Rows:
        """Return duals (a, 3) by which ``curvature`` is that of the secants: as f is concave in u^2, their parabolas
        nowhere lie below the potential."""
        return np.zeros((len(self.limit), 3), like=self.limit)

    def duals_after(self, q: Positions, base: Positions, duals: Rows | None) -> Rows:
        """Return the duals (a, 3) that the full step from base to q leads to, no longer than 1; None: the forces."""
        (u, _), (u_0, length_0) = self.slip(q), self.slip(base)
        slope, tiny = self.slope(length_0), np.finfo(float).tiny
        before = slope[:, None] * u_0 if duals is None else duals
        along = (u_0 * (u - u_0)).sum(axis=1) / np.maximum(length_0, tiny)
        turned = self._bend(length_0) / np.maximum(slope * length_0, tiny) * along
        return shortened(slope[:, None] * u + turned[:, None] * before)

    def curvature(self, q: Positions, plane: Rows, duals: Rows | None) -> Rows:
        """Return mu N (f'/u (I - n n^T) + (f'' - f'/u) (w d^T + d w^T) / 2), (a, 3, 3) [N/m].

        d is the slip's direction and w = p / f' the dual's, no longer than 1, so that no block is negative.

        plane : I - n n^T (a or 1, 3, 3)
        duals : p (a, 3); None: the forces, w = d, which is the Hessian
        """
        u, length = self.slip(q)
        slope = self.slope(length)
        d = u / np.maximum(length, np.finfo(float).tiny)[:, None]
        w = d if duals is None else shortened(duals / np.maximum(slope * length, WEAK)[:, None])
        mixed = 0.5 * (w[:, :, None] * d[:, None, :] + d[:, :, None] * w[:, None, :])
        blocks: Rows = slope[:, None, None] * plane + self._bend(length)[:, None, None] * mixed
        return self.limit[:, None, None] * blocks

    def _bend(self, u: Floats) -> Floats:
        """Return f'' - f' / u, (a,) [1/m], which is not positive."""
        bend: Floats = np.where(u < self.stick, 2 * (1 - u / self.stick) / self.stick, 0.0)
        bend -= self.slope(u)
        return bend


@dataclass(frozen=True)
class NodeFriction(Friction):
    """Friction of nodes on an obstacle.

    nodes   : (a,) those in contact; normal (a, 3) of the faces
    carried : (a, 3) where they are if they do not slip [m]
    """

    nodes: Indices
    normal: Rows
    carried: Positions

    def after(self, last: "NodeFriction | None", q: Positions) -> "NodeFriction":
        """Return friction of a step from q (owned, 3) [m] where ``last`` was that of the step before, if any."""
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
        """Add friction (a, 3) [N] to the rows of ``gradient`` (owned or more, 3) it acts on."""
        gradient[self.nodes] += self.force(q)

    def blocks(self, q: Positions, duals: Rows | None) -> Rows:
        """Return the Hessian's blocks of the nodes (a, 3, 3) [N/m], as ``curvature`` has them."""
        return self.curvature(q, like(q, np.eye(3)) - squares(self.normal), duals)


def squares(vectors: Rows) -> Rows:
    """Return v v^T of each of the vectors (a, 3), (a, 3, 3)."""
    return vectors[:, :, None] * vectors[:, None, :]


def shortened(vectors: Rows) -> Rows:
    """Return vectors (a, 3), those longer than 1 shortened to it."""
    short: Rows = vectors / np.maximum(np.linalg.norm(vectors, axis=1), 1.0)[:, None]
    return short


def smallest(bounds: Rows) -> float:
    """Return the longest side [m] of the smallest of bodies, by their bounds (b, 2, 3) [m]."""
    return float((bounds[:, 1] - bounds[:, 0]).max(axis=1).min())


class Movers(NamedTuple):
    """Nodes whose velocities change: positions q and velocities v (n, 3) [m], [m/s] of all, the rows
    of those that move, 1 / mass (n,) [1/kg], and grad E (n or more, 3) [N]."""

    q: Positions
    v: Rows
    rows: Indices
    per_mass: Floats
    gradient: Rows


def apply_friction(nodes: Movers, pressed: Pressed, carried: Rows, impulse: float) -> None:
    """Apply Coulomb friction to nodes inside an obstacle, as a change of velocity.

    v (n, 3) [m/s] along the face, as seen from an obstacle that moves at ``carried`` (3,) [m/s],
    falls by no more than the friction's impulse a mass, mu N dt / m, and not below nothing: so what
    holds does not creep, however long the substep.

    pressed : of the nodes, the rows (a,) inside, how deep (a,) [m] and the normals (a, 3) there
    impulse : mu k dt [kg/s], times the depth the impulse
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
