"""Memory that a hierarchy keeps beside the lattice, without what factors the coarsest level."""

from functools import partial

import numpy as np
from petsc4py import PETSc

from msmpetsc.solve.multigrid.cycle import Multigrid

INDEX, VALUE = PETSc.IntType().itemsize, PETSc.ScalarType().itemsize


def stored_bytes(multigrid: Multigrid) -> int:
    """Return bytes of this rank: P and matrix of each coarse level, what sums the first, the finest level's blocks."""
    levels = sum(_of_matrix(matrix) for level in multigrid.levels for matrix in (level.interpolation, level.matrix))
    total, fine = multigrid.sum, multigrid.fine
    arrays: list[np.ndarray] = [total.places, total.diagonal, total.upper, fine.inverse, fine.contact]
    for things in (total.springs, total.nodes, total.cells):
        arrays += things.arrays
    return levels + sum(array.nbytes for array in (*arrays, *_blocks(multigrid)))


def _blocks(multigrid: Multigrid) -> list[np.ndarray]:
    """Arrays that the finest level's Hessian has of its own, not of the lattice."""
    elasticity, hessian = multigrid.fine.elasticity, multigrid.fine.elastic
    lent = {id(array) for part in elasticity.parts for array in vars(part).values()}
    parts = [part for part in hessian.parts if isinstance(part, partial)] if hessian else []
    return [array for part in parts for array in part.args if hasattr(array, "nbytes") and id(array) not in lent]


def _of_matrix(matrix: PETSc.Mat) -> int:
    """Return bytes of a rank's part of an AIJ matrix; 0 where it is not there yet."""
    if not matrix:
        return 0
    rows, nonzeros = matrix.getLocalSize()[0], matrix.getInfo(PETSc.Mat.InfoType.LOCAL)["nz_used"]
    return int(nonzeros) * (INDEX + VALUE) + (rows + 1) * INDEX
