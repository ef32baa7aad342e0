"""Which PETSc unknown is which coordinate of which node.

Pinned nodes are no unknowns. A vector of unknowns holds, on each rank, the x of its free nodes,
then their y, then their z: so its local array is an m x 3 dense block, which a scalar m x m matrix
can multiply at once.
"""

import numba
import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.comm import Route
from msmpetsc.model.lattice import Lattice
from msmpetsc.solve.limits import refuse_unknowns


class Unknowns:
    """The free nodes of a lattice, numbered over all ranks, and the scatter that fills the ghosts.

    free    : (m,) local numbers of the free owned nodes
    numbers : (l,) global number of each local node among the free ones, -1 where pinned
    places  : (l, 3) where its x, y and z stand in a vector of unknowns, of no meaning where pinned
    total   : number of free nodes on all ranks

    Raises InputError for more of them than PETSc can number.
    """

    def __init__(self, comm: MPI.Comm, lattice: Lattice):
        self.lattice = lattice
        self.free = np.flatnonzero(~lattice.pinned[: lattice.owned])
        self.size = len(self.free)
        first = comm.exscan(self.size) or 0
        self.total = comm.allreduce(self.size)
        refuse_unknowns(self.total)
        own = np.full(lattice.owned, -1, np.int64)
        own[self.free] = first + np.arange(self.size)
        to_owner = Route(comm, lattice.table.owner_of_index(lattice.ghosts))
        asked = to_owner.send(lattice.ghosts) - lattice.table.first
        self.numbers = np.concatenate([own, to_owner.answer(own[asked])])
        place = np.stack([3 * first + own - first + c * self.size for c in range(3)], axis=1)
        self.places = np.concatenate([place, to_owner.answer(place[asked])])
        self._scatter_ghosts(comm)

    def _scatter_ghosts(self, comm: MPI.Comm) -> None:
        owned = self.lattice.owned
        self.free_ghosts = owned + np.flatnonzero(self.numbers[owned:] >= 0)
        sources = self.places[self.free_ghosts].ravel().astype(PETSc.IntType)
        self.ghost_values = PETSc.Vec().createSeq(len(sources), comm=PETSc.COMM_SELF)
        vector = self.create_vector(comm)
        index = PETSc.IS().createGeneral(sources, comm=comm)
        self.scatter = PETSc.Scatter().create(vector, index, self.ghost_values, None)
        index.destroy()
        vector.destroy()

    def create_vector(self, comm: MPI.Comm) -> PETSc.Vec:
        return PETSc.Vec().createMPI((3 * self.size, 3 * self.total), comm=comm)

    def to_nodes(self, vector: PETSc.Vec, nodes: np.ndarray) -> None:
        """Write unknowns into the free rows, ghosts included, of ``nodes`` (l, 3) (collective)."""
        self.scatter.scatter(vector, self.ghost_values)
        _spread(vector.array_r.reshape(3, self.size), self.free, nodes)
        nodes[self.free_ghosts] = self.ghost_values.array_r.reshape(-1, 3)

    def from_nodes(self, nodes: np.ndarray, vector: PETSc.Vec) -> None:
        """Write the free owned rows of ``nodes`` (>= owned, 3) into the unknowns."""
        _collect(nodes, self.free, vector.array.reshape(3, self.size))

    def destroy(self) -> None:
        self.scatter.destroy()
        self.ghost_values.destroy()


@numba.njit(cache=True)
def _spread(columns, rows, nodes):
    for i in range(len(rows)):
        for c in range(3):
            nodes[rows[i], c] = columns[c, i]


@numba.njit(cache=True)
def _collect(nodes, rows, columns):
    for i in range(len(rows)):
        for c in range(3):
            columns[c, i] = nodes[rows[i], c]
