"""Penalty contact of nodes with obstacles, as a term of the energy that a step minimises.

A node at depth d > 0 has the energy 1/2 k d^2. The energy is convex for a single face. Nodes that
were inside at the start of the step have Coulomb's friction (contact.obstacles.friction).

In a step of BDF2 friction takes N_(n+1) = 2 N_n - N_(n-1) for the normal force, and
u = tau v_(n+1) for the slip (README: BDF2).

A node that entered a box through a face has that face for its ``side``. Its depth is the way back
through this face, beyond the far face, too. So a plate that a node passes within a step pushes the
node back. Without a side the nearest face counts.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from msmpetsc.backend.arrays import Floats, Indices, Positions, Rows, like
from msmpetsc.contact.obstacles.friction import NodeFriction, Pressed, squares
from msmpetsc.contact.obstacles.moving_solid import Obstacle
from msmpetsc.contact.surface.term import SurfaceContact

# Share of its depth that a stopped node keeps, so that the Hessian there knows the
# obstacle
SHALLOW = 1e-3
# (a, 3) of each obstacle's friction and of the surface's; None: the forces of the slips
Duals = list[Rows | None]


@dataclass(frozen=True)
class Penalty:
    """Penalty of an obstacle.

    stiffness   : of each node [N/m]
    friction    : Coulomb's mu
    stick       : slip speed below which friction fades [m/s]
    restitution : normal speed of a striking node after over before; None if the penalty decides
    """

    obstacle: Obstacle
    stiffness: float
    friction: float
    stick: float
    restitution: float | None = None

    def state_at(self, time: float, sides: Indices | None = None) -> "ContactState":
        """Return the state at a time [s] without friction, with ``sides`` (owned or more,)."""
        return ContactState(self, time, sides)

    def during(
        self,
        q: Positions,
        time: float,
        time_step: float,
        sides: Indices | None = None,
        last: Positions | None = None,
        end: Positions | None = None,
    ) -> "ContactState":
        """Return the state in the step that ends at ``time`` [s] and starts at q (owned, 3) [m].

        last : (owned or more, 3) [m] positions one step before q in a step of BDF2. Friction then
               goes by the extrapolated normal force and the velocity at the end of the step
        end  : (owned, 3) [m] end of an earlier solve of the step, whose normal force is then taken
        """
        state = self.state_at(time, sides)
        if self.friction == 0:
            return state
        start, path = time - time_step, self.obstacle.path
        nodes, depth, normal = (
            self.state_at(start, sides).pressed(q) if end is None else state.pressed(end)
        )
        way, stick = like(q, path.displacement_between(start, time)), self.stick * time_step
        carried = q[nodes] + way
        if last is not None:
            # (4 q_n - q_(n-1)) / 3, as seen from the obstacle
            carried += (q[nodes] - last[nodes] - way) / 3
            stick *= 2 / 3
        if last is not None and end is None:
            coming, _ = self.obstacle.depths(2 * q - last[: len(q)], time, sides)
            # A node that has just entered has no reliable extrapolation
            depth = np.clip(coming[nodes], 0, 2 * depth)
        limit, begin = self.friction * self.stiffness * depth, np.zeros((1, 3), like=q)
        friction = NodeFriction(limit, stick, begin, nodes, normal, carried)
        return replace(state, friction=friction)


@dataclass(frozen=True)
class ContactState:
    """Penalty of an obstacle at the end of a step, at a time [s].

    sides    : (owned or more,) face through which each node entered (solids.side_of); None: nearest
    friction : of the step; None without any
    """

    penalty: Penalty
    time: float
    sides: Indices | None
    friction: NodeFriction | None = None

    def after(self, before: "list[ContactState]", q: Positions) -> "ContactState":
        """Return the state with friction that goes on from the last step.

        before : states of the last step, which ended at q (owned, 3) [m]
        """
        last = next((state.friction for state in before if state.penalty is self.penalty), None)
        return replace(self, friction=self.friction.after(last, q)) if self.friction else self

    def friction_limits(self, q: Positions) -> Floats:
        """Return the sum of mu N [N] that friction takes, and the sum at q (owned, 3) [m], (2,)."""
        if not self.friction:
            return np.zeros(2)
        _, depth, _ = self.pressed(q)
        limit_at_q = self.penalty.friction * self.penalty.stiffness * float(depth.sum())
        return np.array([float(self.friction.limit.sum()), limit_at_q])

    def depths(self, q: Positions) -> tuple[Floats, Indices]:
        """Return the depths (n,) [m] of positions (n, 3) [m], and the faces (n,) that push."""
        return self.penalty.obstacle.depths(q, self.time, self.sides)

    def pressed(self, q: Positions) -> Pressed:
        """Return rows (a,) of positions (n, 3) inside, depths (a,) [m] and normals (a, 3)."""
        depths, face = self.depths(q)
        rows = np.flatnonzero(depths > 0)
        return rows, depths[rows], self.penalty.obstacle.normals_at(q[rows], self.time, face[rows])

    def add_gradient(self, q: Positions, gradient: Rows) -> None:
        """Add the gradient [N] at q (owned, 3) [m] to ``gradient`` (owned or more, 3)."""
        rows, depth, normal = self.pressed(q)
        gradient[rows] -= (self.penalty.stiffness * depth)[:, None] * normal
        if self.friction:
            self.friction.add_gradient(q, gradient)

    def stopped(self, q: Positions, base: Positions) -> tuple[Indices, Rows]:
        """Return the nodes (a,) inside at q but not at base (n, 3), and displacements (a, 3) [m].

        The displacements move the nodes back to just inside, where the Hessian knows the obstacle.
        """
        rows, depth, normal = self.pressed(q)
        new = self.depths(base)[0][rows] <= 0
        return rows[new], (1 - SHALLOW) * depth[new][:, None] * normal[new]

    def change(self, q: Positions, base: Positions) -> float:
        """Return the energy of the penalty at q minus that at base (n, 3) [J]."""
        (depths, face), (base_depths, base_face) = self.depths(q), self.depths(base)
        within = np.flatnonzero((depths > 0) & (base_depths > 0) & (face == base_face))
        depths, base_depths = np.maximum(depths, 0), np.maximum(base_depths, 0)
        deeper = depths - base_depths
        if len(within):
            obstacle, moved = self.penalty.obstacle, (q - base)[within]
            deeper[within] = obstacle.solid.deeper(
                obstacle.seen_from(q[within], self.time), moved, face[within]
            )
        return 0.5 * self.penalty.stiffness * float(deeper @ (depths + base_depths))


class Contact:
    """Contact energy of all obstacles and of the surface in one step.

    Positions q are (owned or more, 3) [m]. Obstacles act on nodes, so their Hessian has a 3 x 3
    block a node in contact.

    surface : contact of the surface with itself, whose methods are collective; None without any
    """

    def __init__(
        self, states: list[ContactState], owned: int, surface: SurfaceContact | None = None
    ):
        self.states, self.owned, self.surface = states, owned, surface

    def energy(self, q: Positions) -> float:
        """Return the energy [J] of the penalties of obstacles; friction stores none."""
        energy = 0.0
        for state in self.states:
            inside = np.maximum(state.depths(q[: self.owned])[0], 0)
            energy += 0.5 * state.penalty.stiffness * float(inside @ inside)
        return energy

    def change(self, q: Positions, base: Positions) -> float:
        """Return the energy at q minus that at base, with friction [J]."""
        return self.change_at_nodes(q, base) + (
            self.surface.change(q, base) if self.surface else 0.0
        )

    def change_at_nodes(self, q: Positions, base: Positions) -> float:
        """Return the energy of obstacles at q minus that at base, with friction [J]."""
        total = 0.0
        for state in self.states:
            total += state.change(q[: self.owned], base[: self.owned])
            if state.friction:
                total += state.friction.change(q, base)
        return total

    def stopped(self, q: Positions, base: Positions) -> Positions | None:
        """Return q with nodes stopped at obstacles that they enter after base.

        None if none enters.
        """
        found = [state.stopped(q[: self.owned], base[: self.owned]) for state in self.states]
        if not any(len(rows) for rows, _ in found):
            return None
        stopped = q.copy()
        for rows, way in found:
            stopped[rows] += way
        return stopped

    def add_gradient(self, q: Positions, gradient: Rows) -> None:
        """Add the gradient [N] at q to ``gradient`` (owned or more, 3)."""
        for state in self.states:
            state.add_gradient(q[: self.owned], gradient)
        if self.surface:
            self.surface.add_gradient(q, gradient)

    def friction_limits(self, q: Positions) -> Floats:
        """Return the sum of mu N [N] that this rank's friction takes, and the sum at q, (2,)."""
        of_nodes = sum(
            (state.friction_limits(q[: self.owned]) for state in self.states), np.zeros(2)
        )
        return of_nodes + self.surface.friction_limits(q) if self.surface else of_nodes

    def released(self, q: Positions) -> float:
        """Return the energy [J] of elastic slips at the start of the step minus that at q."""
        of_nodes = sum(
            state.friction.released(q[: self.owned]) for state in self.states if state.friction
        )
        return of_nodes + (self.surface.released(q) if self.surface else 0.0)

    def no_duals(self) -> Duals:
        """Return the duals with which ``hessian`` uses the secants of all friction of obstacles.

        Friction's true Hessian is 0 along a slip. With A nodes would then oscillate.
        """
        return [
            *(state.friction.no_duals() if state.friction else None for state in self.states),
            None,
        ]

    def duals_after(self, q: Positions, base: Positions, duals: Duals) -> Duals:
        """Return the duals of friction after the full step from base to q."""
        of_nodes = [
            state.friction.duals_after(q, base, known) if state.friction else None
            for state, known in zip(self.states, duals[:-1], strict=True)
        ]
        return [*of_nodes, self.surface.duals_after(q, base, duals[-1]) if self.surface else None]

    def hessian(self, q: Positions, duals: Duals | None = None) -> Iterator[tuple[Indices, Rows]]:
        """Yield nodes (a,) and their blocks (a, 3, 3) [N/m] for each penalty and friction of
        obstacles.

        The Hessian is the sum of all blocks, each positive semidefinite. The tangential curvature
        -k d / r at a surface of radius r is left out.

        duals : of friction; None for its true Hessian
        """
        of_states = duals[:-1] if duals else [None] * len(self.states)
        for state, known in zip(self.states, of_states, strict=True):
            rows, _, normal = state.pressed(q[: self.owned])
            yield rows, state.penalty.stiffness * squares(normal)
            if state.friction:
                yield state.friction.nodes, state.friction.blocks(q, known)

    def bound(self, q: Positions) -> Floats:
        """Return upper bounds (owned,) [N/m] of the nodes' blocks.

        The bounds are constant while the same nodes are in contact.
        """
        bound = np.zeros(self.owned, like=q)
        for state in self.states:
            bound += state.penalty.stiffness * (state.depths(q[: self.owned])[0] > 0)
            if state.friction:
                bound[state.friction.nodes] += 2 * state.friction.limit / state.friction.stick
        return bound + self.surface.bound(q) if self.surface else bound
