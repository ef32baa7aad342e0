"""Ghost exchange of nodal values, by a PETSc scatter."""

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.backend.arrays import Array, Indices
from msmpetsc.lattice.lattice import Lattice
from msmpetsc.solve.petsc.device import memory_of
from msmpetsc.solve.petsc.events import GHOSTS
from msmpetsc.solve.petsc.library import refuse_unknowns


def local_numbers(columns: Indices, first: int, owned: int) -> tuple[Indices, Indices]:
    """Return local numbers (k,) of global ``columns`` (k,), and the global numbers (g,) of ghosts.

    Local numbers count owned nodes first, then ghosts.
    """
    is_own = (columns >= first) & (columns < first + owned)
    ghosts, number = np.unique(columns[~is_own], return_inverse=True)
    local = columns - first
    local[~is_own] = owned + number
    return local, ghosts


class Ghosted:
    """Nodal values (l, 3), owned nodes first, then ghosts, in memory shared with PETSc vectors."""

    def __init__(self, comm: MPI.Comm, owned: int, ghosts: Indices, device: Array):
        """Allocate zeros on the device of the array ``device`` (collective).

        owned  : number of owned nodes
        ghosts : (g,) global numbers of ghosts
        """
        self.values = np.zeros((owned + len(ghosts), 3), like=device)
        numbers, memory = self.values.reshape(-1), memory_of(device)
        self.owned = memory.over(numbers[: 3 * owned], comm)
        self.ghosts = memory.over(numbers[3 * owned :], PETSc.COMM_SELF)
        index = PETSc.IS().createBlock(3, ghosts.astype(PETSc.IntType), comm=comm)
        self.scatter = PETSc.Scatter().create(self.owned, index, self.ghosts, None)
        index.destroy()

    @classmethod
    def of(cls, comm: MPI.Comm, lattice: Lattice) -> "Ghosted":
        """Return the values of a lattice's nodes. Raises InputError if PETSc cannot number them."""
        refuse_unknowns(lattice.table.total)
        return cls(comm, lattice.owned, lattice.ghosts, lattice.nodes)

    def update(self) -> None:
        """Update the ghosts with their owners' values (collective)."""
        with GHOSTS:
            self.scatter.scatter(self.owned, self.ghosts)

    def add_ghosts(self) -> None:
        """Add the ghosts' values to their owners' values (collective)."""
        with GHOSTS:
            self.scatter.scatter(
                self.ghosts, self.owned, PETSc.InsertMode.ADD, PETSc.ScatterMode.REVERSE
            )

    def destroy(self) -> None:
        """Destroy all PETSc objects (collective)."""
        for owner in (self.scatter, self.owned, self.ghosts):
            owner.destroy()
