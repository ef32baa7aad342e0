"""The constant A = M + t^2 L as a PETSc matrix (paper Eq. 15-17, without the Kronecker factor).

A is scalar, m x m over the free nodes; solve.linear.operators lets it act on three coordinates at once.
"""

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse import coo_array

from msmpetsc.backend.arrays import Array, to_host
from msmpetsc.errors import InputError
from msmpetsc.solve.linear.unknowns import Unknowns, refuse_nonzeros


def assemble(comm: MPI.Comm, unknowns: Unknowns, time_step: float, prefix: str = "") -> PETSc.Mat:
    """A = M + t^2 L [kg] as a PETSc matrix; ``-mat_type`` chooses its type (collective).

    Raises InputError for more nonzeros than PETSc can count, and for a type whose vectors are not where the arrays are.
    """
    lattice = unknowns.lattice
    row, free = np.full(len(lattice.nodes), -1), to_host(unknowns.free)
    row[free] = np.arange(unknowns.size)
    weight = time_step**2 * lattice.stiffness
    ends = np.concatenate([lattice.springs, lattice.springs[:, ::-1]])
    stiffness = np.bincount(lattice.springs[:, 0], lattice.stiffness, len(row))
    stiffness += np.bincount(lattice.springs[:, 1], lattice.stiffness, len(row))
    diagonal = to_host(unknowns.inertia)[free] + time_step**2 * stiffness[free]
    kept = (row[ends[:, 0]] >= 0) & (unknowns.numbers[ends[:, 1]] >= 0)
    refuse_nonzeros(comm, unknowns.size + int(kept.sum()))
    rows = np.concatenate([np.arange(unknowns.size), row[ends[kept, 0]]])
    columns = unknowns.numbers[np.concatenate([free, ends[kept, 1]])]
    values = np.concatenate([diagonal, -np.tile(weight, 2)[kept]])
    sizes = unknowns.size, unknowns.total
    csr = coo_array((values, (rows, columns)), shape=sizes).tocsr()

    matrix = PETSc.Mat().create(comm=comm)
    matrix.setOptionsPrefix(prefix)
    matrix.setSizes((sizes, sizes))
    matrix.setType(unknowns.memory.mat_type)
    matrix.setOption(PETSc.Mat.Option.SPD, True)
    matrix.setFromOptions()
    matrix.setName("A")
    on_gpu = "cusparse" in unknowns.memory.mat_type
    if ("cusparse" in matrix.getType()) != on_gpu:
        computes = f"the run computes on the {'GPU' if on_gpu else 'CPU'}"
        raise InputError(f"-{prefix}mat_type {matrix.getType()}: {computes}")
    matrix.setPreallocationCSR((csr.indptr.astype(PETSc.IntType), csr.indices.astype(PETSc.IntType), csr.data))
    return matrix


def assembly_bytes(nodes: float | Array, springs: float | Array, nonzeros: float | Array) -> float | Array:
    """Return the bytes that ``assemble`` has at once beside its arguments; numbers, or arrays of a number a rank.

    They are row of each node; weight, ends and kept of each spring; of each nonzero row, column and value,
    COO's two indices, then CSR's index and value.
    """
    return 8 * nodes + (8 + 4 * 4 + 2) * springs + (3 * 8 + 2 * 4 + 4 + 8) * nonzeros
