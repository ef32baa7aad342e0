"""A neo-Hookean solid on a lattice, with the methods that Elasticity needs of a law."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from types import ModuleType

import numpy as np

from msmpetsc.backend.arrays import (
    Array,
    Floats,
    Indices,
    Positions,
    Rows,
    greatest,
    like,
    on_host,
    to_host,
)
from msmpetsc.backend.kernel import kernel, njit
from msmpetsc.elasticity import cell_lanes, cell_threads
from msmpetsc.elasticity.assumed_strain import (
    ASSUMED,
    corner_tensions,
    directions,
    factors,
    rest_constants,
)
from msmpetsc.elasticity.cell_blocks import (
    PROJECTED,
    ROWS,
    STATE,
    CellBlocks,
    CellRows,
    add_corners,
    blocks_of,
    one_by_one,
)
from msmpetsc.elasticity.cell_strain import LANES, corner_strain, form_of
from msmpetsc.elasticity.cell_threads import constants_at, linearise, state_at, strains_at
from msmpetsc.elasticity.neo_hookean import (
    VOLUMETRIC,
    concavity_bounds,
    corner_stiffness,
    kept_gradient,
)
from msmpetsc.elasticity.springs import add_block
from msmpetsc.elasticity.vectors import Vector, cofactors, combined
from msmpetsc.lattice.cell_moments import slopes_and_modes
from msmpetsc.lattice.lattice import Lattice

# number of a cell's constants for bounds of concavity [-]; see ``_concavity_constants``
BOUNDS = 18
# indices of C, by rows, among a cell's constants [-]
COVARIANCE = [6, 11, 10, 11, 7, 9, 10, 9, 8]


@njit(inline="always")
def _row_of(cells: CellRows, i: int, a: int) -> int:
    """Return the row that corner a of cell i adds to."""
    return int(cells.nodes[i, a]) if cells.by_node else (i // LANES * 8 + a) * LANES + i % LANES


def _shares(operators: Rows) -> Rows:
    """Return numbers s (c, 8) for which |B v|^2 is at most the sum of s_a v_a^2.

    s_a is |b_a| times the norm of the sum of b_a b_a^T / |b_a|, with b_a the columns of B.

    operators : B (c, 3, 8)
    """
    lengths = np.linalg.norm(operators, axis=1)
    weighted = operators / np.maximum(lengths, np.finfo(float).tiny)[:, None]
    norms = np.linalg.eigvalsh(weighted @ operators.swapaxes(1, 2))[:, -1:]
    shares: Rows = lengths * norms
    return shares


@kernel
def _add_concavity(
    first: int, count: int, step: int, concavity: Rows, cells: CellRows, c: Floats, q: Positions
) -> None:
    """Add each cell's share of the concavity bound to its corners.

    c : ``NeoHookean._concavity_constants``, flat
    """
    for i in range(first, count, step):
        k, e = constants_at(cells, i), strains_at(q, cells, i)
        at = int(cells.which[i // LANES]) * BOUNDS * LANES + i % LANES
        spectrum = c[at + 16 * LANES], c[at + 17 * LANES]
        slopes, modes = concavity_bounds(cells.constants, k, e, cells.h4, cells.u, spectrum)
        for a in range(8):
            bound = slopes * c[at + a * LANES] + modes * c[at + (8 + a) * LANES]
            concavity[_row_of(cells, i, a), 0] += bound


@kernel
def _add_diagonal(first: int, count: int, step: int, diagonal: Rows, cells: CellRows) -> None:
    for i in range(first, count, step):
        k, s = constants_at(cells, i), state_at(cells, i)
        f, curvature = kept_gradient(cells.state, s), cells.state[s + 80]
        rest = rest_constants(cells.constants, k)
        n, normals = directions(f, factors(f)), cofactors(f)
        for a in range(8):
            g, block = corner_strain(a, form_of(cells.constants, k)), diagonal[_row_of(cells, i, a)]
            own = corner_stiffness(g, cells.constants, k)
            block[0] += own
            block[4] += own
            block[8] += own
            add_block(block, 0.0, curvature, combined((g[0], g[1], g[2]), normals))
            t = corner_tensions(rest, f, g)
            for axis in range(3):
                _add_along(block, n[axis], combined((g[3], g[4], g[5]), t[axis]))


@njit(inline="always")
def _add_along(block: Floats, n: Vector, t: Vector) -> None:
    """Add n t^T to a block (9,)."""
    for row in range(3):
        for column in range(3):
            block[3 * row + column] += n[row] * t[column]


def _loops(array: Array) -> ModuleType:
    """Return the module with the loops over cells for the device of an array."""
    return cell_lanes if on_host(array) else cell_threads


@dataclass(frozen=True)
class CellHessians:
    """The Hessian of all cells, from the ``state`` of ``linearise``.

    A call adds the product with v (l, 3) [N] to ``product`` (l, 3).
    """

    blocks: CellBlocks
    state: Array

    def __call__(self, v: Array, product: Array) -> None:
        _loops(v).add_product(self.blocks, self.state, v, product)

    @property
    def slopes(self) -> Array:
        """V U' / (16 h^2) of the cells, (b, LANES), as a view: the factor of the term F x G."""
        return self.state[:, 9 * LANES : 10 * LANES]

    def add_diagonal(self, diagonal: Rows) -> None:
        """Add the diagonal blocks of a projected Hessian to ``diagonal`` (l, 9) [N/m].

        The term of U' has no diagonal blocks.
        """
        cells = one_by_one(self.blocks, self.state)
        count = len(cells.nodes)
        add_corners(lambda rows: _add_diagonal(count, rows, cells), self.blocks, diagonal)


