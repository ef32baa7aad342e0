"""Numbering of PETSc's unknowns by nodes and coordinates, and values of nodes with ghosts.

Pinned nodes are no unknowns. A vector of unknowns holds, on each rank, the x of its free nodes,
then their y, then their z: so its local array is an m x 3 dense block, which a scalar m x m matrix
can multiply at once.
"""

from typing import NamedTuple
from weakref import finalize

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.backend.arrays import Array, Floats, Indices, Positions, Rows, like, to_host
from msmpetsc.backend.kernel import kernel
from msmpetsc.comm import Route
from msmpetsc.errors import InputError
from msmpetsc.lattice.lattice import Lattice
from msmpetsc.solve.petsc.device import memory_of
from msmpetsc.solve.petsc.events import GHOSTS

LARGEST = int(
    np.iinfo(PETSc.IntType).max
)  # of PETSc's integers: 32 bits, unless it was configured otherwise
ADVICE = "a PETSc configured with --with-64-bit-indices can"
BALLAST = 1e-6  # of the mass
BYTES_OF_NODE = 8  # of ``numbers``, for a forecast of memory


class Unknowns:
    """The free nodes of a lattice, numbered over all ranks, and the scatter that fills the ghosts.

    free    : (m,) local numbers of the free owned nodes, where the lattice's arrays are
    numbers : (l,) global number of each local node among the free ones, -1 where pinned
    total   : number of free nodes on all ranks
    inertia : (owned,) [kg] by which a node resists being moved: its mass; nothing where an equilibrium is looked for
    ballast : (owned,) [kg] the same in multigrid, never nothing: a cell squashed flat has a singular block of its own
    static  : whether it is an equilibrium
    memory  : where PETSc's vectors have their numbers

    Raises InputError for more of them than PETSc can number.
    """

    def __init__(self, comm: MPI.Comm, lattice: Lattice, static: bool = False):
        self.comm, self.lattice, self.memory, self.static = (
            comm,
            lattice,
            memory_of(lattice.nodes),
            static,
        )
        self.inertia = np.zeros_like(lattice.mass) if static else lattice.mass
        self.ballast = BALLAST * lattice.mass if static else lattice.mass
        self.free = np.flatnonzero(~lattice.pinned[: lattice.owned])
        self.rows = self.free.astype(
            np.uint32
        )  # for kernels, which need not look whether a number is negative
        self.size = len(self.free)
        first: int = comm.exscan(self.size) or 0  # type: ignore[attr-defined]  # an Intracomm
        self.total = comm.allreduce(self.size)
        refuse_unknowns(self.total)
        own = np.full(lattice.owned, -1, np.int64)
        own[to_host(self.free)] = first + np.arange(self.size)
        self.numbers = with_ghosts(comm, lattice, own)
        index = np.stack([3 * first + own - first + c * self.size for c in range(3)], axis=1)
        free_ghosts = lattice.owned + np.flatnonzero(self.numbers[lattice.owned :] >= 0)
        self.free_ghosts = like(self.free, free_ghosts)
        self.has_ghosts = comm.allreduce(len(free_ghosts)) > 0  # of any rank
        sources = with_ghosts(comm, lattice, index)[free_ghosts].ravel()  # in a vector of unknowns
        self.ghost_values = self._vector(PETSc.COMM_SELF, len(sources))
        vector = self.create_vector()
        index = PETSc.IS().createGeneral(sources.astype(PETSc.IntType), comm=comm)
        self.scatter = PETSc.Scatter().create(vector, index, self.ghost_values, None)
        index.destroy()
        vector.destroy()

    def create_vector(self) -> PETSc.Vec:
        """Return a new vector of unknowns (collective)."""
        return self._vector(self.comm, (3 * self.size, 3 * self.total))

    def _vector(self, comm: MPI.Comm, sizes: int | tuple[int, int]) -> PETSc.Vec:
        vector = PETSc.Vec().create(comm)
        vector.setSizes(sizes)
        vector.setType(self.memory.vec_type)
        return vector

    def columns(self, vector: PETSc.Vec) -> Rows:
        """A vector of unknowns as (3, m), not to be written to."""
        return self.memory.read(vector).reshape(3, self.size)

    def columns_to_write(self, vector: PETSc.Vec) -> Rows:
        """A vector of unknowns as (3, m), to be written to at once."""
        return self.memory.write(vector).reshape(3, self.size)

    def to_nodes(self, vector: PETSc.Vec, nodes: Array) -> None:
        """Write unknowns into the free rows, ghosts included, of ``nodes`` (l, 3) (collective)."""
        if self.has_ghosts:
            with GHOSTS:
                self.scatter.scatter(vector, self.ghost_values)
        _spread(self.size, self.columns(vector), self.rows, nodes)
        if len(self.free_ghosts):
            nodes[self.free_ghosts] = self.memory.read(self.ghost_values).reshape(-1, 3)

    def from_nodes(self, nodes: Positions, vector: PETSc.Vec) -> None:
        """Write the free owned rows of ``nodes`` (>= owned, 3) into the unknowns."""
        self.collect(nodes, self.columns_to_write(vector))

    def collect(self, nodes: Rows, columns: Rows) -> None:
        """Write the free owned rows of ``nodes`` (>= owned, 3) into ``columns`` (3, m)."""
        _collect(self.size, nodes, self.rows, columns)

    def scaled_sum(self, a: Array, t2: float, b: Array, vector: PETSc.Vec) -> None:
        """Write M a + t^2 b, of the free owned rows of (l, 3) arrays, into the unknowns."""
        _scaled_sum(
            self.size, self.columns_to_write(vector), Terms(self.inertia, a, t2, b, self.rows)
        )

    def destroy(self) -> None:
        """Collective."""
        self.scatter.destroy()
        self.ghost_values.destroy()


