"""Limits of PETSc's own integers: 32 bits, unless it was configured --with-64-bit-indices."""

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.errors import InputError

LARGEST = int(np.iinfo(PETSc.IntType).max)
ADVICE = "a PETSc configured with --with-64-bit-indices can"


def refuse_unknowns(nodes: int) -> None:
    """Raise InputError for more ``nodes`` than PETSc can number three coordinates of."""
    if 3 * nodes > LARGEST:
        most = f"the {LARGEST} unknowns that PETSc can number here"
        raise InputError(f"cages: the three coordinates of {nodes} nodes are more than {most}; {ADVICE}")


def refuse_nonzeros(comm: MPI.Comm, own: int) -> None:
    """Raise InputError where a rank has more nonzeros, ``own`` of this one, than PETSc can count."""
    most = comm.allreduce(own, MPI.MAX)
    if most > LARGEST:
        many = f"{most} nonzeros of the system matrix on one rank are more than the {LARGEST} that PETSc can count here"
        raise InputError(f"cages: {many}; more ranks have fewer each, or {ADVICE}")