@dataclass(frozen=True)
class NeoHookean:
    """A neo-Hookean solid: the cells around the nodes that this rank owns.

    places : (c,) place of each of the lattice's ``local_cells`` in the sequence of blocks
    """

    blocks: CellBlocks
    places: Indices

    @classmethod
    def of_lattice(cls, lattice: Lattice) -> "NeoHookean":
        """Return the solid of a lattice, on the device of its nodes."""
        assert lattice.solid is not None
        h4 = 4 * lattice.cell_size
        forms, volume, shear, lame = map(to_host, lattice.solid)
        m = (shear * volume / h4**2)[:, None]
        modes = m * forms[:, 6:] * np.array([*[ASSUMED] * 6, 1.0])
        constants = np.concatenate(
            [forms[:, :6], modes, m, (lame * volume / h4**2)[:, None]], axis=1
        )
        return cls(*blocks_of(lattice, constants, VOLUMETRIC.index(lattice.volumetric)))

    @property
    def corners(self) -> Indices:
        """Corner nodes (c, 8) of the cells that this rank owns, in the order of the blocks."""
        return to_host(self.blocks.nodes)[: self.blocks.owned].reshape(-1, 8)

    @property
    def _moduli(self) -> tuple[Array, Array]:
        """V mu and V lambda over 16 h^2 among the cells' constants, (k, LANES) each, as views."""
        rows = self.blocks.constants.reshape(-1, ROWS, LANES)
        return rows[:, ROWS - 2], rows[:, ROWS - 1]

    @cached_property
    def _concavity_constants(self) -> Rows:
        """Constants (k, BOUNDS * LANES) of cells for bounds of the Hessian's negative part.

        They are the shares of a cell's eight corners in |G|^2 and in |h|^2, then the least and the
        greatest eigenvalue of C.
        """
        constants = to_host(self.blocks.constants).reshape(-1, ROWS, LANES)
        of_cells = constants.swapaxes(1, 2).reshape(-1, ROWS)
        slopes, modes = slopes_and_modes(of_cells[:, :6])
        spectrum = np.linalg.eigvalsh(of_cells[:, COVARIANCE].reshape(-1, 3, 3))
        least, greatest = spectrum[:, :1].clip(0), spectrum[:, 2:]
        columns = _shares(slopes), _shares(modes[:, :3]), least, greatest
        rows = np.concatenate(columns, axis=1).astype(np.float32).reshape(-1, LANES, BOUNDS)
        return like(self.blocks.nodes, rows.swapaxes(1, 2).reshape(-1, BOUNDS * LANES))

    @property
    def stiffest(self) -> float:
        """The greatest ratio lambda / mu of this rank's cells [-]."""
        mu, lame = self._moduli
        return float(greatest(lame / np.where(mu > 0, mu, 1.0)))

    @contextmanager
    def softened(self, ratio: float) -> Iterator[None]:
        """Limit lambda to ``ratio`` mu within the context."""
        mu, lame = self._moduli
        true = lame.copy()
        np.minimum(true, ratio * mu, out=lame)
        try:
            yield
        finally:
            lame[:] = true

    def change(self, q: Positions, base: Positions) -> float:
        """Return E(q) - E(base) [J] of the cells that this rank owns."""
        return float(_loops(q).elastic_change(self.blocks, q, base))

    def add_gradient(self, q: Positions, gradient: Rows) -> None:
        """Add grad E [N] to ``gradient`` (l, 3)."""
        _loops(q).add_gradient(self.blocks, q, gradient)

    def add_concavity(self, q: Positions, concavity: Floats) -> None:
        """Add a bound of the Hessian's negative part to ``concavity`` (l,) [N/m]."""
        cells, c = one_by_one(self.blocks), self._concavity_constants.ravel()
        count, of_nodes = len(cells.nodes), concavity.reshape(-1, 1)
        add_corners(lambda rows: _add_concavity(count, rows, cells, c, q), self.blocks, of_nodes)

    def hessian_at(self, q: Positions, projected: bool, dtype: type = np.float64) -> CellHessians:
        """Return the Hessian of E at q (l, 3) [m]; positive semidefinite if ``projected``."""
        width = PROJECTED if projected else STATE
        state: Rows = np.empty((len(self.blocks.nodes), width * LANES), dtype, like=q)
        linearise(self.blocks, q, projected, state)
        constants: Rows = self.blocks.constants.astype(dtype, copy=False)
        return CellHessians(self.blocks._replace(constants=constants), state)

    def add_bound(self, q: Positions, blocks: Rows) -> None:
        """Add the diagonal blocks of the projected Hessian at q to ``blocks`` (l, 9) [N/m].

        Eight times these blocks bound the projected Hessian.
        """
        self.hessian_at(q, True).add_diagonal(blocks)
