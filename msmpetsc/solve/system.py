"""The constant matrix A = M + t^2 L as a PETSc matrix (paper Eq. 15-17, without the Kronecker factor).

A is scalar, m x m over the free nodes; solve.operators lets it act on three coordinates at once.
"""

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse import coo_array

from msmpetsc.solve.unknowns import Unknowns


def assemble(comm: MPI.Comm, unknowns: Unknowns, time_step: float) -> PETSc.Mat:
    """A = M + t^2 L [kg] as a PETSc matrix; ``-mat_type`` chooses its type (collective)."""
    lattice = unknowns.lattice
    row = np.full(len(lattice.nodes), -1)
    row[unknowns.free] = np.arange(unknowns.size)
    weight = time_step**2 * lattice.stiffness
    ends = np.concatenate([lattice.springs, lattice.springs[:, ::-1]])
    diagonal = np.bincount(ends[:, 0], np.tile(weight, 2), minlength=len(row))[unknowns.free]
    diagonal += lattice.mass[unknowns.free]
    kept = (row[ends[:, 0]] >= 0) & (unknowns.numbers[ends[:, 1]] >= 0)
    rows = np.concatenate([np.arange(unknowns.size), row[ends[kept, 0]]])
    columns = np.concatenate([unknowns.numbers[unknowns.free], unknowns.numbers[ends[kept, 1]]])
    values = np.concatenate([diagonal, -np.tile(weight, 2)[kept]])
    csr = coo_array((values, (rows, columns)), shape=(unknowns.size, unknowns.total)).tocsr()

    sizes = (unknowns.size, unknowns.total)
    matrix = PETSc.Mat().create(comm=comm)
    matrix.setSizes((sizes, sizes))
    matrix.setType(PETSc.Mat.Type.AIJ)
    matrix.setOption(PETSc.Mat.Option.SPD, True)
    matrix.setFromOptions()
    matrix.setPreallocationCSR((csr.indptr.astype(PETSc.IntType), csr.indices.astype(PETSc.IntType), csr.data))
    return matrix
