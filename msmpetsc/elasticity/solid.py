"""A neo-Hookean solid on a lattice: what Elasticity asks of a law, by the loops of a CPU or of a GPU."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from types import ModuleType

import numba
import numpy as np

from msmpetsc.backend.arrays import Array, Floats, Indices, Positions, Rows, greatest, on_host, to_host
from msmpetsc.backend.kernel import kernel
from msmpetsc.elasticity import cell_lanes, cell_threads
from msmpetsc.elasticity.cell_blocks import ROWS, STATE, Blocks, blocks_of
from msmpetsc.elasticity.cell_strain import LANES, corner_strain, form_of
from msmpetsc.elasticity.cell_threads import constants_at, flat, state_at, strains_at
from msmpetsc.elasticity.neo_hookean import corner_block, gradient_of, lost
from msmpetsc.lattice.lattice import Lattice


@numba.njit(cache=True, inline="always")
def _row_of(i: int, a: int, nodes: Indices, by_node: bool) -> int:
    """Return what corner a of cell i adds to: the row of its node, or one of its own (Blocks.around)."""
    return int(nodes[i, a]) if by_node else (i // LANES * 8 + a) * LANES + i % LANES


@numba.njit(cache=True, inline="always")
def _size(a: int, constants: Floats, k: int) -> float:
    g = corner_strain(a, form_of(constants, k))
    return math.sqrt(g[0] * g[0] + g[1] * g[1] + g[2] * g[2])


@kernel
def _add_concavity(
    first: int, count: int, step: int, q: Positions, nodes: Indices, which: Indices, constants: Floats, h4: float,
    by_node: bool, concavity: Rows,
) -> None:  # fmt: skip
    """V |G|^2 is no more than sum_a |g_a| (sum_b |g_b|) V |v_a|^2, with g_a the mean slope of corner a."""
    for i in range(first, count, step):
        k, sizes = constants_at(which, i), 0.0
        f = gradient_of(strains_at(q, nodes[i], constants, k), 1.0 / h4)
        for a in range(8):
            sizes += _size(a, constants, k)
        taken = sizes * lost(f, constants[k + 104], constants[k + 112])
        for a in range(8):
            concavity[_row_of(i, a, nodes, by_node), 0] += taken * _size(a, constants, k)


@kernel
def _add_diagonal(
    first: int, count: int, step: int, state: Floats, nodes: Indices, which: Indices, constants: Floats, by_node: bool,
    diagonal: Rows,
) -> None:  # fmt: skip
    for i in range(first, count, step):
        k, s = constants_at(which, i), state_at(i)
        for a in range(8):
            own, curvature, e = corner_block(a, constants, k, state, s)
            block = diagonal[_row_of(i, a, nodes, by_node)]
            block[0] += own + curvature * e[0] * e[0]
            block[4] += own + curvature * e[1] * e[1]
            block[8] += own + curvature * e[2] * e[2]
            xy, xz, yz = curvature * e[0] * e[1], curvature * e[0] * e[2], curvature * e[1] * e[2]
            block[1] += xy
            block[3] += xy
            block[2] += xz
            block[6] += xz
            block[5] += yz
            block[7] += yz


def _add_at_corners(write: Callable[[bool, Rows], None], blocks: Blocks, rows: Rows) -> None:
    """Let cells add to the rows (l, k) of their nodes; on a GPU to rows of their own, which each node then sums."""
    if on_host(rows):
        write(True, rows)
    else:
        corners = np.zeros((8 * LANES * len(blocks.nodes) + 1, rows.shape[1]), like=rows)
        write(False, corners)
        rows[: blocks.around.shape[1]] += corners[blocks.around].sum(axis=0)


def _loops(array: Array) -> ModuleType:
    """Return the loops over cells where an array is."""
    return cell_lanes if on_host(array) else cell_threads


@dataclass(frozen=True)
class CellHessians:
    """Hessians of cells, as ``linearise`` leaves them in ``state``: what adds their product with v [N]."""

    blocks: Blocks
    state: Array

    def __call__(self, v: Array, product: Array) -> None:
        _loops(v).add_product(self.blocks, self.state, v, product)

    @property
    def slopes(self) -> Array:
        """V U' (b, LANES) of the cells, to be read or written: by it a cell's J bends with F."""
        return self.state[:, 9 * LANES : 10 * LANES]

    def add_diagonal(self, diagonal: Rows) -> None:
        """Add the diagonal blocks to ``diagonal`` (l, 9) [N/m], but for what U' adds, which is none."""
        write = partial(_add_diagonal, LANES * len(self.blocks.nodes), self.state.ravel(), *flat(self.blocks))
        _add_at_corners(write, self.blocks, diagonal)


