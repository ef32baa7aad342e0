"""Strains of eight cells at once, in the lanes of vectors: the loops over cells that a law of solids is made of.

numba makes vectors of loops over the lanes of one work array with constant offsets. It holds, LANES numbers each, the
values at a cell's 8 corners (3 components each), its constants, what a law keeps of it, and 3 components of the result
at 8 corners. The formulas are those of elasticity.cell_strain.
"""

from typing import NamedTuple

import numba
import numpy as np

from msmpetsc.backend.arrays import Floats, Indices, Rows
from msmpetsc.elasticity.cell_strain import LANES, Eight, Strains, form_of, strain
from msmpetsc.lattice.cell_moments import FORM

ROWS = FORM + 2  # of a cell's constants: its form, modes times m = mu V / (16 h^2); m; lambda V / (16 h^2)
STATE = 11  # F by rows, V U' / (16 h^2), V U'' / (16 h^2)
BY_AXIS = [0, 1, 3, 2, 4, 5, 7, 6]  # corners of VTK's order, x fastest, then y

# where things stand in the work array, after the corners' values
CONSTANTS = 24 * LANES
AT_STATE = CONSTANTS + ROWS * LANES
RESULT = AT_STATE + STATE * LANES
WORK = RESULT + 24 * LANES

FAST = {"contract", "nsz", "reassoc", "arcp"}  # numba: sums may be reordered, for lanes


class Blocks(NamedTuple):
    """Cells of a rank, eight a block; the last block of a kind is filled up with cells of no stiffness.

    nodes     : (b, LANES, 8) local corner nodes, x fastest; unsigned, so that no index is looked at for being negative
    which     : (b,) row of the constants
    constants : (k, ROWS * LANES), LANES of each number
    """

    nodes: Indices
    which: Indices
    constants: Rows


@numba.njit(cache=True, inline="always")
def component_in(w: Floats, at: int) -> Eight:
    return w[at], w[at + 24], w[at + 48], w[at + 72], w[at + 96], w[at + 120], w[at + 144], w[at + 168]


@numba.njit(cache=True, inline="always")
def strains_in(w: Floats, lane: int, at: int = 0) -> Strains:
    """Return the strains of the cell in a lane, by the corners' values from ``at`` on."""
    form = form_of(w, CONSTANTS + lane)
    return (
        strain(component_in(w, at + lane), form),
        strain(component_in(w, at + lane + 8), form),
        strain(component_in(w, at + lane + 16), form),
    )


@numba.njit(cache=True, inline="always")
def gather(nodes: Indices, b: int, q: Rows, w: Floats, at: int = 0) -> None:
    for lane in range(LANES):
        for a in range(8):
            i, k = nodes[b, lane, a], at + 24 * a + lane
            w[k], w[k + 8], w[k + 16] = q[i, 0], q[i, 1], q[i, 2]


@numba.njit(cache=True, inline="always")
def scatter(nodes: Indices, b: int, w: Floats, rows: Rows) -> None:
    for lane in range(LANES):
        for a in range(8):
            i = nodes[b, lane, a]
            rows[i, 0] += w[RESULT + 24 * a + lane]
            rows[i, 1] += w[RESULT + 24 * a + 8 + lane]
            rows[i, 2] += w[RESULT + 24 * a + 16 + lane]


@numba.njit(cache=True, inline="always")
def load(rows: Rows, row: int, w: Floats, at: int) -> None:
    for i in range(rows.shape[1]):
        w[at + i] = rows[row, i]


def in_blocks(nodes: Indices, constants: Rows) -> tuple[Indices, Rows]:
    """Return cells in blocks (b, LANES, 8) and their constants (b, ROWS * LANES); the last is filled up by no cells."""
    lacking = -len(nodes) % LANES
    nodes = np.concatenate([nodes, np.repeat(nodes[-1:], lacking, axis=0)]).astype(np.uint32)
    rows = np.concatenate([constants, np.zeros((lacking, ROWS))]).reshape(-1, LANES, ROWS)
    return nodes.reshape(-1, LANES, 8), rows.transpose(0, 2, 1).reshape(-1, ROWS * LANES)


def shared(rows: Rows) -> tuple[Indices, Rows]:
    """Return the row (b,) of each block's constants, and the constants: those equal to the first are kept once."""
    own = (rows != rows[:1]).any(axis=1)
    which = np.where(own, np.cumsum(own), 0)
    return which.astype(np.int32), np.concatenate([rows[:1], rows[own]])
