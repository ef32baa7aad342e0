"""Strain within a cell, and the forces at its corners: formulas that all loops share.

The strain of a component is its three mean slopes and its four modes (lattice.cell_moments).
Constants are interleaved for LANES cells: number i of the cell at k is c[k + LANES * i].
"""

from typing import TypeAlias

from msmpetsc.backend.arrays import Floats
from msmpetsc.backend.kernel import njit
from msmpetsc.elasticity.vectors import Three, Vector

# number of cells in a block [-]; eight doubles fill the widest vector register
LANES = 8

Four: TypeAlias = tuple[float, float, float, float]
Six: TypeAlias = tuple[float, float, float, float, float, float]
Seven: TypeAlias = tuple[float, float, float, float, float, float, float]
Eight: TypeAlias = tuple[float, float, float, float, float, float, float, float]
# strains of the components x, y and z
Strains: TypeAlias = tuple[Seven, Seven, Seven]
# derivatives by the four modes, for the components x, y and z
Modes: TypeAlias = tuple[Four, Four, Four]


@njit(inline="always")
def form_of(c: Floats, k: int) -> Six:
    """Return the first six constants of a cell, which define its mean slopes."""
    return c[k], c[k + 8], c[k + 16], c[k + 24], c[k + 32], c[k + 40]


@njit(inline="always")
def strain(u: Eight, form: Six) -> Seven:
    """Return the strain of corner values u (8,), x fastest: 4 h times mean slopes, then modes."""
    a, b, c, d, e, f, g, h = u
    s0, d0, s1, d1, s2, d2, s3, d3 = a + b, b - a, c + d, d - c, e + f, f - e, g + h, h - g
    x0, y0, xy0, x1, y1, xy1 = d0 + d1, s1 - s0, d1 - d0, d2 + d3, s3 - s2, d3 - d2
    x, y, z = x0 + x1, y0 + y1, (s2 + s3) - (s0 + s1)
    xy, xz, yz, xyz = xy0 + xy1, x1 - x0, y1 - y0, xy1 - xy0
    cx, cy, cz, mxy, mxz, myz = form
    return (
        x + xy * cy + xz * cz + xyz * myz,
        y + xy * cx + yz * cz + xyz * mxz,
        z + xz * cx + yz * cy + xyz * mxy,
        xy + xyz * cz,
        xz + xyz * cy,
        yz + xyz * cx,
        xyz,
    )


@njit(inline="always")
def corner_strain(a: int, form: Six) -> Seven:
    """Return the ``strain`` of the trilinear function that is 1 at corner a."""
    x, y, z = 2.0 * (a & 1) - 1.0, 1.0 * (a & 2) - 1.0, 0.5 * (a & 4) - 1.0
    cx, cy, cz, mxy, mxz, myz = form
    return (
        x * (1.0 + y * cy + z * cz + y * z * myz),
        y * (1.0 + x * cx + z * cz + x * z * mxz),
        z * (1.0 + x * cx + y * cy + x * y * mxy),
        x * y * (1.0 + z * cz),
        x * z * (1.0 + y * cy),
        y * z * (1.0 + x * cx),
        x * y * z,
    )


@njit(inline="always")
def write_forces(store: Floats, at: int, form: Six, slopes: Three, modes: Modes) -> None:
    """Write the gradient at a cell's corners, 24 numbers, into ``store`` from index ``at``.

    slopes : derivative of E with respect to 4 h times the columns of F
    modes  : (3 x 4) derivative of E with respect to the modes of each component
    """
    x, y, z = slopes
    _write_component(store, at, form, (x[0], y[0], z[0]), modes[0])
    _write_component(store, at + 8, form, (x[1], y[1], z[1]), modes[1])
    _write_component(store, at + 16, form, (x[2], y[2], z[2]), modes[2])


@njit(inline="always")
def _write_component(w: Floats, at: int, form: Six, slopes: Vector, modes: Four) -> None:
    p, q, r = slopes
    m, n, o, v = modes
    cx, cy, cz, mxy, mxz, myz = form
    xyz = v + m * cz + n * cy + o * cx + p * myz + q * mxz + r * mxy
    xy, xz, yz = m + p * cy + q * cx, n + p * cz + r * cx, o + q * cz + r * cy
    x0, x1, y0, y1, xy0, xy1 = p - xz, p + xz, q - yz, q + yz, xy - xyz, xy + xyz
    s0, s1, d0, d1 = -r - y0, y0 - r, x0 - xy0, x0 + xy0
    s2, s3, d2, d3 = r - y1, r + y1, x1 - xy1, x1 + xy1
    w[at], w[at + 24], w[at + 48], w[at + 72] = s0 - d0, s0 + d0, s1 - d1, s1 + d1
    w[at + 96], w[at + 120], w[at + 144], w[at + 168] = s2 - d2, s2 + d2, s3 - d3, s3 + d3
