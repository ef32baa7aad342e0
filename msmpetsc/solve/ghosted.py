"""Values of nodes whose ghosts follow their owners."""

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.model.lattice import Lattice
from msmpetsc.solve.limits import refuse_unknowns


class Ghosted:
    """values (l, 3): the owned nodes, then the ghosts, in the memory of a ghosted PETSc vector."""

    def __init__(self, comm: MPI.Comm, lattice: Lattice):
        refuse_unknowns(lattice.table.total)
        self.values = np.zeros_like(lattice.nodes)
        self.vector = PETSc.Vec().createGhostWithArray(
            lattice.ghosts.astype(PETSc.IntType),
            self.values.reshape(-1),
            size=(3 * lattice.owned, 3 * lattice.table.total),
            bsize=3,
            comm=comm,
        )

    def update(self) -> None:
        """Bring the ghosts their owners' values (collective)."""
        self.vector.ghostUpdate(addv=PETSc.InsertMode.INSERT, mode=PETSc.ScatterMode.FORWARD)

    def destroy(self) -> None:
        self.vector.destroy()


def with_ghosts(comm: MPI.Comm, lattice: Lattice, rows: np.ndarray) -> np.ndarray:
    """(l, 3) from the owned ones (owned, 3) (collective)."""
    field = Ghosted(comm, lattice)
    field.values[: lattice.owned] = rows
    field.update()
    field.destroy()
    return field.values
