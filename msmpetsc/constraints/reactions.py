"""Reactions: the force of each pin and anchor on the body, and its torque.

Of a node that is held, what moves and pulls it leaves  m a + grad E - f_ext - push,  with which the pin or anchor keeps
it where it is. So the forces on a body add up: reactions + loads + pushes = sum of m a, as grad E adds up to nothing.
"""

from dataclasses import dataclass

import numpy as np

from msmpetsc.backend.arrays import Indices, Mask, Positions, Rows, like, to_host
from msmpetsc.lattice.lattice import Lattice


@dataclass(frozen=True)
class Holders:
    """The pins of a scene and then its anchors, by their keys, and whose each node is.

    number  : (owned,) of the pin or anchor that has a node, the number of keys where none does
    centers : (a, 3) of mass of their nodes at rest [m]
    """

    keys: tuple[str, ...]
    number: Indices
    centers: Positions

    @classmethod
    def of_masks(cls, masks: dict[str, Mask], lattice: Lattice) -> "Holders":
        """Return those of the nodes (l,) of each table; of two tables on a node the first has it (collective)."""
        number = np.full(lattice.owned, len(masks))
        for holder, where in reversed([*enumerate(masks.values())]):
            number[where[: lattice.owned]] = holder
        mass = lattice.mass[:, None]
        sums = sums_by(number, np.hstack([mass * lattice.nodes[: lattice.owned], mass]), len(masks))
        whole = lattice.table.comm.allreduce(sums)
        return cls(tuple(masks), number, whole[:, :3] / np.maximum(whole[:, 3:], np.finfo(float).tiny))

    def totals(self, forces: Rows) -> Rows:
        """Return the sum (a, 3) over the nodes of each of what holds nodes (owned, 3), of this rank's."""
        return sums_by(self.number, forces, len(self.keys))

    def torques(self, q: Positions, forces: Rows, points: Positions) -> Rows:
        """Return the sums (a, 3) [N m] of (q - p) x f over the nodes (owned, 3) of each, of this rank's.

        points : p (a, 3) [m] of each
        """
        of_node = like(q, np.vstack([points, np.zeros(3)]))[self.number]
        return self.totals(np.cross(q - of_node, forces))


def sums_by(number: Indices, vectors: Rows, count: int) -> Rows:
    """Return the sums (count, k) of vectors (n, k) by their numbers (n,), which are where these are."""
    sums = np.zeros((count, vectors.shape[1]))
    for which in range(count):
        sums[which] = to_host(vectors[number == which].sum(axis=0))
    return sums
