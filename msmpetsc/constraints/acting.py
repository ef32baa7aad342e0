"""External forces and prescribed displacements that act at a time."""

from collections.abc import Sequence
from functools import reduce
from itertools import compress

import numpy as np

from msmpetsc.backend.arrays import Mask, Positions, Rows, like, to_host
from msmpetsc.constraints.loads import Anchor, Load, OwnForce, Pressure, Timed
from msmpetsc.elasticity.pressure import Pressures
from msmpetsc.lattice.lattice import Lattice


class ActingForces:
    """External forces on the nodes of a rank. Local positions (l, 3) [m] include ghosts."""

    def __init__(
        self,
        lattice: Lattice,
        loads: Sequence[Load],
        own_forces: Sequence[OwnForce],
        pressures: Sequence[Pressure] = (),
    ):
        self.lattice, self.loads, self.own_forces = lattice, loads, own_forces
        self.pressures = pressures
        self.all: list[Timed] = [*loads, *own_forces, *pressures]
        self._own = [np.zeros((0, 3))] * len(own_forces)
        self._states_of_loads: list[bool | tuple[float, ...]] = []
        self._load = np.zeros((lattice.owned, 3), like=lattice.nodes)

    def begin_step(self, q: Positions, v: Rows, time: float) -> None:
        """Evaluate the users' force functions at the state at which a step begins.

        The forces stay constant within the step. So they are explicit, and accurate to first order
        in the step's length with any integrator.

        q, v : positions (l, 3) [m] and velocities (l, 3) [m/s]
        time : begin of the step [s]
        """
        owned = self.lattice.owned
        for number, force in enumerate(self.own_forces):
            self._own[number] = like(
                q, force.force_at(to_host(q[:owned]), to_host(v[:owned]), time)
            )

    def at(self, time: float) -> Rows:
        """Return the external force f_ext (owned, 3) [N] at a time [s], as a read-only array."""
        load = self.given(time)
        for force, own in zip(self.own_forces, self._own, strict=True):
            if force.acts_at(time) and len(own):
                load = load + own
        return load

    def given(self, time: float) -> Rows:
        """Return f_ext (owned, 3) [N] without the users' functions: the part with a potential."""
        states = [load.state_at(time) for load in self.loads]
        if states != self._states_of_loads:
            self._states_of_loads = states
            self._load = np.zeros((self.lattice.owned, 3), like=self.lattice.nodes)
            for load in compress(self.loads, states):
                self._load += load.force_at(time)
        return self._load

    def pressures_at(self, time: float) -> Pressures:
        """Return the pressures at a time [s]."""
        values = [
            float(p.total.value_at(time)[0]) if p.acts_at(time) else 0.0 for p in self.pressures
        ]
        return Pressures([p.part for p in self.pressures], values)

    def beyond(self, time: float, end: float) -> Rows | None:
        """Return f(time) - f(end) (owned, 3) [N] of time-dependent forces that act at both times.

        end : end of the step that contains ``time`` [s]

        The result is None if no force depends on time.
        """
        difference = None
        for load in self.loads:
            if len(load.total.times) > 1:
                difference = np.zeros_like(self._load) if difference is None else difference
                if load.acts_at(time) and load.acts_at(end):
                    difference += load.force_at(time) - load.force_at(end)
        return difference


class Anchors:
    """Anchors, and the nodes that pins and anchors hold. Positions are local, (l, 3) [m]."""

    def __init__(self, lattice: Lattice, anchors: Sequence[Anchor]):
        self.lattice, self.all = lattice, anchors

    def acting(self, time: float) -> list[Anchor]:
        """Return the anchors that act at a time [s]."""
        return [anchor for anchor in self.all if anchor.acts_at(time)]

    def fixed_at(self, time: float) -> Mask:
        """Return the mask (l, 3) of components that are held at a time [s]: no unknowns."""
        return reduce(
            np.logical_or, (anchor.where for anchor in self.acting(time)), self.lattice.held
        )

    def prescribed(
        self, q: Positions, time: float, begin: float = 0.0, share: float = 1.0
    ) -> Positions | None:
        """Return q with the anchored nodes at their prescribed positions; None without anchors.

        begin, share : the anchors made this share of their motion from ``begin`` [s] to ``time``
        """
        anchors = self.acting(time)
        if not anchors:
            return None
        for anchor in anchors:
            pose = (1 - share) * anchor.path.value_at(begin) + share * anchor.path.value_at(time)
            q = np.where(anchor.where, anchor.path.moved(self.lattice.nodes, pose), q)
        return q
