"""Contact as a term of the energy that a step minimises: stiff springs on the nodes that are inside
an obstacle, and Coulomb friction (contact.obstacles.friction) on those that were.

A node at depth d > 0 has the energy 1/2 k d^2. It is convex for one face, and so is what a step minimises.

A step of BDF2 takes N_(n+1) = 2 N_n - N_(n-1) for the push of friction, and u = tau v_(n+1) (README: BDF2).

A node that came into a box by one of its faces has that for its ``side``, and its depth is the way back through it,
also beyond the far face: a plate that a node passes within a step pushes it back. Without a side the nearest counts.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from msmpetsc.backend.arrays import Floats, Indices, Positions, Rows, like
from msmpetsc.contact.obstacles.friction import NodeFriction, Pressed, squares
from msmpetsc.contact.obstacles.moving_solid import Obstacle
from msmpetsc.contact.surface.term import SurfaceContact

SHALLOW = 1e-3  # of the depth that a node would come to, where it is stopped
Duals = list[
    Rows | None
]  # (a, 3) of each obstacle's friction and of the surface's; None: the slips' own forces


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

    def state_at(self, time: float, sides: Indices | None = None) -> "ContactState":
        """Return the obstacle at a time [s] without friction; ``sides`` (owned or more,) of nodes."""
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
        """Return the obstacle in the step that ends at ``time`` [s] and starts from q (owned, 3) [m].

        last : (owned or more, 3) [m] positions one step before q, of a step of BDF2, whose friction is that of the
            velocity that it ends with, under the push that is to be expected then
        end  : (owned, 3) [m] where an earlier solve of the step has ended: it then goes by the push there
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
            carried += (
                q[nodes] - last[nodes] - way
            ) / 3  # (4 q_n - q_(n-1)) / 3, as seen from the obstacle
            stick *= 2 / 3
        if last is not None and end is None:
            coming, _ = self.obstacle.depths(2 * q - last[: len(q)], time, sides)
            depth = np.clip(coming[nodes], 0, 2 * depth)  # what just came in tells little
        limit, begin = self.friction * self.stiffness * depth, np.zeros((1, 3), like=q)
        friction = NodeFriction(limit, stick, begin, nodes, normal, carried)
        return replace(state, friction=friction)


