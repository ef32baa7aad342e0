"""Forces and anchors that act at a time."""

from collections.abc import Sequence
from functools import reduce
from itertools import compress

import numpy as np

from msmpetsc.backend.arrays import Mask, Positions, Rows, like, to_host
from msmpetsc.constraints.loads import Anchor, Load, OwnForce
from msmpetsc.lattice.lattice import Lattice


class ActingForces:
    """External forces on the nodes. Positions are local, (l, 3) [m], ghosts included; times are in [s]."""

    def __init__(self, lattice: Lattice, loads: Sequence[Load], own_forces: Sequence[OwnForce]):
        self.lattice, self.loads, self.own_forces = lattice, loads, own_forces
        self.all: list[Load | OwnForce] = [*loads, *own_forces]
        self._own = [np.zeros((0, 3))] * len(own_forces)
        self._states_of_loads: list[bool | tuple[float, ...]] = []
        self._load = np.zeros((lattice.owned, 3), like=lattice.nodes)

    def begin_step(self, q: Positions, v: Rows, time: float) -> None:
        """Evaluate the forces that are functions, at the state (l, 3) [m], [m/s] that starts a step; they then stay.

        So a step is explicit in them: they are of first order in its length, with any integrator.
        """
        owned = self.lattice.owned
        for number, force in enumerate(self.own_forces):
            self._own[number] = like(
                q, force.force_at(to_host(q[:owned]), to_host(v[:owned]), time)
            )

    def at(self, time: float) -> Rows:
        """Return the external force f_ext (owned, 3) [N], not to be written to."""
        load = self.given(time)
        for force, own in zip(self.own_forces, self._own, strict=True):
            if force.acts_at(time) and len(own):
                load = load + own
        return load

    def given(self, time: float) -> Rows:
        """Return the part of f_ext that has a potential, (owned, 3) [N]: gravity and forces that are no functions."""
        states = [load.state_at(time) for load in self.loads]
        if states != self._states_of_loads:
            self._states_of_loads = states
            self._load = np.zeros((self.lattice.owned, 3), like=self.lattice.nodes)
            for load in compress(self.loads, states):
                self._load += load.force_at(time)
        return self._load

    def beyond(self, time: float, end: float) -> Rows | None:
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


class Anchors:
    """Anchors, and the nodes that they and pins hold. Positions are local, (l, 3) [m]; times are in [s]."""

    def __init__(self, lattice: Lattice, anchors: Sequence[Anchor]):
        self.lattice, self.all = lattice, anchors

    def acting(self, time: float) -> list[Anchor]:
        """Return the anchors that have not let go."""
        return [anchor for anchor in self.all if anchor.acts_at(time)]

    def fixed_at(self, time: float) -> Mask:
        """Return the nodes (l,) bool that are no unknowns, pinned or held by an anchor."""
        return reduce(
            np.logical_or, (anchor.where for anchor in self.acting(time)), self.lattice.pinned
        )

    def prescribed(
        self, q: Positions, time: float, begin: float = 0.0, share: float = 1.0
    ) -> Positions | None:
        """Return q with the anchored nodes where they will be; None if there are none.

        begin, share : they have made but this share of their path from begin [s] to ``time`` [s]
        """
        anchors = self.acting(time)
        if not anchors:
            return None
        for anchor in anchors:
            pose = (1 - share) * anchor.path.value_at(begin) + share * anchor.path.value_at(time)
            q = np.where(anchor.where[:, None], anchor.path.moved(self.lattice.nodes, pose), q)
        return q
