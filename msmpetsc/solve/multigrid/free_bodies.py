"""Bodies that no spring joins, as a step's unknowns see them: what is held lies between them, too.

Each has coarse grids of its own, and translations of what no spring holds are kept exactly.

With T the translations and Q = T (T^T M T)^-1 T^T M, a cycle B becomes (I - Q) B (I - Q)^T + T (T^T M T)^-1 T^T. They
are eigenvectors of M^-1 H, so that forces that balance never move a body as a whole.
"""

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from msmpetsc.backend.arrays import Floats, Indices, Mask, Rows, like, to_host
from msmpetsc.comm import Route, SortedKeys
from msmpetsc.geometry.grid import LIMIT
from msmpetsc.solve.linear.unknowns import Unknowns


@dataclass(frozen=True)
class Bodies:
    """Bodies of a lattice."""

    number: Indices  # (l,) of each local node's body; -1 where it is held
    free: Mask  # (b,) bool of each body, whether no spring holds it

    def apart(self, comm: MPI.Comm, ijk: Indices) -> Indices:
        """Return how far each local node's body is to be moved along the grid's first axis, (l,), so that no two have a
        coarse cell in common; 0 where the grid has no room for that, and of what is held (collective).

        ijk : (l, 3) grid indices of the local nodes
        """
        farthest = comm.allreduce(int(ijk.max(initial=0)), MPI.MAX)
        room = (
            2 << farthest.bit_length()
        )  # twice what they take, and a power of two, so on the coarser grids as well
        return np.maximum(self.number, 0) * (room if len(self.free) * room <= LIMIT else 0)


def bodies_of(unknowns: Unknowns) -> Bodies:
    """Return the bodies of a lattice (collective)."""
    comm, lattice = unknowns.comm, unknowns.lattice
    moves, springs = ~to_host(lattice.pinned), lattice.springs
    both, either = moves[springs].all(axis=1), moves[springs].any(axis=1)
    joined = springs[both]
    graph = coo_array(
        (np.ones(len(joined), np.int8), (joined[:, 0], joined[:, 1])), shape=(len(moves),) * 2
    )
    part = connected_components(graph, directed=False)[1]
    name = _names(unknowns, part)
    table = SortedKeys(comm, name[: lattice.owned][moves[: lattice.owned]])
    number = np.where(moves, table.find(np.where(moves, name, -1)), -1)
    held = np.zeros(table.total, bool)
    ends = springs[either & ~both]
    held[number[ends[moves[ends]]]] = True
    comm.Allreduce(MPI.IN_PLACE, held, MPI.LOR)
    return Bodies(number, ~held)


def _names(unknowns: Unknowns, part: Indices) -> Indices:
    """The least global number (l,) in the body of each node; ``part`` (l,) that of this rank it belongs to.

    Ranks that have parts of one body tell each other until none learns of a lesser number.
    """
    comm, lattice = unknowns.comm, unknowns.lattice
    to_owner = Route(comm, lattice.table.owner_of_index(lattice.ghosts))
    asked = to_owner.send(lattice.ghosts) - lattice.table.first
    name, is_new = lattice.global_numbers, True
    while is_new:
        least = np.full(part.max(initial=-1) + 1, np.iinfo(np.int64).max)
        np.minimum.at(least, part, name)
        lesser = least[part]
        lesser[lattice.owned :] = np.minimum(
            lesser[lattice.owned :], to_owner.answer(lesser[asked])
        )
        is_new = comm.allreduce(bool((lesser < name).any()), MPI.LOR)
        name = lesser
    return name


class Translations:
    """Translations of the free bodies. All methods are collective.

    body : (m,) which of the free ones a free node belongs to; their number where its body is held
    mass : (m,) of each free node [kg]
    of_body : (b,) of each free body [kg]
    """

    def __init__(self, unknowns: Unknowns, bodies: Bodies):
        self.unknowns, self.count = unknowns, int(bodies.free.sum())
        rank = np.where(bodies.free, np.cumsum(bodies.free) - 1, self.count)
        self.body = like(unknowns.lattice.nodes, rank[bodies.number[to_host(unknowns.free)]])
        self.mass = unknowns.lattice.mass[unknowns.free]
        self.of_body = self._sums(self.mass[None])[0]

    def of(self, forces: Rows) -> Rows:
        """Return T (T^T M T)^-1 T^T f, (3, m), of f (3, m)."""
        moved = self._sums(forces) / self.of_body
        return like(forces, np.append(moved, np.zeros((3, 1)), axis=1))[:, self.body]

    def around(self, cycle: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Apply to x what a cycle becomes, into y."""
        unknowns = self.unknowns
        forces, rest = unknowns.columns(x), x.duplicate()
        whole = self.of(forces)
        unknowns.columns_to_write(rest)[:] = forces - self.mass * whole
        cycle.apply(rest, y)
        rest.destroy()
        moved = unknowns.columns_to_write(y)
        moved += whole - self.of(self.mass * moved)

    def _sums(self, rows: Rows) -> Floats:
        """Sums (r, b) over each free body's nodes of rows (r, m)."""
        own = [to_host(np.bincount(self.body, row, self.count + 1)[: self.count]) for row in rows]
        sums: Floats = self.unknowns.comm.allreduce(np.array(own).reshape(len(rows), self.count))
        return sums
