"""Smooth coordinates of a point in its cell: *Cages coordinates, and blended affine maps.

*Cages coordinates
------------------
These properties hold for any set of valid cells:

- The position is continuous. If p lies on a face, edge or corner shared with a valid neighbour,
  that neighbour's factor in Eq. 9 is 0, so b = 0 and s = J. Only the shared corners have a weight
  in J there. They belong to B_c of every cell that has them, and their L_v is common.
- The slope is continuous across the interior of shared faces. The normal derivatives of b and W
  are 0 there (f_h'(0) = 0), and L_v is smooth inside its cage. At the rim of such a face on the
  body's surface, L_v itself has no derivative.

If the corners in B_c have no weight, b = 1 and s = x, so the normalisation never divides 0 by 0.

Affine maps
-----------
The blended affine maps are Eq. 8 alone, over all 8 corners, with L_v(p) = x_v + F_v (p - v). The
gradient F_v fits x_j - x_v = F_v (X_j - X_v) by least squares over the nodes j of the valid cells
around v. F_v depends only on which of these 8 cells are valid, so all cells at v use the same L_v.
Hence position and slope are continuous across every shared face (see ``block.corner_blend``).
"""

from functools import cache

import numpy as np

from msmpetsc.backend.arrays import Floats, Mask, Rows
from msmpetsc.backend.kernel import njit
from msmpetsc.geometry.block import (
    AROUND,
    MIDDLE,
    cells_around,
    corner_bit,
    corner_blend,
    corner_node,
    smoothstep,
)
from msmpetsc.geometry.mean_value_coordinates import joined_cage, plane_heights


@njit()
def own_weight(own: Floats, valid: Mask, smoothing: float) -> float:
    """Return b(p) of Eq. 9 with f_h = smoothstep(x / h): 0 where a valid neighbour shares p.

    own : (64,) coordinates in the cell alone; Eq. 9 sums them over a neighbour's corners
    """
    product = 1.0
    for cell in range(27):
        if valid[cell] and cell != MIDDLE:
            shared = 0.0
            for v in range(8):
                if AROUND[v, cell]:
                    shared += own[corner_node(v)]
            product *= max(1.0 - shared, 0.0)
    return smoothstep(product / smoothing)


@njit()
def boundary_blends(u: Floats, valid: Mask, blends: Floats) -> float:
    """Set W(v, p) of Eq. 8 in ``blends`` (8,), 0 at corners that no other cell has.

    Return the sum of the blends.
    """
    for v in range(8):
        mask = cells_around(v, valid)
        alone = mask & (mask - 1) == 0
        blends[v] = 0.0 if alone else corner_blend(v, u)
    return float(blends.sum())


@njit()
def cages_weights(u: Rows, neighbours: Mask, smoothing: float, weights: Rows) -> None:
    """Set s(p) of Eq. 7 in ``weights``.

    The arguments are as in ``embedding.stencil_weights``.

    u          : (p,3) in [0,1]
    neighbours : (p,27) bool
    smoothing  : h in (0,1]
    weights    : (p,64) result
    """
    alone = np.zeros(27, np.bool_)
    alone[MIDDLE] = True
    blends = np.empty(8)
    joined = np.empty(64)
    for p in range(len(u)):
        planes = plane_heights(u[p])
        # x(p) of Eq. 7
        joined_cage(0, alone, planes, weights[p])
        b = own_weight(weights[p], neighbours[p], smoothing)
        if b == 1.0:
            continue
        total = boundary_blends(u[p], neighbours[p], blends)
        weights[p] *= b
        for v in range(8):
            if blends[v] > 0.0:
                joined_cage(v, neighbours[p], planes, joined)
                share = (1.0 - b) * blends[v] / total
                for node in range(64):
                    weights[p, node] += share * joined[node]


@cache
def gradient_table() -> Rows:
    """Return a table (256,3,27) of gradients: column a of F_v is table[mask, a] @ x.

    ``mask`` is the result of ``cells_around``, and x (27,3) are the 3x3x3 nodes around v. A single
    valid cell suffices, because its 8 nodes span space. Mask 0 does not occur; its rows are zero.
    """
    axes = [[-1.0, 0.0, 1.0]] * 3
    offsets = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(27, 3)
    # a cell around v has its far corner at (+-1, +-1, +-1)
    octants = (offsets != 0).all(1)
    # (8 cells, 27 nodes)
    is_corner = ((offsets == 0) | (offsets == offsets[octants][:, None])).all(-1)
    bits = np.arange(256)[:, None] >> np.arange(8) & 1
    has_node = bits @ is_corner > 0
    # (256,27,3) X_j - X_v, and 0 if node j belongs to no valid cell
    spans = has_node[..., None] * offsets
    table = np.zeros((256, 3, 27))
    # normal equations: their solution is exactly 0 at nodes of no valid cell
    normal = spans[1:].swapaxes(1, 2)
    table[1:] = np.linalg.solve(normal @ spans[1:], normal)
    # v itself has the negative sum, because the fit is to x_j - x_v
    table[:, :, 13] = -table.sum(2)
    return table


@njit()
def affine_weights(u: Rows, neighbours: Mask, table: Rows, weights: Rows) -> None:
    """Set J(p) of Eq. 8 with the affine L_v of ``gradient_table``; see ``cages_weights``."""
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
