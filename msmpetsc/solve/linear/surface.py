"""The surface of a moment, W @ positions, computed only for frames that are written."""

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse import csr_array

from msmpetsc.geometry.embedding import Embedding
from msmpetsc.model.lattice import Lattice


class SurfaceMotion:
    """Applies this rank's rows of W; a PETSc scatter brings the nodes they need."""

    def __init__(self, comm: MPI.Comm, lattice: Lattice, embedding: Embedding):
        columns, local = np.unique(embedding.indices, return_inverse=True)
        self.weights = csr_array(
            (embedding.weights, local.ravel(), embedding.indptr), shape=(embedding.points, len(columns))
        )
        self.nodes = PETSc.Vec().createMPI((3 * lattice.owned, 3 * lattice.table.total), comm=comm)
        self.needed = PETSc.Vec().createSeq(3 * len(columns), comm=PETSc.COMM_SELF)
        index = PETSc.IS().createBlock(3, columns.astype(PETSc.IntType), comm=comm)
        self.scatter = PETSc.Scatter().create(self.nodes, index, self.needed, None)
        index.destroy()

    def __call__(self, position: np.ndarray) -> np.ndarray:
        """Surface points (v_local, 3) [m] for node positions (owned, 3) [m] (collective)."""
        self.nodes.array[:] = position.ravel()
        self.scatter.scatter(self.nodes, self.needed)
        return self.weights @ self.needed.array_r.reshape(-1, 3)

    def destroy(self) -> None:
        for owner in (self.scatter, self.nodes, self.needed):
            owner.destroy()
