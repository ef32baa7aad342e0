"""Numbering of the 3x3x3 cells around a cell, and of their nodes, squares and edges, as tables.

Lengths are in units of the cell size, with the cell's low corner at 0. Cell (x,y,z), each 0..2, of the block is
entry 9x + 3y + z and lies at offset (x-1, y-1, z-1): the cell itself is 13. Node (x,y,z), each 0..3, is entry
16x + 4y + z at offset (x-1, y-1, z-1). Corner v = 0..7 of the cell has the bits (v>>2 & 1, v>>1 & 1, v & 1).

A square is (axis, plane, j, k): normal to its axis, at node `plane` 0..3 along it, at cells j, k along the next two
axes in cyclic order. An edge is (axis, i, j, k): cell i along its axis, nodes j, k along the next two.
"""

import numpy as np

from msmpetsc.backend.arrays import Floats, Indices, Mask
from msmpetsc.backend.kernel import njit

ITSELF = 13  # entry of the cell among its 27
CELL_STRIDE = np.array([9, 3, 1])
NODE_STRIDE = np.array([16, 4, 1])
OUTSIDE = 27  # stands for every cell out of the block


def _entry(stride: Indices, axis: Indices, i: Indices, j: Indices, k: Indices) -> Indices:
    entry: Indices = i * stride[axis] + j * stride[(axis + 1) % 3] + k * stride[(axis + 2) % 3]
    return entry


def _edge(axis: Indices, i: Indices, j: Indices, k: Indices) -> Indices:
    return ((axis % 3 * 3 + i) * 4 + j) * 4 + k


_axis, _plane, _j, _k = np.indices((3, 4, 3, 3)).reshape(4, -1)
_x, _y, _z = np.indices((2, 2, 2)).reshape(3, -1, 1)

SQUARE = np.stack([_axis, _plane, _j, _k], 1)  # (108,4)
NODES = np.stack(  # (108,4) corner nodes, as (a,b): 00, 10, 11, 01
    [
        _entry(NODE_STRIDE, _axis, _plane, _j + a, _k + b)
        for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))
    ],
    1,
)
CELLS = np.stack(  # (108,2) cells below and above
    [
        np.where(_plane > 0, _entry(CELL_STRIDE, _axis, _plane - 1, _j, _k), OUTSIDE),
        np.where(_plane < 3, _entry(CELL_STRIDE, _axis, _plane, _j, _k), OUTSIDE),
    ],
    1,
)
EDGES = np.stack(  # (108,4) edges 00-10, 10-11, 01-11, 00-01
    [
        _edge(_axis + 1, _j, _k, _plane),
        _edge(_axis + 2, _k, _plane, _j + 1),
        _edge(_axis + 1, _j, _k + 1, _plane),
        _edge(_axis + 2, _k, _plane, _j),
    ],
    1,
)
EDGE = np.indices((3, 3, 4, 4)).reshape(4, -1).T.copy()  # (144,4): axis, i, j, k
AROUND = np.zeros((8, 28), bool)  # the 8 cells around each corner of the middle cell
for _dx, _dy, _dz in np.ndindex(2, 2, 2):
    AROUND[np.arange(8)[:, None], 9 * (_x + _dx) + 3 * (_y + _dy) + _z + _dz] = True
OF_CORNER = (
    np.nonzero(AROUND[:, CELLS].any(2))[1].reshape(8, 36).copy()
)  # the squares of those cells


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
    """Return a bit mask of the valid cells around corner v: bit 4i + 2j + k of the cell (i,j,k)."""
    first = 9 * corner_bit(v, 0) + 3 * corner_bit(v, 1) + corner_bit(v, 2)
    mask = 0
    for bit in range(8):
        if valid[first + 9 * corner_bit(bit, 0) + 3 * corner_bit(bit, 1) + corner_bit(bit, 2)]:
            mask |= 1 << bit
    return mask


@njit()
def smoothstep(z: float) -> float:
    """Return z^2 (3 - 2z) on [0,1], constant beyond: its slope is 0 at both ends."""
    z = min(max(z, 0.0), 1.0)
    return z * z * (3.0 - 2.0 * z)


@njit()
def corner_blend(v: int, u: Floats) -> float:
    """Return W(v, p) of Eq. 8: the product over the axes of smoothstep(1 - distance to v).

    It sums to 1 over the 8 corners.

    On a face of the cell only its 4 corners count, and no W changes along the face's normal: two cells that share
    the face and agree on what a corner says (L_v of Eq. 8) therefore agree in position and in slope.
    """
    product = 1.0
    for axis in range(3):
        product *= smoothstep(u[axis] if corner_bit(v, axis) else 1.0 - u[axis])
    return product
