"""Galerkin matrix P^T H P of the first coarse level, summed over springs, nodes and cells.

A coarse cell has 2 x 2 x 2 fine cells, and each spring lies within a coarse cell. Let w_a be the
weights (8,) of the cell's corners at end a of a spring, or 0 if the end is pinned. The matrix
(24 x 24) of the cell is the sum of these terms:

- a spring with block B: (w_a - w_b)(w_a - w_b)^T (x) t^2 B
- a node of mass m with contact block C: w w^T (x) (m I + t^2 C)
- a fixed component of a roller: a spring to the ground, GROUND times as stiff as the node
- a solid cell: its Hessian in the strains of the coarse corners (elasticity.neo_hookean)
"""

from typing import NamedTuple

import numpy as np
from petsc4py import PETSc

from msmpetsc.backend.arrays import Array, Floats, Indices, Positions, Rows, like, on_host, to_host
from msmpetsc.backend.kernel import kernel, njit
from msmpetsc.elasticity.assumed_strain import (
    corner_tensions,
    directions,
    factors,
    full_forces,
    rest_constants,
)
from msmpetsc.elasticity.cell_blocks import CellRows, one_by_one
from msmpetsc.elasticity.cell_strain import form_of, strain
from msmpetsc.elasticity.cell_threads import constants_at, state_at
from msmpetsc.elasticity.energy import Elasticity
from msmpetsc.elasticity.neo_hookean import kept_gradient
from msmpetsc.elasticity.solid import CellHessians
from msmpetsc.elasticity.springs import SYMMETRIC, spring_block
from msmpetsc.elasticity.vectors import Three, cofactors, combined, cross, scaled
from msmpetsc.geometry.grid import CORNERS
from msmpetsc.geometry.morton import COPIES, decode_morton, encode_morton
from msmpetsc.lattice.lattice import Springs
from msmpetsc.solve.linear.unknowns import Unknowns
from msmpetsc.solve.multigrid.coarse_copies import DIGITS, MOST_COPIES, in_cells
from msmpetsc.solve.multigrid.grids import CoarseGrid
from msmpetsc.solve.petsc.library import preallocate_coo, refuse_nonzeros, set_values_coo

# code of a pinned node; a node at (i, j, k) in its coarse cell has the code
# 9 i + 3 j + k
PINNED = 27
# the upper triangle in a 3 x 3 block, and the diagonal in the upper triangle
UPPER, DIAGONAL = [0, 1, 2, 4, 5, 8], [0, 3, 5]
# place in a 3 x 3 block of each entry of the block's transpose
TRANSPOSED = [0, 3, 6, 1, 4, 7, 2, 5, 8]
# stiffness of the spring that holds a fixed component on coarse levels [stiffness of
# the node]; much stiffer than components that move
GROUND = 100.0
# number of entries in a row of ``_write_coarse``
COARSE = 41
# pairs (36, 2) of corners: the upper triangle of a cell's matrix
PAIRS = np.array([(p, q) for p in range(8) for q in range(p, 8)])


def _weights() -> Rows:
    """Return the weights (28, 8) of a coarse cell's corners at each position code."""
    ijk = np.stack(np.unravel_index(np.arange(27), (3, 3, 3)), axis=1)
    along = np.where(CORNERS[None] > 0, ijk[:, None, :] / 2, 1 - ijk[:, None, :] / 2)
    return np.concatenate([along.prod(axis=2), np.zeros((1, 8))])


class Products(NamedTuple):
    """Nonzeros of the outer products w w^T of weights (n, 8), in compressed rows.

    begin  : (n + 1,) product i has the entries begin[i] : begin[i + 1]
    pair   : (k,) index of each entry in PAIRS
    factor : (k,) value of each entry
    """

    begin: Indices
    pair: Indices
    factor: Floats

    @classmethod
    def of(cls, weights: Rows) -> "Products":
        """Return the products of weights (n, 8)."""
        factors = weights[:, PAIRS[:, 0]] * weights[:, PAIRS[:, 1]]
        which, pair = np.nonzero(factors)
        begin = np.searchsorted(which, np.arange(len(weights) + 1)).astype(np.int32)
        return cls(begin, pair.astype(np.int32), factors[which, pair])


