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
from msmpetsc.geometry.grid import CHUNK, Grid, unpacked
from msmpetsc.geometry.morton import LIMIT
from msmpetsc.geometry.surface import Surface, is_inside
from msmpetsc.geometry.valid_cells import clip_to_cell

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
    """Fill of ascending cells that contain all cells crossed by triangles.

    corners : (c, 2, 2, 2) fills of their corners; material inside two parts counts twice
    moments : (c, 3) second moments about the middle of the cell [cells^5]: 1/12 in a full cell
    below   : (c, 2, 2) winding number below the cell: mean over the base, weighted by the bilinear
              function of each corner
    leak    : largest winding number below a column: 0 for a closed, consistently wound surface
    """

    corners: Rows
    moments: Rows
    below: Rows
    leak: float

    @classmethod
    def crossed(cls, triangles: Rows, number: Indices, place: Indices, keys: Indices) -> "Columns":
        """Return the columns of triangles (f, 3, 3) in cells with keys (c,) (grid.packed).

        number, place : (n,) triangle and row of the cell, for each triangle and cell that touch
        """
        sums = _sums_in_cells(triangles, number, place, unpacked(keys))
        column = keys // LIMIT
        above = _sums_above(column, sums[:, :SEEN])
        below = 4 * above[:, :4].reshape(-1, 2, 2)
        above -= sums[:, :SEEN]
        for first in (SEEN, SEEN + 4):
            sums[:, first : first + 4] += 0.5 * above[:, :4]
        corners = 8 * sums[:, SEEN : SEEN + 8].reshape(-1, 2, 4).transpose(0, 2, 1)
        moments: Rows = sums[:, -3:].copy()
        moments[:, :2] += above[:, 4:]
        moments[:, 2] += above[:, :4].sum(axis=1) / 12
        lowest = np.diff(column, prepend=-1) != 0
        leak = float(np.abs(below[lowest]).max(initial=0.0))
        return cls(np.reshape(corners, (-1, 2, 2, 2)), moments, below, leak)


@njit()
def _sums_above(column: Indices, values: Rows) -> Rows:
    """Return, for each row, the sum of values (c, k) from the row to the end of its column (c,)."""
    sums = values.copy()
    for c in range(len(column) - 2, -1, -1):
        if column[c] == column[c + 1]:
            sums[c] += sums[c + 1]
    return sums


@njit()
def _sums_in_cells(triangles: Rows, number: Indices, place: Indices, cells: Indices) -> Rows:
    """Return the sums (c, SUMS) of ``_add_sums`` over the pieces of triangles in cells (c, 3)."""
    sums = np.zeros((len(cells), SUMS))
    own = np.empty(SUMS)
    buffers = np.empty((3, 12, 3))
    for n in range(len(number)):
        cell = cells[place[n]]
        piece = clip_to_cell(triangles[number[n]], cell, buffers)
        own[:] = 0.0
        for a in range(1, len(piece) - 1):
            _add_sums(piece[0], piece[a], piece[a + 1], cell, own)
        sums[place[n]] += own
    return sums


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
