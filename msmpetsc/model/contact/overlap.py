"""Nodes that lie inside obstacles where these begin: a scene seldom means that, and what reflects leaves them there."""

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import greatest
from msmpetsc.model.contact.obstacle import Obstacle, depths
from msmpetsc.model.lattice import Lattice
from msmpetsc.model.locate import place_of_greatest

TOUCHING = 1e-6  # cells: no depth, but what was rounded


def overlap(
    comm: MPI.Comm, lattice: Lattice, obstacle: Obstacle, q: np.ndarray, held: np.ndarray, time: float
) -> str | None:
    """How many free nodes are inside an obstacle as it stands at ``time``, how deep and where, in words; None if none is
    (collective).

    q, held : (l, 3) [m]; (l,) bool, the nodes that are not free
    """
    owned = slice(lattice.owned)
    inside, _ = depths(q[owned], obstacle.points_at(time), obstacle.normals)
    rows = np.flatnonzero((inside > TOUCHING * lattice.cell_size) & ~held[owned])
    count = comm.allreduce(len(rows))
    if not count:
        return None
    deepest = comm.allreduce(greatest(inside[rows]), MPI.MAX)
    nodes = f"{count} node{'s' if count > 1 else ''}"
    place = place_of_greatest(comm, lattice, rows, inside[rows])
    return (
        f"{nodes} inside {obstacle.key}, up to {deepest:.3g} m ({deepest / lattice.cell_size:.2g} cells) deep: {place}"
    )