WEIGHTS = _weights()
# products of a spring, at the index 28 times the code of its first end plus the code of
# its second end; a node is a spring with a pinned second end
PRODUCTS = Products.of((WEIGHTS[:, None, :] - WEIGHTS[None, :, :]).reshape(-1, 8))


class ByCell(NamedTuple):
    """Springs, nodes or cells of a rank, sorted by their coarse cell.

    start : (c + 1,) coarse cell i has the items order[start[i] : start[i + 1]]
    order : (n,) numbers of the items
    code  : (n, k) codes of the positions of each item's k ends or corners in the coarse cell, in
            the order of ``order``
    """

    start: Indices
    order: Indices
    code: Indices

    @classmethod
    def of(cls, cells: Indices, keys: Indices, code: Indices, which: Indices) -> "ByCell":
        """Return items sorted by their coarse cells.

        cells : (n,) key of each item's coarse cell
        keys  : (c,) all keys, ascending
        code  : (n, k) position codes of each item
        which : (n,) number of each item
        """
        by_cell = np.argsort(cells, kind="stable")
        start = np.searchsorted(cells[by_cell], keys, side="left")
        start = np.append(start, len(cells)).astype(np.int32)
        return cls(start, which[by_cell].astype(np.int32), code[by_cell].astype(np.uint8))


class PairSum(NamedTuple):
    """Sum of the blocks of springs or nodes over the coarse cells.

    values   : (b, 6) upper triangles of the blocks
    places   : (c, 36) block of each pair of a coarse cell's corners, -1 if there is none
    products : products of the weights at the ends of each code, times t^2 [s^2]
    """

    values: Rows
    places: Indices
    by_cell: ByCell
    products: Products


class CellSum(NamedTuple):
    """Sum of the blocks of fine cells over the coarse cells.

    values  : (b, 9) blocks
    places  : (c, 36) block of each pair of a coarse cell's corners, -1 if there is none
    weights : (28, 8) weights of the corners times the time step [s], because H has t^2
    """

    values: Rows
    places: Indices
    by_cell: ByCell
    weights: Rows