@dataclass(frozen=True)
class ContactState:
    """An obstacle as it stands at a time [s], where a step ends.

    sides    : (owned or more,) by which face each node came in (solids.side_of); None: the nearest
    friction : of the step, if any
    """

    penalty: Penalty
    time: float
    sides: Indices | None
    friction: NodeFriction | None = None

    def after(self, before: "list[ContactState]", q: Positions) -> "ContactState":
        """Return the same with friction that goes on from that of the step before, which ended at q (owned, 3) [m]."""
        last = next((state.friction for state in before if state.penalty is self.penalty), None)
        return replace(self, friction=self.friction.after(last, q)) if self.friction else self

    def friction_limits(self, q: Positions) -> Floats:
        """Return the sums (2,) of mu N [N] that friction goes by, and with the push at q (owned, 3) [m]."""
        if not self.friction:
            return np.zeros(2)
        _, depth, _ = self.pressed(q)
        limit_at_q = self.penalty.friction * self.penalty.stiffness * float(depth.sum())
        return np.array([float(self.friction.limit.sum()), limit_at_q])

    def depths(self, q: Positions) -> tuple[Floats, Indices]:
        """Return the depths (n,) [m] of positions (n, 3), and the faces (n,) that push."""
        return self.penalty.obstacle.depths(q, self.time, self.sides)

    def pressed(self, q: Positions) -> Pressed:
        """Return which of the positions (n, 3) are pressed, rows (a,), how deep (a,) [m] and the normals (a, 3)."""
        depths, face = self.depths(q)
        rows = np.flatnonzero(depths > 0)
        return rows, depths[rows], self.penalty.obstacle.normals_at(q[rows], self.time, face[rows])

    def add_gradient(self, q: Positions, gradient: Rows) -> None:
        """Add the gradient [N] of the push and the friction at q (owned, 3) to ``gradient`` (owned or more, 3)."""
        rows, depth, normal = self.pressed(q)
        gradient[rows] -= (self.penalty.stiffness * depth)[:, None] * normal
        if self.friction:
            self.friction.add_gradient(q, gradient)

    def stopped(self, q: Positions, base: Positions) -> tuple[Indices, Rows]:
        """Return the nodes (a,) that are pressed at q but not at base (n, 3), and by what to move them (a, 3) [m] to
        where they all but cease to: the Hessian there knows of them."""
        rows, depth, normal = self.pressed(q)
        new = self.depths(base)[0][rows] <= 0
        return rows[new], (1 - SHALLOW) * depth[new][:, None] * normal[new]

    def change(self, q: Positions, base: Positions) -> float:
        """Return the energy of the push at q less that at base (n, 3) [J]."""
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
    """What all obstacles, and the surface that meets itself, add to E in one step. Positions q are
    (owned or more, 3) [m].

    Gradient and Hessian of obstacles act on nodes alone: the Hessian is a 3 x 3 block a node in contact.

    surface : self-contact, if the scene has it; all that asks it is collective
    """

    def __init__(
        self, states: list[ContactState], owned: int, surface: SurfaceContact | None = None
    ):
        self.states, self.owned, self.surface = states, owned, surface

    def energy(self, q: Positions) -> float:
        """Return the energy [J] of the push of obstacles alone: friction stores none."""
        energy = 0.0
        for state in self.states:
            inside = np.maximum(state.depths(q[: self.owned])[0], 0)
            energy += 0.5 * state.penalty.stiffness * float(inside @ inside)
        return energy

    def change(self, q: Positions, base: Positions) -> float:
        """Return the energy at q less that at base, friction included [J]."""
        return self.change_at_nodes(q, base) + (
            self.surface.change(q, base) if self.surface else 0.0
        )

    def change_at_nodes(self, q: Positions, base: Positions) -> float:
        """Return the energy of obstacles alone at q less that at base, friction included [J]."""
        total = 0.0
        for state in self.states:
            total += state.change(q[: self.owned], base[: self.owned])
            if state.friction:
                total += state.friction.change(q, base)
        return total

    def stopped(self, q: Positions, base: Positions) -> Positions | None:
        """Return q with the nodes that come into obstacles on the way from base stopped there; None if none does."""
        found = [state.stopped(q[: self.owned], base[: self.owned]) for state in self.states]
        if not any(len(rows) for rows, _ in found):
            return None
        stopped = q.copy()
        for rows, way in found:
            stopped[rows] += way
        return stopped

    def add_gradient(self, q: Positions, gradient: Rows) -> None:
        """Add its gradient [N] to ``gradient`` (owned or more, 3)."""
        for state in self.states:
            state.add_gradient(q[: self.owned], gradient)
        if self.surface:
            self.surface.add_gradient(q, gradient)

    def friction_limits(self, q: Positions) -> Floats:
        """Return the sums (2,) of mu N [N] that this rank's friction goes by, and with the push at q."""
        of_nodes = sum(
            (state.friction_limits(q[: self.owned]) for state in self.states), np.zeros(2)
        )
        return of_nodes + self.surface.friction_limits(q) if self.surface else of_nodes

    def released(self, q: Positions) -> float:
        """Return how much less energy [J] elastic slips of friction store at q than where the step begins."""
        of_nodes = sum(
            state.friction.released(q[: self.owned]) for state in self.states if state.friction
        )
        return of_nodes + (self.surface.released(q) if self.surface else 0.0)

    def no_duals(self) -> Duals:
        """Return what ``hessian`` takes for all friction of obstacles to have its secant.

        With A, friction's true Hessian, nothing along a slip, would let nodes run to and fro.
        """
        return [
            *(state.friction.no_duals() if state.friction else None for state in self.states),
            None,
        ]

    def duals_after(self, q: Positions, base: Positions, duals: Duals) -> Duals:
        """Return the duals of friction that the full step from base to q leads to."""
        of_nodes = [
            state.friction.duals_after(q, base, known) if state.friction else None
            for state, known in zip(self.states, duals[:-1], strict=True)
        ]
        return [*of_nodes, self.surface.duals_after(q, base, duals[-1]) if self.surface else None]

    def hessian(self, q: Positions, duals: Duals | None = None) -> Iterator[tuple[Indices, Rows]]:
        """Yield of each push and friction of obstacles the nodes (a,), each once, and their blocks (a, 3, 3) [N/m].

        The Hessian is the sum of all; each block is positive semidefinite. Across the
        normal a solid that is round with radius r at a node has -k d / r, too, which is left out.

        duals : of friction; none: its true Hessian
        """
        of_states = duals[:-1] if duals else [None] * len(self.states)
        for state, known in zip(self.states, of_states, strict=True):
            rows, _, normal = state.pressed(q[: self.owned])
            yield rows, state.penalty.stiffness * squares(normal)
            if state.friction:
                yield state.friction.nodes, state.friction.blocks(q, known)

    def bound(self, q: Positions) -> Floats:
        """Return (owned,) [N/m] no less than each node's block, and constant while the same nodes meet obstacles."""
        bound = np.zeros(self.owned, like=q)
        for state in self.states:
            bound += state.penalty.stiffness * (state.depths(q[: self.owned])[0] > 0)
            if state.friction:
                bound[state.friction.nodes] += 2 * state.friction.limit / state.friction.stick
        return bound + self.surface.bound(q) if self.surface else bound
