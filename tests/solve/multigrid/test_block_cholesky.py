"""The Cholesky factor of the coarsest level agrees with dense solves."""

import numpy as np
from petsc4py import PETSc

from msmpetsc.solve.multigrid.block_cholesky import BlockCholesky


def test_solves_are_those_of_a_dense_matrix_also_with_other_nonzeros():
    """Solve for a chain of light nodes that springs join; in the second round at other nodes."""
    size, rng = 50, np.random.default_rng(3)
    pc = PETSc.PC().createPython(BlockCholesky(), comm=PETSc.COMM_SELF)
    for others in (20, 5):
        root = np.zeros((size, 3, size, 3))
        for i in range(size):
            for j in {i, (i + 1) % size, i * others % size}:
                root[i, :, j] = rng.normal(size=(3, 3))
        root = root.reshape(3 * size, -1)
        dense = 1e-20 * (root @ root.T + np.eye(3 * size))
        dense[np.abs(dense) < 1e-30] = 0
        matrix = PETSc.Mat().createDense(dense.shape, array=dense, comm=PETSc.COMM_SELF)
        sparse = matrix.convert("aij", PETSc.Mat())
        sparse.setBlockSize(3)
        pc.setOperators(sparse)
        pc.setUp()
        x, b = sparse.createVecs()
        b.array[:] = rng.normal(size=3 * size)
        pc.apply(b, x)
        expected = np.linalg.solve(dense, b.array)
        np.testing.assert_allclose(x.array, expected, rtol=0, atol=1e-9 * abs(expected).max())
        for owned in (matrix, sparse, x, b):
            owned.destroy()
    pc.destroy()
