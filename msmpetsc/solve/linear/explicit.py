"""Operators that are only known by their products, as matrices with entries: to be viewed, or written to a file."""

from collections.abc import Iterator
from itertools import product
from typing import TypeAlias

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse import coo_array

from msmpetsc.backend.arrays import like, to_host
from msmpetsc.solve.linear.unknowns import Unknowns

Entries: TypeAlias = tuple[np.ndarray, np.ndarray, np.ndarray]  # rows of this rank, columns of all, values
SUMMARIES = (PETSc.Viewer.Format.ASCII_INFO, PETSc.Viewer.Format.ASCII_INFO_DETAIL)


def asks_for_entries(viewer: PETSc.Viewer) -> bool:
    """Whether a matrix is to be written whole, not described in a line."""
    return viewer.getType() != PETSc.Viewer.Type.ASCII or viewer.getFormat() not in SUMMARIES


def explicit(operator: PETSc.Mat, unknowns: Unknowns, apart: np.ndarray | None = None) -> PETSc.Mat:
    """An operator on vectors of unknowns, 3m x 3m, as AIJ (collective).

    It couples nodes that a spring joins. No two nodes of a colour, three cells apart, have a neighbour in common, so
    that one product a colour and coordinate tells the entries of all its columns: 81 products.

    apart : (m,) bool, of the nodes that it couples with others, too; each of their columns is a product of its own
    """
    apart = np.zeros(unknowns.size, bool) if apart is None else apart
    x, y = operator.createVecs()
    parts = [*_by_colours(operator, unknowns, apart, x, y), *_one_by_one(operator, unknowns, apart, x, y)]
    x.destroy()
    y.destroy()
    rows, columns, values = map(np.concatenate, zip(*parts, strict=True))
    sizes = 3 * unknowns.size, 3 * unknowns.total
    csr = coo_array((values, (rows, columns)), shape=sizes).tocsr()
    csr.eliminate_zeros()
    index = csr.indptr.astype(PETSc.IntType), csr.indices.astype(PETSc.IntType)
    matrix = PETSc.Mat().createAIJ((sizes, sizes), csr=(*index, csr.data), comm=operator.comm)
    matrix.setName(operator.getName())
    return matrix


def _by_colours(
    operator: PETSc.Mat, unknowns: Unknowns, apart: np.ndarray, x: PETSc.Vec, y: PETSc.Vec
) -> Iterator[Entries]:
    """The entries of all columns but those ``apart``."""
    flags = np.zeros_like(unknowns.lattice.nodes)
    _write(unknowns, x, np.tile(apart.astype(float), (3, 1)))
    unknowns.to_nodes(x, flags)
    (a, b), colours, free = _neighbours(unknowns), _colours(unknowns), to_host(unknowns.free)
    colours = np.where(to_host(flags)[:, 0] > 0, -1, colours)
    row = np.full(len(colours), -1)
    row[free] = np.arange(unknowns.size)
    row, indices, colour = row[a], unknowns.indices[b], colours[b]
    for wanted, c in product(range(27), range(3)):
        chosen = np.zeros((3, unknowns.size))
        chosen[c] = colours[free] == wanted
        _write(unknowns, x, chosen)
        operator.mult(x, y)
        entries, hit = to_host(unknowns.columns(y)), np.flatnonzero(colour == wanted)
        rows = (row[hit] + unknowns.size * np.arange(3)[:, None]).ravel()
        yield rows, np.tile(indices[hit, c], 3), entries[:, row[hit]].ravel()


def _one_by_one(
    operator: PETSc.Mat, unknowns: Unknowns, apart: np.ndarray, x: PETSc.Vec, y: PETSc.Vec
) -> Iterator[Entries]:
    """The entries of the columns ``apart``, of all ranks."""
    first = operator.getOwnershipRange()[0]
    own = (np.flatnonzero(apart) + unknowns.size * np.arange(3)[:, None]).ravel()
    for column in np.concatenate(unknowns.lattice.table.comm.allgather(first + own)):
        chosen = np.zeros(3 * unknowns.size)
        if first <= column < first + len(chosen):
            chosen[column - first] = 1.0
        _write(unknowns, x, chosen.reshape(3, -1))
        operator.mult(x, y)
        entries = to_host(unknowns.columns(y)).ravel()
        rows = np.flatnonzero(entries)
        yield rows, np.full(len(rows), column), entries[rows]


def _write(unknowns: Unknowns, x: PETSc.Vec, values: np.ndarray) -> None:
    """Write values (3, m) into a vector of unknowns."""
    target = unknowns.columns_to_write(x)
    target[:] = like(target, values)


def _neighbours(unknowns: Unknowns) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of local numbers of free nodes that are the same or joined, the first of this rank."""
    springs, free = to_host(unknowns.lattice.springs), to_host(unknowns.free)
    a = np.concatenate([springs[:, 0], springs[:, 1], free])
    b = np.concatenate([springs[:, 1], springs[:, 0], free])
    kept = (a < unknowns.lattice.owned) & (unknowns.numbers[a] >= 0) & (unknowns.numbers[b] >= 0)
    return a[kept], b[kept]


def _colours(unknowns: Unknowns) -> np.ndarray:
    """(l,) of 27: where a node is among its cell and the next two, along each axis (collective)."""
    lattice = unknowns.lattice
    nodes, corner = to_host(lattice.nodes), np.empty(3)
    lattice.table.comm.Allreduce(nodes.min(axis=0, initial=np.inf), corner, MPI.MIN)
    index = np.rint((nodes - corner) / lattice.cell_size).astype(np.int64) % 3
    return index @ [9, 3, 1]
