"""The 108 unit squares and 144 edges of the 3x3x3 block around a cell, as tables of constants (see block.py).

A square is (axis, plane, j, k): normal to its axis, at node `plane` 0..3 along it, at cells j, k along the next two
axes in cyclic order. An edge is (axis, i, j, k): cell i along its axis, nodes j, k along the next two.
"""

import numpy as np

CELL_STRIDE = np.array([9, 3, 1])
NODE_STRIDE = np.array([16, 4, 1])
OUTSIDE = 27  # stands for every cell out of the block


def _entry(stride, axis, i, j, k):
    return i * stride[axis] + j * stride[(axis + 1) % 3] + k * stride[(axis + 2) % 3]


def _edge(axis, i, j, k):
    return ((axis % 3 * 3 + i) * 4 + j) * 4 + k


_axis, _plane, _j, _k = np.indices((3, 4, 3, 3)).reshape(4, -1)
_x, _y, _z = np.indices((2, 2, 2)).reshape(3, -1, 1)

SQUARE = np.stack([_axis, _plane, _j, _k], 1)  # (108,4)
NODES = np.stack(  # (108,4) corner nodes, as (a,b): 00, 10, 11, 01
    [_entry(NODE_STRIDE, _axis, _plane, _j + a, _k + b) for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))], 1
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
OF_CORNER = np.nonzero(AROUND[:, CELLS].any(2))[1].reshape(8, 36).copy()  # the squares of those cells
