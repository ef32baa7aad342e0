"""Cholesky factor in 3 x 3 blocks, for the coarsest level of multigrid."""

import numpy as np
from petsc4py import PETSc
from scipy.sparse import bsr_array, csr_array

# smallest pivot [kg]; PETSc's own bound is absolute, but a light body has small pivots
LEAST_PIVOT = 1e-300


class BlockCholesky:
    """Solve with a matrix by its Cholesky factor in blocks (a context of PCPYTHON).

    The matrix gives the block size: 3 on a lattice, 1 in GAMG of A. Blocks take 0.4 of the time of
    PETSc's factor of an AIJ, whose symbolic factorisation takes longer than its numeric
    factorisation. PETSc factors blocks in their given order, so ``order`` (n,) first permutes the
    blocks. The ordering is qmd: of the orderings that every PETSc has, it has the least fill.
    """

    def __init__(self) -> None:
        self.factor, self.matrix, self.x, self.y = PETSc.PC(), PETSc.Mat(), PETSc.Vec(), PETSc.Vec()
        self.order, self.side = np.empty(0, PETSc.IntType), 1

    def setUp(self, pc: PETSc.PC) -> None:
        self.destroy(pc)
        given = pc.getOperators()[1]
        self.side = given.getBlockSize()
        begin, columns, values = given.getValuesCSR()
        blocks = bsr_array(csr_array((values, columns, begin)), blocksize=2 * (self.side,))
        count, column = len(blocks.indptr) - 1, blocks.indices
        nodes = csr_array((np.ones(len(column)), column, blocks.indptr), (count, count))
        csr = nodes.indptr, nodes.indices, nodes.data
        pattern = PETSc.Mat().createAIJ(nodes.shape, csr=csr, comm=PETSc.COMM_SELF)
        self.order = pattern.getOrdering("qmd")[0].getIndices()
        pattern.destroy()
        rank = np.argsort(self.order)
        first, second = np.repeat(rank, np.diff(blocks.indptr)), rank[column]
        upper = np.flatnonzero(first <= second)
        upper = upper[np.lexsort((second[upper], first[upper]))]
        begin = np.searchsorted(first[upper], np.arange(count + 1))
        csr = *(part.astype(PETSc.IntType) for part in (begin, second[upper])), blocks.data[upper]
        self.matrix.createSBAIJ(self.side * count, self.side, csr=csr, comm=PETSc.COMM_SELF)
        self.matrix.setOption(PETSc.Mat.Option.SPD, True)
        self.factor.create(PETSc.COMM_SELF)
        self.factor.setType(PETSc.PC.Type.CHOLESKY)
        self.factor.setFactorPivot(LEAST_PIVOT)
        self.factor.setFactorOrdering("natural")
        self.factor.setOperators(self.matrix)
        self.factor.setUp()
        self.x, self.y = self.matrix.createVecs()

    def apply(self, _: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        rows = -1, self.side
        self.x.array_w.reshape(rows)[:] = x.array_r.reshape(rows)[self.order]
        self.factor.apply(self.x, self.y)
        y.array_w.reshape(rows)[self.order] = self.y.array_r.reshape(rows)

    def destroy(self, _: PETSc.PC) -> None:
        for owned in (self.factor, self.matrix, self.x, self.y):
            owned.destroy()
