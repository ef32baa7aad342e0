"""What acts on a body from outside at a time: loads, anchors, obstacles."""

from dataclasses import replace
from functools import reduce
from itertools import compress
from typing import Any

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Floats, Indices, Mask, Positions, Rows, like, to_host
from msmpetsc.build import Model
from msmpetsc.constraints.loads import Anchor, Load, OwnForce
from msmpetsc.contact.obstacles.friction import Movers, apply_friction
from msmpetsc.contact.obstacles.moving_solid import Obstacle
from msmpetsc.contact.obstacles.penalty import Contact, Penalty
from msmpetsc.contact.obstacles.reflection import StepTaken, slowed
from msmpetsc.contact.surface.pairs import Contacts, NearPairs, Touch
from msmpetsc.contact.surface.term import SurfaceContact

GROWN = 4.0  # times more or less than the push that friction went by: then the step is solved again

Placed = tuple[Positions, Indices | None]  # q (owned, 3) [m] and sides (o, owned or more), if any


class Environment:
    """Loads, anchors and obstacles of a model. An implicit step asks once for its end, an explicit one in each substep.

    Positions are local, (l, 3) [m], ghosts included; ``time`` [s] is that of a step's end and
    ``time_step`` [s] its length; ``sides`` (o, l) tell of each obstacle by which face each node is
    in contact (faces.side_of): the penalties' first, then the exchanges'.
    """

    def __init__(self, model: Model):
        self.lattice, self.loads, self.anchors = model.lattice, model.loads, model.anchors
        self.damping = model.damping  # of velocities, by the mass [1/s]
        self.retardation = model.retardation  # viscosity over stiffness [s]
        self.pulling: list[Load | OwnForce] = [*model.loads, *model.own_forces]
        self.own_forces, self._own = model.own_forces, [np.zeros((0, 3))] * len(model.own_forces)
        self.penalties, self.exchanges = model.penalties, model.exchanges
        self.self_contact = NearPairs(self.lattice.table.comm, model.collision) if model.collision else None
        self.contacts = Contacts(self.self_contact, 0.0, 0.0) if self.self_contact else None  # of the last step begun
        self.has_friction = any(p.friction > 0 for p in self.penalties) or bool(
            self.self_contact and self.self_contact.law.friction > 0
        )
        self._ended: tuple[Positions, Contact] | None = None  # the last step, if it had contact, and what there was
        self.touches = bool(self.penalties or self.self_contact)
        self.moving: list[Anchor | Obstacle] = [*model.anchors, *model.obstacles]
        self.obstacles = [p.obstacle for p in self.penalties] + [e.obstacle for e in self.exchanges]
        self.has_sides = any(obstacle.solid.has_sides for obstacle in self.obstacles)
        self.pressing, self.exchanging = slice(len(self.penalties)), slice(len(self.penalties), None)  # rows of sides
        self.strikes = bool(self.exchanges) or any(p.restitution is not None for p in self.penalties)
        nodes = self.lattice.nodes
        self.no_sides: Indices = np.zeros((len(self.obstacles), len(nodes)), np.int8, like=nodes)
        self._states_of_loads: list[bool | tuple[float, ...]] = []
        self._load = np.zeros((self.lattice.owned, 3), like=nodes)

    def events(self) -> list[float]:
        """Return the times [s] at which a load, an anchor or an obstacle begins, ends or turns."""
        turns = [time for moving in self.moving for time in moving.path.times.tolist()]
        return turns + [time for timed in (*self.pulling, *self.moving) for time in timed.events]

    def begin_step(self, q: Positions, v: Rows, time: float) -> None:
        """Evaluate the forces that are functions, at the state (l, 3) [m], [m/s] that starts a step; they then stay.

        So a step is explicit in them: they are of first order in its length, with any integrator.
        """
        owned = self.lattice.owned
        for number, force in enumerate(self.own_forces):
            self._own[number] = like(q, force.force_at(to_host(q[:owned]), to_host(v[:owned]), time))

    def load(self, time: float) -> Rows:
        """Return the external force f_ext (owned, 3) [N], not to be written to."""
        load = self.given_load(time)
        for force, own in zip(self.own_forces, self._own, strict=True):
            if force.acts_at(time) and len(own):
                load = load + own
        return load

    def given_load(self, time: float) -> Rows:
        """Return the part of f_ext that has a potential, (owned, 3) [N]: gravity and forces that are no functions."""
        states = [load.state_at(time) for load in self.loads]
        if states != self._states_of_loads:
            self._states_of_loads = states
            self._load = np.zeros((self.lattice.owned, 3), like=self.lattice.nodes)
            for load in compress(self.loads, states):
                self._load += load.force_at(time)
        return self._load

    def load_beyond(self, time: float, end: float) -> Rows | None:
        """Return how much more forces (owned, 3) [N] that change pull at a time than at the end of its step; or None.

        None stands for a scene without such forces.
        """
        beyond = None
        for load in self.loads:
            if len(load.total.times) > 1:
                beyond = np.zeros_like(self._load) if beyond is None else beyond
                if load.acts_at(time) and load.acts_at(end):
                    beyond += load.force_at(time) - load.force_at(end)
        return beyond

    def anchors_at(self, time: float) -> list[Anchor]:
        """Return the anchors that have not let go."""
        return [anchor for anchor in self.anchors if anchor.acts_at(time)]

    def fixed_at(self, time: float) -> Mask:
        """Return the nodes (l,) bool that are no unknowns, pinned or held by an anchor."""
        return reduce(np.logical_or, (anchor.where for anchor in self.anchors_at(time)), self.lattice.pinned)

    def prescribed(self, q: Positions, time: float, begin: float = 0.0, share: float = 1.0) -> Positions | None:
        """Return q with the anchored nodes where they will be; None if there are none.

        begin, share : they have made but this share of their path from begin [s] to ``time`` [s]
        """
        anchors = self.anchors_at(time)
        if not anchors:
            return None
        for anchor in anchors:
            pose = (1 - share) * anchor.path.value_at(begin) + share * anchor.path.value_at(time)
            q = np.where(anchor.where[:, None], anchor.path.moved(self.lattice.nodes, pose), q)
        return q

    def is_same(self, begin: float, end: float) -> bool:
        """Return whether loads, anchors and obstacles are at one time [s] just as at another."""

        def at(time: float) -> list[Any]:
            loads: list[Any] = [load.state_at(time) for load in self.pulling]
            return loads + [moving.acts_at(time) and tuple(moving.path.value_at(time)) for moving in self.moving]

        return at(begin) == at(end)

    def contact_faces(
        self, q: Positions, end: Positions, time: float, time_step: float, before: Indices | None, held: Mask
    ) -> Indices:
        """Return the sides (o, n) of nodes that go straight from q to ``end`` (n, 3) in a step.

        A plane has but one face, which needs no name.

        before : (o, n) the sides when the step began
        held   : (n,) bool, the nodes that do not give way: they have no side
        """
        sides = np.zeros((len(self.obstacles), len(q)), np.int8, like=q)
        for row, obstacle in enumerate(self.obstacles):
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

    def contact(
        self,
        q: Positions,
        last: Positions | None,
        time: float,
        time_step: float,
        sides: Indices | None,
        end: Positions | None = None,
    ) -> Contact | None:
        """Return what presses in the step from q, with friction; None if nothing does (collective).

        last : (l, 3) [m] positions one step before q, of a step that looks back to them
        end  : (l, 3) [m] where an earlier solve of the step has ended: friction then goes by the push there
        """
        owned, surface, before = self.lattice.owned, None, self._before(q)
        states, held, ended = [], before.states if before else [], None if end is None else end[:owned]
        for p, side in self._pressing(time, sides):
            states.append(p.during(q[:owned], time, time_step, side[:owned], last, ended).after(held, q[:owned]))
        if self.contacts and not self.contacts.apart:
            surface = SurfaceContact(self.contacts, q, time_step, last, end, before.surface if before else None)
        return Contact(states, owned, surface) if states or surface else None

    def begin_contacts(self, q: Positions, time: float, time_step: float) -> None:
        """Begin a step at q: the surface is asked about around its contacts alone, if these are few (collective)."""
        if self.self_contact:
            begin = max(time - time_step, 0.0)
            self.contacts = Contacts(self.self_contact, begin, time, self.contacts)
            self.contacts.narrow(q, begin)

    def _before(self, q: Positions) -> Contact | None:
        """Return the contact of the step that ended at q; None if the last one known did not."""
        if self._ended is None:
            return None
        ended, contact = self._ended
        is_there = bool(np.array_equal(q[: self.lattice.owned], ended))
        return contact if self.lattice.table.comm.allreduce(is_there, MPI.LAND) else None

    def end_step(self, x: Positions, contact: Contact | None) -> None:
        """A step has come to x (l, 3) [m]: friction of the next one goes on from there."""
        self._ended = (x[: self.lattice.owned].copy(), contact) if contact and self.has_friction else None

    def friction_lags(self, x: Positions, contact: Contact | None) -> bool:
        """Return whether friction of a step to x (l, 3) [m] went by a push far from the one there (collective)."""
        if not (contact and self.has_friction):
            return False
        by, at_end = self.lattice.table.comm.allreduce(contact.friction_limits(x))
        return bool(max(at_end, by) > GROWN * min(at_end, by))

    def forget(self) -> None:
        """Forget what earlier steps showed (collective)."""
        self._ended = None
        if self.self_contact:
            self.self_contact.forget()
            self.contacts = Contacts(self.self_contact, 0.0, 0.0)

    def touch(self, q: Positions, time: float) -> Touch:
        """Return what contacts the surface has with itself and obstacles at q and a time [s] (collective)."""
        return self.contacts.touch(q, time) if self.contacts else Touch()

    def push(self, time: float, sides: Indices | None) -> Contact | None:
        """Return what presses at a time, without friction; None if nothing does."""
        states = [p.state_at(time, side[: self.lattice.owned]) for p, side in self._pressing(time, sides)]
        return Contact(states, self.lattice.owned) if states else None

    def apply_friction(
        self, nodes: Movers, time: float, duration: float, substep: tuple[float, float], sides: Indices
    ) -> None:
        """Apply friction of obstacles at a time, for a ``duration`` [s], to this rank's nodes.

        substep : its begin and end [s], between which an obstacle carries along what it holds
        """
        begin, end = substep
        for p, side in self._pressing(time, sides):
            if p.friction > 0:
                carried = like(nodes.q, p.obstacle.path.displacement_between(begin, end) / (end - begin))
                pressed = p.state_at(time, side).pressed(nodes.q)
                apply_friction(nodes, pressed, carried, p.friction * p.stiffness * duration)

    def contact_stiffness_bound(self, q: Positions, speed: float, start: float, time: float, sides: Indices) -> Floats:
        """Return a bound (owned,) [N/m] of what obstacles add to a node's stiffness from start to ``time``.

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

    def energy_of_new_obstacles(self, q: Positions, begin: float, end: float, sides: Indices) -> float:
        """Return the energy [J], at a substep's end, of the push of penalties that were not there when it began."""
        new = [p.state_at(end, side) for p, side in self._pressing(end, sides) if not p.obstacle.acts_at(begin)]
        return Contact(new, self.lattice.owned).energy(q) if new else 0.0

    def friction_work_bound(self, before: Placed, after: Placed, time: float, time_step: float, frame: Floats) -> float:
        """Return no less than the work [J] that friction of moving obstacles does on this rank's nodes in a step.

        It is mu N times how far they go, seen from a frame that goes by ``frame`` (3,) [m] itself.
        """
        work = 0.0
        for row, p in enumerate(self.penalties):
            way = float(np.linalg.norm(p.obstacle.path.displacement_between(time - time_step, time) - frame))
            if p.obstacle.acts_at(time) and p.friction > 0 and way > 0:
                for state, when in ((before, time - time_step), (after, time)):
                    work += p.friction * p.stiffness * float(self._pushed(row, state, when).sum()) * way
        return work

    def way_of_pressing(self, state: Placed, time: float, time_step: float) -> tuple[float, Floats]:
        """Return the push of penalties on this rank's nodes [N], and the sum (3,) [N m] of each push times its way."""
        push, led = 0.0, np.zeros(3)
        for row, p in enumerate(self.penalties):
            if p.obstacle.acts_at(time):
                share = p.stiffness * float(self._pushed(row, state, time).sum())
                push, led = push + share, led + share * p.obstacle.path.displacement_between(time - time_step, time)
        return push, led

    def change_of_push(self, before: Placed, after: Placed, time: float, time_step: float) -> Floats:
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
        return [(p, side) for p, side in zip(self.penalties, sides, strict=True) if p.obstacle.acts_at(time)]

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
                work += self._impulse_work(exchange.obstacle, (after - before) - (q - q_previous), step)
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
