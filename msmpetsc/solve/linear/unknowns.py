"""Numbering of the unknowns by nodes and coordinates.

Pinned nodes are not unknowns. A node that is fixed in part (a roller) is an unknown. Its fixed
components are zero in each vector of unknowns, and no operator or preconditioner changes them. On
each rank, a vector of unknowns holds the x of the free nodes, then their y, then their z. The local
array is therefore an m x 3 dense block, which a scalar m x m matrix multiplies in a single product.
"""

from typing import NamedTuple
from weakref import finalize

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.backend.arrays import Array, Floats, Indices, Positions, Rows, like, to_host
from msmpetsc.backend.kernel import kernel
from msmpetsc.comm import reduced
from msmpetsc.lattice.lattice import Lattice
from msmpetsc.solve.linear.ghosts import Ghosted
from msmpetsc.solve.petsc.device import memory_of
from msmpetsc.solve.petsc.library import refuse_unknowns

# inertia of static nodes in multigrid [mass]; a flat cell has a singular block
BALLAST = 1e-6


class Unknowns:
    """Number the free nodes of a lattice over all ranks.

    free    : (m,) local numbers of the free owned nodes
    numbers : (l,) global number of each local node among the free nodes, -1 if pinned
    total   : number of free nodes on all ranks
    inertia : (owned,) [kg] mass in the residual; 0 for statics
    rollers : (h,), (h,) local nodes and components of the lattice's rollers
    has_fixed : whether any component of a node is fixed on any rank
    ballast : (owned,) [kg] mass in multigrid; small but positive for statics
    memory  : memory of PETSc's vectors, on the CPU or the GPU

    Raises InputError if there are more unknowns than PETSc can number.
    """

    def __init__(self, comm: MPI.Comm, lattice: Lattice, static: bool = False):
        self.comm, self.lattice, self.static = comm, lattice, static
        self.memory = memory_of(lattice.nodes)
        self.inertia = np.zeros_like(lattice.mass) if static else lattice.mass
        self.ballast = BALLAST * lattice.mass if static else lattice.mass
        self.free = np.flatnonzero(~lattice.pinned[: lattice.owned])
        self.size = len(self.free)
        first: int = comm.exscan(self.size) or 0  # type: ignore[attr-defined]
        self.total = reduced(comm, self.size)
        refuse_unknowns(self.total)
        self.rollers = lattice.rollers
        self.has_fixed = self.total < lattice.table.total or reduced(comm, len(self.rollers[0])) > 0
        own = np.full(lattice.owned, -1, np.int64)
        own[to_host(self.free)] = first + np.arange(self.size)
        node, component = (to_host(rows[self.rollers[0] < lattice.owned]) for rows in self.rollers)
        self._roller_rows = like(self.free, component * self.size + own[node] - first)
        self.numbers = lattice.table.with_ghosts(lattice.ghosts, own)
        any_ghosts = reduced(comm, len(lattice.ghosts)) > 0
        self._ghosted = Ghosted.of(comm, lattice) if any_ghosts else None

    def create_vector(self) -> PETSc.Vec:
        """Return a new vector of unknowns (collective)."""
        vector = PETSc.Vec().create(self.comm)
        vector.setSizes((3 * self.size, 3 * self.total))
        vector.setType(self.memory.vec_type)
        return vector

    def columns(self, vector: PETSc.Vec) -> Rows:
        """Return a vector of unknowns as a read-only array (3, m)."""
        return self.memory.read(vector).reshape(3, self.size)

    def columns_to_write(self, vector: PETSc.Vec) -> Rows:
        """Return a vector of unknowns as an array (3, m), for immediate writing."""
        return self.memory.write(vector).reshape(3, self.size)

    def to_nodes(self, vector: PETSc.Vec, nodes: Array) -> None:
        """Copy a vector of unknowns to the free rows of ``nodes`` (l, 3), with ghosts (collective).

        Fixed components keep their values.
        """
        kept = nodes[self.rollers] if len(self.rollers[0]) else None
        _spread(self.size, self.columns(vector), self.free, nodes)
        if self._ghosted:
            values, owned = self._ghosted.values, self.lattice.owned
            values[:owned] = nodes[:owned]
            self._ghosted.update()
            nodes[owned:] = values[owned:]
        if kept is not None:
            nodes[self.rollers] = kept

    def from_nodes(self, nodes: Positions, vector: PETSc.Vec) -> None:
        """Copy the free owned rows of ``nodes`` (>= owned, 3) to a vector of unknowns."""
        self.collect(nodes, self.columns_to_write(vector))

    def collect(self, nodes: Rows, columns: Rows) -> None:
        """Copy the free owned rows of ``nodes`` (>= owned, 3) to ``columns`` (3, m)."""
        columns[:] = nodes[self.free].T
        if len(self._roller_rows):
            columns.reshape(-1)[self._roller_rows] = 0

    def projected(self, rows: Rows) -> Rows:
        """Set the fixed components of rows (k, 3 m) of unknowns to zero; return the same rows."""
        rows[:, self._roller_rows] = 0
        return rows

    def project(self, vector: PETSc.Vec) -> None:
        """Set the fixed components of a vector of unknowns to zero."""
        if len(self._roller_rows):
            self.memory.write(vector)[self._roller_rows] = 0

    def scaled_sum(self, a: Array, t2: float, b: Array, vector: PETSc.Vec) -> None:
        """Write M a + t^2 b of arrays (l, 3) of nodal values to a vector of unknowns."""
        _scaled_sum(
            self.size, self.columns_to_write(vector), Terms(self.inertia, a, t2, b, self.free)
        )
        self.project(vector)

    def destroy(self) -> None:
        """Destroy all PETSc objects (collective)."""
        if self._ghosted:
            self._ghosted.destroy()


class VectorPool:
    """Lend vectors of unknowns, and reuse returned vectors.

    All ranks must destroy a vector together. Therefore the pool destroys its vectors itself, and
    Python's garbage collection destroys none.
    """

    def __init__(self, unknowns: Unknowns):
        self.unknowns = unknowns
        self._all: list[PETSc.Vec] = []
        self._free: list[PETSc.Vec] = []

    def take(self) -> PETSc.Vec:
        """Return a vector with arbitrary values (collective)."""
        if self._free:
            return self._free.pop()
        self._all.append(self.unknowns.create_vector())
        return self._all[-1]

    def lend(self, user: object, *vectors: PETSc.Vec) -> None:
        """Let vectors return to the pool when Python deletes their ``user``."""
        finalize(user, self._free.extend, vectors).atexit = False

    def give_back(self, vector: PETSc.Vec) -> None:
        """Return a vector to the pool."""
        self._free.append(vector)

    def destroy(self) -> None:
        """Destroy all vectors of the pool (collective)."""
        for vector in self._all:
            vector.destroy()


@kernel
def _spread(first: int, count: int, step: int, columns: Rows, rows: Indices, nodes: Rows) -> None:
    for i in range(first, count, step):
        for c in range(3):
            nodes[rows[i], c] = columns[c, i]


class Terms(NamedTuple):
    """Terms of the sum M a + t^2 b at given ``rows`` of nodal arrays."""

    mass: Floats
    a: Array
    t2: float
    b: Array
    rows: Array


@kernel
def _scaled_sum(first: int, count: int, step: int, columns: Rows, terms: Terms) -> None:
    for i in range(first, count, step):
        row = terms.rows[i]
        for c in range(3):
            columns[c, i] = terms.mass[row] * terms.a[row, c] + terms.t2 * terms.b[row, c]
