"""Signed volumes that reveal inverted cells: the volumes at a cell's corners, and its mean J.

The three edges at a corner span the corner's volume. Positions are local, (l, 3) [m].
"""

from typing import NamedTuple

import numpy as np

from msmpetsc.backend.arrays import Floats, Indices, Positions, Rows
from msmpetsc.backend.kernel import kernel, njit
from msmpetsc.elasticity.cell_strain import Six, strain
from msmpetsc.elasticity.vectors import Vector, cross, dot, vector


class Shapes(NamedTuple):
    """Corner nodes (c, 8) of a solid's cells, and their forms (c, FORM) (lattice.cell_moments)."""

    cells: Indices
    forms: Rows


@njit()
def _volume(a: Vector, b: Vector, c: Vector) -> float:
    """Return a . (b x c)."""
    return dot(a, cross(b, c))


@njit()
def least_volume(q: Positions, c: Indices) -> float:
    """Return the smallest of the eight corner volumes of a cell [m^3]."""
    x0, x1 = vector(q, c[0], c[1]), vector(q, c[3], c[2])
    x2, x3 = vector(q, c[4], c[5]), vector(q, c[7], c[6])
    y0, y1 = vector(q, c[0], c[3]), vector(q, c[1], c[2])
    y2, y3 = vector(q, c[4], c[7]), vector(q, c[5], c[6])
    z0, z1 = vector(q, c[0], c[4]), vector(q, c[1], c[5])
    z2, z3 = vector(q, c[2], c[6]), vector(q, c[3], c[7])
    low = min(_volume(x0, y0, z0), _volume(x0, y1, z1), _volume(x1, y1, z2), _volume(x1, y0, z3))
    v4, v5 = _volume(x2, y2, z0), _volume(x2, y3, z1)
    v6, v7 = _volume(x3, y3, z2), _volume(x3, y2, z3)
    return float(min(low, v4, v5, v6, v7))


@kernel
def _least_volume_of(
    first: int, count: int, step: int, q: Positions, cells: Indices, least: Floats,
) -> None:  # fmt: skip
    for i in range(first, count, step):
        least[i] = least_volume(q, cells[i])


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
    first: int, count: int, step: int, volumes: Floats, q: Positions, shapes: Shapes
) -> None:
    cells, forms = shapes
    for i in range(first, count, step):
        f, c = forms[i], cells[i]
        form = f[0], f[1], f[2], f[3], f[4], f[5]
        volumes[i] = _volume(
            _mean_slope(q, c, 0, form), _mean_slope(q, c, 1, form), _mean_slope(q, c, 2, form)
        )


def volume_ratios(q: Positions, cells: Indices, forms: Rows, cell_size: float) -> Floats:
    """Return J (c,) [-] of a solid's cells at q (l, 3) [m], of the mean deformation gradient."""
    volumes: Floats = np.empty(len(cells), like=q)
    _mean_volume_of(len(cells), volumes, q, Shapes(cells, forms))
    return volumes / (4.0 * cell_size) ** 3
