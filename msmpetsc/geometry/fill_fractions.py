"""Compute the fill of cut cells and of their corners, and the second moments of their material.

The fill of a corner is 8 times the integral of its trilinear function N over the part of the cell
inside the surface: 1 in a full cell. The mean over the 8 corners is the filled fraction of the
cell. The fills alone place the material too far out, so thin limbs become too stiff; second moments
correct this.

For a closed surface the fill is exact. A ray is inside the body between entering and leaving.
The integral of N along the ray, within body and cell, is a sum over crossings with the surface.
A crossing lies in the cell, at height z, or above the cell:

    sum_in sign S(z) + sum_above sign S(1),   S' = N(z), S(0) = 0.

The sign is 1 if the ray leaves and -1 if it enters. The integral over all rays is an integral over
the triangles' pieces projected along the ray: the divergence theorem for the body within the cell.
The second moments, integrals of x^2, y^2, z^2 from the middle of the cell, are computed alike.
For an open surface, samples with a winding number above 1/2 are counted (Jacobson et al. 2013).

All lengths are in cells, with axes cycled as in geometry.cages. Rays run along the last axis, so
a slab of the first axis contains whole columns of cells.
"""

from dataclasses import dataclass

import numpy as np

from msmpetsc.backend.arrays import Floats, Indices, Rows
from msmpetsc.backend.kernel import njit
from msmpetsc.geometry.grid import CHUNK, Grid, packed
from msmpetsc.geometry.morton import LIMIT
from msmpetsc.geometry.surface import Surface, is_inside
from msmpetsc.geometry.valid_cells import clip_between, extent, grown

# samples along an axis of a cut cell [-]; the fill beside a plane errs by 0.6% rms
SAMPLES = 6
# least winding number below a column that shows inconsistent winding [-]; far above
# rounding, far below the effect of a single triangle
LEAK = 1e-6

# number of a piece's sums that also count for the cells below, and of all its sums [-]
SEEN, SUMS = 6, 17

# barycentric coordinates and weights of a rule of degree 4 on triangles (Dunavant 1985)
POINTS = np.array(
    [
        np.roll([1 - 2 * a, a, a], turn)
        for a in (0.445948490915965, 0.091576213509771)
        for turn in range(3)
    ]
)
WEIGHTS = np.repeat([0.223381589678011, 0.109951743655322], 3)


