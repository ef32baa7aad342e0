"""Estimated memory of the ranks of a run.

The memory of a rank is the program plus the larger of two peaks: FACTOR times the arrays during
the assembly of A, and the construction of W.
"""

from collections.abc import Sequence

import numpy as np

from msmpetsc.backend.arrays import Floats
from msmpetsc.geometry.surface import Surface
from msmpetsc.lattice.partition_counts import Partition

# memory of a rank without arrays [byte]; measured in runs with the preset newton
PROGRAM = 0.29e9
# peak memory over the arrays of a rank [-]; measured in runs with the preset newton
FACTOR = 2.1
# memory of the lattice for a cell, a node (ghosts included) and a spring [byte]
BYTES = np.array([145, 43, 24])
# peak memory for a surface point with 64 weights while W is made [byte]; measured with
# the embedding "affine"
BYTES_OF_POINT = 14 * 64 * 8


def memory_of(partition: Partition, surfaces: Sequence[Surface], mesh_bytes: float) -> Floats:
    """Return the estimated memory (R,) of each rank [byte].

    surfaces   : surfaces that the result stores
    mesh_bytes : memory that reading and preparing the meshes took, on rank 0 [byte]
    """
    # PETSc must get its options before it is imported
    from msmpetsc.solve.linear.operators import assembly_bytes
    from msmpetsc.solve.linear.unknowns import BYTES_OF_NODE

    nodes = partition.nodes + partition.ghosts
    springs = partition.springs
    arrays = BYTES @ np.array([partition.cells, nodes, springs]) + nodes * BYTES_OF_NODE
    arrays += assembly_bytes(nodes, springs, partition.nonzeros)
    points = sum(len(surface.points) for surface in surfaces)
    needed: Floats = PROGRAM + np.maximum(FACTOR * arrays, BYTES_OF_POINT * points / len(nodes))
    needed[0] = max(needed[0], PROGRAM + mesh_bytes)
    return needed
