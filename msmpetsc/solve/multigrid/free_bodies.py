"""Separate bodies in multigrid, and exact translations of free bodies.

A body is a set of free nodes joined by springs or cells. Pinned nodes separate bodies. Each body
has its own coarse grids. With the translations T of the free bodies, and
Q = T (T^T M T)^-1 T^T M, a cycle B becomes

    (I - Q) B (I - Q)^T + T (T^T M T)^-1 T^T.

Translations are eigenvectors of M^-1 H. Balanced forces therefore never move a body as a whole.
"""

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from msmpetsc.backend.arrays import Floats, Indices, Mask, Rows, like, to_host
from msmpetsc.comm import Route, reduced
from msmpetsc.geometry.morton import LIMIT, decode_morton, encode_morton
from msmpetsc.geometry.partition import SortedKeys
from msmpetsc.solve.linear.unknowns import Unknowns


@dataclass(frozen=True)
class Bodies:
    """Bodies of a lattice.

    number : (l,) body of each local node, -1 if pinned
    free   : (b, 3) bool, whether the body is free along each axis: no node of the body, or joined
             with the body, is fixed along the axis
    """

    number: Indices
    free: Mask

    def offsets(self, comm: MPI.Comm, keys: Indices) -> Indices:
        """Return the offsets (l,) to add to the nodes' keys, so that bodies separate (collective).

        The offsets shift bodies along the first axis, so that they share no coarse cell. Pinned
        nodes have offset 0. If the grid indices have no room, all offsets are 0.
        """
        farthest = reduced(comm, int(decode_morton(keys).max(initial=0)), MPI.MAX)
        # A power of two above the extent separates bodies on coarser grids as well. It
        # shares no bit with the nodes' indices, so keys may be added.
        room = 2 << farthest.bit_length()
        shift = np.maximum(self.number, 0) * (room if len(self.free) * room <= LIMIT else 0)
        return encode_morton(shift[:, None] * np.array([1, 0, 0]))


def bodies_of(unknowns: Unknowns) -> Bodies:
    """Return the bodies of a lattice (collective)."""
    comm, lattice = unknowns.comm, unknowns.lattice
    moves = ~to_host(lattice.pinned)
    groups = to_host(lattice.local_cells) if lattice.solid else lattice.springs
    moving = moves[groups]
    first = moving.argmax(axis=1)
    others = moving.copy()
    others[np.arange(len(groups)), first] = False
    group, place = np.nonzero(others)
    joined = groups[group, first[group]], groups[group, place]
    graph = coo_array((np.ones(len(group), np.int8), joined), shape=(len(moves),) * 2)
    part = connected_components(graph, directed=False)[1]
    label = _labels(unknowns, part)
    table = SortedKeys(comm, label[: lattice.owned][moves[: lattice.owned]])
    number = np.where(moves, table.find(np.where(moves, label, -1)), -1)
    fixed = np.zeros((table.total, 3), bool)
    ends = groups[moving.any(axis=1) & ~moving.all(axis=1)]
    fixed[number[ends[moves[ends]]]] = True
    node, component = map(to_host, lattice.rollers)
    fixed[number[node], component] = True
    comm.Allreduce(MPI.IN_PLACE, fixed, MPI.LOR)
    return Bodies(number, ~fixed)


def _labels(unknowns: Unknowns, part: Indices) -> Indices:
    """Return the smallest global number (l,) of a node in the body of each node (collective).

    Ranks that share a body exchange their smallest numbers until no number changes.

    part : (l,) number of each node's connected part on this rank
    """
    comm, lattice = unknowns.comm, unknowns.lattice
    to_owner = Route(comm, lattice.table.owner_of_index(lattice.ghosts))
    asked = to_owner.send(lattice.ghosts) - lattice.table.first
    label, is_new = lattice.global_numbers, True
    while is_new:
        least = np.full(part.max(initial=-1) + 1, np.iinfo(np.int64).max)
        np.minimum.at(least, part, label)
        smaller = least[part]
        smaller[lattice.owned :] = np.minimum(
            smaller[lattice.owned :], to_owner.answer(smaller[asked])
        )
        is_new = reduced(comm, bool((smaller < label).any()), MPI.LOR)
        label = smaller
    return label


class Translations:
    """Treat translations of free bodies exactly in a multigrid cycle. All methods are collective.

    A body that is fixed along some axes is free along the remaining axes.

    count   : number b of free bodies
    free    : (3, b) 1 along the axes on which each free body is free, otherwise 0
    body    : (m,) free body of each free node; b if its body is fixed
    mass    : (m,) mass of each free node [kg]
    of_body : (b,) mass of each free body [kg]
    """

    def __init__(self, unknowns: Unknowns, bodies: Bodies):
        is_free = bodies.free.any(axis=1)
        self.unknowns, self.count = unknowns, int(is_free.sum())
        self.free = bodies.free[is_free].T.astype(float)
        rank = np.where(is_free, np.cumsum(is_free) - 1, self.count)
        self.body = like(unknowns.lattice.nodes, rank[bodies.number[to_host(unknowns.free)]])
        self.mass = unknowns.lattice.mass[unknowns.free]
        self.of_body = self._sums(self.mass[None])[0]

    def means(self, forces: Rows) -> Rows:
        """Return the columns (3, b + 1) of (T^T M T)^-1 T^T f for forces f (3, m), then zeros."""
        moved = self.free * self._sums(forces) / self.of_body
        return like(forces, np.append(moved, np.zeros((3, 1)), axis=1))

    def around(self, cycle: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Apply a cycle with exact translations to x, and write the result to y."""
        unknowns = self.unknowns
        forces, rest = unknowns.columns(x), x.duplicate()
        whole = self.means(forces)
        unknowns.columns_to_write(rest)[:] = forces - self.mass * whole.take(self.body, axis=1)
        cycle.apply(rest, y)
        rest.destroy()
        moved = unknowns.columns_to_write(y)
        moved += (whole - self.means(self.mass * moved)).take(self.body, axis=1)

    def _sums(self, rows: Rows) -> Floats:
        """Return the sums (r, b) of rows (r, m) over the nodes of each free body."""
        own = [to_host(np.bincount(self.body, row, self.count + 1)[: self.count]) for row in rows]
        sums: Floats = reduced(self.unknowns.comm, np.array(own).reshape(len(rows), self.count))
        return sums
