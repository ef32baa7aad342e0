"""Anchors: nodes with a prescribed displacement."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np

from msmpetsc.backend.arrays import Mask, Positions
from msmpetsc.constraints.time_functions import Motion, Timed
from msmpetsc.lattice.lattice import Lattice


@dataclass(frozen=True)
class Anchor(Timed):
    """Nodes with a prescribed displacement along a path, until the anchor releases them.

    where : (l, 3) bool, the prescribed components of the nodes, ghosts included
    """

    where: Mask
    path: Motion


class Anchors:
    """Anchors, and the nodes that pins and anchors hold. Positions are local, (l, 3) [m]."""

    def __init__(self, lattice: Lattice, anchors: Sequence[Anchor]):
        self.lattice, self.all = lattice, anchors

    def acting(self, time: float) -> list[Anchor]:
        """Return the anchors that act at a time [s]."""
        return [anchor for anchor in self.all if anchor.acts_at(time)]

    def fixed_at(self, time: float) -> Mask:
        """Return the mask (l, 3) of components that are fixed at a time [s]: no unknowns."""
        return reduce(
            np.logical_or, (anchor.where for anchor in self.acting(time)), self.lattice.fixed
        )

    def prescribed(
        self, q: Positions, time: float, begin: float = 0.0, share: float = 1.0
    ) -> Positions | None:
        """Return q with the anchored nodes at their prescribed positions; None without anchors.

        begin, share : the pose is this share of the way from the pose at ``begin`` [s] to the
            pose at ``time``
        """
        anchors = self.acting(time)
        if not anchors:
            return None
        for anchor in anchors:
            pose = (1 - share) * anchor.path.value_at(begin) + share * anchor.path.value_at(time)
            q = np.where(anchor.where, anchor.path.moved(self.lattice.nodes, pose), q)
        return q