@dataclass(frozen=True)
class Columns:
    """Fill of the cells that triangles cross, in lexicographic order.

    keys    : (c,) keys of the cells (grid.packed)
    corners : (c, 2, 2, 2) fills of their corners; material inside two parts counts twice
    moments : (c, 3) second moments about the middle of the cell [cells^5]: 1/12 in a full cell
    below   : (c, 2, 2) winding number below the cell: mean over the base, weighted by the bilinear
              function of each corner
    """

    keys: Indices
    corners: Rows
    moments: Rows
    below: Rows

    @classmethod
    def crossed(cls, triangles: Rows, low: Indices, high: Indices) -> "Columns":
        """Return the columns of triangles (f, 3, 3) in cells low <= cell < high, (3,) int each."""
        starts = range(0, max(1, len(triangles)), CHUNK)
        pieces = (_pieces(triangles[start : start + CHUNK], low, high) for start in starts)
        parts = [_sums_of_keys(packed(cells), values) for cells, values in pieces]
        keys, sums = _sums_of_keys(*map(np.concatenate, zip(*parts, strict=True)))
        above = _sums_above(keys // LIMIT, sums[:, :SEEN])
        below = 4 * above[:, :4].reshape(-1, 2, 2)
        above -= sums[:, :SEEN]
        for first in (SEEN, SEEN + 4):
            sums[:, first : first + 4] += 0.5 * above[:, :4]
        corners = 8 * sums[:, SEEN : SEEN + 8].reshape(-1, 2, 4).transpose(0, 2, 1)
        moments: Rows = sums[:, -3:].copy()
        moments[:, :2] += above[:, 4:]
        moments[:, 2] += above[:, :4].sum(axis=1) / 12
        return cls(keys, np.reshape(corners, (-1, 2, 2, 2)), moments, below)

    @property
    def leak(self) -> float:
        """Largest winding number below a column: 0 for a closed, consistently wound surface."""
        lowest = np.diff(self.keys // LIMIT, prepend=-1) != 0
        return float(np.abs(self.below[lowest]).max(initial=0.0))

    def inside(self, cells: Indices) -> tuple[Rows, Rows]:
        """Return the fills (k, 2, 2, 2) and second moments (k, 3) of any cells (k, 3)."""
        if len(self.keys) == 0:
            return np.zeros((len(cells), 2, 2, 2)), np.zeros((len(cells), 3))
        keys = packed(cells)
        place = np.searchsorted(self.keys, keys).clip(max=len(self.keys) - 1)
        next_cut = self.keys[place]
        is_above = (next_cut >= keys) & (next_cut // LIMIT == keys // LIMIT)
        uncut = np.where(is_above[:, None, None], self.below[place], 0.0)
        is_cut = next_cut == keys
        fills = np.where(is_cut[:, None, None, None], self.corners[place], uncut[..., None])
        uncut_moments = uncut.mean(axis=(1, 2))[:, None] / 12
        return fills, np.where(is_cut[:, None], self.moments[place], uncut_moments)


def _sums_of_keys(keys: Indices, values: Rows) -> tuple[Indices, Rows]:
    """Return the distinct keys (c,), ascending, and the sums (c, k) of their rows (p, k)."""
    distinct, place = np.unique(keys, return_inverse=True)
    sums: Rows = np.empty((len(distinct), values.shape[1]))
    for column, rows in enumerate(values.T):
        sums[:, column] = np.bincount(place, rows, len(distinct))
    return distinct, sums


@njit()
def _sums_above(column: Indices, values: Rows) -> Rows:
    """Return, for each row, the sum of values (c, k) from the row to the end of its column (c,)."""
    sums = values.copy()
    for c in range(len(column) - 2, -1, -1):
        if column[c] == column[c + 1]:
            sums[c] += sums[c + 1]
    return sums


@njit()
def _pieces(triangles: Rows, low: Indices, high: Indices) -> tuple[Indices, Rows]:
    """Cut triangles into pieces by cells.

    returns : cell (p, 3) of each piece, and its sums (p, SUMS) from ``_add_sums``
    """
    cells = np.empty((4 * len(triangles) + 16, 3), np.int64)
    values = np.empty((len(cells), SUMS))
    used = 0
    buffers = np.empty((4, 12, 3))
    work, across, along, piece = buffers[0], buffers[1], buffers[2], buffers[3]
    for triangle in triangles:
        i0, i1 = _layers(triangle, 3, 0, low, high)
        for i in range(i0, i1):
            n = clip_between(triangle, 3, 0, (float(i), i + 1.0), work, across)
            j0, j1 = _layers(across, n, 1, low, high)
            for j in range(j0, j1):
                m = clip_between(across, n, 1, (float(j), j + 1.0), work, along)
                k0, k1 = _layers(along, m, 2, low, high)
                for k in range(k0, k1):
                    corners = clip_between(along, m, 2, (float(k), k + 1.0), work, piece)
                    cells, values = grown(cells, used), grown(values, used)
                    cells[used, 0], cells[used, 1], cells[used, 2] = i, j, k
                    values[used] = 0.0
                    for a in range(1, corners - 1):
                        _add_sums(piece[0], piece[a], piece[a + 1], cells[used], values[used])
                    used += 1
    return cells[:used], values[:used]


@njit()
def _layers(polygon: Rows, n: int, axis: int, low: Indices, high: Indices) -> tuple[int, int]:
    """Return the first cell index of a polygon along an axis, and its last index plus 1."""
    if n == 0:
        return 0, 0
    smallest, largest = extent(polygon, n, axis)
    return max(int(np.floor(smallest)), low[axis]), min(int(np.floor(largest)) + 1, high[axis])


@njit()
def _add_sums(p: Floats, q: Floats, r: Floats, cell: Indices, sums: Floats) -> None:
    """Add the integrals over a triangle in a cell, projected along the last axis, to ``sums``.

    z is the height in the cell. N_ab is the bilinear function of the vertical edge at (a, b), the
    edge of number 2 a + b. The sums (SUMS,) are, in this order, the integrals of

    - N_ab (4), and x^2 and y^2 from the middle (2),
    - N_ab S with S = z - z^2/2, of the lower corners (4),
    - N_ab S with S = z^2/2, of the upper corners (4),
    - S of the second moments in x, y and z (3).
    """
    area = 0.5 * ((q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0]))
    for s in range(len(WEIGHTS)):
        u, v, w = POINTS[s]
        x = u * p[0] + v * q[0] + w * r[0] - cell[0]
        y = u * p[1] + v * q[1] + w * r[1] - cell[1]
        z = u * p[2] + v * q[2] + w * r[2] - cell[2]
        for edge in range(4):
            part = area * WEIGHTS[s] * (x if edge >= 2 else 1.0 - x) * (y if edge % 2 else 1.0 - y)
            sums[edge] += part
            sums[SEEN + edge] += part * (z - 0.5 * z * z)
            sums[SEEN + 4 + edge] += part * 0.5 * z * z
        part = area * WEIGHTS[s]
        x, y, up = x - 0.5, y - 0.5, z - 0.5
        sums[4] += part * x * x
        sums[5] += part * y * y
        sums[SEEN + 8] += part * x * x * z
        sums[SEEN + 9] += part * y * y * z
        sums[SEEN + 10] += part * (up * up * up + 0.125) / 3


def sampled_inside(surface: Surface, grid: Grid, cells: Indices) -> tuple[Rows, Rows]:
    """Return fills (c, 2, 2, 2) and second moments (c, 3) of cells (c, 3) from samples."""
    at = (np.arange(SAMPLES) + 0.5) / SAMPLES
    # the two linear functions of an axis at the samples
    along = np.stack([1 - at, at]) / SAMPLES
    middles = np.stack(np.meshgrid(at, at, at, indexing="ij"), axis=-1).reshape(-1, 3)
    fills = np.empty((len(cells), 2, 2, 2))
    moments = np.empty((len(cells), 3))
    step = max(1, CHUNK // len(middles))
    for start in range(0, len(cells), step):
        points = grid.node_positions(cells[start : start + step, None, :] + middles).reshape(-1, 3)
        inside = is_inside(surface, points).reshape(-1, SAMPLES, SAMPLES, SAMPLES)
        fills[start : start + step] = 8 * np.einsum(
            "cxyz,ax,by,dz->cabd", inside, along, along, along
        )
        moments[start : start + step] = (
            inside.reshape(len(inside), -1) @ (middles - 0.5) ** 2 / len(middles)
        )
    return fills, moments
