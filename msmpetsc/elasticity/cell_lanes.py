"""Strains of eight cells at once, in the lanes of vectors: the loops over cells that a law of solids is made of.

numba makes vectors of loops over the lanes of one work array with constant offsets. It holds, LANES numbers each, the
values at a cell's 8 corners (3 components each), its constants, what a law keeps of it, and 3 components of the result
at 8 corners. A component's strain is the three mean slopes and the four modes of lattice.cell_moments.
"""

from typing import NamedTuple

import numba
import numpy as np

from msmpetsc.backend.arrays import Floats, Indices, Rows
from msmpetsc.elasticity.springs import Four, Vector
from msmpetsc.lattice.cell_moments import FORM

LANES = 8
ROWS = FORM + 2  # of a cell's constants: its form, modes times m = mu V / (16 h^2); m; lambda V / (16 h^2)
STATE = 11  # F by rows, V U' / (16 h^2), V U'' / (16 h^2)
BY_AXIS = [0, 1, 3, 2, 4, 5, 7, 6]  # corners of VTK's order, x fastest, then y

# where things stand in the work array, after the corners' values
CONSTANTS = 24 * LANES
AT_STATE = CONSTANTS + ROWS * LANES
RESULT = AT_STATE + STATE * LANES
WORK = RESULT + 24 * LANES

FAST = {"contract", "nsz", "reassoc", "arcp"}  # numba: sums may be reordered, for lanes

Seven = tuple[float, float, float, float, float, float, float]


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
def _sums(w: Floats, at: int, lane: int) -> Seven:
    """Return the sums X, Y, Z, XY, XZ, YZ, XYZ (lattice.cell_moments) over a component's corner values."""
    a, b, c, d = w[at + lane], w[at + 24 + lane], w[at + 48 + lane], w[at + 72 + lane]
    e, f, g, h = w[at + 96 + lane], w[at + 120 + lane], w[at + 144 + lane], w[at + 168 + lane]
    s0, d0, s1, d1, s2, d2, s3, d3 = a + b, b - a, c + d, d - c, e + f, f - e, g + h, h - g
    x0, y0, xy0 = d0 + d1, s1 - s0, d1 - d0
    x1, y1, xy1 = d2 + d3, s3 - s2, d3 - d2
    return x0 + x1, y0 + y1, (s2 + s3) - (s0 + s1), xy0 + xy1, x1 - x0, y1 - y0, xy1 - xy0


@numba.njit(cache=True, inline="always")
def strain(w: Floats, at: int, lane: int) -> Seven:
    """Return 4 h times a component's mean slope, and its modes."""
    x, y, z, xy, xz, yz, xyz = _sums(w, at, lane)
    k = CONSTANTS + lane
    cx, cy, cz, mxy, mxz, myz = w[k], w[k + 8], w[k + 16], w[k + 24], w[k + 32], w[k + 40]
    return (
        x + xy * cy + xz * cz + xyz * myz,
        y + xy * cx + yz * cz + xyz * mxz,
        z + xz * cx + yz * cy + xyz * mxy,
        xy + xyz * cz,
        xz + xyz * cy,
        yz + xyz * cx,
        xyz,
    )


@numba.njit(cache=True, inline="always")
def modes_forces(w: Floats, lane: int, a: float, b: float, c: float, d: float) -> Four:
    """Return the slopes of the modes' energy by the modes."""
    k = CONSTANTS + lane
    xy, xz, yz, of_yz, of_xz, of_xy = w[k + 48], w[k + 56], w[k + 64], w[k + 72], w[k + 80], w[k + 88]
    return xy * a + of_yz * b + of_xz * c, of_yz * a + xz * b + of_xy * c, of_xz * a + of_xy * b + yz * c, w[k + 96] * d


@numba.njit(cache=True, inline="always")
def write_forces(w: Floats, k: int, lane: int, slopes: Vector, strain: Seven) -> None:
    """Write a component's forces on the corners: ``slopes`` by 4 h times its slopes, and those of its modes."""
    at, of_form, (p, q, r) = RESULT + k, CONSTANTS + lane, slopes
    a, b, c, d = modes_forces(w, lane, strain[3], strain[4], strain[5], strain[6])
    cx, cy, cz = w[of_form], w[of_form + 8], w[of_form + 16]
    mxy, mxz, myz = w[of_form + 24], w[of_form + 32], w[of_form + 40]
    xyz = d + a * cz + b * cy + c * cx + p * myz + q * mxz + r * mxy
    xy, xz, yz = a + p * cy + q * cx, b + p * cz + r * cx, c + q * cz + r * cy
    x0, x1, y0, y1, xy0, xy1 = p - xz, p + xz, q - yz, q + yz, xy - xyz, xy + xyz
    s0, s1, d0, d1 = -r - y0, y0 - r, x0 - xy0, x0 + xy0
    s2, s3, d2, d3 = r - y1, r + y1, x1 - xy1, x1 + xy1
    w[at + lane], w[at + 24 + lane], w[at + 48 + lane], w[at + 72 + lane] = s0 - d0, s0 + d0, s1 - d1, s1 + d1
    w[at + 96 + lane], w[at + 120 + lane], w[at + 144 + lane], w[at + 168 + lane] = s2 - d2, s2 + d2, s3 - d3, s3 + d3


@numba.njit(cache=True, inline="always")
def corner_strain(w: Floats, a: int, lane: int) -> Seven:
    """Return 4 h times the mean slopes, and the modes, of what is 1 at corner a and 0 at the others."""
    x, y, z = 2.0 * (a & 1) - 1.0, 1.0 * (a & 2) - 1.0, 0.5 * (a & 4) - 1.0
    k = CONSTANTS + lane
    cx, cy, cz, mxy, mxz, myz = w[k], w[k + 8], w[k + 16], w[k + 24], w[k + 32], w[k + 40]
    return (
        x * (1.0 + y * cy + z * cz + y * z * myz),
        y * (1.0 + x * cx + z * cz + x * z * mxz),
        z * (1.0 + x * cx + y * cy + x * y * mxy),
        x * y * (1.0 + z * cz),
        x * z * (1.0 + y * cy),
        y * z * (1.0 + x * cx),
        x * y * z,
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
