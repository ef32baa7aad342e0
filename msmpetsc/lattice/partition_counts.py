"""Count the partition of a lattice among ranks on a single process."""

from dataclasses import dataclass

import numpy as np

from msmpetsc.backend.arrays import Array
from msmpetsc.lattice.topology import Topology

# springs of a cell with neighbours on all sides [-]
INNER_SPRINGS = 13


@dataclass(frozen=True)
class Partition:
    """Counts (R,) of each rank, counted or scaled from a smaller lattice.

    cells, nodes : owned by the rank
    ghosts       : nodes of other ranks at the far ends of its springs
    cut          : springs between an owned node and a ghost
    nonzeros     : entries in the rank's rows of A: a diagonal, and one for each spring of a node
    neighbours   : ranks that own its ghosts: the messages in a ghost exchange
    """

    cells: Array
    nodes: Array
    ghosts: Array
    cut: Array
    nonzeros: Array
    neighbours: Array

    @property
    def springs(self) -> Array:
        """Return the number of springs (R,) that each rank stores."""
        springs: Array = (self.nonzeros - self.nodes + self.cut) / 2
        return springs

    @property
    def all_springs(self) -> float:
        """Return the number of springs, each counted once."""
        return float(self.springs.sum() - self.cut.sum() / 2)

    def scaled(self, cells: float) -> "Partition":
        """Return the partition of the same body with ``cells`` cells on the same number of ranks.

        The volume part of a count grows as the number of cells, and the surface part as its power
        2/3. Ghosts and cut springs grow as the nodes around a cube of a rank's nodes.
        """
        old_nodes = self.nodes.sum()
        old_cells = self.cells.sum()
        ratio = cells / old_cells
        surface_ratio = ratio ** (2 / 3)
        nodes = cells + (old_nodes - old_cells) * surface_ratio
        springs = INNER_SPRINGS * cells
        springs += (self.all_springs - INNER_SPRINGS * old_cells) * surface_ratio
        side, old_side = np.cbrt(np.array([nodes, old_nodes]) / len(self.nodes))
        ghost_ratio = ((side + 2) ** 3 - side**3) / ((old_side + 2) ** 3 - old_side**3)
        return Partition(
            cells=self.cells * ratio,
            nodes=self.nodes * nodes / old_nodes,
            ghosts=self.ghosts * ghost_ratio,
            cut=self.cut * ghost_ratio,
            nonzeros=self.nonzeros * (nodes + 2 * springs) / self.nonzeros.sum(),
            neighbours=self.neighbours,
        )


def count_partition(lattice: Topology, ranks: int) -> Partition:
    """Return the partition among ``ranks`` ranks of a whole lattice, built on a single rank."""
    cells = len(lattice.corners)
    nodes = len(lattice.octants)
    rank_of_cell = np.arange(cells) * ranks // cells
    rank_of_node = np.arange(nodes) * ranks // nodes
    springs = lattice.springs().ends
    rank_of_end = rank_of_node[springs]
    is_cut = rank_of_end[:, 0] != rank_of_end[:, 1]
    # the far end of each cut spring is a ghost of the rank at its near end
    near_rank = rank_of_end[is_cut].ravel()
    far_node = springs[is_cut][:, ::-1].ravel()
    ghosts = np.unique(near_rank * nodes + far_node)
    ghost_rank = ghosts // nodes
    owner = rank_of_node[ghosts % nodes]
    neighbour_rank = np.unique(ghost_rank * ranks + owner) // ranks

    def per_rank(rank_of: Array) -> Array:
        return np.bincount(rank_of, minlength=ranks)

    return Partition(
        cells=per_rank(rank_of_cell),
        nodes=per_rank(rank_of_node),
        ghosts=per_rank(ghost_rank),
        cut=per_rank(near_rank),
        nonzeros=per_rank(np.append(rank_of_node, rank_of_end)),
        neighbours=per_rank(neighbour_rank),
    )
