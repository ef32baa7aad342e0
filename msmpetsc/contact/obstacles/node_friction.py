"""Coulomb friction of nodes on obstacles.

Implicit steps use the law of contact.friction. Explicit substeps apply friction as a change of
velocity.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from msmpetsc.backend.arrays import Floats, Indices, Positions, Rows, like
from msmpetsc.contact.friction import Friction, squares
from msmpetsc.contact.obstacles.solids import TINY

# rows (a,) of pressed nodes, their depths (a,) [m] and normals (a, 3)
Pressed = tuple[Indices, Floats, Rows]


@dataclass(frozen=True)
class NodeFriction(Friction):
    """Friction of nodes on an obstacle.

    nodes   : (a,) nodes in contact
    normal  : (a, 3) unit normals of the faces
    carried : (a, 3) positions of the nodes without slip [m]
    """

    nodes: Indices
    normal: Rows
    carried: Positions

    def after(self, last: "NodeFriction", q: Positions) -> "NodeFriction":
        """Return the friction that begins with the last step's elastic slips, at q (owned, 3)."""
        slips = np.zeros_like(q)
        slips[last.nodes] = last.elastic_slip(q, self.stick)
        return replace(self, begin=self._tangential(slips[self.nodes]))

    def along(self, moved: Rows) -> Rows:
        return self._tangential(moved[self.nodes])

    def slip(self, q: Positions) -> tuple[Rows, Floats]:
        u = self.begin + self._tangential(q[self.nodes] - self.carried)
        return u, np.linalg.norm(u, axis=1)

    def _tangential(self, moved: Rows) -> Rows:
        tangential: Rows = moved - (moved * self.normal).sum(axis=1)[:, None] * self.normal
        return tangential

    def add_gradient(self, q: Positions, gradient: Rows) -> None:
        """Add the friction's gradient [N] at q to ``gradient`` (owned or more, 3)."""
        gradient[self.nodes] += self.force(q)

    def blocks(self, q: Positions, duals: Rows | None) -> Rows:
        """Return the Hessian's blocks (a, 3, 3) [N/m] of the nodes (see ``curvature``)."""
        return self.curvature(q, like(q, np.eye(3)) - squares(self.normal), duals)


class Movers(NamedTuple):
    """The state of an explicit substep.

    v        : (n, 3) velocities [m/s], which a substep changes
    rows     : nodes that move
    per_mass : (n,) 1 / mass [1/kg]
    gradient : (n or more, 3) grad E [N]
    """

    v: Rows
    rows: Indices
    per_mass: Floats
    gradient: Rows


def apply_friction(nodes: Movers, pressed: Pressed, carried: Rows, impulse: float) -> None:
    """Apply Coulomb friction to nodes inside an obstacle, as a change of velocity.

    The tangential speed relative to the obstacle decreases by mu N dt / m, but not below zero. So
    a sticking contact does not creep, however long the substep is.

    pressed : rows (a,) of the nodes inside, their depths (a,) [m] and the normals (a, 3)
    carried : (3,) velocity of the obstacle [m/s]
    impulse : mu k dt [kg/s], impulse of friction per depth
    """
    v = nodes.v
    moves = np.zeros(len(v), bool, like=v)
    moves[nodes.rows] = True
    rows, depth, normal = pressed
    moving = moves[rows]
    rows, depth, normal = rows[moving], depth[moving], normal[moving]
    slip = v[rows] - carried
    slip -= (slip * normal).sum(axis=1)[:, None] * normal
    speed = np.maximum(np.linalg.norm(slip, axis=1), TINY)
    v[rows] -= np.minimum(1.0, impulse * depth * nodes.per_mass[rows] / speed)[:, None] * slip