class GalerkinSum:
    """Sum P^T H P of the first coarse grid, with H = M + t^2 (projected Hessian of E).

    On a CPU, all cells add to the blocks of this rank's pairs of nodes. On a GPU, each cell has its
    own blocks, which PETSc sums.

    grid    : the first coarse grid
    keys    : (l,) key of each local node
    offsets : (l,) key of the offset of each node's body (free_bodies.Bodies.offsets)
    copies  : (l, 8) copies of each node's parents (multigrid.coarse_copies)
    stiff   : (owned,) stiffness of each node at rest [N/m]
    pattern : AIJ of the coarse nodes, with an entry for each block
    """

    def __init__(
        self,
        unknowns: Unknowns,
        elasticity: Elasticity,
        t2: float,
        grid: CoarseGrid,
        keys: Indices,
        offsets: Indices,
        copies: Array,
        stiff: Floats,
    ):
        lattice = unknowns.lattice
        self.unknowns, self.elasticity, self.t2 = unknowns, elasticity, t2
        corners, self.springs, self.nodes, self.cells = _by_cell(
            unknowns, elasticity, decode_morton(keys), offsets, copies
        )
        self.weights, self.full = (like(lattice.nodes, a) for a in (t2**0.5 * WEIGHTS, SYMMETRIC))
        scaled_products = PRODUCTS._replace(factor=t2 * PRODUCTS.factor)
        self.products = Products(*(like(lattice.nodes, part) for part in scaled_products))
        # Places, and stiffnesses [N/m], of the springs that hold rollers
        node, component = (rows[lattice.rollers[0] < lattice.owned] for rows in lattice.rollers)
        self.rollers = node, like(node, np.array(DIAGONAL))[component]
        self.ground = GROUND * stiff[node]
        first, second, places = self._pairs(grid, corners)
        self.blocks, self.places = len(first), like(lattice.nodes, places)
        upper = np.flatnonzero(first != second)
        self.upper = like(lattice.nodes, upper)
        self.pattern = self._create_pattern(grid, first, second, upper)

    def _pairs(self, grid: CoarseGrid, corners: Indices) -> tuple[Indices, Indices, Indices]:
        """Return first and second nodes (b,) of all blocks, and the numbers of blocks (c, 36).

        corners : (c, 8) keys of the cells' corners
        """
        number = grid.table.find(corners)
        first, second = number[:, PAIRS[:, 0]], number[:, PAIRS[:, 1]]
        exists = (first >= 0) & (second >= 0)
        pairs = (first * grid.table.total + second)[exists]
        places = np.full(exists.shape, -1, np.int32)
        places[exists] = np.arange(len(pairs))
        if on_host(self.unknowns.lattice.nodes):
            pairs, shared = np.unique(pairs, return_inverse=True)
            places[exists] = shared
        return pairs // grid.table.total, pairs % grid.table.total, places

    def _create_pattern(
        self, grid: CoarseGrid, first: Indices, second: Indices, upper: Indices
    ) -> PETSc.Mat:
        """Return a matrix with an entry for each pair, and for transposed pairs (collective).

        first, second : (b,) nodes of each pair
        upper         : numbers of the pairs that also have a transposed entry
        """
        comm = self.unknowns.comm
        # Only a GPU has a matrix of all unknowns on this level.
        entries = 1 if on_host(self.unknowns.lattice.nodes) else 9
        refuse_nonzeros(comm, entries * (len(first) + len(upper)))
        pattern = PETSc.Mat().create(comm=comm)
        pattern.setSizes(2 * ((len(grid.table.keys), grid.table.total),))
        pattern.setType(self.unknowns.memory.mat_type)
        rows = np.concatenate([first, second[upper]])
        preallocate_coo(pattern, rows, np.concatenate([second, first[upper]]))
        return pattern

    def set_entries(self, blocks: Rows, entry: int) -> None:
        """Set the pattern's values to one entry, 0 to 8, of ``blocks`` (b, 9) (collective)."""
        below = blocks[self.upper, TRANSPOSED[entry]]
        set_values_coo(self.pattern, np.concatenate([blocks[:, entry], below]))

    def blocks_at(self, q: Positions, contact: Rows) -> Rows:
        """Return the blocks (b, 9) of this rank's pairs at positions q (l, 3) [m].

        contact : (owned, 9) or (0, 9) Hessian of contact of each node [N/m]
        """
        count = len(self.places)
        symmetric = np.zeros((self.blocks, 6), like=q)
        solid, viscosity = self.elasticity.solid, self.elasticity.viscosity
        if self.elasticity.springs:
            of_springs = PairSum(symmetric, self.places, self.springs, self.products)
            add_springs(count, q, of_springs, self.elasticity.springs.owned)
        # Matrix of single nodes over t^2 [N/m]
        own = np.zeros((len(self.unknowns.ballast), 6), like=q)
        own[:, DIAGONAL] = self.unknowns.ballast[:, None] / self.t2
        own[self.rollers] += self.ground
        if len(contact):
            own += contact[:, UPPER]
        add_nodes(count, own, PairSum(symmetric, self.places, self.nodes, self.products))
        into = CellSum(symmetric[:, self.full], self.places, self.cells, self.weights)
        scratch = np.empty((1 if on_host(q) else count, 8, COARSE), like=q)
        hessians: list[CellHessians] = [solid.hessian_at(q, True)] if solid else []
        for hessian in hessians + ([viscosity.hessian] if viscosity else []):
            add_solid(count, scratch, into, one_by_one(hessian.blocks, hessian.state))
        return into.values


