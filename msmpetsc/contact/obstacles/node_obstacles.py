"""Obstacles that press on nodes or that nodes bounce off, at a time and over a step."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Floats, Indices, Mask, Positions, Rows, like, to_host
from msmpetsc.contact.obstacles.friction import Movers, apply_friction
from msmpetsc.contact.obstacles.moving_solid import Obstacle
from msmpetsc.contact.obstacles.penalty import Contact, ContactState, Penalty
from msmpetsc.contact.obstacles.reflection import Exchange, StepTaken, slowed
from msmpetsc.lattice.lattice import Lattice

# q (owned, 3) [m] and sides (o, owned or more); None without sides
Placed = tuple[Positions, Indices | None]


class NodeObstacles:
    """Obstacles that act on nodes: penalties, which press, and exchanges, which reverse velocities.

    Positions are local, (l, 3) [m], with ghosts. ``time`` [s] is the end of a step and
    ``time_step`` [s] its length. ``sides`` (o, l) are the faces by which nodes are in contact with
    each obstacle (solids.side_of), first of the penalties, then of the exchanges.
    """

    def __init__(
        self, lattice: Lattice, penalties: Sequence[Penalty], exchanges: Sequence[Exchange]
    ):
        self.lattice, self.penalties, self.exchanges = lattice, penalties, exchanges
        self.all = [p.obstacle for p in penalties] + [e.obstacle for e in exchanges]
        self.has_sides = any(obstacle.solid.has_sides for obstacle in self.all)
        # Rows of sides
        self.pressing, self.exchanging = slice(len(penalties)), slice(len(penalties), None)
        self.strikes = bool(exchanges) or any(p.restitution is not None for p in penalties)
        self.has_friction = any(p.friction > 0 for p in penalties)
        nodes = lattice.nodes
        self.no_sides: Indices = np.zeros((len(self.all), len(nodes)), np.int8, like=nodes)

    def contact_faces(
        self,
        q: Positions,
        end: Positions,
        time: float,
        time_step: float,
        before: Indices | None,
        held: Mask,
    ) -> Indices:
        """Return the sides (o, n) of nodes that move straight from q to ``end`` (n, 3) in a step.

        Obstacles of a single face have no sides.

        before : (o, n) sides at the start of the step
        held   : (n,) whether a node is fixed; fixed nodes have no side
        """
        sides = np.zeros((len(self.all), len(q)), np.int8, like=q)
        for row, obstacle in enumerate(self.all):
            if obstacle.solid.has_sides:
                side_before = None if before is None else before[row]
                sides[row] = np.where(held, 0, obstacle.sides(q, end, time, time_step, side_before))
        return sides

    def same_push(self, q: Positions, time: float, a: Indices, b: Indices) -> bool:
        """Return whether penalties press alike on nodes with sides a and b (o, l) (collective)."""
        rows = q[: self.lattice.owned]
        pressing = [row for row, p in enumerate(self.penalties) if p.obstacle.acts_at(time)]
        pushed = ([self._pushed(row, (rows, side), time) for row in pressing] for side in (a, b))
        return bool(self.lattice.table.comm.allreduce(all(map(np.array_equal, *pushed)), MPI.LAND))

    def push(self, time: float, sides: Indices | None) -> Contact | None:
        """Return the contact with penalties at a time, without friction.

        None if no penalty acts.
        """
        states = [
            p.state_at(time, side[: self.lattice.owned]) for p, side in self._pressing(time, sides)
        ]
        return Contact(states, self.lattice.owned) if states else None

    def during(
        self,
        q: Positions,
        last: Positions | None,
        end: Positions | None,
        step: tuple[float, float],
        sides: Indices | None,
        before: Contact | None,
    ) -> list[ContactState]:
        """Return the states of the penalties that act in a step from q.

        last, end : see Environment.contact
        step      : end and length of the step [s]
        before    : contact of the last step, whose friction goes on
        """
        (time, time_step), owned, states = step, self.lattice.owned, []
        held = before.states if before else []
        ended = None if end is None else end[:owned]
        for p, side in self._pressing(time, sides):
            states.append(
                p.during(q[:owned], time, time_step, side[:owned], last, ended).after(
                    held, q[:owned]
                )
            )
        return states

    def apply_friction(
        self,
        nodes: Movers,
        time: float,
        duration: float,
        substep: tuple[float, float],
        sides: Indices,
    ) -> None:
        """Apply friction of obstacles at a time, for a ``duration`` [s], to this rank's nodes.

        substep : begin and end [s], between which an obstacle carries nodes along
        """
        begin, end = substep
        for p, side in self._pressing(time, sides):
            if p.friction > 0:
                carried = like(
                    nodes.q, p.obstacle.path.displacement_between(begin, end) / (end - begin)
                )
                pressed = p.state_at(time, side).pressed(nodes.q)
                apply_friction(nodes, pressed, carried, p.friction * p.stiffness * duration)

    def contact_stiffness_bound(
        self, q: Positions, speed: float, start: float, time: float, sides: Indices
    ) -> Floats:
        """Return a bound (owned,) [N/m] of the stiffness that obstacles add from start to ``time``.

        A node counts as inside from twice its possible way on.

        q     : (owned, 3) [m] at the start
        speed : bound of all nodes' speeds [m/s]
        """
        stiffness = np.zeros(len(q), like=q)
        for p, side in zip(self.penalties, sides[self.pressing], strict=True):
            if p.obstacle.acts_at(start) or p.obstacle.acts_at(time):
                way = p.obstacle.path.displacement_between(start, time)
                reach = 2 * (speed * (time - start) + np.linalg.norm(way))
                inside, _ = p.obstacle.depths(q, start)
                stiffness += p.stiffness * ((inside > -reach) | (side > 0))
        return stiffness

    def power(self, q: Positions, time: float, begin: float, end: float, sides: Indices) -> float:
        """Return the power [W] of penalties on this rank's nodes q (owned, 3) [m] at ``time``.

        begin, end : substep [s] that gives the velocities of obstacles
        """
        power = 0.0
        for p, side in self._pressing(time, sides):
            way = p.obstacle.path.displacement_between(begin, end)
            if way.any():
                _, depth, normal = p.state_at(time, side).pressed(q)
                power += p.stiffness / (end - begin) * float(depth @ (normal @ like(q, way)))
        return power

    def energy_of_new_obstacles(
        self, q: Positions, begin: float, end: float, sides: Indices
    ) -> float:
        """Return the energy [J] at a substep's end of penalties that began to act within it."""
        new = [
            p.state_at(end, side)
            for p, side in self._pressing(end, sides)
            if not p.obstacle.acts_at(begin)
        ]
        return Contact(new, self.lattice.owned).energy(q) if new else 0.0

    def friction_work_bound(
        self, before: Placed, after: Placed, time: float, time_step: float, frame: Floats
    ) -> float:
        """Return a bound of the work [J] of friction of moving obstacles on this rank's nodes in a
        step.

        The bound is mu N times the displacement of each obstacle relative to a frame.

        frame : (3,) displacement of the frame [m]
        """
        work = 0.0
        for row, p in enumerate(self.penalties):
            way = float(
                np.linalg.norm(p.obstacle.path.displacement_between(time - time_step, time) - frame)
            )
            if p.obstacle.acts_at(time) and p.friction > 0 and way > 0:
                for state, when in ((before, time - time_step), (after, time)):
                    work += (
                        p.friction * p.stiffness * float(self._pushed(row, state, when).sum()) * way
                    )
        return work

    def way_of_pressing(self, state: Placed, time: float, time_step: float) -> tuple[float, Floats]:
        """Return the force of penalties on this rank's nodes [N], and its products with
        displacements.

        The second is the sum (3,) [N m] over obstacles of force times displacement in the step.
        """
        push, led = 0.0, np.zeros(3)
        for row, p in enumerate(self.penalties):
            if p.obstacle.acts_at(time):
                share = p.stiffness * float(self._pushed(row, state, time).sum())
                way = p.obstacle.path.displacement_between(time - time_step, time)
                push, led = push + share, led + share * way
        return push, led

    def change_of_push(
        self, before: Placed, after: Placed, time: float, time_step: float
    ) -> Floats:
        """Return the change (owned,) [N] of penalty forces on this rank's nodes in a step."""
        change = np.zeros(self.lattice.owned, like=self.lattice.mass)
        for row, p in enumerate(self.penalties):
            deeper = np.zeros_like(change)
            for sign, state, when in ((-1, before, time - time_step), (1, after, time)):
                if p.obstacle.acts_at(when):
                    deeper += sign * self._pushed(row, state, when)
            change += p.stiffness * np.abs(deeper)
        return change

    def _pushed(self, row: int, state: Placed, time: float) -> Floats:
        """Return the depths (owned,) [m] of nodes in a penalty's obstacle, 0 outside."""
        q, sides = state
        side = (self.no_sides if sides is None else sides)[row, : len(q)]
        return np.maximum(self.penalties[row].state_at(time, side).depths(q)[0], 0)

    def _pressing(self, time: float, sides: Indices | None) -> list[tuple[Penalty, Indices]]:
        """Return the penalties that act at a time [s], each with the sides of its nodes."""
        sides = (self.no_sides if sides is None else sides)[self.pressing]
        return [
            (p, side)
            for p, side in zip(self.penalties, sides, strict=True)
            if p.obstacle.acts_at(time)
        ]

    def strike(
        self, q: Positions, q_previous: Positions, step: StepTaken, held: Mask
    ) -> tuple[Positions, Positions, float]:
        """Return q_n and q_(n-1) after strikes, and the obstacles' work [J] on this rank's nodes.

        The arrays are the same objects if no node strikes.

        step : with the sides (o, l) of all obstacles
        held : (l,) whether a node is fixed
        """
        free, work = ~held[:, None], 0.0
        sides = self.no_sides if step.sides is None else step.sides
        for exchange, side in zip(self.exchanges, sides[self.exchanging], strict=True):
            after, before = exchange.exchanged(q, q_previous, replace(step, sides=side))
            if after is not q:
                after, before = np.where(free, after, q), np.where(free, before, q_previous)
                work += self._impulse_work(
                    exchange.obstacle, (after - before) - (q - q_previous), step
                )
                q, q_previous = after, before
        for p, side in zip(self.penalties, sides[self.pressing], strict=True):
            if p.restitution is not None:
                before = slowed(p.obstacle, p.restitution, q, q_previous, replace(step, sides=side))
                if before is not q_previous:
                    before = np.where(free, before, q_previous)
                    work += self._impulse_work(p.obstacle, q_previous - before, step)
                    q_previous = before
        return q, q_previous, work

    def _impulse_work(self, obstacle: Obstacle, change: Rows, step: StepTaken) -> float:
        """Return the work [J] of an obstacle that changes velocities.

        impulse times its velocity.
        """
        if not obstacle.path.leads_away:
            return 0.0
        way = obstacle.path.displacement_between(step.time - step.length, step.time)
        mass = self.lattice.mass
        return float(to_host(mass @ change[: len(mass)]) @ way) / step.length**2
