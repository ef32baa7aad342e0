"""Coulomb's friction of nodes on obstacles.

It opposes the slip u, the way along the surface during the step, with mu N once |u| passes a small
e; N is the push on the node at the step's start, so that friction has a potential, mu N f(|u|),
with f(u) = u^2 / e - u^3 / (3 e^2) + e / 3 for u < e and u beyond (Li et al. 2020, Incremental
Potential Contact, Eq. 12 to 15). It is convex. Explicit substeps take it as a change of velocity.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from msmpetsc.backend.arrays import Floats, Indices, Mask, Positions, Rows, like
from msmpetsc.contact.obstacles.solids import TINY

STICK = 1e-2  # longest sides a second: friction holds but for a creep below this; 1e-3 took Newton 5 times as long

Pressed = tuple[Indices, Floats, Rows]


@dataclass(frozen=True)
class Friction:
    """Friction of one step.

    nodes   : (a,) those in contact; normal (a, 3) of the faces
    carried : (a, 3) where they are if they do not slip [m]
    limit   : (a,) mu N [N]
    stick   : e [m]
    """

    nodes: Indices
    normal: Rows
    carried: Positions
    limit: Floats
    stick: float

    def slip(self, q: Positions) -> tuple[Rows, Floats]:
        """Return the slip u (a, 3) and its length (a,) [m]."""
        moved = q[self.nodes] - self.carried
        u = moved - (moved * self.normal).sum(axis=1)[:, None] * self.normal
        return u, np.linalg.norm(u, axis=1)

    def change(self, q: Positions, base: Positions) -> float:
        """Return mu N (f(u) - f(u_0)) [J], from how far q is from base, so that a small change keeps its digits."""
        (u, length), (u_0, length_0), e = self.slip(q), self.slip(base), self.stick
        moved = (q - base)[self.nodes]  # u - u_0, but for a part along the normal, where u + u_0 has none
        longer = (moved * (u + u_0)).sum(axis=1) / np.maximum(length + length_0, np.finfo(float).tiny)
        low, low_0 = np.minimum(length, e), np.minimum(length_0, e)
        beyond = np.maximum(length, e) - np.maximum(length_0, e)
        within = np.where(np.maximum(length, length_0) < e, longer, low - low_0)
        beyond = np.where(np.minimum(length, length_0) >= e, longer, beyond)
        return float(
            self.limit @ (within * ((low + low_0) / e - (low**2 + low * low_0 + low_0**2) / (3 * e**2)) + beyond)
        )

    def slope(self, u: Floats) -> Floats:
        """Return f'(u) / u, (a,) [1/m]."""
        return np.where(u < self.stick, (2 - u / self.stick) / self.stick, 1 / np.maximum(u, self.stick))

    def add_gradient(self, q: Positions, gradient: Rows) -> None:
        """Add friction (a, 3) [N] to the rows of ``gradient`` (owned or more, 3) that it acts on."""
        u, length = self.slip(q)
        gradient[self.nodes] += (self.limit * self.slope(length))[:, None] * u

    def all_secant(self) -> Mask:
        """Return what ``blocks`` takes for all nodes to have their secants, (a,) bool."""
        return self.limit >= 0

    def passes_kink(self, q: Positions, base: Positions) -> Mask:
        """Return which nodes turn round or come to stick on their way from base to q, (a,) bool."""
        (u, length), (u_0, length_0) = self.slip(q), self.slip(base)
        passes: Mask = ((u * u_0).sum(axis=1) < 0) | ((length < self.stick) & (length_0 >= self.stick))
        return passes

    def blocks(self, q: Positions, true: bool, secant: Mask | None = None) -> Rows:
        """Return mu N (f'/u (I - n n^T) + (f'' - f'/u) d d^T), d the slip's direction, (a, 3, 3) [N/m].

        The second part is not positive; unless ``true``, or where ``secant`` (a,), it is left out. What is then left
        is no less than the Hessian, and as f is concave in u^2, its parabola nowhere lies below the potential.
        """
        u, length = self.slip(q)
        slope = self.slope(length)
        blocks = slope[:, None, None] * (like(q, np.eye(3)) - squares(self.normal))
        if true:
            direction = u / np.maximum(length, np.finfo(float).tiny)[:, None]
            curvature = np.where(length < self.stick, 2 * (1 - length / self.stick) / self.stick, 0.0)
            less = curvature - slope if secant is None else np.where(secant, 0.0, curvature - slope)
            blocks += less[:, None, None] * squares(direction)
        return self.limit[:, None, None] * blocks


def squares(vectors: Rows) -> Rows:
    """Return v v^T of each of the vectors (a, 3), (a, 3, 3)."""
    return vectors[:, :, None] * vectors[:, None, :]


class Movers(NamedTuple):
    """Nodes whose velocities change: positions q and velocities v (n, 3) [m], [m/s] of all, those
    that move as rows or (n,) bool, and 1 / mass (n,) [1/kg]."""

    q: Positions
    v: Rows
    rows: Indices | Mask
    per_mass: Floats


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
