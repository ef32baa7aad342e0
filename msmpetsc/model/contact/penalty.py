"""Contact as a term of the energy that a step minimises: stiff springs on the nodes that are inside an obstacle,
and Coulomb friction on those that were.

A node at depth d > 0 has the energy 1/2 k d^2. Friction opposes the slip u, the way along the surface during the
step, with mu N once |u| passes a small e; N is the push on the node at the step's start, so that friction has a
potential, mu N f(|u|), with f(u) = u^2 / e - u^3 / (3 e^2) + e / 3 for u < e and u beyond (Li et al. 2020,
Incremental Potential Contact, Eq. 12 to 15). Both are convex for one face, and so is what a step minimises.

With the push of the start friction is of first order in the step's length. A step of BDF2 takes what the two last
states lead to, N_(n+1) = 2 N_n - N_(n-1), and u = tau v_(n+1), the velocity that it ends with: of second order.

A node that came into a box by one of its faces has that for its ``side``, and its depth is the way back through it,
also beyond the far face: a plate that a node passes within a step pushes it back. Without a side the nearest counts.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from msmpetsc.backend.arrays import like
from msmpetsc.model.contact.obstacle import Obstacle
from msmpetsc.model.contact.solids import TINY

if TYPE_CHECKING:
    from msmpetsc.model.self_contact.term import SurfaceContact

Secants = list[np.ndarray | None]  # of each obstacle's friction, if it has any, whose nodes (a,) have their secant


@dataclass(frozen=True)
class Penalty:
    """stiffness [N/m] on each node; friction mu; below the slip speed ``stick`` [m/s] friction fades to nothing.

    restitution : of nodes that strike, normal speed after over before; None for 1: what the push makes of it
    """

    obstacle: Obstacle
    stiffness: float
    friction: float
    stick: float
    restitution: float | None = None

    def state_at(self, time: float, sides: np.ndarray | None = None) -> "ContactState":
        """Return the obstacle at a time [s], without friction; ``sides`` (owned or more,) of the nodes."""
        return ContactState(self.obstacle, time, self.stiffness, None, sides)

    def during(
        self,
        q: np.ndarray,
        time: float,
        time_step: float,
        sides: np.ndarray | None = None,
        before: np.ndarray | None = None,
    ) -> "ContactState":
        """Return the obstacle in the step that ends at ``time`` [s] and starts from q (owned, 3) [m].

        before : (owned, 3) [m] positions one step before q, of a step of BDF2, whose friction is that of the velocity
            that it ends with, under the push that is to be expected then
        """
        state = self.state_at(time, sides)
        if self.friction == 0:
            return state
        start, path = time - time_step, self.obstacle.path
        nodes, depth, normal = self.state_at(start, sides).pressed(q)
        way, stick = like(q, path.displacement_between(start, time)), self.stick * time_step
        carried = q[nodes] + way
        if before is not None:
            carried += (q[nodes] - before[nodes] - way) / 3  # (4 q_n - q_(n-1)) / 3, as seen from the obstacle
            stick *= 2 / 3
            depth = self._depth_to_come(2 * q - before, time, sides, nodes, depth)
        return replace(state, friction=Friction(nodes, normal, carried, self.friction * self.stiffness * depth, stick))

    def _depth_to_come(
        self, q: np.ndarray, time: float, sides: np.ndarray | None, nodes: np.ndarray, depth: np.ndarray
    ) -> np.ndarray:
        """Return how deep ``nodes`` (a,) will be that go straight on to q (owned, 3) [m], (a,) [m].

        Not less than nothing and not more than twice their ``depth`` (a,) now: of what has just come in the way there
        says nothing of how far it goes.
        """
        coming, _ = self.obstacle.depths(q, time, sides)
        return np.clip(coming[nodes], 0, 2 * depth)


@dataclass(frozen=True)
class Friction:
    """Friction of one step.

    nodes   : (a,) those in contact; normal (a, 3) of the faces
    carried : (a, 3) where they are if they do not slip [m]
    limit   : (a,) mu N [N]
    stick   : e [m]
    """

    nodes: np.ndarray
    normal: np.ndarray
    carried: np.ndarray
    limit: np.ndarray
    stick: float

    def slip(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the slip u (a, 3) and its length (a,) [m]."""
        moved = q[self.nodes] - self.carried
        u = moved - (moved * self.normal).sum(axis=1)[:, None] * self.normal
        return u, np.linalg.norm(u, axis=1)

    def change(self, q: np.ndarray, base: np.ndarray) -> float:
        """Return mu N (f(u) - f(u_0)) [J], from how far q is from base, so that a small change keeps its digits."""
        (u, length), (u_0, length_0), e = self.slip(q), self.slip(base), self.stick
        moved = (q - base)[self.nodes]  # u - u_0, but for a part along the normal, where u + u_0 has none
        longer = (moved * (u + u_0)).sum(axis=1) / np.maximum(length + length_0, np.finfo(float).tiny)
        low, low_0 = np.minimum(length, e), np.minimum(length_0, e)
        beyond = np.maximum(length, e) - np.maximum(length_0, e)
        within = np.where(np.maximum(length, length_0) < e, longer, low - low_0)
        beyond = np.where(np.minimum(length, length_0) >= e, longer, beyond)
        return self.limit @ (within * ((low + low_0) / e - (low**2 + low * low_0 + low_0**2) / (3 * e**2)) + beyond)

    def slope(self, u: np.ndarray) -> np.ndarray:
        """Return f'(u) / u, (a,) [1/m]."""
        return np.where(u < self.stick, (2 - u / self.stick) / self.stick, 1 / np.maximum(u, self.stick))

    def add_gradient(self, q: np.ndarray, gradient: np.ndarray) -> None:
        """Add the friction (a, 3) [N] to the rows of ``gradient`` (owned or more, 3) that it acts on."""
        u, length = self.slip(q)
        gradient[self.nodes] += (self.limit * self.slope(length))[:, None] * u

    def all_secant(self) -> np.ndarray:
        """Return what ``blocks`` takes for all nodes to have their secants, (a,) bool."""
        return self.limit >= 0

    def passes_kink(self, q: np.ndarray, base: np.ndarray) -> np.ndarray:
        """Return which nodes turn round or come to stick on their way from base to q, (a,) bool."""
        (u, length), (u_0, length_0) = self.slip(q), self.slip(base)
        return ((u * u_0).sum(axis=1) < 0) | ((length < self.stick) & (length_0 >= self.stick))

    def blocks(self, q: np.ndarray, true: bool, secant: np.ndarray | None = None) -> np.ndarray:
        """Return mu N (f'/u (I - n n^T) + (f'' - f'/u) d d^T), d the slip's direction, (a, 3, 3) [N/m].

        The second part is not positive; unless ``true``, or where ``secant`` (a,), it is left out. What is then left
        is no less than the Hessian, and as f is concave in u^2, its parabola nowhere lies below the potential.
        """
        u, length = self.slip(q)
        slope = self.slope(length)
        blocks = slope[:, None, None] * (like(q, np.eye(3)) - _squares(self.normal))
        if true:
            direction = u / np.maximum(length, np.finfo(float).tiny)[:, None]
            curvature = np.where(length < self.stick, 2 * (1 - length / self.stick) / self.stick, 0.0)
            less = curvature - slope if secant is None else np.where(secant, 0.0, curvature - slope)
            blocks += less[:, None, None] * _squares(direction)
        return self.limit[:, None, None] * blocks


