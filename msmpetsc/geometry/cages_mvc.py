"""*Cages mean value coordinates: blends that make the embedding smooth across cells (paper 3.1, Eq. 7-9).

What is guaranteed, for any set of valid cells:
- The position is continuous. On a face, edge or corner that a cell shares with a valid neighbour that neighbour's
  factor of Eq. 9 is 0, so b = 0 and s = J; there only the shared corners weigh in J, they belong to B_c of every
  cell that has them, and their L_v are common. Corners outside B_c weigh nothing there: normalising without them
  changes nothing, whatever else B_c holds.
- The slope is continuous across the inside of shared faces: neither b (f_h' (0) = 0) nor W changes along the normal,
  and L_v is smooth inside its cage. At the rim of such a face on the body's surface, L_v itself has no slope.
Where the corners in B_c weigh nothing, b = 1 and s = x, so 0/0 of the normalisation is never met.
"""

import numba
import numpy as np

from msmpetsc.geometry.block import (
    ITSELF,
    cells_around,
    corner_blend,
    corner_node,
    smoothstep,
)
from msmpetsc.geometry.mvc import joined_cage, look_from, new_view
from msmpetsc.geometry.squares import AROUND


@numba.njit(cache=True)
def own_share(own, valid, smoothing):
    """b(p) of Eq. 9: 0 on everything shared with a valid neighbour, 1 away from it; f_h is smoothstep(x / h).

    own (64,): the cell's own coordinates; the sum in Eq. 9 is taken over the corners shared with that neighbour.
    """
    product = 1.0
    for cell in range(27):
        if valid[cell] and cell != ITSELF:
            shared = 0.0
            for v in range(8):
                if AROUND[v, cell]:
                    shared += own[corner_node(v)]
            product *= max(1.0 - shared, 0.0)
    return smoothstep(product / smoothing)


@numba.njit(cache=True)
def boundary_blends(u, valid, blends):
    """W(v, p) of Eq. 8 into blends (8,), 0 off B_c: the corners shared with another valid cell. Returns their sum."""
    for v in range(8):
        mask = cells_around(v, valid)
        alone = mask & (mask - 1) == 0
        blends[v] = 0.0 if alone else corner_blend(v, u)
    return blends.sum()


@numba.njit(cache=True)
def cages_weights(u, neighbours, smoothing, weights):
    """s(p) of Eq. 7: u (p,3) in [0,1]; neighbours (p,27) bool; smoothing h in (0,1]; weights (p,64), result."""
    alone = np.zeros(27, np.bool_)
    alone[ITSELF] = True
    view, blends, joined = new_view(), np.empty(8), np.empty(64)
    for p in range(len(u)):
        look_from(u[p], view)
        joined_cage(0, alone, view, weights[p])  # x(p)
        total = boundary_blends(u[p], neighbours[p], blends)
        b = own_share(weights[p], neighbours[p], smoothing)
        if b == 1.0:
            continue
        weights[p] *= b
        for v in range(8):
            if blends[v] > 0.0:
                joined_cage(v, neighbours[p], view, joined)
                share = (1.0 - b) * blends[v] / total
                for node in range(64):
                    weights[p, node] += share * joined[node]
