"""Values of nodes whose ghosts follow their owners."""

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.backend.arrays import Array
from msmpetsc.comm import Route
from msmpetsc.lattice.lattice import Lattice
from msmpetsc.solve.petsc.events import GHOSTS
from msmpetsc.solve.petsc.limits import refuse_unknowns
from msmpetsc.solve.petsc.memory import memory_of


class Ghosted:
    """values (l, 3): the owned nodes, then the ghosts, in the memory of two PETSc vectors."""

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
        """Bring the ghosts their owners' values (collective)."""
        with GHOSTS:
            self.scatter.scatter(self.owned, self.ghosts)

    def destroy(self) -> None:
        for owner in (self.scatter, self.owned, self.ghosts):
            owner.destroy()


def with_ghosts(comm: MPI.Comm, lattice: Lattice, rows: Array) -> Array:
    """Rows (l, ...) of local nodes from those of the owned ones, both on the host (collective)."""
    to_owner = Route(comm, lattice.table.owner_of_index(lattice.ghosts))
    asked = to_owner.send(lattice.ghosts) - lattice.table.first
    return np.concatenate([rows, to_owner.answer(rows[asked])])
