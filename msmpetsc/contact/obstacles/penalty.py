"""Penalty contact with obstacles, as a term of the energy that a step minimises.

A node at depth d > 0 has the energy 1/2 k d^2, which is convex for a single face. Coulomb friction
(contact.friction) acts on the nodes that were inside when the step began.

A step of BDF2 uses N_(n+1) = 2 N_n - N_(n-1) as the normal force of friction, and the slip
u = tau v_(n+1) (solve.integrators.implicit).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from msmpetsc.backend.arrays import Floats, Indices, Positions, Rows, like
from msmpetsc.contact.friction import STICK
from msmpetsc.contact.obstacles.moving_solid import Obstacle
from msmpetsc.contact.obstacles.node_friction import NodeFriction, Pressed
from msmpetsc.contact.obstacles.reflection import StepTaken, striking
from msmpetsc.scene.obstacles import ObstacleTable

# default stiffness [stiffness of the stiffest spring]; nodes then sink in by little
STIFFNESS = 10.0


@dataclass(frozen=True)
class Penalty:
    """Penalty contact with an obstacle.

    stiffness   : k of each node [N/m]
    friction    : coefficient mu [-]
    stick       : slip speed below which a contact sticks [m/s]
    restitution : normal speed of a node after an impact over the speed before [-]; None: only the
                  penalty changes the speed
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

    def during(
        self,
        q: Positions,
        time: float,
        time_step: float,
        sides: Indices | None = None,
        last: Positions | None = None,
        end: Positions | None = None,
        before: "Sequence[ObstacleContact]" = (),
    ) -> "ObstacleContact":
        """Return the contact in the step that ends at ``time`` [s] and begins at q (owned, 3) [m].

        last   : (owned or more, 3) positions a step before q [m], for a step of BDF2. Friction then
                 uses the velocity and the extrapolated normal force at the step's end.
        end    : (owned, 3) end positions of an earlier solve of the step [m], which then give the
                 normal force
        before : contacts of the last step with all obstacles, whose elastic slips continue
        """
        state = ObstacleContact(self, time, sides)
        if self.friction == 0:
            return state
        start = time - time_step
        if end is None:
            nodes, depth, normal = replace(state, time=start).pressed(q)
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
        ended = next((contact.friction for contact in before if contact.penalty is self), None)
        return replace(state, friction=friction.after(ended, q) if ended else friction)

    def struck(
        self, q: Positions, q_previous: Positions, step: StepTaken
    ) -> tuple[Positions, Positions]:
        """Return q_n and a q_(n-1) (n, 3) [m] that scales the normal velocity of striking nodes.

        A node strikes in the step in which it reaches a face. In explicit steps its depth is scaled
        as well. Otherwise the penalty would push the node out. Near the stability limit that gives
        up to 2.6 times the velocity of the impact.
        """
        if self.restitution is None:
            return q, q_previous
        rows, into, out = striking(self.obstacle, q, q_previous, step)
        start = step.time - step.length
        strikes = self.obstacle.depths(q_previous, start, step.sides)[0][rows] < 0
        if strikes.any():
            rows, lost = rows[strikes], 1 - self.restitution
            q_previous = q_previous.copy()
            q_previous[rows] += lost * into[strikes]
            if step.explicit:
                q = q.copy()
                q[rows] += lost * out[strikes]
                q_previous[rows] += lost * out[strikes]
        return q, q_previous


@dataclass(frozen=True)
class ObstacleContact:
    """Penalty contact with an obstacle at the time [s] at which a step ends.

    sides    : (owned or more,) sides of the nodes (solids.side_of), from whose faces depths are
               measured, even beyond the opposite face; None for the nearest face
    friction : friction in the step; None without friction
    """

    penalty: Penalty
    time: float
    sides: Indices | None
    friction: NodeFriction | None = None

    def friction_limits(self, q: Positions) -> Floats:
        """Return the sums of mu N [N], (2,): as friction uses it, and at q (owned, 3)."""
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