@dataclass(frozen=True)
class ContactState:
    """An obstacle as it stands at a time [s], where a step ends.

    stiffness : [N/m] on each node
    friction  : of the step, if any
    sides     : (owned or more,) by which face each node came in (faces.side_of); None: the nearest
    """

    obstacle: Obstacle
    time: float
    stiffness: float
    friction: Friction | None
    sides: np.ndarray | None = None

    def depths(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the depths (n,) [m] of positions (n, 3), and the faces (n,) that push."""
        return self.obstacle.depths(q, self.time, self.sides)

    def pressed(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return which of the positions (n, 3) are pressed, rows (a,), how deep (a,) [m] and the normals (a, 3)."""
        depths, face = self.depths(q)
        rows = np.flatnonzero(depths > 0)
        return rows, depths[rows], self.obstacle.normals_at(q[rows], self.time, face[rows])

    def change(self, q: np.ndarray, base: np.ndarray) -> float:
        """Return the energy of the push at q less that at base (n, 3) [J]."""
        (depths, face), (base_depths, base_face) = self.depths(q), self.depths(base)
        within = np.flatnonzero((depths > 0) & (base_depths > 0) & (face == base_face))
        depths, base_depths = np.maximum(depths, 0), np.maximum(base_depths, 0)
        deeper = depths - base_depths
        if len(within):
            seen, moved = self.obstacle.seen_from(q[within], self.time), (q - base)[within]
            deeper[within] = self.obstacle.solid.deeper(seen, moved, face[within])
        return 0.5 * self.stiffness * float(deeper @ (depths + base_depths))


class Contact:
    """What all obstacles, and the surface that meets itself, add to E in one step. Positions q are (owned or more, 3)
    [m].

    Gradient and Hessian of obstacles act on nodes alone: the Hessian is a 3 x 3 block a node in contact.

    surface : self-contact, if the scene has it; all that asks it is collective
    """

    def __init__(self, states: list[ContactState], owned: int, surface: "SurfaceContact | None" = None):
        self.states, self.owned, self.surface = states, owned, surface

    def energy(self, q: np.ndarray) -> float:
        """Return the energy [J] of the push of obstacles alone: friction stores none."""
        energy = 0.0
        for state in self.states:
            inside = np.maximum(state.depths(q[: self.owned])[0], 0)
            energy += 0.5 * state.stiffness * float(inside @ inside)
        return energy

    def change(self, q: np.ndarray, base: np.ndarray) -> float:
        """Return the energy at q less that at base, friction included [J]."""
        return self.change_at_nodes(q, base) + (self.surface.change(q, base) if self.surface else 0.0)

    def change_at_nodes(self, q: np.ndarray, base: np.ndarray) -> float:
        """Return the same of obstacles alone."""
        total = 0.0
        for state in self.states:
            total += state.change(q[: self.owned], base[: self.owned])
            if state.friction:
                total += float(state.friction.change(q, base))
        return total

    def add_gradient(self, q: np.ndarray, gradient: np.ndarray) -> None:
        """Add its gradient [N] to ``gradient`` (owned or more, 3)."""
        for state in self.states:
            rows, depth, normal = state.pressed(q[: self.owned])
            gradient[rows] -= (state.stiffness * depth)[:, None] * normal
            if state.friction:
                state.friction.add_gradient(q, gradient)
        if self.surface:
            self.surface.add_gradient(q, gradient)

    def all_secant(self) -> Secants:
        """Return what ``hessian`` takes for all friction to have its secant."""
        return [state.friction.all_secant() if state.friction else None for state in self.states]

    def passes_kinks(self, q: np.ndarray, base: np.ndarray) -> Secants:
        """Return the same for the nodes alone whose friction has a kink on their way from base to q."""
        return [state.friction.passes_kink(q, base) if state.friction else None for state in self.states]

    def hessian(
        self, q: np.ndarray, true: bool, secants: Secants | None = None
    ) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield of each push and friction of obstacles the nodes (a,), each once, and their blocks (a, 3, 3) [N/m].

        The Hessian is the sum of all; each block is positive semidefinite. Across the
        normal a solid that is round with radius r at a node has -k d / r, too, which is left out.

        true : or else no less than that, as A is no less than the Hessian of the springs: with A, friction's true
            Hessian, nothing along a slip, would let nodes run to and fro
        secants : where friction has that of its secant all the same
        """
        for state, secant in zip(self.states, secants or [None] * len(self.states), strict=True):
            rows, _, normal = state.pressed(q[: self.owned])
            yield rows, state.stiffness * _squares(normal)
            if state.friction:
                yield state.friction.nodes, state.friction.blocks(q, true, secant)

    def bound(self, q: np.ndarray) -> np.ndarray:
        """Return (owned,) [N/m] no less than each node's block, and constant while the same nodes meet obstacles."""
        bound = np.zeros(self.owned, like=q)
        for state in self.states:
            bound += state.stiffness * (state.depths(q[: self.owned])[0] > 0)
            if state.friction:
                bound[state.friction.nodes] += 2 * state.friction.limit / state.friction.stick
        return bound + self.surface.bound(q) if self.surface else bound


def _squares(vectors: np.ndarray) -> np.ndarray:
    """Return v v^T of each of the vectors (a, 3), (a, 3, 3)."""
    return vectors[:, :, None] * vectors[:, None, :]


class Movers(NamedTuple):
    """Nodes whose velocities change: positions q and velocities v (n, 3) [m], [m/s] of all, those that move as rows or
    (n,) bool, and 1 / mass (n,) [1/kg]."""

    q: np.ndarray
    v: np.ndarray
    rows: np.ndarray
    per_mass: np.ndarray


def apply_friction(nodes: Movers, state: ContactState, carried: np.ndarray, impulse: float) -> None:
    """Apply Coulomb friction as a change of velocity to the nodes that are inside.

    v (n, 3) [m/s] along the face, as seen from an obstacle that moves at ``carried`` (3,) [m/s], falls by no more than
    the friction's impulse a mass, mu N dt / m, and not below nothing: so what holds does not creep, however long the
    substep.

    impulse : mu k dt [kg/s], times the depth the impulse
    """
    q, v, per_mass = nodes.q, nodes.v, nodes.per_mass
    moves = np.zeros(len(q), bool, like=q)
    moves[nodes.rows] = True
    pressed, depth, normal = state.pressed(q)
    own = moves[pressed]
    pressed, depth, normal = pressed[own], depth[own], normal[own]
    slip = v[pressed] - carried
    slip -= (slip * normal).sum(axis=1)[:, None] * normal
    speed = np.maximum(np.linalg.norm(slip, axis=1), TINY)
    v[pressed] -= np.minimum(1.0, impulse * depth * per_mass[pressed] / speed)[:, None] * slip
