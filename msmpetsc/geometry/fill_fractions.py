"""Shares of a cell and of its corners that lie inside the surface, by which boundary cells weigh.

The share of a corner is 8 times the integral of its trilinear function N over the part of the cell that is inside:
1 in a whole cell, and on average over the corners the share of the volume. A mean of N alone would spread what a cell
holds evenly, further out than it is, which makes thin limbs too stiff.

Of a closed surface it is exact. A ray is inside a body from where it enters to where it leaves, so an integral along
the ray, within the body and a cell, is a sum over the places z where it crosses the surface, in the cell or above it,

    sum_in sign S(z) + sum_above sign S(1),      sign = 1 where the ray leaves, -1 where it enters, S' = N(z), S(0) = 0.

Over all rays that is an integral over pieces of triangles as seen along the ray: the divergence theorem for the body
within the cell. So are the squares, the integrals of x^2, y^2 and z^2 from the middle of the cell. Of an open
surface they are counted in samples by the generalized winding number (Jacobson et al. 2013).

All is in cell units, axes cycled as in geometry.cages. Rays run along the last axis, so a slab of
the first has its columns whole.
"""

from dataclasses import dataclass

import numpy as np

from msmpetsc.backend.arrays import Floats, Indices, Rows
from msmpetsc.backend.kernel import njit
from msmpetsc.geometry.grid import CHUNK, LIMIT, Grid, packed
from msmpetsc.geometry.surface import Surface, is_inside
from msmpetsc.geometry.valid_cells import clip_between, extent, grown

SAMPLES = 6  # a side of a cell of an open surface: a plane through a cell is seen to 0.6% of the cell, rms
OUTSIDE = 0.5  # a winding number below this
LEAK = 1e-6  # windings left below a column: above rounding, far below what one triangle wound the wrong way leaves

SEEN, SUMS = 6, 17  # sums of a piece: those that count for the cells below it too, and all

