"""Limits of PETSc's own integers: 32 bits, unless it was configured --with-64-bit-indices."""

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.errors import InputError

BITS = 8 * np.dtype(PETSc.IntType).itemsize
LARGEST = int(np.iinfo(PETSc.IntType).max)
ADVICE = "a PETSc configured with --with-64-bit-indices can"


def refuse_unknowns(nodes: int) -> None:
    """Raises InputError for more ``nodes`` than PETSc can give three coordinates a number each.

    nodes : of all ranks, so that all of them raise it
    """
    if 3 * nodes > LARGEST:
        raise InputError(
            f"cages: the three coordinates of {nodes} nodes are more than the {LARGEST} unknowns that PETSc can number "
            f"here; {ADVICE}"
        )


def refuse_nonzeros(comm: MPI.Comm, own: int) -> None:
    """Raises InputError where a rank has more nonzeros of a matrix than PETSc can count; ``own`` of
    this one (collective)."""
    most = comm.allreduce(own, MPI.MAX)
    if most > LARGEST:
        raise InputError(
            f"cages: {most} nonzeros of the system matrix on one rank are more than the {LARGEST} that PETSc can count "
            f"here; more ranks have fewer each, or {ADVICE}"
        )
