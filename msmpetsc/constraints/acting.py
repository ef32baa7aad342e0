"""External forces and prescribed displacements that act at a time."""

from collections.abc import Callable, Sequence
from functools import reduce
from typing import NamedTuple

import numpy as np

from msmpetsc.backend.arrays import Floats, Mask, Positions, Rows, like, to_host
from msmpetsc.constraints.loads import Anchor, Load, OwnForce, Pressure, Varying
from msmpetsc.elasticity.pressure import Pressures
from msmpetsc.lattice.lattice import Lattice


class ExternalForces(NamedTuple):
    """External forces at a time, or their means over a time.

    force     : (owned, 3) [N] that do not depend on positions, as a read-only array
    pressures : pressures, whose forces follow the surface
    """

    force: Rows
    pressures: Pressures

    def at(self, q: Positions) -> Rows:
        """Return the force f_ext (owned, 3) [N] at positions q (l, 3) [m] (collective)."""
        if not self.pressures.parts:
            return self.force
        gradient = -self.force
        self.pressures.add_gradient(q, gradient)
        return -gradient


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
        self.all: list[Varying] = [*loads, *own_forces, *pressures]
        self._own = [np.zeros((0, 3))] * len(own_forces)
        self._totals: list[tuple[float, ...]] = []
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

    def at(self, time: float, users: bool = True) -> ExternalForces:
        """Return the external forces at a time [s].

        users : whether with the users' functions, the part without a potential
        """
        return self._with(lambda load: load.state_at(time), users)

    def mean(self, begin: float, end: float) -> ExternalForces:
        """Return the means of the external forces from begin to end [s]."""
        return self._with(lambda load: load.mean(begin, end))

    def ahead(self, before: float, begin: float, end: float) -> ExternalForces:
        """Return (3 f - f') / 2 with the means f from begin to end, f' from before to begin [s]."""

        def total(load: Varying) -> Floats:
            mean = load.mean(begin, end)
            return mean + 0.5 * (mean - load.mean(before, begin))

        return self._with(total)

    def _with(self, total: Callable[[Varying], Floats], users: bool = True) -> ExternalForces:
        """Return the external forces with these totals of each load."""
        totals = [tuple(total(load).tolist()) for load in self.loads]
        if totals != self._totals:
            self._totals = totals
            self._load = np.zeros((self.lattice.owned, 3), like=self.lattice.nodes)
            for load, vector in zip(self.loads, totals, strict=True):
                if any(vector):
                    self._load += load.share * like(load.share, np.array(vector))
        force = self._load
        for function, own in zip(self.own_forces, self._own, strict=True):
            share = float(total(function)[0])
            if users and share and len(own):
                force = force + share * own
        values = [float(total(pressure)[0]) for pressure in self.pressures]
        return ExternalForces(force, Pressures([p.part for p in self.pressures], values))


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