# barycentric coordinates and weights that integrate polynomials of degree 4 over a triangle (Dunavant 1985)
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
    """The cells that triangles cross, in lexicographic order.

    keys    : (c,) of the cells (grid.packed)
    corners : (c, 2, 2, 2) shares of their corners; what is inside twice counts twice
    squares : (c, 3) integrals of x^2, y^2, z^2 over what is inside, from the middle of the cell: 1/12 in a whole one
    below   : (c, 2, 2) winding number below the cell, a mean over its base weighted by each corner's bilinear function
    """

    keys: Indices
    corners: Rows
    squares: Rows
    below: Rows

    @classmethod
    def crossed(cls, triangles: Rows, low: Indices, high: Indices) -> "Columns":
        """Return the columns of triangles (f, 3, 3) within low <= cell < high, (3,) int."""
        starts = range(0, max(1, len(triangles)), CHUNK)
        pieces = (_pieces(triangles[start : start + CHUNK], low, high) for start in starts)
        parts = [_sums_of_keys(packed(cells), values) for cells, values in pieces]
        keys = np.unique(np.concatenate([of_part for of_part, _ in parts]))
        sums = np.zeros((len(keys), SUMS))
        for of_part, values in parts:  # whose keys are distinct, each
            sums[np.searchsorted(keys, of_part)] += values
        above = _sums_above(keys // LIMIT, sums[:, :SEEN])
        below = 4 * above[:, :4].reshape(-1, 2, 2)
        above -= sums[:, :SEEN]
        for first in (SEEN, SEEN + 4):
            sums[:, first : first + 4] += 0.5 * above[:, :4]
        corners = 8 * sums[:, SEEN : SEEN + 8].reshape(-1, 2, 4).transpose(0, 2, 1)
        squares: Rows = sums[:, -3:].copy()
        squares[:, :2] += above[:, 4:]
        squares[:, 2] += above[:, :4].sum(axis=1) / 12
        return cls(keys, np.reshape(corners, (-1, 2, 2, 2)), squares, below)

    @property
    def leak(self) -> float:
        """The greatest winding number below a column: 0 of a closed surface wound one way."""
        lowest = np.diff(self.keys // LIMIT, prepend=-1) != 0
        return float(np.abs(self.below[lowest]).max(initial=0.0))

    def inside(self, cells: Indices) -> tuple[Rows, Rows]:
        """Return the shares (k, 2, 2, 2) of the corners of any cells (k, 3), and their squares (k, 3)."""
        if len(self.keys) == 0:
            return np.zeros((len(cells), 2, 2, 2)), np.zeros((len(cells), 3))
        keys = packed(cells)
        place = np.searchsorted(self.keys, keys).clip(max=len(self.keys) - 1)
        found = self.keys[place]
        is_above = (found >= keys) & (found // LIMIT == keys // LIMIT)
        uncut = np.where(is_above[:, None, None], self.below[place], 0.0)
        is_cut = found == keys
        share = np.where(is_cut[:, None, None, None], self.corners[place], uncut[..., None])
        return share, np.where(
            is_cut[:, None], self.squares[place], uncut.mean(axis=(1, 2))[:, None] / 12
        )


def _sums_of_keys(keys: Indices, values: Rows) -> tuple[Indices, Rows]:
    """Return the distinct keys (c,), ascending, and the sums (c, k) of the rows (p, k) of each."""
    distinct, place = np.unique(keys, return_inverse=True)
    sums: Rows = np.empty((len(distinct), values.shape[1]))
    for column, rows in enumerate(values.T):
        sums[:, column] = np.bincount(place, rows, len(distinct))
    return distinct, sums


@njit()
def _sums_above(column: Indices, values: Rows) -> Rows:
    """Return for each row the sum of the values (c, k) from it to the end of its column (c,)."""
    sums = values.copy()
    for c in range(len(column) - 2, -1, -1):
        if column[c] == column[c + 1]:
            sums[c] += sums[c + 1]
    return sums


@njit()
def _pieces(triangles: Rows, low: Indices, high: Indices) -> tuple[Indices, Rows]:
    """Cut triangles into cells.

    returns : cell (p, 3) of each piece, and its sums (p, SUMS) of ``_add_sums``
    """
    cells = np.empty((4 * len(triangles) + 16, 3), np.int64)
    values = np.empty((len(cells), SUMS))
    used = 0
    rooms = np.empty((4, 12, 3))
    work, across, along, piece = rooms[0], rooms[1], rooms[2], rooms[3]
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
    """Return the first cell index that a polygon reaches along an axis, and that after its last."""
    if n == 0:
        return 0, 0
    smallest, largest = extent(polygon, n, axis)
    return max(int(np.floor(smallest)), low[axis]), min(int(np.floor(largest)) + 1, high[axis])


@njit()
def _add_sums(p: Floats, q: Floats, r: Floats, cell: Indices, sums: Floats) -> None:
    """Add the integrals over a triangle of a cell, as seen along the last axis, to ``sums`` (SUMS,).

    With z the height in the cell and N_ab the bilinear function of the edge at (a, b) of its base, they are of N_ab and
    of x^2 and y^2 from the middle; then of N_ab S for the lower corner, S = z - z^2/2, of N_ab S for the upper one,
    S = z^2/2, and of the three squares' S; 2 a + b is the place among four.
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
        part, x, y, up = area * WEIGHTS[s], x - 0.5, y - 0.5, z - 0.5
        sums[4] += part * x * x
        sums[5] += part * y * y
        sums[SEEN + 8] += part * x * x * z
        sums[SEEN + 9] += part * y * y * z
        sums[SEEN + 10] += part * (up * up * up + 0.125) / 3


def sampled_inside(surface: Surface, grid: Grid, cells: Indices) -> tuple[Rows, Rows]:
    """Return shares and squares of cells (c, 3) as ``Columns.inside``, by samples."""
    at = (np.arange(SAMPLES) + 0.5) / SAMPLES
    along = np.stack([1 - at, at]) / SAMPLES  # the two linear functions of an axis
    middles = np.stack(np.meshgrid(at, at, at, indexing="ij"), axis=-1).reshape(-1, 3)
    shares, squares, step = (
        np.empty((len(cells), 2, 2, 2)),
        np.empty((len(cells), 3)),
        max(1, CHUNK // len(middles)),
    )
    for start in range(0, len(cells), step):
        points = grid.node_positions(cells[start : start + step, None, :] + middles).reshape(-1, 3)
        inside = is_inside(surface, points).reshape(-1, SAMPLES, SAMPLES, SAMPLES)
        shares[start : start + step] = 8 * np.einsum(
            "cxyz,ax,by,dz->cabd", inside, along, along, along
        )
        squares[start : start + step] = (
            inside.reshape(len(inside), -1) @ (middles - 0.5) ** 2 / len(middles)
        )
    return shares, squares
