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

Placed = tuple[Positions, Indices | None]  # q (owned, 3) [m] and sides (o, owned or more), if any


class NodeObstacles:
    """Obstacles that act on nodes: penalties, which press, and exchanges, which nodes bounce off.

    Positions are local, (l, 3) [m], ghosts included; ``time`` [s] is that of a step's end and
    ``time_step`` [s] its length; ``sides`` (o, l) tell of each obstacle by which face each node is
    in contact (faces.side_of): the penalties' first, then the exchanges'.
    """

    def __init__(
        self, lattice: Lattice, penalties: Sequence[Penalty], exchanges: Sequence[Exchange]
    ):
        self.lattice, self.penalties, self.exchanges = lattice, penalties, exchanges
        self.all = [p.obstacle for p in penalties] + [e.obstacle for e in exchanges]
        self.has_sides = any(obstacle.solid.has_sides for obstacle in self.all)
        self.pressing, self.exchanging = (
            slice(len(penalties)),
            slice(len(penalties), None),
        )  # rows of sides
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
        """Return the sides (o, n) of nodes that go straight from q to ``end`` (n, 3) in a step.

        A plane has but one face, which needs no name.

        before : (o, n) the sides when the step began
        held   : (n,) bool, the nodes that do not give way: they have no side
        """
        sides = np.zeros((len(self.all), len(q)), np.int8, like=q)
        for row, obstacle in enumerate(self.all):
            if obstacle.solid.has_sides:
                side_before = None if before is None else before[row]
                sides[row] = np.where(held, 0, obstacle.sides(q, end, time, time_step, side_before))
        return sides

    def same_push(self, q: Positions, time: float, a: Indices, b: Indices) -> bool:
        """Return whether penalties press alike on nodes at q with both sides (o, l) (collective)."""
        rows = q[: self.lattice.owned]
        pressing = [row for row, p in enumerate(self.penalties) if p.obstacle.acts_at(time)]
        pushed = ([self._pushed(row, (rows, side), time) for row in pressing] for side in (a, b))
        return bool(self.lattice.table.comm.allreduce(all(map(np.array_equal, *pushed)), MPI.LAND))

    def push(self, time: float, sides: Indices | None) -> Contact | None:
        """Return the contact with penalties at a time, without friction; None if no penalty acts."""
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
        """Return the penalties that press in a step from q, with friction that goes on from the contact ``before``.

        last, end : as Environment.contact has them
        step      : the time of its end and its length [s]
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

        substep : its begin and end [s], between which an obstacle carries nodes along
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
        """Bound the stiffness (owned,) [N/m] that obstacles add to each node from start to ``time``.

        q, speed : (owned, 3) [m] at the start, and no less than any node's speed [m/s]: twice the way that it
            makes good is counted as inside already
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
        """Return the power [W] of penalties' push at ``time`` on this rank's nodes (owned, 3) [m].

        begin, end : the substep [s] as in which obstacles move
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
        """Return the energy [J], at a substep's end, of the push of penalties that were not there when it began."""
        new = [
            p.state_at(end, side)
            for p, side in self._pressing(end, sides)
            if not p.obstacle.acts_at(begin)
        ]
        return Contact(new, self.lattice.owned).energy(q) if new else 0.0

    def friction_work_bound(
        self, before: Placed, after: Placed, time: float, time_step: float, frame: Floats
    ) -> float:
        """Return no less than the work [J] that friction of moving obstacles does on this rank's nodes in a step.

        It is mu N times how far they go, seen from a frame that goes by ``frame`` (3,) [m] itself.
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
        """Return the push of penalties on this rank's nodes [N], and the sum (3,) [N m] of each push times its way."""
        push, led = 0.0, np.zeros(3)
        for row, p in enumerate(self.penalties):
            if p.obstacle.acts_at(time):
                share = p.stiffness * float(self._pushed(row, state, time).sum())
                push, led = (
                    push + share,
                    led + share * p.obstacle.path.displacement_between(time - time_step, time),
                )
        return push, led

    def change_of_push(
        self, before: Placed, after: Placed, time: float, time_step: float
    ) -> Floats:
        """Return how much penalties' push on this rank's nodes changes in a step, (owned,) [N]."""
        change = np.zeros(self.lattice.owned, like=self.lattice.mass)
        for row, p in enumerate(self.penalties):
            deeper = np.zeros_like(change)
            for sign, state, when in ((-1, before, time - time_step), (1, after, time)):
                if p.obstacle.acts_at(when):
                    deeper += sign * self._pushed(row, state, when)
            change += p.stiffness * np.abs(deeper)
        return change

    def _pushed(self, row: int, state: Placed, time: float) -> Floats:
        """Return how deep nodes (owned,) of a state are in a penalty's obstacle at a time [s], 0 outside [m]."""
        q, sides = state
        side = (self.no_sides if sides is None else sides)[row, : len(q)]
        return np.maximum(self.penalties[row].state_at(time, side).depths(q)[0], 0)

    def _pressing(self, time: float, sides: Indices | None) -> list[tuple[Penalty, Indices]]:
        sides = (self.no_sides if sides is None else sides)[self.pressing]
        return [
            (p, side)
            for p, side in zip(self.penalties, sides, strict=True)
            if p.obstacle.acts_at(time)
        ]

    def strike(
        self, q: Positions, q_previous: Positions, step: StepTaken, held: Mask
    ) -> tuple[Positions, Positions, float]:
        """Return q_n and q_(n-1) after obstacles that nodes bounce off, and their work [J] on this rank's nodes.

        The arrays are the very same if nothing is struck.

        step : with the sides (o, l) of all obstacles
        held : (l,) bool, the nodes that do not give way
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
        """Return an obstacle's work [J] that changes velocities: the impulse times its velocity."""
        if not obstacle.path.leads_away:
            return 0.0
        way = obstacle.path.displacement_between(step.time - step.length, step.time)
        mass = self.lattice.mass
        return float(to_host(mass @ change[: len(mass)]) @ way) / step.length**2
