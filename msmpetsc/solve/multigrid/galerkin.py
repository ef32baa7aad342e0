"""The first coarse level's matrix, P^T H P, summed spring by spring without the fine level's ever being assembled.

Each spring lies within one coarse cell of 2 x 2 x 2 cells. With w_a the weights (8,) of a cell's corners at the end a,
zero where that is held, a spring of block B adds (w_a - w_b)(w_a - w_b)^T (x) t^2 B to the matrix (24 x 24) of its
cell; a node of mass m with the block C of contact adds w w^T (x) (m I + t^2 C); and the corner of a cell that resists
being turned inside out, t^2 times its curvature times G G^T, G the slopes of its volume at the cell's corners.
"""

from dataclasses import dataclass

import numba
import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.backend.arrays import like, on_host, to_host
from msmpetsc.backend.kernel import kernel
from msmpetsc.geometry.grid import decode_morton, encode_morton
from msmpetsc.model.elasticity import Elasticity
from msmpetsc.model.inversion import FRAMES, cofactors, corner_curvature, edges, vector_of
from msmpetsc.model.lattice import CORNERS
from msmpetsc.model.springs import spring_block
from msmpetsc.solve.linear.unknowns import Unknowns
from msmpetsc.solve.multigrid.grids import Grid, grid_indices
from msmpetsc.solve.petsc.library import preallocate_coo, set_values_coo
from msmpetsc.solve.petsc.limits import refuse_nonzeros

HELD = 27  # code of an end that is no unknown; others are 9 i + 3 j + k of where they are in their coarse cell
RAISED = 1 + 1e-5  # diagonals: few fine nodes in a coarse cell leave its columns linearly dependent
PAIRS = np.array([(p, q) for p in range(8) for q in range(p, 8)])  # of corners: the upper triangle of a cell's matrix
PAIR = np.zeros((8, 8), np.int64)
PAIR[PAIRS[:, 0], PAIRS[:, 1]] = np.arange(len(PAIRS))


def _weights() -> np.ndarray:
    """Weights (28, 8) of a coarse cell's corners at each of its 27 fine nodes; none where one is held."""
    ijk = np.stack(np.unravel_index(np.arange(27), (3, 3, 3)), axis=1)
    along = np.where(CORNERS[None] > 0, ijk[:, None, :] / 2, 1 - ijk[:, None, :] / 2)
    return np.concatenate([along.prod(axis=2), np.zeros((1, 8))])


def _differences() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of each two codes, 28 a + b, w_a - w_b: how many corners have a part, which (784, 8), and what part."""
    d = (WEIGHTS[:, None, :] - WEIGHTS[None, :, :]).reshape(-1, 8)
    corner = np.argsort(d == 0, axis=1, kind="stable")
    return (d != 0).sum(axis=1), corner.astype(np.uint8), np.take_along_axis(d, corner, axis=1)


WEIGHTS = _weights()
COUNT, CORNER, PART = _differences()


@dataclass(frozen=True)
class ByCell:
    """Things of a rank ordered by the coarse cell they lie in: those of cell i are order[start[i] : start[i + 1]].

    code : of each, in that order, where its ends or corners are in that cell
    """

    start: np.ndarray
    order: np.ndarray
    code: np.ndarray

    @classmethod
    def of(cls, cells: np.ndarray, keys: np.ndarray, code: np.ndarray, which: np.ndarray) -> "ByCell":
        """keys : ascending ones of all cells; cells (n,) the key of each thing; which (n,) its number."""
        by_cell = np.argsort(cells, kind="stable")
        start = np.searchsorted(cells[by_cell], keys, side="left")
        start = np.append(start, len(cells)).astype(np.int32)
        return cls(start, which[by_cell].astype(np.int32), code[by_cell].astype(np.uint8))

    @property
    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What kernels take."""
        return self.start, self.order, self.code

    def near(self, array: np.ndarray) -> "ByCell":
        """Return the same in the memory that an array is in."""
        return ByCell(like(array, self.start), like(array, self.order), like(array, self.code))


