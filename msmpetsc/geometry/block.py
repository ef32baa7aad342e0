"""Number the 3x3x3 cells around a cell, and their nodes, squares and edges, in tables.

Lengths are in cell sizes, and the middle cell's low corner is at 0.

- Cell (x,y,z), each 0..2, is entry 9x + 3y + z, at offset (x-1, y-1, z-1). The middle cell is 13.
- Node (x,y,z), each 0..3, is entry 16x + 4y + z, at offset (x-1, y-1, z-1).
- Corner v = 0..7 of the middle cell has the coordinates (v>>2 & 1, v>>1 & 1, v & 1).
- Square (axis, plane, j, k) is normal to ``axis`` at node ``plane`` 0..3 along it. Its position is
  cell j, k along the next two axes in cyclic order.
- Edge (axis, i, j, k) is at cell i along its axis, and at node j, k along the next two axes.
"""

import numpy as np

from msmpetsc.backend.arrays import Floats, Indices, Mask
from msmpetsc.backend.kernel import njit

# entry of the middle cell
MIDDLE = 13
CELL_STRIDE = np.array([9, 3, 1])
NODE_STRIDE = np.array([16, 4, 1])
# common entry of all cells outside the block
OUTSIDE = 27


def _entry(stride: Indices, axis: Indices, i: Indices, j: Indices, k: Indices) -> Indices:
    """Return the entries of cells or nodes at i along ``axis`` and j, k along the next two axes."""
    entry: Indices = i * stride[axis] + j * stride[(axis + 1) % 3] + k * stride[(axis + 2) % 3]
    return entry


def _edge(axis: Indices, i: Indices, j: Indices, k: Indices) -> Indices:
    """Return the entry in ``EDGE`` of edges (axis, i, j, k)."""
    return ((axis % 3 * 3 + i) * 4 + j) * 4 + k


_axis, _plane, _j, _k = np.indices((3, 4, 3, 3)).reshape(4, -1)
_x, _y, _z = np.indices((2, 2, 2)).reshape(3, -1, 1)

# (108, 4) axis, plane, j, k of each square
SQUARE = np.stack([_axis, _plane, _j, _k], 1)
# (108, 4) corner nodes of each square, in the order (a,b) = 00, 10, 11, 01
NODES = np.stack(
    [
        _entry(NODE_STRIDE, _axis, _plane, _j + a, _k + b)
        for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))
    ],
    1,
)
# (108, 2) cells below and above each square
CELLS = np.stack(
    [
        np.where(_plane > 0, _entry(CELL_STRIDE, _axis, _plane - 1, _j, _k), OUTSIDE),
        np.where(_plane < 3, _entry(CELL_STRIDE, _axis, _plane, _j, _k), OUTSIDE),
    ],
    1,
)
# (108, 4) edges 00-10, 10-11, 01-11, 00-01 of each square
EDGES = np.stack(
    [
        _edge(_axis + 1, _j, _k, _plane),
        _edge(_axis + 2, _k, _plane, _j + 1),
        _edge(_axis + 1, _j, _k + 1, _plane),
        _edge(_axis + 2, _k, _plane, _j),
    ],
    1,
)
# (144, 4) axis, i, j, k of each edge
EDGE = np.indices((3, 3, 4, 4)).reshape(4, -1).T.copy()
# (8, 28) whether a cell is among the 8 around a corner of the middle cell
AROUND = np.zeros((8, 28), bool)
for _dx, _dy, _dz in np.ndindex(2, 2, 2):
    AROUND[np.arange(8)[:, None], 9 * (_x + _dx) + 3 * (_y + _dy) + _z + _dz] = True
# (8, 36) squares of the 8 cells around each corner
OF_CORNER = np.nonzero(AROUND[:, CELLS].any(2))[1].reshape(8, 36).copy()


@njit()
def corner_bit(v: int, axis: int) -> int:
    """Return the coordinate, 0 or 1, of corner v along an axis."""
    return (v >> (2 - axis)) & 1


@njit()
def corner_node(v: int) -> int:
    """Return the entry of corner v among the 64 nodes."""
    return 16 * (1 + corner_bit(v, 0)) + 4 * (1 + corner_bit(v, 1)) + 1 + corner_bit(v, 2)


@njit()
def cells_around(v: int, valid: Mask) -> int:
    """Return the valid cells around corner v as a bit mask: bit 4i + 2j + k is cell (i,j,k)."""
    first = 9 * corner_bit(v, 0) + 3 * corner_bit(v, 1) + corner_bit(v, 2)
    mask = 0
    for bit in range(8):
        if valid[first + 9 * corner_bit(bit, 0) + 3 * corner_bit(bit, 1) + corner_bit(bit, 2)]:
            mask |= 1 << bit
    return mask


@njit()
def smoothstep(z: float) -> float:
    """Return z^2 (3 - 2z), with z clipped to [0,1]: the slope is 0 at both ends."""
    z = min(max(z, 0.0), 1.0)
    return z * z * (3.0 - 2.0 * z)


@njit()
def corner_blend(v: int, u: Floats) -> float:
    """Return W(v, p) of Eq. 8: the product over the axes of smoothstep(1 - distance to v).

    The 8 values sum to 1. On a face of the cell only its 4 corners have a weight, and the normal
    derivative of each W is 0. So cells with the same L_v at these corners share value and slope.
    """
    product = 1.0
    for axis in range(3):
        product *= smoothstep(u[axis] if corner_bit(v, axis) else 1.0 - u[axis])
    return product
