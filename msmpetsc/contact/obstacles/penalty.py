"""Penalty contact with obstacles, as a term of the energy that a step minimises.

A node at depth d > 0 has the energy 1/2 k d^2, which is convex for a single face. Coulomb friction
(contact.friction) acts on the nodes that were inside when the step began.

A step of BDF2 uses N_(n+1) = 2 N_n - N_(n-1) as the normal force of friction, and the slip
u = tau v_(n+1) (README: BDF2).

The ``side`` of a node is the face by which it entered a box. Its depth is measured from this face,
also beyond the opposite face, so a node that passes a plate in a step is pushed back. Without a
side, depth is measured from the nearest face.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from msmpetsc.backend.arrays import Floats, Indices, Positions, Rows, like
from msmpetsc.contact.friction import STICK, squares
from msmpetsc.contact.obstacles.moving_solid import Obstacle
from msmpetsc.contact.obstacles.node_friction import (
    Movers,
    NodeFriction,
    Pressed,
    apply_friction,
)
from msmpetsc.contact.surface.surface_contact import SurfaceContact
from msmpetsc.scene.obstacles import ObstacleTable

# default stiffness [stiffest spring]; so that nodes sink in by little
STIFFNESS = 10.0
# depth at which nodes are stopped [fraction]; above 0, so that the Hessian has contact
STOP_DEPTH = 1e-3
# duals (a, 3) of each obstacle's friction and of the surface's; None for slips' forces
Duals = list[Rows | None]


@dataclass(frozen=True)
class Penalty:
    """Penalty contact with an obstacle.

    stiffness   : k of each node [N/m]
    friction    : coefficient mu [-]
    stick       : slip speed below which a contact sticks [m/s]
    restitution : normal speed of a node after an impact over the speed before [-]; None: no change
                  of speed but by the penalty
    """

    obstacle: Obstacle
    stiffness: float
    friction: float
    stick: float
    restitution: float | None = None

    @classmethod
    def of_table(
        cls, obstacle: Obstacle, table: ObstacleTable, stiffest: float, side: float
    ) -> "Penalty":
        """Return the penalty of an obstacle's table.

        stiffest : stiffness of the stiffest spring [N/m]
        side     : longest side of the smallest body [m]
        """
        stiffness = table.stiffness or STIFFNESS * stiffest
        stick = table.friction_speed or STICK * side
        restitution = None if table.restitution == 1 else table.restitution
        return cls(obstacle, stiffness, table.friction or 0.0, stick, restitution)

    def state_at(self, time: float, sides: Indices | None = None) -> "ContactState":
        """Return the contact at a time [s] without friction, for ``sides`` (owned or more,)."""
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
        """Return the contact in the step that ends at ``time`` [s] and begins at q (owned, 3) [m].

        last : (owned or more, 3) positions a step before q [m], for a step of BDF2. Friction then
               uses the velocity and the extrapolated normal force at the step's end.
        end  : (owned, 3) positions at the end of an earlier solve of the step [m], which then give
               the normal force
        """
        state = self.state_at(time, sides)
        if self.friction == 0:
            return state
        start = time - time_step
        if end is None:
            nodes, depth, normal = self.state_at(start, sides).pressed(q)
        else:
            nodes, depth, normal = state.pressed(end)
        displacement = like(q, self.obstacle.path.displacement_between(start, time))
        stick = self.stick * time_step
        carried = q[nodes] + displacement
        if last is not None:
            # (4 q_n - q_(n-1)) / 3, relative to the obstacle
            carried += (q[nodes] - last[nodes] - displacement) / 3
            stick *= 2 / 3
        if last is not None and end is None:
            extrapolated, _ = self.obstacle.depths(2 * q - last[: len(q)], time, sides)
            # Extrapolation is poor for a node that has just entered.
            depth = np.clip(extrapolated[nodes], 0, 2 * depth)
        limit = self.friction * self.stiffness * depth
        begin = np.zeros((1, 3), like=q)
        friction = NodeFriction(limit, stick, begin, nodes, normal, carried)
        return replace(state, friction=friction)


@dataclass(frozen=True)
class ContactState:
    """Penalty contact with an obstacle at the time [s] at which a step ends.

    sides    : (owned or more,) sides of the nodes (solids.side_of); None for the nearest face
    friction : friction in the step; None without friction
    """

    penalty: Penalty
    time: float
    sides: Indices | None
    friction: NodeFriction | None = None

    def after(self, before: "list[ContactState]", q: Positions) -> "ContactState":
        """Return the contact with the elastic slips of the states ``before`` at q (owned, 3)."""
        last = next((state.friction for state in before if state.penalty is self.penalty), None)
        return replace(self, friction=self.friction.after(last, q)) if self.friction else self

    def friction_limits(self, q: Positions) -> Floats:
        """Return the sum of mu N [N] that friction uses, and its value at q (owned, 3), as (2,)."""
        if not self.friction:
            return np.zeros(2)
        _, depth, _ = self.pressed(q)
        limit_at_q = self.penalty.friction * self.penalty.stiffness * float(depth.sum())
        return np.array([float(self.friction.limit.sum()), limit_at_q])

    def depths(self, q: Positions) -> tuple[Floats, Indices]:
        """Return the depths (n,) [m] of positions q (n, 3), and the faces (n,) that push."""
        return self.penalty.obstacle.depths(q, self.time, self.sides)

    def pressed(self, q: Positions) -> Pressed:
        """Return the rows (a,) of nodes q (n, 3) inside, their depths (a,) and normals (a, 3)."""
        depths, face = self.depths(q)
        rows = np.flatnonzero(depths > 0)
        return rows, depths[rows], self.penalty.obstacle.normals_at(q[rows], self.time, face[rows])

    def add_gradient(self, q: Positions, pressed: Pressed, gradient: Rows) -> None:
        """Add the gradient [N] of penalty and friction at q to ``gradient`` (owned or more, 3).

        pressed : the nodes that are inside at q
        """
        rows, depth, normal = pressed
        gradient[rows] -= (self.penalty.stiffness * depth)[:, None] * normal
        if self.friction:
            self.friction.add_gradient(q, gradient)

    def change(self, q: Positions, base: Positions) -> float:
        """Return the change [J] of the penalty energy from base to q (n, 3)."""
        depths, face = self.depths(q)
        base_depths, base_face = self.depths(base)
        stays = np.flatnonzero((depths > 0) & (base_depths > 0) & (face == base_face))
        depths, base_depths = np.maximum(depths, 0), np.maximum(base_depths, 0)
        change = depths - base_depths
        if len(stays):
            obstacle = self.penalty.obstacle
            change[stays] = obstacle.solid.depth_change(
                obstacle.seen_from(q[stays], self.time), (q - base)[stays], face[stays]
            )
        return 0.5 * self.penalty.stiffness * float(change @ (depths + base_depths))


class Contact:
    """The contact energy of a step: all obstacles, and the surface's self-contact.

    Positions q are (owned or more, 3) [m]. The Hessian of obstacles has a 3 x 3 block per node in
    contact. Methods that use the surface are collective.

    surface : self-contact of the scene; None if it has none
    """

    def __init__(
        self, states: list[ContactState], owned: int, surface: SurfaceContact | None = None
    ):
        self.states, self.owned, self.surface = states, owned, surface

    def energy(self, q: Positions) -> float:
        """Return the penalty energy [J] of obstacles, without friction and self-contact."""
        energy = 0.0
        for state in self.states:
            inside = np.maximum(state.depths(q[: self.owned])[0], 0)
            energy += 0.5 * state.penalty.stiffness * float(inside @ inside)
        return energy

    def change(self, q: Positions, base: Positions) -> float:
        """Return the change [J] of the contact energy from base to q, friction included."""
        total = 0.0
        for state in self.states:
            total += state.change(q[: self.owned], base[: self.owned])
            if state.friction:
                total += state.friction.change(q, base)
        return total + (self.surface.change(q, base) if self.surface else 0.0)

    def change_of_friction(self, q: Positions, base: Positions) -> float:
        """Return the change [J] of the energy of the obstacles' friction from base to q."""
        return sum(state.friction.change(q, base) for state in self.states if state.friction)

    def at(self, q: Positions) -> "ContactAt":
        """Return the contact at q."""
        return ContactAt(self, q, [state.pressed(q[: self.owned]) for state in self.states])

    def friction_limits(self, q: Positions) -> Floats:
        """Return the sum of mu N [N] that this rank's friction uses, and its value at q, (2,)."""
        of_nodes = sum(
            (state.friction_limits(q[: self.owned]) for state in self.states), np.zeros(2)
        )
        return of_nodes + self.surface.friction_limits(q) if self.surface else of_nodes

    def released(self, q: Positions) -> float:
        """Return the energy [J] of elastic slips at the step's beginning minus that at q."""
        of_nodes = sum(
            state.friction.released(q[: self.owned]) for state in self.states if state.friction
        )
        return of_nodes + (self.surface.released(q) if self.surface else 0.0)

    def no_duals(self) -> Duals:
        """Return the duals for which ``hessian`` has the secant of the obstacles' friction.

        The matrix A needs the secant: the true Hessian is zero along a slip, so nodes oscillate.
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


@dataclass(frozen=True)
class ContactAt:
    """The contact energy of a step at given positions, with its derivatives.

    q       : (owned or more, 3) positions [m]
    pressed : the nodes inside each obstacle
    """

    contact: Contact
    q: Positions
    pressed: list[Pressed]

    @property
    def surface(self) -> SurfaceContact | None:
        """Self-contact of the scene; None if it has none."""
        return self.contact.surface

    @property
    def of_obstacles(self) -> Iterator[tuple[ContactState, Pressed]]:
        """The contact of each obstacle, with the nodes inside."""
        return zip(self.contact.states, self.pressed, strict=True)

    def add_gradient(self, gradient: Rows) -> None:
        """Add the gradient [N] of the contact energy to ``gradient`` (owned or more, 3)."""
        for state, pressed in self.of_obstacles:
            state.add_gradient(self.q[: self.contact.owned], pressed, gradient)
        if self.surface:
            self.surface.add_gradient(self.q, gradient)

    def stopped(self, end: Positions) -> Positions | None:
        """Return positions with the nodes that enter obstacles on the path to ``end`` stopped.

        They stop at a small depth, where the Hessian has the contact. Return None without such
        nodes.

        end : (owned or more, 3) [m]
        """
        owned, stopped = self.contact.owned, None
        for state, (inside, _, _) in self.of_obstacles:
            rows, depth, normal = state.pressed(end[:owned])
            was_inside = np.zeros(owned, bool, like=end)
            was_inside[inside] = True
            new = ~was_inside[rows]
            if new.any():
                stopped = end.copy() if stopped is None else stopped
                stopped[rows[new]] += (1 - STOP_DEPTH) * depth[new][:, None] * normal[new]
        return stopped

    def hessian(self, duals: Duals | None = None) -> Iterator[tuple[Indices, Rows]]:
        """Yield the nodes (a,) and blocks (a, 3, 3) [N/m] of each obstacle's penalty and friction.

        The Hessian is the sum of all blocks, each positive semidefinite. The negative term -k d / r
        of a solid with radius of curvature r is neglected.

        duals : duals of friction; None for its true Hessian
        """
        of_states = duals[:-1] if duals else [None] * len(self.pressed)
        for (state, pressed), known in zip(self.of_obstacles, of_states, strict=True):
            rows, _, normal = pressed
            yield rows, state.penalty.stiffness * squares(normal)
            if state.friction:
                yield state.friction.nodes, state.friction.blocks(self.q, known)

    def bound(self) -> Floats:
        """Return an upper bound (owned,) [N/m] of each node's block.

        It is constant while the set of nodes in contact is.
        """
        bound = np.zeros(self.contact.owned, like=self.q)
        for state, (rows, _, _) in self.of_obstacles:
            bound[rows] += state.penalty.stiffness
            if state.friction:
                bound[state.friction.nodes] += 2 * state.friction.limit / state.friction.stick
        return bound + self.surface.bound(self.q) if self.surface else bound

    def power(self, begin: float, end: float) -> float:
        """Return the power [W] of the penalties on this rank's nodes.

        begin, end : the substep [s] that gives an obstacle's velocity
        """
        power = 0.0
        for state, (_, depth, normal) in self.of_obstacles:
            displacement = state.penalty.obstacle.path.displacement_between(begin, end)
            if displacement.any():
                work = float(depth @ (normal @ like(self.q, displacement)))
                power += state.penalty.stiffness / (end - begin) * work
        return power

    def apply_friction(self, nodes: Movers, duration: float, begin: float, end: float) -> None:
        """Apply the obstacles' friction for a ``duration`` [s] to this rank's nodes.

        begin, end : the substep [s] that gives an obstacle's velocity
        """
        for state, pressed in self.of_obstacles:
            p = state.penalty
            if p.friction > 0:
                displacement = p.obstacle.path.displacement_between(begin, end)
                carried = like(self.q, displacement / (end - begin))
                apply_friction(nodes, pressed, carried, p.friction * p.stiffness * duration)