def _by_cell(
    unknowns: Unknowns, elasticity: Elasticity, ijk: Indices, offsets: Indices, parents: Array
) -> tuple[Indices, ByCell, ByCell, ByCell]:
    """Return the keys of coarse cells' corners (c, 8), and springs, nodes and cells by coarse cell.

    parents : (l, 8) copies of each node's parents
    """
    lattice = unknowns.lattice
    pinned, free = to_host(lattice.pinned), to_host(unknowns.free)
    springs = to_host(lattice.springs)[: lattice.springs_owned if elasticity.springs else 0]
    moving = np.flatnonzero(~pinned[springs].all(axis=1))
    corners = elasticity.corners
    ends = [springs[moving], free[:, None], corners]
    low = [ijk[nodes].min(axis=1) // 2 for nodes in ends]
    # A pinned node has offset 0 and follows the body that it holds.
    # The bits of half an offset are three places lower in its key.
    keys = [
        encode_morton(corner) + (offsets[nodes].max(axis=1) >> 3)
        for corner, nodes in zip(low, ends, strict=True)
    ]
    codes = [
        np.where(pinned[nodes], PINNED, (ijk[nodes] - 2 * corner[:, None]) @ [9, 3, 1])
        for nodes, corner in zip(ends, low, strict=True)
    ]
    tails = [
        _copies_of_corners(corner, ijk, nodes, parents)
        for corner, nodes in zip(low, ends, strict=True)
    ]
    bases = np.unique(np.concatenate(keys))
    numbers = [
        np.searchsorted(bases, key) * MOST_COPIES + tail
        for key, tail in zip(keys, tails, strict=True)
    ]
    every = np.unique(np.concatenate(numbers))
    of_corners = every[:, None] // DIGITS % COPIES
    cells = encode_morton(decode_morton(bases[every // MOST_COPIES])[:, None] + CORNERS)
    which = moving, free, np.arange(len(corners))
    of_springs, of_nodes, of_cells = (
        ByCell(*(like(lattice.nodes, part) for part in ByCell.of(number, every, code, items)))
        for number, code, items in zip(numbers, codes, which, strict=True)
    )
    return cells + of_corners, of_springs, of_nodes, of_cells


def _copies_of_corners(low: Indices, ijk: Indices, nodes: Indices, parents: Array) -> Indices:
    """Return the copies of the corners of each item's coarse cell, combined by DIGITS, (n,).

    low     : (n, 3) index of the coarse cells
    ijk     : (l, 3) index of the fine nodes
    nodes   : (n, k) local nodes of each item
    parents : (l, 8) copies of each node's parents
    """
    numbers = np.zeros(len(nodes), np.int64)
    own = np.flatnonzero(parents.any(axis=1)[nodes].any(axis=1))
    numbers[own] = in_cells(low[own], ijk[nodes[own]], parents[nodes[own]]) @ DIGITS
    return numbers


@kernel
def add_springs(
    first: int, count: int, step: int, q: Positions, into: PairSum, springs: Springs
) -> None:
    """Add t^2 times the projected Hessians of the springs at q (l, 3) [m]."""
    values, places, (start, order, code), (begin, pair, factor) = into
    ends, rest, k = springs
    for i in range(first, count, step):
        for at in range(start[i], start[i + 1]):
            s, kind = order[at], 28 * code[at, 0] + code[at, 1]
            m, n = ends[s, 0], ends[s, 1]
            x, y, z = q[m, 0] - q[n, 0], q[m, 1] - q[n, 1], q[m, 2] - q[n, 2]
            c, ex, ey, ez = spring_block((x, y, z), rest[s], k[s], True)
            xx, xy, xz = c + ex * ex, ex * ey, ex * ez
            yy, yz, zz = c + ey * ey, ey * ez, c + ez * ez
            for entry in range(begin[kind], begin[kind + 1]):
                f, place = factor[entry], places[i, pair[entry]]
                # A view of the block would double the time.
                values[place, 0] += f * xx
                values[place, 1] += f * xy
                values[place, 2] += f * xz
                values[place, 3] += f * yy
                values[place, 4] += f * yz
                values[place, 5] += f * zz


@kernel
def add_nodes(first: int, count: int, step: int, own: Rows, into: PairSum) -> None:
    """Add t^2 times the upper triangles ``own`` (owned, 6) of the nodes' blocks."""
    values, places, (start, order, code), (begin, pair, factor) = into
    for i in range(first, count, step):
        for at in range(start[i], start[i + 1]):
            node, kind = order[at], 28 * code[at, 0] + PINNED
            for entry in range(begin[kind], begin[kind + 1]):
                place = places[i, pair[entry]]
                for c in range(6):
                    values[place, c] += factor[entry] * own[node, c]


@kernel
def add_solid(
    first: int, count: int, step: int, scratch: Array, into: CellSum, cells: CellRows
) -> None:
    """Add t^2 times the Hessians of fine cells, with corners interpolated from coarse corners.

    scratch : (s, 8, COARSE) memory for ``_write_coarse``; coarse cell i uses part i % s
    """
    values, places, by_cell, weights = into
    for i in range(first, count, step):
        e = scratch[i % len(scratch)]
        for at in range(by_cell.start[i], by_cell.start[i + 1]):
            cell = by_cell.order[at]
            k, s = constants_at(cells, cell), state_at(cells, cell)
            m, f = cells.constants[k + 104], kept_gradient(cells.state, s)
            n = directions(f, factors(f))
            _write_coarse(e, weights, by_cell.code[at], cells, k, s)
            pair = -1
            for a in range(8):
                for c in range(a, 8):
                    pair += 1
                    if places[i, pair] >= 0:
                        own = m * (e[a, 0] * e[c, 0] + e[a, 1] * e[c, 1] + e[a, 2] * e[c, 2])
                        for mode in range(4):
                            own += e[a, 3 + mode] * e[c, 7 + mode]
                        block = values[places[i, pair]]
                        _add_block(block, own, cells.state, s, e[a], e[c])
                        _add_bending(block, n, e[a], e[c])


@njit(inline="always")
def _write_coarse(rows: Rows, weights: Rows, code: Array, cells: CellRows, k: int, s: int) -> None:
    """Write a row (COARSE,) for each corner of the coarse cell around a fine cell.

    A row has the fine cell's strain by a unit displacement of the corner (7), ``full_forces`` (4),
    cof F g (3) and ``corner_tensions`` (27).
    """
    f, rest = kept_gradient(cells.state, s), rest_constants(cells.constants, k)
    n = cofactors(f)
    for a in range(8):
        u = (
            weights[code[0], a], weights[code[1], a], weights[code[2], a], weights[code[3], a],
            weights[code[4], a], weights[code[5], a], weights[code[6], a], weights[code[7], a],
        )  # fmt: skip
        e, row = strain(u, form_of(cells.constants, k)), rows[a]
        row[0], row[1], row[2], row[3], row[4], row[5], row[6] = e
        row[7], row[8], row[9], row[10] = full_forces(rest, e)
        row[11], row[12], row[13] = combined((e[0], e[1], e[2]), n)
        t = corner_tensions(rest, f, e)
        for axis in range(3):
            for mode in range(3):
                at = 14 + 9 * axis + 3 * mode
                row[at], row[at + 1], row[at + 2] = t[axis][mode]


@njit(inline="always")
def _add_bending(block: Floats, n: Three, g: Floats, h: Floats) -> None:
    """Add the coupling of two corners by bending and twist, with directions n fixed."""
    for axis in range(3):
        at = 14 + 9 * axis
        x = g[3] * h[at] + g[4] * h[at + 3] + g[5] * h[at + 6]
        y = g[3] * h[at + 1] + g[4] * h[at + 4] + g[5] * h[at + 7]
        z = g[3] * h[at + 2] + g[4] * h[at + 5] + g[5] * h[at + 8]
        for r in range(3):
            block[3 * r] += n[axis][r] * x
            block[3 * r + 1] += n[axis][r] * y
            block[3 * r + 2] += n[axis][r] * z


@njit(inline="always")
def _add_block(block: Floats, own: float, state: Floats, s: int, g: Floats, h: Floats) -> None:
    """Add own I + U'' m n^T + U' [t]_x, with t = F (h x g), to the block of two corners.

    m and n are cof F g and cof F h. The last term is the bilinear form v . (F x (u (x) h)) g.
    """
    f, slope, curvature = kept_gradient(state, s), state[s + 72], state[s + 80]
    t = cross((h[0], h[1], h[2]), (g[0], g[1], g[2]))
    for row in range(3):
        block[4 * row] += own
        for column in range(3):
            block[3 * row + column] += curvature * g[11 + row] * h[11 + column]
    a, b, c = scaled(slope, combined(t, f))
    block[7] += a
    block[5] -= a
    block[2] += b
    block[6] -= b
    block[3] += c
    block[1] -= c
