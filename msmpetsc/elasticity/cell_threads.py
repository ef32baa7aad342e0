"""The loops of elasticity.cell_lanes as a GPU has them: a thread a cell writes what it adds at its corners, a thread a
node sums what the cells around it have written, so that sums come out the same every time.

Cell i stands in lane i % LANES of block i // LANES; what a kernel writes at its corner a has the place (b, a, lane).
"""

from collections.abc import Callable
from functools import partial

import numba
import numpy as np

from msmpetsc.backend.arrays import Array, Floats, Indices, Positions, Rows
from msmpetsc.backend.kernel import kernel
from msmpetsc.elasticity.cell_blocks import ROWS, STATE, Blocks
from msmpetsc.elasticity.cell_strain import LANES, Strains, form_of, strain, write_forces
from msmpetsc.elasticity.neo_hookean import (
    changes,
    cofactors,
    determinant,
    gradient_of,
    pull,
    quadratic,
    quadratic_change,
    slopes_at,
    turned_pull,
    volume_change,
    volume_energy,
    write_state,
)


@numba.njit(cache=True, inline="always")
def constants_at(which: Indices, i: int) -> int:
    """Return where the constants of cell i begin in all of them."""
    return int(which[i // LANES]) * ROWS * LANES + i % LANES


@numba.njit(cache=True, inline="always")
def state_at(i: int) -> int:
    """Return where what a Hessian keeps of cell i begins."""
    return (i // LANES) * STATE * LANES + i % LANES


@numba.njit(cache=True, inline="always")
def strains_at(q: Positions, c: Indices, constants: Floats, k: int) -> Strains:
    """Return the strains of the cell with the corner nodes c (8,)."""
    form = form_of(constants, k)
    return (
        strain((q[c[0], 0], q[c[1], 0], q[c[2], 0], q[c[3], 0], q[c[4], 0], q[c[5], 0], q[c[6], 0], q[c[7], 0]), form),
        strain((q[c[0], 1], q[c[1], 1], q[c[2], 1], q[c[3], 1], q[c[4], 1], q[c[5], 1], q[c[6], 1], q[c[7], 1]), form),
        strain((q[c[0], 2], q[c[1], 2], q[c[2], 2], q[c[3], 2], q[c[4], 2], q[c[5], 2], q[c[6], 2], q[c[7], 2]), form),
    )


def flat(blocks: Blocks) -> tuple[Indices, Indices, Floats]:
    """Return the corner nodes (c, 8) of cells, and their constants as rows of numbers: what kernels take."""
    return blocks.nodes.reshape(-1, 8), blocks.which, blocks.constants.ravel()


@kernel
def _write_products(
    first: int, count: int, step: int, v: Rows, nodes: Indices, which: Indices, constants: Floats, state: Floats,
    store: Floats,
) -> None:  # fmt: skip
    for i in range(first, count, step):
        k = constants_at(which, i)
        e = strains_at(v, nodes[i], constants, k)
        slopes = turned_pull(e, constants[k + 104], state, state_at(i))
        write_forces(store, (i // LANES) * 24 * LANES + i % LANES, constants, k, slopes, e)


@kernel
def _write_gradients(
    first: int, count: int, step: int, q: Positions, nodes: Indices, which: Indices, constants: Floats, h4: float,
    store: Floats,
) -> None:  # fmt: skip
    for i in range(first, count, step):
        k = constants_at(which, i)
        e = strains_at(q, nodes[i], constants, k)
        slopes = pull(e, constants[k + 104], constants[k + 112], h4)
        write_forces(store, (i // LANES) * 24 * LANES + i % LANES, constants, k, slopes, e)


@kernel
def _add_around(first: int, count: int, step: int, store: Floats, around: Indices, rows: Rows) -> None:
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
    first: int, count: int, step: int, q: Positions, nodes: Indices, which: Indices, constants: Floats, h4: float,
    projected: bool, state: Floats,
) -> None:  # fmt: skip
    for i in range(first, count, step):
        k = constants_at(which, i)
        f = gradient_of(strains_at(q, nodes[i], constants, k), 1.0 / h4)
        slope, curvature = slopes_at(f, constants[k + 104], constants[k + 112], projected)
        write_state(state, state_at(i), f, slope, curvature)


@kernel
def _write_energies(
    first: int, count: int, step: int, q: Positions, nodes: Indices, which: Indices, constants: Floats, h4: float,
    energies: Floats,
) -> None:  # fmt: skip
    for i in range(first, count, step):
        k = constants_at(which, i)
        e, m = strains_at(q, nodes[i], constants, k), constants[k + 104]
        f = gradient_of(e, 1.0 / h4)
        volume = volume_energy(determinant(f, cofactors(f)), m, constants[k + 112])
        energies[i] = 0.5 * quadratic(constants, k, e, e) + h4 * h4 * (volume - 1.5 * m)


@kernel
def _write_changes(
    first: int, count: int, step: int, moved: Rows, base: Positions, nodes: Indices, which: Indices, constants: Floats,
    h4: float, parts: Floats,
) -> None:  # fmt: skip
    for i in range(first, count, step):
        k = constants_at(which, i)
        d, e = strains_at(moved, nodes[i], constants, k), strains_at(base, nodes[i], constants, k)
        before, more = changes(gradient_of(d, 1.0 / h4), gradient_of(e, 1.0 / h4))
        m, parts[i] = constants[k + 104], 0.0
        if m > 0.0:
            parts[i] = quadratic_change(constants, k, d, e)
            parts[i] += h4 * h4 * volume_change(before + more, before, more, m, constants[k + 112])


def _add(write: Callable[[Floats], None], blocks: Blocks, rows: Rows) -> None:
    """Let cells write 3 numbers a corner, and add them to the owned rows (l, 3)."""
    store = np.empty(24 * LANES * len(blocks.nodes), like=rows)
    write(store)
    _add_around(blocks.around.shape[1], store, blocks.around, rows)


def add_product(blocks: Blocks, state: Rows, v: Array, product: Array) -> None:
    """Add (Hessian) v [N] to the owned rows of ``product`` (l, 3), its ``state`` that of ``linearise``."""
    _add(partial(_write_products, LANES * len(blocks.nodes), v, *flat(blocks), state.ravel()), blocks, product)


def add_gradient(blocks: Blocks, h4: float, q: Positions, gradient: Rows) -> None:
    """Add grad E [N] at q (l, 3) [m] to the owned rows of ``gradient`` (l, 3)."""
    _add(partial(_write_gradients, LANES * len(blocks.nodes), q, *flat(blocks), h4), blocks, gradient)


def linearise(blocks: Blocks, h4: float, q: Positions, projected: bool, state: Rows) -> None:
    """Write what a Hessian keeps of each cell into ``state`` (b, STATE * LANES)."""
    _write_states(LANES * len(blocks.nodes), q, *flat(blocks), h4, projected, state.ravel())


def cell_energies(blocks: Blocks, h4: float, q: Positions, energies: Rows) -> None:
    """Write the energy of cells [J] at q (l, 3) [m], 0 at rest, into ``energies`` (b, LANES), of the first b blocks."""
    _write_energies(energies.size, q, *flat(blocks), h4, energies.ravel())


def elastic_change(blocks: Blocks, owned: int, h4: float, q: Positions, base: Positions) -> float:
    """Return E(q) - E(base) [J] of the first ``owned`` blocks, by how the nodes moved, so that it keeps its digits."""
    parts = np.empty(LANES * owned, like=q)
    _write_changes(len(parts), q - base, base, *flat(blocks), h4, parts)
    return float(parts.sum())