class VectorPool:
    """Vectors of unknowns that are lent to their users, until these give them back or are forgotten.

    A vector of several ranks must be destroyed by all of them together. So the pool destroys its vectors itself,
    once, and no vector is destroyed as Python forgets it.
    """

    def __init__(self, unknowns: Unknowns):
        self.unknowns = unknowns
        self._all: list[PETSc.Vec] = []
        self._free: list[PETSc.Vec] = []

    def take(self) -> PETSc.Vec:
        """Return a vector of any values (collective)."""
        if self._free:
            return self._free.pop()
        self._all.append(self.unknowns.create_vector())
        return self._all[-1]

    def lend(self, user: object, *vectors: PETSc.Vec) -> None:
        """Take vectors back when nothing refers to their user any more."""
        finalize(user, self._free.extend, vectors).atexit = False

    def give_back(self, vector: PETSc.Vec) -> None:
        """Take a vector back."""
        self._free.append(vector)

    def destroy(self) -> None:
        """Collective."""
        for vector in self._all:
            vector.destroy()


class Ghosted:
    """Values (l, 3) of the owned nodes, then of the ghosts, in the memory of two PETSc vectors."""

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
    """Return rows (l, ...) of local nodes from those of the owned ones, on the host (collective)."""
    to_owner = Route(comm, lattice.table.owner_of_index(lattice.ghosts))
    asked = to_owner.send(lattice.ghosts) - lattice.table.first
    return np.concatenate([rows, to_owner.answer(rows[asked])])


def refuse_unknowns(nodes: int) -> None:
    """Raise InputError for more ``nodes`` than PETSc can number three coordinates of."""
    if 3 * nodes > LARGEST:
        most = f"the {LARGEST} unknowns that PETSc can number here"
        raise InputError(
            f"cages: the three coordinates of {nodes} nodes are more than {most}; {ADVICE}"
        )


def refuse_nonzeros(comm: MPI.Comm, own: int) -> None:
    """Raise InputError where a rank has more nonzeros, ``own`` of this one, than PETSc can count."""
    most = comm.allreduce(own, MPI.MAX)
    if most > LARGEST:
        many = f"{most} nonzeros of the system matrix on one rank are more than the {LARGEST} that PETSc can count here"
        raise InputError(f"cages: {many}; more ranks have fewer each, or {ADVICE}")


@kernel
def _spread(first: int, count: int, step: int, columns: Rows, rows: Indices, nodes: Rows) -> None:
    for i in range(first, count, step):
        for c in range(3):
            nodes[rows[i], c] = columns[c, i]


@kernel
def _collect(first: int, count: int, step: int, nodes: Rows, rows: Indices, columns: Rows) -> None:
    for i in range(first, count, step):
        for c in range(3):
            columns[c, i] = nodes[rows[i], c]


class Terms(NamedTuple):
    """What the sum M a + t^2 b is made of, at some rows of arrays of nodes."""

    mass: Floats
    a: Array
    t2: float
    b: Array
    rows: Array


@kernel
def _scaled_sum(first: int, count: int, step: int, columns: Rows, of: Terms) -> None:
    for i in range(first, count, step):
        row = of.rows[i]
        for c in range(3):
            columns[c, i] = of.mass[row] * of.a[row, c] + of.t2 * of.b[row, c]
