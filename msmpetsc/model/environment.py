"""What acts on a body from outside at a time: loads, anchors, obstacles."""

from functools import reduce
from itertools import compress

import numpy as np

from msmpetsc.backend.arrays import like, to_host
from msmpetsc.model.build import Model
from msmpetsc.model.contact.obstacle import Obstacle
from msmpetsc.model.contact.penalty import Contact, ContactState, Penalty, apply_friction
from msmpetsc.model.contact.reflection import Step, slowed
from msmpetsc.model.loads import Anchor, Load, OwnForce
from msmpetsc.model.self_contact.contacts import Touch
from msmpetsc.model.self_contact.kinds import contacts_of, term_of


class Environment:
    """Loads, anchors and obstacles of a model. An implicit step asks once for its end, an explicit one in each substep.

    Positions are local, (l, 3) [m], ghosts included; ``time`` [s] is that of a step's end and ``time_step`` [s]
    its length; ``sides`` (o, l) tell of each obstacle by which face each node is in contact (faces.side_of): the
    penalties' first, then the exchanges'.
    """

    def __init__(self, model: Model):
        self.lattice, self.loads, self.anchors = model.lattice, model.loads, model.anchors
        self.pulling: list[Load | OwnForce] = [*model.loads, *model.own_forces]
        self.own_forces, self._own = model.own_forces, [np.zeros((0, 3))] * len(model.own_forces)
        self.penalties, self.exchanges = model.penalties, model.exchanges
        self.self_contact = contacts_of(self.lattice.table.comm, model.collision) if model.collision else None
        self.touches = bool(self.penalties or self.self_contact)
        self.obstacles = [p.obstacle for p in self.penalties] + [e.obstacle for e in self.exchanges]
        self.has_sides = any(obstacle.has_sides for obstacle in self.obstacles)
        self.pressing, self.exchanging = slice(len(self.penalties)), slice(len(self.penalties), None)  # rows of sides
        self.strikes = bool(self.exchanges) or any(p.restitution is not None for p in self.penalties)
        nodes = self.lattice.nodes
        self.no_sides = np.zeros((len(self.obstacles), len(nodes)), np.int8, like=nodes)
        self._states_of_loads: list[bool | tuple[float, ...]] = []
        self._load = np.zeros((self.lattice.owned, 3), like=nodes)

    def events(self) -> list[float]:
        """Return the times [s] at which a load, an anchor or an obstacle begins, ends or turns."""
        paths = [*(anchor.path for anchor in self.anchors), *(obstacle.path for obstacle in self.obstacles)]
        times = [time for path in paths for time in path.times.tolist()]
        times += [time for load in self.pulling for time in load.events]
        times += [time for obstacle in self.obstacles for time in (obstacle.start, obstacle.stop) if time is not None]
        return times + [anchor.stop for anchor in self.anchors if anchor.stop is not None]

    def begin_step(self, q: np.ndarray, v: np.ndarray, time: float) -> None:
        """Evaluate the forces that are functions, at the state (l, 3) [m], [m/s] that starts a step; they then stay.

        So a step is explicit in them: they are of first order in its length, whatever the integrator.
        """
        owned = self.lattice.owned
        for number, force in enumerate(self.own_forces):
            self._own[number] = like(q, force.at(to_host(q[:owned]), to_host(v[:owned]), time))

    def load(self, time: float) -> np.ndarray:
        """Return the external force f_ext (owned, 3) [N], not to be written to."""
        load = self.given_load(time)
        for force, own in zip(self.own_forces, self._own, strict=True):
            if force.acts_at(time) and len(own):
                load = load + own
        return load

    def given_load(self, time: float) -> np.ndarray:
        """Return the part of f_ext that has a potential, (owned, 3) [N]: gravity and forces that are no functions."""
        states = [load.state_at(time) for load in self.loads]
        if states != self._states_of_loads:
            self._states_of_loads = states
            self._load = np.zeros((self.lattice.owned, 3), like=self.lattice.nodes)
            for load in compress(self.loads, states):
                self._load += load.force_at(time)
        return self._load

    def load_beyond(self, time: float, end: float) -> np.ndarray | None:
        """Return how much more forces (owned, 3) [N] that change pull at a time than at the end of its step; or None.

        None stands for a scene without such forces.
        """
        beyond = None
        for load in self.loads:
            if load.table is not None:
                beyond = np.zeros_like(self._load) if beyond is None else beyond
                if load.acts_at(time) and load.acts_at(end):
                    beyond += load.force_at(time) - load.force_at(end)
        return beyond

    def anchors_at(self, time: float) -> list[Anchor]:
        """Return the anchors that have not let go."""
        return [anchor for anchor in self.anchors if anchor.holds_at(time)]

    def fixed_at(self, time: float) -> np.ndarray:
        """Return the nodes (l,) bool that are no unknowns, pinned or held by an anchor."""
        return reduce(np.logical_or, (anchor.where for anchor in self.anchors_at(time)), self.lattice.pinned)

    def prescribed(self, q: np.ndarray, time: float) -> np.ndarray | None:
        """Return q with the anchored nodes where they will be; None if there are none."""
        anchors = self.anchors_at(time)
        if not anchors:
            return None
        for anchor in anchors:
            target = self.lattice.nodes + like(q, anchor.path.at(time))
            q = np.where(anchor.where[:, None], target, q)
        return q

    def is_same(self, begin: float, end: float) -> bool:
        """Return whether loads, anchors and obstacles are at one time [s] just as at another."""

        def at(time: float) -> list:
            loads = [load.state_at(time) for load in self.pulling]
            anchors = [anchor.holds_at(time) and tuple(anchor.path.at(time)) for anchor in self.anchors]
            return [*loads, *anchors, *(o.acts_at(time) and tuple(o.path.at(time)) for o in self.obstacles)]

        return at(begin) == at(end)

    def last_change(self, until: float) -> float:
        """Return when loads, anchors and obstacles change for the last time [s] before ``until``, or 0."""
        times: list[float | None] = [time for load in self.pulling for time in load.events]
        times += [time for anchor in self.anchors for time in (*anchor.path.times.tolist(), anchor.stop)]
        times += [time for o in self.obstacles for time in (*o.path.times.tolist(), o.start, o.stop)]
        return max((time for time in times if time is not None and time <= until), default=0.0)

    def contact_faces(
        self,
        q: np.ndarray,
        end: np.ndarray,
        time: float,
        time_step: float,
        before: np.ndarray | None,
        held: np.ndarray,
    ) -> np.ndarray:
        """Return the sides (o, n) of nodes that go straight from q to ``end`` (n, 3) in a step.

        A plane has but one face, which needs no name.

        before : (o, n) the sides when the step began
        held   : (n,) bool, the nodes that do not give way: they have no side
        """
        if not self.has_sides:
            return self.no_sides[:, : len(q)]
        sides = np.zeros((len(self.obstacles), len(q)), np.int8, like=q)
        for row, obstacle in enumerate(self.obstacles):
            if obstacle.has_sides:
                side_before = None if before is None else before[row]
                sides[row] = np.where(held, 0, obstacle.sides(q, end, time, time_step, side_before))
        return sides

    def same_push(self, q: np.ndarray, time: float, sides_a: np.ndarray, sides_b: np.ndarray) -> bool:
        """Return whether penalties press on this rank's nodes at q just the same with either sides (o, l)."""
        rows = q[: self.lattice.owned]
        states = zip(self._states(time, sides_a), self._states(time, sides_b), strict=True)
        return all(
            np.array_equal(np.maximum(a.depths(rows)[0], 0), np.maximum(b.depths(rows)[0], 0)) for a, b in states
        )

    def contact(
        self,
        q: np.ndarray,
        end: np.ndarray,
        time: float,
        time_step: float,
        sides: np.ndarray,
        before: np.ndarray | None = None,
    ) -> Contact | None:
        """Return what presses in the step from q to about ``end``, friction included; None if nothing does.

        before : (l, 3) [m] positions one step before q, of a step that looks back to them
        """
        owned, surface = self.lattice.owned, None
        last = None if before is None else before[:owned]
        pressing = self._pressing(time, sides)
        states = [p.during(q[:owned], time, time_step, side[:owned], last) for p, side in pressing]
        if self.self_contact:
            self.self_contact.expect(q, end)
            surface = term_of(self.self_contact, q, time_step)
        return Contact(states, owned, surface) if states or surface else None

    def forget(self) -> None:
        """Know nothing of the steps before (collective)."""
        if self.self_contact:
            self.self_contact.forget()

    def touch(self, q: np.ndarray) -> Touch:
        """Return what there is of contacts of the surface with itself at q (collective)."""
        return self.self_contact.touch(q) if self.self_contact else Touch()

    def push(self, time: float, sides: np.ndarray | None) -> Contact | None:
        """Return what presses at a time, without friction; None if nothing does. None stands for no sides."""
        states = self._states(time, sides)
        return Contact(states, self.lattice.owned) if states else None

    def _states(self, time: float, sides: np.ndarray | None) -> list[ContactState]:
        return [p.at(time, side[: self.lattice.owned]) for p, side in self._pressing(time, sides)]

    def apply_friction(
        self,
        q: np.ndarray,
        v: np.ndarray,
        rows: np.ndarray,
        per_mass: np.ndarray,
        time: float,
        duration: float,
        begin: float,
        end: float,
        sides: np.ndarray,
    ) -> None:
        """Apply friction of obstacles as they stand at a time, for a ``duration`` [s], to v (owned, 3) [m/s].

        q, rows, per_mass : (owned, 3) [m]; the nodes that move; (owned,) [1/kg]
        begin, end        : the substep [s] in which an obstacle carries along what it holds
        """
        for p, side in self._pressing(time, sides):
            if p.friction > 0:
                path = p.obstacle.path
                carried = like(q, (path.at(end) - path.at(begin)) / (end - begin))
                apply_friction(rows, q, p.at(time, side), carried, p.friction * p.stiffness * duration, per_mass, v)

    def contact_stiffness_bound(
        self, q: np.ndarray, speed: float, start: float, time: float, sides: np.ndarray
    ) -> np.ndarray:
        """Return (owned,) [N/m] no less than what obstacles add to a node's stiffness from start to ``time``.

        q, speed : (owned, 3) [m] at the start, and no less than any node's speed [m/s]: twice the way that it
            makes good is counted as inside already
        """
        stiffness = np.zeros(len(q), like=q)
        for p, side in zip(self.penalties, sides[self.pressing], strict=True):
            if p.obstacle.acts_at(start) or p.obstacle.acts_at(time):
                way = p.obstacle.path.at(time) - p.obstacle.path.at(start)
                reach = 2 * (speed * (time - start) + np.linalg.norm(way))
                inside, _ = p.obstacle.depths(q, start)
                stiffness += p.stiffness * ((inside > -reach) | (side > 0))
        return stiffness

    def power(self, q: np.ndarray, time: float, begin: float, end: float, sides: np.ndarray) -> float:
        """Return the power [W] of the push of penalties at ``time`` on this rank's nodes (owned, 3) [m].

        begin, end : the substep [s] as in which obstacles move
        """
        power = 0.0
        for p, side in self._pressing(time, sides):
            way = p.obstacle.path.at(end) - p.obstacle.path.at(begin)
            if way.any():
                _, depth, normal = p.at(time, side).pressed(q)
                power += p.stiffness / (end - begin) * float(depth @ (normal @ like(q, way)))
        return power

    def energy_of_new_obstacles(self, q: np.ndarray, begin: float, end: float, sides: np.ndarray) -> float:
        """Return the energy [J], at a substep's end, of the push of penalties that were not there when it began."""
        new = [p.at(end, side) for p, side in self._pressing(end, sides) if not p.obstacle.acts_at(begin)]
        return Contact(new, self.lattice.owned).energy(q) if new else 0.0

    def friction_work_bound(
        self,
        before: tuple[np.ndarray, np.ndarray | None],
        after: tuple[np.ndarray, np.ndarray | None],
        time: float,
        time_step: float,
    ) -> float:
        """Return no less than the work [J] that friction of moving obstacles does on this rank's nodes in a step.

        It is mu N times how far they go.

        before, after : positions (owned, 3) [m] and sides (o, owned or more), None where there are none
        """
        work = 0.0
        for row, p in enumerate(self.penalties):
            if not p.obstacle.acts_at(time):
                continue
            way = float(np.linalg.norm(p.obstacle.path.at(time) - p.obstacle.path.at(time - time_step)))
            if p.friction > 0 and way > 0:
                for (q, sides), when in ((before, time - time_step), (after, time)):
                    side = (self.no_sides if sides is None else sides)[row, : len(q)]
                    inside, _ = p.at(when, side).depths(q)
                    work += p.friction * p.stiffness * float(np.maximum(inside, 0).sum()) * way
        return work

    def change_of_push(
        self,
        before: tuple[np.ndarray, np.ndarray | None],
        after: tuple[np.ndarray, np.ndarray | None],
        time: float,
        time_step: float,
    ) -> np.ndarray:
        """Return by how much the push of penalties on this rank's nodes changes in a step, (owned,) [N].

        before, after : positions (owned, 3) [m] and sides (o, owned or more), None where there are none
        """
        change = np.zeros(self.lattice.owned, like=self.lattice.mass)
        for row, p in enumerate(self.penalties):
            depths = []
            for (q, sides), when in ((before, time - time_step), (after, time)):
                side = (self.no_sides if sides is None else sides)[row, : len(q)]
                acts = p.obstacle.acts_at(when)
                depths.append(np.maximum(p.at(when, side).depths(q)[0], 0) if acts else np.zeros_like(change))
            change += p.stiffness * np.abs(depths[1] - depths[0])
        return change

    def _pressing(self, time: float, sides: np.ndarray | None) -> list[tuple[Penalty, np.ndarray]]:
        sides = (self.no_sides if sides is None else sides)[self.pressing]
        return [(p, side) for p, side in zip(self.penalties, sides, strict=True) if p.obstacle.acts_at(time)]

    def strike(
        self, q: np.ndarray, q_previous: np.ndarray, step: tuple[float, float, np.ndarray], held: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, float]:
        """Return q_n and q_(n-1) after obstacles that nodes bounce off, and their work [J] on this rank's nodes.

        The arrays are the very same if nothing is struck.

        step : the time [s] that it ended at, its length [s], and the sides (o, l)
        held : (l,) bool, the nodes that do not give way
        """
        time, time_step, sides = step
        free, work = ~held[:, None], 0.0
        for exchange, side in zip(self.exchanges, sides[self.exchanging], strict=True):
            after, before = exchange.exchanged(q, q_previous, Step(time, time_step, side))
            if after is not q:
                after, before = np.where(free, after, q), np.where(free, before, q_previous)
                work += self._impulse_work(exchange.obstacle, (after - before) - (q - q_previous), time, time_step)
                q, q_previous = after, before
        for p, side in zip(self.penalties, sides[self.pressing], strict=True):
            if p.restitution is not None:
                before = slowed(p.obstacle, p.restitution, q, q_previous, Step(time, time_step, side))
                if before is not q_previous:
                    before = np.where(free, before, q_previous)
                    work += self._impulse_work(p.obstacle, q_previous - before, time, time_step)
                    q_previous = before
        return q, q_previous, work

    def _impulse_work(self, obstacle: Obstacle, change: np.ndarray, time: float, time_step: float) -> float:
        """Return an obstacle's work [J] that changes velocities by change / t: the impulse times its velocity."""
        if not obstacle.path.leads_away:
            return 0.0
        way = obstacle.path.at(time) - obstacle.path.at(time - time_step)
        mass = self.lattice.mass
        return float(to_host(mass @ change[: len(mass)]) @ way) / time_step**2
