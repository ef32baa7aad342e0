"""Signed volumes that reveal inverted cells: the volumes at a cell's corners, and its mean J.

The three edges at a corner span the corner volume. Positions are local, (l, 3) [m].
"""

import math

import numpy as np

from msmpetsc.backend.arrays import Floats, Indices, Positions, Rows
from msmpetsc.backend.kernel import kernel, njit
from msmpetsc.elasticity.cell_strain import Six, strain
from msmpetsc.elasticity.vectors import Vector, cross, dot, vector


@njit()
def _volume(a: Vector, b: Vector, c: Vector) -> float:
    """Return a . (b x c)."""
    return dot(a, cross(b, c))


@kernel
def _least_volume_of(
    first: int, count: int, step: int, q: Positions, cells: Indices, least: Floats
) -> None:
    for i in range(first, count, step):
        c, least[i] = cells[i], math.inf
        for a in range(4):
            b, d, e = (a + 1) % 4, (a + 3) % 4, a + 4
            x, y, z = vector(q, c[a], c[b]), vector(q, c[a], c[d]), vector(q, c[a], c[e])
            u, v, w = vector(q, c[e], c[d + 4]), vector(q, c[e], c[b + 4]), vector(q, c[e], c[a])
            least[i] = min(least[i], _volume(x, y, z), _volume(u, v, w))


def least_volumes(q: Positions, cells: Indices) -> Floats:
    """Return the smallest corner volume (c,) [m^3] of each cell; <= 0 if the cell is inverted."""
    least = np.empty(len(cells), like=q)
    _least_volume_of(len(cells), q, cells, least)
    return least


@njit(inline="always")
def _mean_slope(q: Positions, c: Indices, k: int, form: Six) -> Vector:
    corners = (
        q[c[0], k], q[c[1], k], q[c[3], k], q[c[2], k],
        q[c[4], k], q[c[5], k], q[c[7], k], q[c[6], k],
    )  # fmt: skip
    x, y, z, _, _, _, _ = strain(corners, form)
    return x, y, z


@kernel
def _mean_volume_of(
    first: int, count: int, step: int, volumes: Floats, q: Positions, cells: Indices, forms: Rows
) -> None:
    for i in range(first, count, step):
        f, c = forms[i], cells[i]
        form = f[0], f[1], f[2], f[3], f[4], f[5]
        volumes[i] = _volume(
            _mean_slope(q, c, 0, form), _mean_slope(q, c, 1, form), _mean_slope(q, c, 2, form)
        )


def volume_ratios(q: Positions, cells: Indices, forms: Rows, cell_size: float) -> Floats:
    """Return J = det F (c,) [-] of a solid's cells at q (l, 3) [m], with F the cell's mean.

    cells : (c, 8) corner nodes
    forms : (c, FORM) forms of the cells (lattice.cell_moments)
    """
    volumes: Floats = np.empty(len(cells), like=q)
    _mean_volume_of(len(cells), volumes, q, cells, forms)
    return volumes / (4.0 * cell_size) ** 3
