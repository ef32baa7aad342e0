"""Affine embedding: every node carries an affine map of its surroundings, blended over a cell's corners (ours).

Eq. 8 of the paper alone, over all 8 corners, with L_v(p) = x_v + F_v (p - v). F_v is the gradient that fits the nodes
j of the valid cells around v best: x_j - x_v = F_v (X_j - X_v), least squares. It depends on which of those 8 cells
are valid and on nothing else, so cells agree on it, and position and slope are continuous across every shared face
of every set of valid cells (block.corner_blend says why).
"""

from functools import cache

import numba
import numpy as np

from msmpetsc.geometry.block import (
    cells_around,
    corner_bit,
    corner_blend,
    corner_node,
)


@cache
def gradient_table():
    """(256,3,27): column a of F_v is table[mask, a] @ x over the 3x3x3 nodes around v; mask as in cells_around.

    One valid cell is enough: its 8 nodes span space. Mask 0 does not occur and holds zeros.
    """
    offsets = np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3, indexing="ij"), -1).reshape(27, 3)
    octants = (offsets != 0).all(1)  # a cell around v has its far corner at (+-1, +-1, +-1)
    is_corner = ((offsets == 0) | (offsets == offsets[octants][:, None])).all(-1)  # (8 cells, 27 nodes)
    bits = np.arange(256)[:, None] >> np.arange(8) & 1
    spans = (bits @ is_corner > 0)[..., None] * offsets  # (256,27,3): X_j - X_v, 0 where there is no node
    table = np.zeros((256, 3, 27))
    normal = spans[1:].swapaxes(1, 2)  # normal equations: exactly 0 where there is no node
    table[1:] = np.linalg.solve(normal @ spans[1:], normal)
    table[:, :, 13] = -table.sum(2)  # x_j - x_v: v itself, whose own span is 0
    return table


@numba.njit(cache=True)
def _affine_weights(u, neighbours, table, weights):
    weights[:] = 0.0
    for p in range(len(u)):
        for v in range(8):
            gradient = table[cells_around(v, neighbours[p])]
            x, y, z = corner_bit(v, 0), corner_bit(v, 1), corner_bit(v, 2)
            dx, dy, dz = u[p, 0] - x, u[p, 1] - y, u[p, 2] - z
            blend = corner_blend(v, u[p])
            weights[p, corner_node(v)] += blend
            for j in range(27):
                node = 16 * (x + j // 9) + 4 * (y + j // 3 % 3) + z + j % 3
                lever = dx * gradient[0, j] + dy * gradient[1, j] + dz * gradient[2, j]
                weights[p, node] += blend * lever


def affine_weights(u, neighbours, weights):
    """J(p) of Eq. 8 with affine L_v: u (p,3) in [0,1]; neighbours (p,27) bool; weights (p,64), result."""
    _affine_weights(u, neighbours, gradient_table(), weights)
