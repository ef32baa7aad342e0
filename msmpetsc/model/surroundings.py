"""What acts on a body from outside at a time: loads, what leads its nodes, obstacles."""

from functools import reduce
from itertools import compress

import numpy as np

from msmpetsc.model.anchor import Anchor
from msmpetsc.model.build import Model
from msmpetsc.model.obstacle import depths
from msmpetsc.model.penalty import Contact, Penalty, rub
from msmpetsc.place.arrays import beside


class Surroundings:
    """Of one model. An implicit step asks once for its end, an explicit one in each substep.

    Positions are local, (l, 3) [m], ghosts included; ``time`` [s] is that of a step's end and ``time_step`` [s]
    its length.
    """

    def __init__(self, model: Model):
        self.lattice, self.loads, self.anchors = model.lattice, model.loads, model.anchors
        self.penalties, self.reflections = model.penalties, model.reflections
        self._acting = self._load = None

    def load(self, time: float) -> np.ndarray:
        """External force f_ext (owned, 3) [N], not to be written to."""
        acting = [load.acts_at(time) for load in self.loads]
        if acting != self._acting:
            self._acting, self._load = acting, np.zeros((self.lattice.owned, 3), like=self.lattice.nodes)
            for load in compress(self.loads, acting):
                self._load += load.force
        return self._load

    def held_at(self, time: float) -> list[Anchor]:
        """The anchors that have not let go."""
        return [anchor for anchor in self.anchors if anchor.holds_at(time)]

    def pinned_at(self, time: float) -> np.ndarray:
        """(l,) bool: the nodes that are no unknowns, pinned or held by an anchor."""
        return reduce(np.logical_or, (anchor.where for anchor in self.held_at(time)), self.lattice.pinned)

    def led(self, q: np.ndarray, time: float) -> np.ndarray | None:
        """q with the anchored nodes where they will be; None if there are none."""
        held = self.held_at(time)
        if not held:
            return None
        for anchor in held:
            place = self.lattice.nodes + beside(q, anchor.path.at(time))
            q = np.where(anchor.where[:, None], place, q)
        return q

    def contact(self, q: np.ndarray, time: float, time_step: float) -> Contact | None:
        """What presses in the step that starts from q."""
        owned = self.lattice.owned
        q = q[:owned]
        presses = [penalty.during(q, time, time_step) for penalty in self._pressing(time)]
        return Contact(presses, owned) if presses else None

    def push(self, time: float) -> Contact | None:
        """What presses at a time, without friction."""
        presses = [penalty.at(time) for penalty in self._pressing(time)]
        return Contact(presses, self.lattice.owned) if presses else None

    def rub(
        self,
        q: np.ndarray,
        v: np.ndarray,
        rows: np.ndarray,
        per_mass: np.ndarray,
        time: float,
        duration: float,
        begin: float,
        end: float,
    ) -> None:
        """Friction of obstacles as they stand at ``time``, for a ``duration``, on velocities v (owned, 3) [m/s].

        q, rows, per_mass : (owned, 3) [m]; the nodes that move; (owned,) [1/kg]
        begin, end        : the substep [s] in which an obstacle carries along what it holds
        """
        for p in self._pressing(time):
            if p.friction > 0:
                path, points = p.obstacle.path, p.obstacle.points_at(time)
                carried = beside(q, (path.at(end) - path.at(begin)) / (end - begin))
                impulse = p.friction * p.stiffness * duration
                rub(rows, q, points, p.obstacle.normals, carried, impulse, per_mass, v)

    def stiffest_push(self, q: np.ndarray, speed: float, start: float, time: float) -> np.ndarray:
        """(owned,) [N/m]: no less than what obstacles add to a node's stiffness from start to ``time``.

        q, speed : (owned, 3) [m] at the start, and no less than any node's speed [m/s]: twice the way that it
            makes good is counted as inside already
        """
        stiffness = np.zeros(len(q), like=q)
        for p in self.penalties:
            if p.obstacle.acts_at(start) or p.obstacle.acts_at(time):
                way = p.obstacle.path.at(time) - p.obstacle.path.at(start)
                reach = 2 * (speed * (time - start) + np.linalg.norm(way))
                inside, _ = depths(q, p.obstacle.points_at(start), p.obstacle.normals)
                stiffness += p.stiffness * (inside > -reach)
        return stiffness

    def dragged(self, before: np.ndarray, after: np.ndarray, time: float, time_step: float) -> float:
        """No less than the work [J] that the friction of moving obstacles does on this rank's nodes in a step between
        two positions (owned, 3) [m]: mu N times how far they go."""
        work = 0.0
        for p in self._pressing(time) if self.penalties else ():
            way = np.linalg.norm(p.obstacle.path.at(time) - p.obstacle.path.at(time - time_step))
            if p.friction > 0 and way > 0:
                for q, when in ((before, time - time_step), (after, time)):
                    inside, _ = depths(q, p.obstacle.points_at(when), p.obstacle.normals)
                    work += p.friction * p.stiffness * float(np.maximum(inside, 0).sum()) * way
        return work

    def _pressing(self, time: float) -> list[Penalty]:
        return [penalty for penalty in self.penalties if penalty.obstacle.acts_at(time)]

    def reflect(
        self, q: np.ndarray, q_previous: np.ndarray, time: float, time_step: float, held: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """q_n and q_(n-1) after the obstacles that nodes bounce off; the very same arrays if nothing is touched.

        held : (l,) bool, the nodes that do not give way
        """
        after, before = q, q_previous
        for reflection in self.reflections:
            after, before = reflection.reflect(after, before, time, time_step)
        if after is q:
            return q, q_previous
        free = ~held[:, None]
        return np.where(free, after, q), np.where(free, before, q_previous)
