"""Reactions: the force of each pin and anchor on the body.

Of a node that is held, what moves and pulls it leaves  m a + grad E - f_ext - push,  with which the pin or anchor keeps
it where it is. So the forces on a body add up: reactions + loads + pushes = sum of m a, as grad E adds up to nothing.
"""

from dataclasses import dataclass

import numpy as np

from msmpetsc.backend.arrays import Indices, Mask, Rows, to_host


@dataclass(frozen=True)
class Holders:
    """The pins of a scene and then its anchors, by their keys, and whose each node is.

    number : (owned,) of the pin or anchor that has a node, the number of keys where none does
    """

    keys: tuple[str, ...]
    number: Indices

    @classmethod
    def of_masks(cls, masks: dict[str, Mask], owned: int) -> "Holders":
        """Return those of the nodes (owned or more,) of each table; of two tables on a node the first has it."""
        number = np.full(owned, len(masks))
        for holder, where in reversed([*enumerate(masks.values())]):
            number[where[:owned]] = holder
        return cls(tuple(masks), number)

    def totals(self, forces: Rows) -> Rows:
        """Return the sum (a, 3) over the nodes of each of what holds nodes (owned, 3), of this rank's."""
        return sums_by(self.number, forces, len(self.keys))


def sums_by(number: Indices, vectors: Rows, count: int) -> Rows:
    """Return the sums (count, 3) of vectors (n, 3) by their numbers (n,), which are where these are."""
    sums = np.zeros((count, 3))
    for which in range(count):
        sums[which] = to_host(vectors[number == which].sum(axis=0))
    return sums