@dataclass(frozen=True)
class NeoHookean:
    """The cells around this rank's nodes, those that it owns first.

    owned : number of blocks of cells that this rank owns
    h4    : four times the side of a cell [m]
    """

    blocks: Blocks
    owned: int
    h4: float

    @classmethod
    def of_lattice(cls, lattice: Lattice) -> "NeoHookean":
        """Return the solid of a lattice, in the memory that its nodes are in."""
        assert lattice.solid is not None
        h4 = 4 * lattice.cell_size
        forms, volume, shear, lame = map(to_host, lattice.solid)
        m = (shear * volume / h4**2)[:, None]
        constants = np.concatenate([forms[:, :6], m * forms[:, 6:], m, (lame * volume / h4**2)[:, None]], axis=1)
        return cls(*blocks_of(lattice, constants), h4)

    @property
    def corners(self) -> Indices:
        """Corner nodes (c, 8) of the cells that this rank owns, in the order of its blocks."""
        return to_host(self.blocks.nodes)[: self.owned].reshape(-1, 8)

    @property
    def _moduli(self) -> tuple[Array, Array]:
        """V mu and V lambda (k, LANES) of the cells' constants, to be read or written."""
        rows = self.blocks.constants.reshape(-1, ROWS, LANES)
        return rows[:, ROWS - 2], rows[:, ROWS - 1]

    @property
    def stiffest(self) -> float:
        """The greatest lambda of a cell, in mu."""
        mu, lame = self._moduli
        return float(greatest(lame / np.where(mu > 0, mu, 1.0)))

    @contextmanager
    def softened(self, ratio: float) -> Iterator[None]:
        """Take no lambda for more than ``ratio`` mu meanwhile."""
        mu, lame = self._moduli
        true = lame.copy()
        np.minimum(true, ratio * mu, out=lame)
        try:
            yield
        finally:
            lame[:] = true

    def energies(self, q: Positions, blocks: int) -> Rows:
        """Return E [J] by cell (blocks, LANES), of the first blocks."""
        energies = np.empty((blocks, LANES), like=q)
        _loops(q).cell_energies(self.blocks, self.h4, q, energies)
        return energies

    def energy(self, q: Positions) -> float:
        """Return E [J] of the cells that this rank owns."""
        return float(self.energies(q, self.owned).sum())

    def change(self, q: Positions, base: Positions) -> float:
        """Return E(q) - E(base) [J] of the cells that this rank owns."""
        return float(_loops(q).elastic_change(self.blocks, self.owned, self.h4, q, base))

    def add_gradient(self, q: Positions, gradient: Rows) -> None:
        """Add grad E [N] to ``gradient`` (l, 3)."""
        _loops(q).add_gradient(self.blocks, self.h4, q, gradient)

    def add_concavity(self, q: Positions, concavity: Floats) -> None:
        """Add to ``concavity`` (l,) [N/m] how much less than 0 the Hessian may be."""
        write = partial(_add_concavity, LANES * len(self.blocks.nodes), q, *flat(self.blocks), self.h4)
        _add_at_corners(write, self.blocks, concavity.reshape(-1, 1))

    def hessian_at(self, q: Positions, projected: bool, dtype: type = np.float64) -> CellHessians:
        """Return what adds (Hessian of E at q) v [N] to its second argument: of F, V U' and V U'' of all cells."""
        state: Rows = np.empty((len(self.blocks.nodes), STATE * LANES), dtype, like=q)
        _loops(q).linearise(self.blocks, self.h4, q, projected, state)
        constants: Rows = self.blocks.constants.astype(dtype, copy=False)
        return CellHessians(self.blocks._replace(constants=constants), state)

    def add_bound(self, q: Positions, blocks: Rows) -> None:
        """Add the diagonal blocks of the projected Hessian to ``blocks`` (l, 9) [N/m]: an eighth of what bounds it."""
        self.hessian_at(q, True).add_diagonal(blocks)
