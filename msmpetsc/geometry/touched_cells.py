"""Boundary cells: the grid cells that a triangle touches (paper section 4.1).

Everything is in cell units: cell (i, j, k) is the box [i, i+1) x [j, j+1) x [k, k+1). A cell owns its
low faces, so a face of the body that lies in a grid plane marks one layer of cells, not two.
"""

import numba
import numpy as np

from msmpetsc.backend.arrays import Indices, Rows
from msmpetsc.geometry.clipping import clip_to_layer, extent, grown

SLACK = 1e-12  # of the largest coordinate: above the rounding of an interpolated one, below anything that matters


def touched_cells(corners: Rows, low: Indices, high: Indices) -> Indices:
    """Return every cell that a triangle touches: exact up to rounding, and conservative within it.

    corners   : (f, 3, 3) triangles in cell units
    low, high : (3,) int, cells outside low..high-1 are left out
    returns   : (c, 3) int64, one row a touched (triangle, cell) pair, so cells repeat
    """
    return _touched(corners, low.astype(np.int64), high.astype(np.int64))


def sampled_cells(corners: Rows, low: Indices, high: Indices) -> Indices:
    """Return the cells of the paper's sample points v3 + (i/n)(v1 - v3) + (j/n)(v2 - v3), n = ceil(longest side).

    Misses cells that a triangle only grazes. Arguments and result as in ``touched_cells``.
    """
    return _sampled(corners, low.astype(np.int64), high.astype(np.int64))


@numba.njit(cache=True)
def _slack(triangle, axis):
    """Return more than the rounding of a coordinate interpolated between corners of the triangle."""
    smallest, largest = extent(triangle, 3, axis)
    return SLACK * (1.0 + max(abs(smallest), abs(largest)))


@numba.njit(cache=True)
def _index_range(triangle, part, n, axis, low, high, slack):
    """Return the first and last cell index that a part of a triangle reaches along an axis.

    Slack widens the part, whose points may be interpolated, but never past the triangle's own
    corners: those are exact, so a triangle that ends in a grid plane does not mark the layer behind.
    """
    smallest, largest = extent(part, n, axis)
    first, last = extent(triangle, 3, axis)
    smallest, largest = max(smallest - slack, first), min(largest + slack, last)
    return max(int(np.floor(smallest)), low), min(int(np.floor(largest)), high - 1)


@numba.njit(cache=True)
def _within_a_cell(triangle):
    for c in range(3):
        index = np.floor(triangle[0, c])
        if np.floor(triangle[1, c]) != index or np.floor(triangle[2, c]) != index:
            return False
    return True


@numba.njit(cache=True)
def _within(cell, low, high):
    return np.all((low <= cell) & (cell < high))


@numba.njit(cache=True)
def _touched(corners, low, high):
    cells = np.empty((4 * len(corners) + 16, 3), np.int64)
    used = 0
    work, across, along = np.empty((12, 3)), np.empty((12, 3)), np.empty((12, 3))
    for triangle in corners:
        if _within_a_cell(triangle):
            cells = grown(cells, used)
            for c in range(3):
                cells[used, c] = int(np.floor(triangle[0, c]))
            used += _within(cells[used], low, high)
            continue
        slack_j, slack_k = _slack(triangle, 1), _slack(triangle, 2)
        i0, i1 = _index_range(triangle, triangle, 3, 0, low[0], high[0], 0.0)
        for i in range(i0, i1 + 1):
            n = clip_to_layer(triangle, 3, 0, i, 0.0, work, across)  # never empty: corners are exact, so is i's range
            j0, j1 = _index_range(triangle, across, n, 1, low[1], high[1], slack_j)
            for j in range(j0, j1 + 1):
                m = clip_to_layer(across, n, 1, j, slack_j, work, along)
                if m == 0:
                    continue
                k0, k1 = _index_range(triangle, along, m, 2, low[2], high[2], slack_k)
                for k in range(k0, k1 + 1):
                    cells = grown(cells, used)
                    cells[used, 0], cells[used, 1], cells[used, 2] = i, j, k
                    used += 1
    return cells[:used]


@numba.njit(cache=True)
def _sampled(corners, low, high):
    cells = np.empty((4 * len(corners) + 16, 3), np.int64)
    used = 0
    for f in range(len(corners)):
        v1, v2, v3 = corners[f, 0], corners[f, 1], corners[f, 2]
        longest = max(np.sum((v1 - v2) ** 2), np.sum((v2 - v3) ** 2), np.sum((v3 - v1) ** 2)) ** 0.5
        n = max(1, int(np.ceil(longest)))
        for i in range(n + 1):
            for j in range(n + 1 - i):
                point = v3 + (i / n) * (v1 - v3) + (j / n) * (v2 - v3)
                if i == n or j == n:
                    point = v1 if i == n else v2  # not rounded: a corner's own cell must be marked
                cells = grown(cells, used)
                inside = True
                for c in range(3):
                    cells[used, c] = int(np.floor(point[c]))
                    inside &= low[c] <= cells[used, c] < high[c]
                used += inside
    return cells[:used]
