"""Ghost exchange of nodal values, by a PETSc scatter."""

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.lattice.lattice import Lattice
from msmpetsc.solve.linear.unknowns import refuse_unknowns
from msmpetsc.solve.petsc.device import memory_of
from msmpetsc.solve.petsc.events import GHOSTS


class Ghosted:
    """Nodal values (l, 3), first owned nodes, then ghosts, shared with two PETSc vectors."""

    def __init__(self, comm: MPI.Comm, lattice: Lattice):
        refuse_unknowns(lattice.table.total)
        self.values, memory = np.zeros_like(lattice.nodes), memory_of(lattice.nodes)
        numbers = self.values.reshape(-1)
        self.owned = memory.over(numbers[: 3 * lattice.owned], comm)
        self.ghosts = memory.over(numbers[3 * lattice.owned :], PETSc.COMM_SELF)
        index = PETSc.IS().createBlock(3, lattice.ghosts.astype(PETSc.IntType), comm=comm)
        self.scatter = PETSc.Scatter().create(self.owned, index, self.ghosts, None)
        index.destroy()

    def update(self) -> None:
        """Update the ghosts with their owners' values (collective)."""
        with GHOSTS:
            self.scatter.scatter(self.owned, self.ghosts)

    def destroy(self) -> None:
        """Destroy all PETSc objects (collective)."""
        for owner in (self.scatter, self.owned, self.ghosts):
            owner.destroy()