class GalerkinSum:
    """Sums P^T H P of a lattice, H = M + t^2 (projected Hessian of E), into a matrix of the first coarse grid.

    matrix : AIJ of block size 3; it has values after the first ``update``

    On a CPU all cells add to the blocks of this rank's pairs of nodes; on a GPU each has blocks of its own, which PETSc
    then adds.
    """

    def __init__(self, comm: MPI.Comm, unknowns: Unknowns, elasticity: Elasticity, t2: float, grid: Grid):
        lattice = unknowns.lattice
        self.unknowns, self.elasticity, self.t2 = unknowns, elasticity, t2
        keys, self.springs, self.nodes, self.cells = _by_cell(unknowns, elasticity)
        self.law = tuple(like(lattice.nodes, a) for a in (lattice.springs, lattice.rest_length, lattice.stiffness))
        self.tables = tuple(like(lattice.nodes, a) for a in (COUNT, CORNER, PART, WEIGHTS, PAIR))
        first, second, places = self._pairs(grid, keys)
        self.blocks, self.places = len(first), like(lattice.nodes, places)
        diagonal = np.flatnonzero((first == second) & (first >= 0))
        upper = np.flatnonzero(first != second)
        self.diagonal, self.upper = (like(lattice.nodes, a) for a in (diagonal, upper))
        self.matrix = self._create_matrix(comm, grid, first, second, upper)

    def _pairs(self, grid: Grid, keys: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Global numbers (b,), (b,) of the pairs of nodes that have a block; which a cell adds to, (c, 36), -1 none."""
        number = grid.table.find(encode_morton(decode_morton(keys)[:, None, :] + CORNERS))
        first, second = number[:, PAIRS[:, 0]], number[:, PAIRS[:, 1]]
        exists = (first >= 0) & (second >= 0)
        pairs, places = (first * grid.table.total + second)[exists], np.full(exists.shape, -1, np.int32)
        places[exists] = np.arange(len(pairs))
        if on_host(self.unknowns.lattice.nodes):
            pairs, shared = np.unique(pairs, return_inverse=True)
            places[exists] = shared
        return pairs // grid.table.total, pairs % grid.table.total, places

    def _create_matrix(
        self, comm: MPI.Comm, grid: Grid, first: np.ndarray, second: np.ndarray, upper: np.ndarray
    ) -> PETSc.Mat:
        refuse_nonzeros(comm, 9 * (len(first) + len(upper)))
        matrix = PETSc.Mat().create(comm=comm)
        matrix.setSizes((grid.sizes, grid.sizes))
        matrix.setBlockSize(3)
        matrix.setType(self.unknowns.memory.mat_type)
        matrix.setOption(PETSc.Mat.Option.SPD, True)
        row, column = (3 * n[:, None] + c for n, c in ((first, np.repeat(range(3), 3)), (second, np.tile(range(3), 3))))
        rows = np.concatenate([row.ravel(), column[upper].ravel()])
        columns = np.concatenate([column.ravel(), row[upper].ravel()])
        preallocate_coo(matrix, rows, columns)
        set_block_size(matrix)
        return matrix

    def update(self, q: np.ndarray, contact: np.ndarray) -> None:
        """Sum the matrix at positions q (l, 3) [m]; ``contact`` (owned, 9), or (0, 9), of the nodes [N/m]
        (collective)."""
        values = np.zeros((self.blocks, 9), like=q)
        tables, stiffening, count = self.tables, self.elasticity.springs.stiffening, len(self.places)
        add_springs(count, q, *self.springs.arrays, *self.law, stiffening, self.t2, *tables, self.places, values)
        add_nodes(count, *self.nodes.arrays, self.unknowns.lattice.mass, contact, self.t2, *tables, self.places, values)
        if self.elasticity.cells:
            law = self.elasticity.cells.law
            add_resistance(count, q, *self.cells.arrays, *law, self.t2, *tables, self.places, values)
        values[self.diagonal[:, None], [[0, 4, 8]]] *= RAISED
        set_values_coo(self.matrix, np.concatenate([values, values[self.upper]]).ravel())

    def destroy(self) -> None:
        self.matrix.destroy()


def set_block_size(matrix: PETSc.Mat) -> None:
    """Give a matrix of three rows a node this block size, its diagonal part, which pbjacobi inverts, too: PETSc makes
    that of a matrix on several ranks without one."""
    matrix.setBlockSize(3)
    matrix.getDiagonalBlock().setBlockSize(3)


def _by_cell(unknowns: Unknowns, elasticity: Elasticity) -> tuple[np.ndarray, ByCell, ByCell, ByCell]:
    """Keys of the coarse cells that anything of this rank lies in; its springs, free nodes and resisting cells."""
    lattice, ijk = unknowns.lattice, grid_indices(unknowns)
    held, free = to_host(lattice.pinned), to_host(unknowns.free)
    springs = to_host(lattice.springs)[: lattice.springs_owned]
    moving = np.flatnonzero(~held[springs].all(axis=1))
    cells = elasticity.cells
    corners = np.empty((0, 8), np.int64) if cells is None else to_host(cells.cells[: cells.cells_owned])
    ends = [springs[moving], free[:, None], corners]
    low = [ijk[nodes].min(axis=1) // 2 for nodes in ends]
    keys = [encode_morton(corner) for corner in low]
    codes = [
        np.where(held[nodes], HELD, (ijk[nodes] - 2 * corner[:, None]) @ [9, 3, 1])
        for nodes, corner in zip(ends, low, strict=True)
    ]
    every, which = np.unique(np.concatenate(keys)), (moving, free, np.arange(len(corners)))
    of_springs, of_nodes, of_cells = (
        ByCell.of(key, every, code, number).near(lattice.nodes)
        for key, code, number in zip(keys, codes, which, strict=True)
    )
    return every, of_springs, of_nodes, of_cells


@numba.njit(cache=True)
def _add_block(places, i, p, q, pair, values, f, b00, b01, b02, b10, b11, b12, b20, b21, b22):
    """Add f times a block to that of corners p and q of cell i, p <= q."""
    row = places[i, pair[p, q]]
    if row >= 0:
        values[row, 0] += f * b00
        values[row, 1] += f * b01
        values[row, 2] += f * b02
        values[row, 3] += f * b10
        values[row, 4] += f * b11
        values[row, 5] += f * b12
        values[row, 6] += f * b20
        values[row, 7] += f * b21
        values[row, 8] += f * b22


@kernel
def add_springs(
    first, count, step, q, start, order, code, springs, rest, k, b, t2, counts, corner, part, _, pair, places, values
):
    for i in range(first, count, step):
        for at in range(start[i], start[i + 1]):
            s, kind = order[at], 28 * code[at, 0] + code[at, 1]
            m, n = springs[s, 0], springs[s, 1]
            x, y, z = q[m, 0] - q[n, 0], q[m, 1] - q[n, 1], q[m, 2] - q[n, 2]
            c, ex, ey, ez = spring_block(x, y, z, rest[s], k[s], b, True)
            for u in range(counts[kind]):
                for v in range(counts[kind]):
                    a, d = corner[kind, u], corner[kind, v]
                    if a <= d:
                        f = t2 * part[kind, u] * part[kind, v]
                        _add_block(
                            places, i, a, d, pair, values, f, c + ex * ex, ex * ey, ex * ez,
                            ex * ey, c + ey * ey, ey * ez, ex * ez, ey * ez, c + ez * ez,
                        )  # fmt: skip


@kernel
def add_nodes(
    first, count, step, start, order, code, mass, contact, t2, counts, corner, part, weights, pair, places, values
):
    for i in range(first, count, step):
        for at in range(start[i], start[i + 1]):
            node, m = order[at], mass[order[at]]
            for a in range(8):
                for d in range(a, 8):
                    f = weights[code[at, 0], a] * weights[code[at, 0], d]
                    if f == 0.0:
                        continue
                    _add_block(places, i, a, d, pair, values, f, m, 0.0, 0.0, 0.0, m, 0.0, 0.0, 0.0, m)
                    if len(contact):
                        c = contact[node]
                        _add_block(
                            places, i, a, d, pair, values, t2 * f, c[0], c[1], c[2], c[3], c[4], c[5], c[6], c[7], c[8]
                        )


@kernel
def add_resistance(
    first, count, step, q, start, order, code, cells, resistance, least, t2, _, __, ___, weights, pair, places, values
):
    for i in range(first, count, step):
        for at in range(start[i], start[i + 1]):
            cell = order[at]
            for frame in range(8):
                e = edges(q, cells[cell], frame)
                n = cofactors(e)
                curvature = t2 * corner_curvature(e, n[0], resistance[cell], least)
                if curvature == 0.0:
                    continue
                for a in range(8):
                    g = _slope(frame, code[at], weights, a, n)
                    for d in range(a, 8):
                        h = _slope(frame, code[at], weights, d, n)
                        _add_block(
                            places, i, a, d, pair, values, curvature, g[0] * h[0], g[0] * h[1], g[0] * h[2],
                            g[1] * h[0], g[1] * h[1], g[1] * h[2], g[2] * h[0], g[2] * h[1], g[2] * h[2],
                        )  # fmt: skip


@numba.njit(cache=True)
def _slope(frame, code, weights, a, n):
    """Slope of a corner's volume as corner a of the coarse cell moves."""
    x, y, z = 0.0, 0.0, 0.0
    for role in range(4):
        w = weights[code[FRAMES[frame, role]], a]
        g = vector_of(role, n)
        x, y, z = x + w * g[0], y + w * g[1], z + w * g[2]
    return x, y, z
