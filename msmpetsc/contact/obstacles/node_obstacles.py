"""Obstacles that act on nodes, at a time and over a step: penalties and reflections."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Floats, Indices, Mask, Positions, Rows, to_host
from msmpetsc.comm import reduced
from msmpetsc.contact.obstacles.moving_solid import Obstacle
from msmpetsc.contact.obstacles.penalty import ObstacleContact, Penalty
from msmpetsc.contact.obstacles.reflection import Exchange, StepTaken
from msmpetsc.contact.step_contact import StepContact
from msmpetsc.lattice.lattice import Lattice

# positions (owned, 3) [m] and sides (o, owned or more), which are None without contact
Placed = tuple[Positions, Indices | None]


class NodeObstacles:
    """Obstacles that act on nodes: penalties press nodes, and exchanges reflect them.

    Positions are local, (l, 3) [m], ghosts included. ``time`` [s] is the end of a step, and
    ``time_step`` [s] its length. ``sides`` (o, l) has a row per obstacle, penalties first, with the
    side of each node (solids.side_of).
    """

    def __init__(
        self, lattice: Lattice, penalties: Sequence[Penalty], exchanges: Sequence[Exchange]
    ):
        self.lattice, self.penalties, self.exchanges = lattice, penalties, exchanges
        self.all = [p.obstacle for p in penalties] + [e.obstacle for e in exchanges]
        self.has_sides = any(obstacle.solid.has_sides for obstacle in self.all)
        # Rows of penalties in ``sides``
        self.pressing = slice(len(penalties))
        self.strikes = bool(exchanges) or any(p.restitution is not None for p in penalties)
        nodes = lattice.nodes
        self.no_sides: Indices = np.zeros((len(self.all), len(nodes)), np.int8, like=nodes)

    def contact_faces(
        self,
        q: Positions,
        end: Positions,
        time: float,
        time_step: float,
        before: Indices | None,
        fixed: Mask,
    ) -> Indices:
        """Return the sides (o, n) of nodes on straight paths from q to ``end`` (n, 3) in a step.

        A plane has a single face, so its row is zero.

        before : (o, n) the sides at the beginning of the step
        fixed  : (n,) bool, the nodes that are not free; their side is 0
        """
        sides = np.zeros((len(self.all), len(q)), np.int8, like=q)
        for row, obstacle in enumerate(self.all):
            if obstacle.solid.has_sides:
                side_before = None if before is None else before[row]
                sides[row] = np.where(
                    fixed, 0, obstacle.sides(q, end, time, time_step, side_before)
                )
        return sides

    def same_push(self, q: Positions, time: float, a: Indices, b: Indices) -> bool:
        """Return whether sides a and b (o, l) give the same penalty forces at q (collective)."""
        rows = q[: self.lattice.owned]
        pressing = [row for row, p in enumerate(self.penalties) if p.obstacle.acts_at(time)]
        pushed = ([self._depths(row, (rows, side), time) for row in pressing] for side in (a, b))
        return bool(reduced(self.lattice.table.comm, all(map(np.array_equal, *pushed)), MPI.LAND))

    def push(self, time: float, sides: Indices | None) -> StepContact | None:
        """Return the penalty contact at a time, without friction; None if no penalty acts."""
        owned = self.lattice.owned
        states = [ObstacleContact(p, time, side[:owned]) for p, side in self._pressing(time, sides)]
        return StepContact(states, owned) if states else None

    def during(
        self,
        q: Positions,
        last: Positions | None,
        end: Positions | None,
        step: tuple[float, float],
        sides: Indices | None,
        before: StepContact | None,
    ) -> list[ObstacleContact]:
        """Return the penalty contacts in a step from q, with friction.

        last   : (l, 3) positions a step before q [m], for BDF2; None otherwise
        end    : (l, 3) end positions of an earlier solve of the step [m], which then give the
                 normal forces of friction; None otherwise
        step   : time of the step's end, and its length [s]
        before : contact of the last step, whose elastic slips continue; None without it
        """
        owned = self.lattice.owned
        ended = None if end is None else end[:owned]
        states = before.states if before else []
        return [
            p.during(q[:owned], *step, side[:owned], last=last, end=ended, before=states)
            for p, side in self._pressing(step[0], sides)
        ]

    def contact_stiffness_bound(
        self, q: Positions, speed: float, start: float, time: float, sides: Indices
    ) -> Floats:
        """Return a bound (owned,) [N/m] of the obstacles' stiffness at nodes until ``time``.

        A node counts as inside within twice the distance that it and the obstacle can move.

        q     : (owned, 3) positions at ``start`` [m]
        speed : upper bound of the nodes' speed [m/s]
        """
        stiffness = np.zeros(len(q), like=q)
        for p, side in zip(self.penalties, sides[self.pressing], strict=True):
            if p.obstacle.acts_at(start) or p.obstacle.acts_at(time):
                displacement = p.obstacle.path.displacement_between(start, time)
                margin = 2 * (speed * (time - start) + np.linalg.norm(displacement))
                depths, _ = p.obstacle.depths(q, start)
                stiffness += p.stiffness * ((depths > -margin) | (side > 0))
        return stiffness

    def energy_of_new_obstacles(
        self, q: Positions, begin: float, end: float, sides: Indices
    ) -> float:
        """Return the energy [J] of penalties that began to act in a substep, at its end.

        begin, end : times [s] of the substep
        """
        new = [
            ObstacleContact(p, end, side)
            for p, side in self._pressing(end, sides)
            if not p.obstacle.acts_at(begin)
        ]
        return StepContact(new, self.lattice.owned).energy(q) if new else 0.0

    def friction_work_bound(
        self, before: Placed, after: Placed, time: float, time_step: float, frame: Floats
    ) -> float:
        """Return a bound of the work [J] of moving obstacles' friction on owned nodes in a step.

        The bound is the sum of mu N at the step's start and end, times the obstacle's displacement
        relative to the frame.

        frame : (3,) displacement of the frame of reference in the step [m]
        """
        work = 0.0
        for row, p in enumerate(self.penalties):
            displacement = p.obstacle.path.displacement_between(time - time_step, time)
            distance = float(np.linalg.norm(displacement - frame))
            if p.obstacle.acts_at(time) and p.friction > 0 and distance > 0:
                for state, when in ((before, time - time_step), (after, time)):
                    depth = float(self._depths(row, state, when).sum())
                    work += p.friction * p.stiffness * depth * distance
        return work

    def pressing_displacement(
        self, before: Placed, after: Placed, time: float, time_step: float
    ) -> tuple[float, Floats]:
        """Return the sum of penalty forces [N], and the sum (3,) [N m] of force times displacement.

        Both sums run over this rank's nodes, at a step's start and at its end. The displacement is
        the obstacle's in the step.
        """
        total, weighted = 0.0, np.zeros(3)
        for row, p in enumerate(self.penalties):
            displacement = p.obstacle.path.displacement_between(time - time_step, time)
            for state, when in ((before, time - time_step), (after, time)):
                if p.obstacle.acts_at(when):
                    force = p.stiffness * float(self._depths(row, state, when).sum())
                    total += force
                    weighted = weighted + force * displacement
        return total, weighted

    def change_of_push(
        self, before: Placed, after: Placed, time: float, time_step: float
    ) -> Floats:
        """Return how much a step changes the penalty forces on each owned node, (owned,) [N].

        The result is the sum over obstacles of k times the absolute change of depth.
        """
        change = np.zeros(self.lattice.owned, like=self.lattice.mass)
        for row, p in enumerate(self.penalties):
            depth_change = np.zeros_like(change)
            for sign, state, when in ((-1, before, time - time_step), (1, after, time)):
                if p.obstacle.acts_at(when):
                    depth_change += sign * self._depths(row, state, when)
            change += p.stiffness * np.abs(depth_change)
        return change

    def _depths(self, row: int, state: Placed, time: float) -> Floats:
        """Return the depths (owned,) [m] of nodes in a penalty's obstacle; 0 outside."""
        q, sides = state
        side = (self.no_sides if sides is None else sides)[row, : len(q)]
        return np.maximum(self.penalties[row].obstacle.depths(q, time, side)[0], 0)

    def _pressing(self, time: float, sides: Indices | None) -> list[tuple[Penalty, Indices]]:
        sides = (self.no_sides if sides is None else sides)[self.pressing]
        return [
            (p, side)
            for p, side in zip(self.penalties, sides, strict=True)
            if p.obstacle.acts_at(time)
        ]

    def strike(
        self, q: Positions, q_previous: Positions, step: StepTaken, fixed: Mask
    ) -> tuple[Positions, Positions, float]:
        """Return q_n and q_(n-1) after impacts on obstacles, and the work [J] on this rank's nodes.

        If no node strikes, the arrays are the arguments themselves.

        step  : the completed step, with the sides (o, l) for all obstacles
        fixed : (l, 3) bool, the components that are not free
        """
        free = ~fixed
        work = 0.0
        sides = self.no_sides if step.sides is None else step.sides
        laws: list[Penalty | Exchange] = [*self.penalties, *self.exchanges]
        for law, side in zip(laws, sides, strict=True):
            after, before = law.struck(q, q_previous, replace(step, sides=side))
            if before is not q_previous:
                before = np.where(free, before, q_previous)
                # friction continues from positions that do not change
                after = q if after is q else np.where(free, after, q)
                change = (after - before) - (q - q_previous)
                work += self._impulse_work(law.obstacle, change, step)
                q, q_previous = after, before
        return q, q_previous, work

    def _impulse_work(self, obstacle: Obstacle, change: Rows, step: StepTaken) -> float:
        """Return an obstacle's work [J] in an impact: the impulse times the obstacle's velocity.

        change : (l, 3) change of v_n = q_n - q_(n-1) [m]
        """
        if not obstacle.path.is_moving:
            return 0.0
        displacement = obstacle.path.displacement_between(step.time - step.length, step.time)
        mass = self.lattice.mass
        return float(to_host(mass @ change[: len(mass)]) @ displacement) / step.length**2
