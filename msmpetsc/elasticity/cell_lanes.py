"""Vectorised loops over cells on a CPU: energy change, gradient and Hessian product.

Eight cells are computed at once, each in its lane. The work array holds, LANES numbers per entry:

- the values at the 8 corners, 3 components per corner;
- the cell's constants, then its entries of a Hessian's state;
- the result at the 8 corners, 3 components per corner.

numba vectorises loops over the lanes, because all offsets into the work array are constants.
The formulas are in elasticity.cell_strain and elasticity.neo_hookean.
"""

from typing import Any

import numpy as np

from msmpetsc.backend.arrays import Floats, Indices, Positions, Rows
from msmpetsc.backend.kernel import njit
from msmpetsc.elasticity.assumed_strain import rest_constants
from msmpetsc.elasticity.cell_blocks import PROJECTED, ROWS, STATE, CellBlocks
from msmpetsc.elasticity.cell_strain import LANES, Eight, Strains, form_of, strain, write_forces
from msmpetsc.elasticity.neo_hookean import (
    cell_gradient,
    cell_product,
    determinant_and_change,
    forms_change,
    gradient_of,
    projected_product,
    volume_change,
)

# offsets into the work array [-]; the corners' values come first
CONSTANTS = 24 * LANES
AT_STATE = CONSTANTS + ROWS * LANES
RESULT = AT_STATE + STATE * LANES
WORK = RESULT + 24 * LANES

# numba's options for loops over lanes. Vectorisation needs sums that may be reordered.
# LLVM optimises an inlined loop in its caller alone. Without inlining, a run that
# compiles would sum in another order than later runs.
LANE_LOOP: Any = {
    "fastmath": {"contract", "nsz", "reassoc", "arcp"},
    "error_model": "numpy",
    "forceinline": True,
}


@njit(inline="always")
def _component_in(w: Floats, at: int) -> Eight:
    return (
        w[at], w[at + 24], w[at + 48], w[at + 72],
        w[at + 96], w[at + 120], w[at + 144], w[at + 168],
    )  # fmt: skip


@njit(inline="always")
def _strains_in(w: Floats, lane: int, at: int = 0) -> Strains:
    """Return the strains of the cell in a lane, from the corners' values that begin at ``at``."""
    form = form_of(w, CONSTANTS + lane)
    return (
        strain(_component_in(w, at + lane), form),
        strain(_component_in(w, at + lane + 8), form),
        strain(_component_in(w, at + lane + 16), form),
    )


@njit(inline="always")
def _gather(nodes: Indices, b: int, q: Rows, w: Floats, at: int = 0) -> None:
    for lane in range(LANES):
        for a in range(8):
            i, k = nodes[b, lane, a], at + 24 * a + lane
            w[k], w[k + 8], w[k + 16] = q[i, 0], q[i, 1], q[i, 2]


@njit(inline="always")
def _scatter(nodes: Indices, b: int, w: Floats, rows: Rows) -> None:
    for lane in range(LANES):
        for a in range(8):
            i = nodes[b, lane, a]
            rows[i, 0] += w[RESULT + 24 * a + lane]
            rows[i, 1] += w[RESULT + 24 * a + 8 + lane]
            rows[i, 2] += w[RESULT + 24 * a + 16 + lane]


@njit(inline="always")
def _load(rows: Rows, row: int, w: Floats, at: int) -> None:
    for i in range(rows.shape[1]):
        w[at + i] = rows[row, i]


@njit(**LANE_LOOP)
def _product_lanes(w: Floats, projected: bool) -> None:
    for lane in range(LANES):
        k, e = CONSTANTS + lane, _strains_in(w, lane)
        if projected:
            slopes, modes = projected_product(w, k, w, AT_STATE + lane, e)
        else:
            slopes, modes = cell_product(w, k, w, AT_STATE + lane, e)
        write_forces(w, RESULT + lane, form_of(w, k), slopes, modes)


@njit()
def add_product(blocks: CellBlocks, state: Rows, v: Rows, product: Rows) -> None:
    """Add (Hessian) v [N] to ``product`` (l, 3), with the ``state`` of ``linearise``.

    The width of the state tells whether the Hessian is projected. All arrays have the same dtype.
    """
    w, projected = np.zeros(WORK, v.dtype), state.shape[1] == PROJECTED * LANES
    for b in range(len(blocks.nodes)):
        _gather(blocks.nodes, b, v, w)
        _load(blocks.constants, blocks.which[b], w, CONSTANTS)
        _load(state, b, w, AT_STATE)
        _product_lanes(w, projected)
        _scatter(blocks.nodes, b, w, product)


@njit(**LANE_LOOP)
def _gradient_lanes(w: Floats, h4: float, u: int) -> None:
    for lane in range(LANES):
        k, e = CONSTANTS + lane, _strains_in(w, lane)
        slopes, modes = cell_gradient(rest_constants(w, k), w[k + 104], w[k + 112], e, h4, u)
        write_forces(w, RESULT + lane, form_of(w, k), slopes, modes)


@njit()
def add_gradient(blocks: CellBlocks, q: Positions, gradient: Rows) -> None:
    """Add grad E [N] at q (l, 3) [m] to ``gradient`` (l, 3)."""
    w = np.zeros(WORK)
    for b in range(len(blocks.nodes)):
        _gather(blocks.nodes, b, q, w)
        _load(blocks.constants, blocks.which[b], w, CONSTANTS)
        _gradient_lanes(w, blocks.h4, blocks.u)
        _scatter(blocks.nodes, b, w, gradient)


@njit(**LANE_LOOP)
def _change_lanes(w: Floats, inverse_h4: float) -> None:
    for lane in range(LANES):
        moved, base, s = _strains_in(w, lane), _strains_in(w, lane, RESULT), AT_STATE + lane
        d, f = gradient_of(moved, inverse_h4), gradient_of(base, inverse_h4)
        w[s], w[s + 8] = determinant_and_change(d, f)
        w[s + 16] = forms_change(w, CONSTANTS + lane, d, base, moved, inverse_h4)


@njit()
def elastic_change(blocks: CellBlocks, q: Positions, base: Positions) -> float:
    """Return E(q) - E(base) [J] of the cells that the rank owns.

    The change is computed from the displacement q - base, so a small change keeps its digits.
    """
    moved, w, change = q - base, np.zeros(WORK), 0.0
    for b in range(blocks.owned):
        _gather(blocks.nodes, b, moved, w)
        _gather(blocks.nodes, b, base, w, RESULT)
        _load(blocks.constants, blocks.which[b], w, CONSTANTS)
        _change_lanes(w, 1.0 / blocks.h4)
        for lane in range(LANES):
            s, m, lame = AT_STATE + lane, w[CONSTANTS + 104 + lane], w[CONSTANTS + 112 + lane]
            j_base, j_change = w[s], w[s + 8]
            if m > 0.0:
                change += w[s + 16] + blocks.h4**2 * volume_change(
                    j_base + j_change, j_base, j_change, m, lame, blocks.u
                )
    return change
