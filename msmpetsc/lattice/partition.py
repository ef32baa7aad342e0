"""Parts of a lattice that R ranks would hold, counted on one rank.

Ranks own equal parts of cells and of nodes along the Morton curve; those that R ranks make themselves, by a sample
(comm.SortedKeys), are as large within an eighth.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from msmpetsc.backend.arrays import Array
from msmpetsc.geometry.cages import BodySurface, choose_cell_size, fill
from msmpetsc.lattice.lattice import Lattice, LatticeMaterial, build_lattice
from msmpetsc.scene.body import CagesTable

MOST = 1 << 40  # cells: the scene's own limit is for runs
INNER_SPRINGS = 13  # of each cell, where cells have neighbours on all sides


@dataclass(frozen=True)
class Partition:
    """What each rank holds, one number a rank, (R,): whole where they were counted, fractions where they were scaled.

    cells, nodes : that the rank owns
    ghosts       : nodes of others that its springs reach
    cut          : springs of which it owns one end
    nonzeros     : of its rows of A: of each node the diagonal and the far ends of its springs
    neighbours   : ranks that its ghosts come from: messages that it gets in one exchange, and sends
    """

    cells: Array
    nodes: Array
    ghosts: Array
    cut: Array
    nonzeros: Array
    neighbours: Array

    @property
    def springs(self) -> Array:
        """Number of springs (R,) that each rank keeps."""
        springs: Array = (self.nonzeros - self.nodes + self.cut) / 2
        return springs

    @property
    def all_springs(self) -> float:
        """Number of springs, each counted once."""
        return float(self.springs.sum() - self.cut.sum() / 2)

    def scaled(self, cells: float) -> "Partition":
        """Return the partition of the same body with more cells on as many ranks.

        What fills it grows with the cells, the surface with their power 2/3; ghosts and cut springs
        as they do around a cube of as many nodes as a rank has.
        """
        nodes = self.nodes.sum()
        before = self.cells.sum()
        f = cells / before
        grown = cells + (nodes - before) * f ** (2 / 3)
        springs = INNER_SPRINGS * cells + (self.all_springs - INNER_SPRINGS * before) * f ** (2 / 3)
        side, side_before = np.cbrt(np.array([grown, nodes]) / len(self.nodes))
        around = ((side + 2) ** 3 - side**3) / ((side_before + 2) ** 3 - side_before**3)  # nodes around a cube
        nonzeros = self.nonzeros * (grown + 2 * springs) / self.nonzeros.sum()
        held = self.cells * f, self.nodes * grown / nodes, self.ghosts * around, self.cut * around, nonzeros
        return Partition(*held, self.neighbours)


def partition_of(bodies: Sequence[BodySurface], wanted: CagesTable, ranks: int, most: int) -> tuple[Partition, int]:
    """Return the partition among ``ranks`` ranks, and the cells of the lattice that it was counted on.

    That lattice has about ``most`` cells where more are wanted, and its numbers are scaled.
    """
    h, cells = wanted.cell_size, float(wanted.count or 0)
    if h is not None:  # inside the surface, and sticking out of it, as choose_cell_size has it
        area, enclosed = (sum(abs(getattr(body.report, name)) for body in bodies) for name in ("area", "volume"))
        cells = enclosed / h**3 + 3 / 4 * area / h**2
    if h is None or cells > most:
        h = choose_cell_size(bodies, int(min(cells, most)), MOST, wanted.boundary)
    cages = fill(bodies, h, MOST, wanted.boundary)
    partition = count_partition(build_lattice(cages, LatticeMaterial(1.0, 1.0)), ranks)
    counted = int(partition.cells.sum())
    return partition.scaled(round(cells)) if cells > most else partition, counted


def count_partition(lattice: Lattice, ranks: int) -> Partition:
    """Return the partition among ``ranks`` ranks of a lattice that is whole, built on one rank."""
    cell_rank, rank = (np.arange(n) * ranks // n for n in (len(lattice.cells), lattice.owned))
    of_end = rank[lattice.springs]
    across = of_end[:, 0] != of_end[:, 1]
    to, node = of_end[across].ravel(), lattice.springs[across][:, ::-1].ravel()
    ghosts = np.unique(to * len(rank) + node)
    holder, owner = ghosts // len(rank), rank[ghosts % len(rank)]
    holders = cell_rank, rank, holder, to, np.append(rank, of_end), np.unique(holder * ranks + owner) // ranks
    return Partition(*(np.bincount(rank_of, minlength=ranks) for rank_of in holders))
