"""Loops over single cells: all loops of a GPU, and the rare loops of a CPU.

On a GPU a thread per cell writes the forces at the cell's corners. A thread per node then sums the
forces of the cells around the node, so that the sums are reproducible. The force at corner a of a
cell is stored at (block, a, component, lane).
"""

from collections.abc import Callable

import numpy as np

from msmpetsc.backend.arrays import Array, Floats, Indices, Positions, Rows
from msmpetsc.backend.kernel import kernel, njit
from msmpetsc.elasticity.assumed_strain import rest_constants
from msmpetsc.elasticity.cell_blocks import PROJECTED, ROWS, CellBlocks, CellRows, one_by_one
from msmpetsc.elasticity.cell_strain import LANES, Strains, form_of, strain, write_forces
from msmpetsc.elasticity.neo_hookean import (
    cell_gradient,
    cell_product,
    determinant_and_change,
    forms_change,
    gradient_of,
    projected_product,
    slopes_at,
    volume_change,
    write_modes,
    write_state,
)


@njit(inline="always")
def constants_at(cells: CellRows, i: int) -> int:
    """Return the index at which the constants of cell i begin."""
    return int(cells.which[i // LANES]) * ROWS * LANES + i % LANES


@njit(inline="always")
def state_at(cells: CellRows, i: int) -> int:
    """Return the index at which the Hessian's state of cell i begins."""
    return (i // LANES) * cells.width * LANES + i % LANES


@njit(inline="always")
def strains_at(q: Positions, cells: CellRows, i: int) -> Strains:
    """Return the strains of cell i for the values q (l, 3) of nodes."""
    c, form = cells.nodes[i], form_of(cells.constants, constants_at(cells, i))
    return (
        strain((q[c[0], 0], q[c[1], 0], q[c[2], 0], q[c[3], 0],
                q[c[4], 0], q[c[5], 0], q[c[6], 0], q[c[7], 0]), form),
        strain((q[c[0], 1], q[c[1], 1], q[c[2], 1], q[c[3], 1],
                q[c[4], 1], q[c[5], 1], q[c[6], 1], q[c[7], 1]), form),
        strain((q[c[0], 2], q[c[1], 2], q[c[2], 2], q[c[3], 2],
                q[c[4], 2], q[c[5], 2], q[c[6], 2], q[c[7], 2]), form),
    )  # fmt: skip


@kernel
def _write_products(
    first: int, count: int, step: int, v: Rows, cells: CellRows, store: Floats
) -> None:
    for i in range(first, count, step):
        k, e = constants_at(cells, i), strains_at(v, cells, i)
        s = state_at(cells, i)
        if cells.width == PROJECTED:
            slopes, modes = projected_product(cells.constants, k, cells.state, s, e)
        else:
            slopes, modes = cell_product(cells.constants, k, cells.state, s, e)
        at = (i // LANES) * 24 * LANES + i % LANES
        write_forces(store, at, form_of(cells.constants, k), slopes, modes)


@kernel
def _write_gradients(
    first: int, count: int, step: int, q: Positions, cells: CellRows, store: Floats
) -> None:
    for i in range(first, count, step):
        k, e = constants_at(cells, i), strains_at(q, cells, i)
        m, lame = cells.constants[k + 104], cells.constants[k + 112]
        slopes, modes = cell_gradient(
            rest_constants(cells.constants, k), m, lame, e, cells.h4, cells.u
        )
        at = (i // LANES) * 24 * LANES + i % LANES
        write_forces(store, at, form_of(cells.constants, k), slopes, modes)


@kernel
def _add_around(
    first: int, count: int, step: int, store: Floats, around: Indices, rows: Rows
) -> None:
    for i in range(first, count, step):
        x, y, z = 0.0, 0.0, 0.0
        for a in range(8):
            at = around[a, i] // LANES * 3 * LANES + around[a, i] % LANES
            if at < len(store):
                x, y, z = x + store[at], y + store[at + LANES], z + store[at + 2 * LANES]
        rows[i, 0] += x
        rows[i, 1] += y
        rows[i, 2] += z


@kernel
def _write_states(
    first: int, count: int, step: int, q: Positions, cells: CellRows, projected: bool
) -> None:
    for i in range(first, count, step):
        k, e, inverse_h4 = constants_at(cells, i), strains_at(q, cells, i), 1.0 / cells.h4
        f = gradient_of(e, inverse_h4)
        slope, curvature = slopes_at(
            f, cells.constants[k + 104], cells.constants[k + 112], cells.u, projected
        )
        write_state(cells.state, state_at(cells, i), f, slope, curvature)
        if not projected:
            write_modes(cells.state, state_at(cells, i), e, inverse_h4)


@kernel
def _write_changes(
    first: int, count: int, step: int, parts: Floats, cells: CellRows, path: tuple[Rows, Rows]
) -> None:
    """Write E(base + moved) - E(base) [J] of each cell to ``parts`` (count,).

    path : ``moved`` and ``base``, (l, 3) [m]
    """
    moved, base = path
    for i in range(first, count, step):
        k, d, e = constants_at(cells, i), strains_at(moved, cells, i), strains_at(base, cells, i)
        g, f = gradient_of(d, 1.0 / cells.h4), gradient_of(e, 1.0 / cells.h4)
        j_base, j_change = determinant_and_change(g, f)
        m, lame, parts[i] = cells.constants[k + 104], cells.constants[k + 112], 0.0
        if m > 0.0:
            volume = volume_change(j_base + j_change, j_base, j_change, m, lame, cells.u)
            forms = forms_change(cells.constants, k, g, e, d, 1.0 / cells.h4)
            parts[i] = forms + cells.h4**2 * volume


def _add(
    kernel: Callable[..., None], array: Array, cells: CellRows, around: Indices, rows: Rows
) -> None:
    """Run a kernel that writes three numbers per corner. Add these to the owned rows (l, 3)."""
    store = np.empty(24 * len(cells.nodes), like=rows)
    kernel(len(cells.nodes), array, cells, store)
    _add_around(around.shape[1], store, around, rows)


def add_product(blocks: CellBlocks, state: Rows, v: Array, product: Array) -> None:
    """Add (Hessian) v [N] to owned rows of ``product`` (l, 3), with the state of ``linearise``."""
    _add(_write_products, v, one_by_one(blocks, state), blocks.around, product)


def add_gradient(blocks: CellBlocks, q: Positions, gradient: Rows) -> None:
    """Add grad E [N] at q (l, 3) [m] to the owned rows of ``gradient`` (l, 3)."""
    _add(_write_gradients, q, one_by_one(blocks), blocks.around, gradient)


def linearise(blocks: CellBlocks, q: Positions, projected: bool, state: Rows) -> None:
    """Write the state of each cell's Hessian at q (l, 3) [m] into ``state`` (b, width * LANES).

    The width is PROJECTED if the Hessian is ``projected``, else STATE (elasticity.cell_blocks).
    """
    _write_states(LANES * len(blocks.nodes), q, one_by_one(blocks, state), projected)


def cell_changes(blocks: CellBlocks, count: int, q: Positions, base: Positions) -> Floats:
    """Return E(q) - E(base) [J] of each of the first cells (count,)."""
    parts: Floats = np.empty(count, like=q)
    _write_changes(count, parts, one_by_one(blocks), (q - base, base))
    return parts


def elastic_change(blocks: CellBlocks, q: Positions, base: Positions) -> float:
    """Return E(q) - E(base) [J] of the cells that the rank owns."""
    return float(cell_changes(blocks, LANES * blocks.owned, q, base).sum())
