"""What acts on a body from outside at a time: loads, what leads its nodes, obstacles."""

from functools import reduce

import numpy as np

from msmpetsc.model.anchor import Anchor
from msmpetsc.model.build import Model
from msmpetsc.model.penalty import Contact


class Surroundings:
    """Of one model. An implicit step asks once for its end, an explicit one in each substep.

    Positions are local, (l, 3) [m], ghosts included; ``time`` [s] is that of a step's end and ``time_step`` [s]
    its length.
    """

    def __init__(self, model: Model):
        self.lattice, self.loads, self.anchors = model.lattice, model.loads, model.anchors
        self.penalties, self.reflections = model.penalties, model.reflections

    def load(self, time: float) -> np.ndarray:
        """External force f_ext (owned, 3) [N]."""
        total = np.zeros((self.lattice.owned, 3))
        for load in self.loads:
            if load.acts_at(time):
                total += load.force
        return total

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
        q = q.copy()
        for anchor in held:
            q[anchor.where] = self.lattice.nodes[anchor.where] + anchor.path.at(time)
        return q

    def contact(self, q: np.ndarray, time: float, time_step: float) -> Contact | None:
        """What presses in the step that starts from q."""
        owned = self.lattice.owned
        q = q[:owned]
        presses = [p.during(q, time, time_step) for p in self.penalties if p.obstacle.acts_at(time)]
        return Contact(presses, owned) if presses else None

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
