"""Contact energy of a step: penalties of obstacles on nodes, and contact of surfaces.

``StepContact.at`` finds the nodes inside each obstacle at given positions. Gradient, Hessian and
bounds share these nodes.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from msmpetsc.backend.arrays import Floats, Indices, Positions, Rows, like
from msmpetsc.contact.friction import squares
from msmpetsc.contact.obstacles.node_friction import Movers, Pressed, apply_friction
from msmpetsc.contact.obstacles.penalty import ObstacleContact
from msmpetsc.contact.surface.surface_contact import SurfaceContact, SurfaceContactAt

# depth of a stopped node over its depth without the stop [-]; above 0, so that the
# Hessian includes the contact
STOP_DEPTH = 1e-3
# duals (a, 3) of friction for each obstacle, then for the surface; None for the forces
# of the present slips
Duals = list[Rows | None]


class StepContact:
    """The contact energy of a step: all obstacles, and the surface's self-contact.

    Positions q are (owned or more, 3) [m]. The Hessian of obstacles has a 3 x 3 block per node in
    contact. Methods that use the surface are collective.

    states  : penalty contact with each obstacle
    owned   : number of nodes that this rank owns
    surface : contact of surfaces; None without it
    """

    def __init__(
        self, states: list[ObstacleContact], owned: int, surface: SurfaceContact | None = None
    ):
        self.states, self.owned, self.surface = states, owned, surface

    def energy(self, q: Positions) -> float:
        """Return the penalty energy [J] of obstacles, without friction and self-contact."""
        energy = 0.0
        for state in self.states:
            inside = np.maximum(state.depths(q[: self.owned])[0], 0)
            energy += 0.5 * state.penalty.stiffness * float(inside @ inside)
        return energy

    def change_of_friction(self, q: Positions, base: Positions) -> float:
        """Return the change [J] of the obstacles' friction energy from base to q."""
        return sum(state.friction.change(q, base) for state in self.states if state.friction)

    def at(self, q: Positions) -> "StepContactAt":
        """Return the contact at q."""
        pressed = [state.pressed(q[: self.owned]) for state in self.states]
        return StepContactAt(self, q, pressed, self.surface.at(q) if self.surface else None)

    def no_duals(self) -> Duals:
        """Return the duals for which ``hessian`` has the secant of the obstacles' friction.

        Methods with the matrix A need the secant. The true Hessian is zero along a slip, so nodes
        would oscillate.
        """
        return [
            *(state.friction.no_duals() if state.friction else None for state in self.states),
            None,
        ]


@dataclass(frozen=True)
class StepContactAt:
    """The contact energy of a step at given positions, with its derivatives.

    Methods that use the surface are collective.

    step    : contact in the step
    q       : (owned or more, 3) positions [m]
    pressed : the nodes inside each obstacle
    surface : contact of surfaces; None without it
    """

    step: StepContact
    q: Positions
    pressed: list[Pressed]
    surface: SurfaceContactAt | None

    @property
    def of_obstacles(self) -> Iterator[tuple[ObstacleContact, Pressed]]:
        """The contact of each obstacle, with the nodes inside."""
        return zip(self.step.states, self.pressed, strict=True)

    @property
    def presses_nodes(self) -> bool:
        """Whether an obstacle presses or rubs a node of this rank."""
        return any(
            len(rows) or (state.friction is not None and len(state.friction.nodes))
            for state, (rows, _, _) in self.of_obstacles
        )

    def change(self, base: "StepContactAt") -> float:
        """Return the change [J] of the contact energy from base to here, friction included."""
        owned, total = self.step.owned, 0.0
        for state in self.step.states:
            total += state.change(self.q[:owned], base.q[:owned])
            if state.friction:
                total += state.friction.change(self.q, base.q)
        if self.surface and base.surface:
            total += self.surface.change(base.surface)
        return total

    def friction_limits(self) -> Floats:
        """Return this rank's sums of mu N [N], (2,): as the step's friction uses it, and here."""
        owned = self.step.owned
        of_nodes = sum(
            (state.friction_limits(self.q[:owned]) for state in self.step.states), np.zeros(2)
        )
        return of_nodes + self.surface.friction_limits() if self.surface else of_nodes

    def released(self) -> float:
        """Return the energy [J] of elastic slips at the step's beginning minus that here."""
        of_nodes = sum(
            state.friction.released(self.q) for state in self.step.states if state.friction
        )
        return of_nodes + (self.surface.released() if self.surface else 0.0)

    def duals_after(self, base: "StepContactAt", duals: Duals) -> Duals:
        """Return the duals of friction after the full step from base to here."""
        of_nodes = [
            state.friction.duals_after(self.q, base.q, known) if state.friction else None
            for state, known in zip(self.step.states, duals[:-1], strict=True)
        ]
        of_surface = None
        if self.surface and base.surface:
            of_surface = self.surface.duals_after(base.surface, duals[-1])
        return [*of_nodes, of_surface]

    def add_gradient(self, gradient: Rows) -> None:
        """Add the gradient [N] of the contact energy to ``gradient`` (owned or more, 3)."""
        for state, pressed in self.of_obstacles:
            state.add_gradient(self.q[: self.step.owned], pressed, gradient)
        if self.surface:
            self.surface.add_gradient(gradient)

    def stopped(self, end: Positions) -> Positions | None:
        """Return ``end`` with the nodes that enter obstacles on the path stopped; None if none do.

        The nodes stop at a small depth, so that the Hessian includes their contact.

        end : (owned or more, 3) [m]
        """
        owned, stopped = self.step.owned, None
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

        The obstacles' part changes only with the set of nodes in contact, the surface's seldom.
        """
        bound = np.zeros(self.step.owned, like=self.q)
        for state, (rows, _, _) in self.of_obstacles:
            bound[rows] += state.penalty.stiffness
            if state.friction:
                bound[state.friction.nodes] += 2 * state.friction.limit / state.friction.stick
        return bound + self.surface.bound() if self.surface else bound

    def power(self, begin: float, end: float) -> float:
        """Return the power [W] that moving obstacles' penalties put into this rank's nodes.

        begin, end : times [s] of the substep, which gives an obstacle's velocity
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

        begin, end : times [s] of the substep, which gives an obstacle's velocity
        """
        for state, pressed in self.of_obstacles:
            p = state.penalty
            if p.friction > 0:
                displacement = p.obstacle.path.displacement_between(begin, end)
                carried = like(self.q, displacement / (end - begin))
                apply_friction(nodes, pressed, carried, p.friction * p.stiffness * duration)
