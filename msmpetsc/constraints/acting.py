"""External forces and prescribed displacements that act at a time."""

from collections.abc import Sequence
from functools import reduce

import numpy as np

from msmpetsc.backend.arrays import Mask, Positions, Rows, like, to_host
from msmpetsc.constraints.loads import Anchor, Load, OwnForce
from msmpetsc.lattice.lattice import Lattice


class ActingForces:
    """External forces on the nodes of a rank. Local positions (l, 3) [m] include ghosts."""

    def __init__(self, lattice: Lattice, loads: Sequence[Load], own_forces: Sequence[OwnForce]):
        self.lattice, self.loads, self.own_forces = lattice, loads, own_forces
        self.all: list[Load | OwnForce] = [*loads, *own_forces]
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

    def at(self, time: float) -> Rows:
        """Return the external force f_ext (owned, 3) [N] at a time [s], as a read-only array."""
        return self._with_own(self.given(time), [force.acts_at(time) for force in self.own_forces])

    def mean(self, begin: float, end: float) -> Rows:
        """Return the mean of f_ext (owned, 3) [N] from begin to end [s], as a read-only array."""
        load = self._shared([load.mean(begin, end) for load in self.loads])
        return self._with_own(load, [force.share(begin, end) for force in self.own_forces])

    def given(self, time: float) -> Rows:
        """Return f_ext (owned, 3) [N] without the users' functions: the part with a potential."""
        return self._shared([load.state_at(time) for load in self.loads])

    def _shared(self, totals: list[tuple[float, ...]]) -> Rows:
        """Return the force (owned, 3) [N] of the loads with these totals."""
        if totals != self._totals:
            self._totals = totals
            self._load = np.zeros((self.lattice.owned, 3), like=self.lattice.nodes)
            for load, total in zip(self.loads, totals, strict=True):
                if any(total):
                    self._load += load.share * like(load.share, np.array(total))
        return self._load

    def _with_own(self, load: Rows, shares: Sequence[float]) -> Rows:
        """Return a force (owned, 3) [N] plus shares of the users' forces."""
        for share, own in zip(shares, self._own, strict=True):
            if share and len(own):
                load = load + share * own
        return load


class Anchors:
    """Anchors, and the nodes that pins and anchors hold. Positions are local, (l, 3) [m]."""

    def __init__(self, lattice: Lattice, anchors: Sequence[Anchor]):
        self.lattice, self.all = lattice, anchors

    def acting(self, time: float) -> list[Anchor]:
        """Return the anchors that act at a time [s]."""
        return [anchor for anchor in self.all if anchor.acts_at(time)]

    def fixed_at(self, time: float) -> Mask:
        """Return the mask (l,) of nodes that are pinned or anchored at a time [s]: no unknowns."""
        return reduce(
            np.logical_or, (anchor.where for anchor in self.acting(time)), self.lattice.pinned
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
            q = np.where(anchor.where[:, None], anchor.path.moved(self.lattice.nodes, pose), q)
        return q
