"""Bending and twist of a cell: the energy of what the mean deformation gradient leaves out.

F is the mean deformation gradient of a cell, with the columns f_x, f_y and f_z. With the distance
d = X - c from the centroid of the part inside the surface, positions in the cell are

    x = c' + F d + p_xy d_x d_y + p_xz d_x d_z + p_yz d_y d_z + ...

The vectors p are the mixed second derivatives at the centroid. The directions of the columns are

    n_I = (1 + D) f_I / (D + |f_I|^2),        D = 1/2.                                          (1)

They are f_I at rest, turn with the cell, and stay finite if a column vanishes. Their length falls
as a column stretches, as the tangent of the neo-Hookean law does. With a_I,JK = n_I . p_JK the
strains are (Simo and Rifai 1990 and Belytschko and Bindeman 1993 on assumed strains)

    e_I  = sum over K != I of d_K a_I,IK               normal strains, from bending             (2)
    g_IJ = d_K (a_I,JK + a_J,IK), K the third axis     shear strains, from twist                (3)

The shear d_I a_I,IK that a cell has in bending is left out: trilinear functions have it, but a beam
does not. With <> the mean over the part inside the surface the energy is

    W = 1/2 mu V ((1 - s) Q + 2 s <|G|^2> + XYZ),                                               (4)
    Q = <2 sum e_I^2 + beta (sum e_I)^2 + sum g_IJ^2>,     beta = 2 lambda / (lambda + 2 mu).

beta is that of plane stress, so a plate of a single cell bends as it should at any Poisson's ratio.
<|G|^2> is the mean square of the whole remainder of the gradient. Its share s holds corners of
cells of which little is inside. XYZ is the square of the mode XYZ (lattice.cell_moments).

- W is a sum of squares: it is never negative, also in folded cells, and 0 for rigid motions.
- At rest W is at most mu V <|G|^2> (1 + 3 beta / 2) if d_x, d_y and d_z are not correlated. The
  general bound is that of lattice.cell_moments.bounding_laplacians.
- Q depends on the covariance C = <d d^T> alone. Its form on the nine a (3 by axis, 3 by mode) is K.

With r_I = sum over m of (K a)_I,m p_m, the gradient of Q / 2 has the parts

    dQ/dp_m = sum over I of (K a)_I,m n_I,        dQ/df_I = c r_I - b (f_I . r_I) f_I           (5)

with c = (1 + D) / (D + |f_I|^2) and b = 2 c^2 / (1 + D). The change of a direction with f_I by g is
c g - b (f_I . g) f_I; its norm is at most c |g|. The projected Hessian keeps the directions: it is
the form K of the changes n_I . dp. A Hessian's state therefore has p = 0 if it is projected.

Lengths: the modes h of a strain are 2 h^2 p, h the side of a cell, and slopes are 4 h times F. So
with the modes in a state divided by 4 h, all products are in units of slopes.
"""

import math
from typing import TypeAlias

import numpy as np

from msmpetsc.backend.arrays import Floats
from msmpetsc.backend.kernel import njit
from msmpetsc.elasticity.cell_strain import Eight, Modes, Nine, Seven, Strains
from msmpetsc.elasticity.springs import Vector, dot

# vectors of the modes XY, XZ and YZ
Bent: TypeAlias = tuple[Vector, Vector, Vector]

# Numbers of products are of single precision and exact there, so that products of
# single precision stay so.
# D [-] of Eq. 1; bending and torsion of a bar stretched by 0.7 to 1.5 are within a
# factor 2 with a single cell across
SQUARE = np.float32(0.5)
# 1 + D [-]
RANGE = np.float32(1.5)
# 2 s / (1 - s) [-]; walls of a tenth of a cell bend 15% too little
FULL = np.float32(1 / 256)
# 1 - s [-], the factor of C in a cell's constants
ASSUMED = 2 / (2 + float(FULL))
# keeps divisors from zero [-]
LEAST = np.float32(1e-30)


@njit(inline="always")
def column(f: Nine, i: int) -> Vector:
    """Return column i of a matrix (9,) by rows."""
    return f[i], f[3 + i], f[6 + i]


@njit(inline="always")
def mode(e: Strains, m: int) -> Vector:
    """Return mode m of a strain, 0, 1 and 2 for XY, XZ and YZ."""
    return e[0][3 + m], e[1][3 + m], e[2][3 + m]


@njit(inline="always")
def slope_column(e: Strains, i: int) -> Vector:
    """Return the slopes of a strain along axis i, 4 h times those of F's column."""
    return e[0][i], e[1][i], e[2][i]


@njit(inline="always")
def kept_modes(state: Floats, s: int) -> Bent:
    """Return the modes XY, XZ and YZ over 4 h of the cell whose entries begin at ``state[s]``."""
    return (
        (state[s + 88], state[s + 96], state[s + 104]),
        (state[s + 112], state[s + 120], state[s + 128]),
        (state[s + 136], state[s + 144], state[s + 152]),
    )


@njit(inline="always")
def by_rows(x: Vector, y: Vector, z: Vector) -> Nine:
    """Return a matrix (9,) by rows from its columns."""
    return x[0], y[0], z[0], x[1], y[1], z[1], x[2], y[2], z[2]


@njit(inline="always")
def combined(a: float, x: Vector, b: float, y: Vector, c: float, z: Vector) -> Vector:
    """Return a x + b y + c z."""
    return (
        a * x[0] + b * y[0] + c * z[0],
        a * x[1] + b * y[1] + c * z[1],
        a * x[2] + b * y[2] + c * z[2],
    )


@njit(inline="always")
def scaled(a: float, x: Vector) -> Vector:
    return a * x[0], a * x[1], a * x[2]


@njit(inline="always")
def added(x: Vector, y: Vector) -> Vector:
    return x[0] + y[0], x[1] + y[1], x[2] + y[2]


@njit(inline="always")
def direction_factor(f: Vector) -> float:
    """Return c, the length of a direction (Eq. 1) over that of its column."""
    return RANGE / (SQUARE + dot(f, f))  # type: ignore[no-any-return]


@njit(inline="always")
def bend_factor(c: float) -> float:
    """Return b, by which a direction falls behind its column as it stretches (Eq. 5)."""
    return c * (c + c) / RANGE  # type: ignore[no-any-return]


@njit(inline="always")
def turned(f: Vector, c: float, b: float, g: Vector) -> Vector:
    """Return the change of a direction as its column f changes by g. The map is symmetric."""
    along = b * dot(f, g)
    return c * g[0] - along * f[0], c * g[1] - along * f[1], c * g[2] - along * f[2]


@njit(inline="always")
def turned_force(f: Vector, c: float, b: float, r: Vector, g: Vector) -> Vector:
    """Return the change of ``turned(f, c, b, r)`` as the column f changes by g."""
    fg, fr = b * dot(f, g), b * dot(f, r)
    along = (b + b) * (c + c) / RANGE * dot(f, r) * dot(f, g) - b * dot(g, r)
    return combined(along, f, -fg, r, -fr, g)


@njit(inline="always")
def rest_constants(c: Floats, k: int) -> Eight:
    """Return 4 m (1 - s) C (6,) as xx, yy, zz, yz, xz, xy, then the constant of XYZ, and beta.

    c, k : constants of the cell, from index k on
    """
    # a cell of no stiffness must not divide by zero
    m, lame = c[k + 104], c[k + 112]
    beta = (lame + lame) / (lame + m + m + LEAST)
    return (
        c[k + 48], c[k + 56], c[k + 64], c[k + 72], c[k + 80], c[k + 88], c[k + 96], beta,
    )  # fmt: skip


@njit(inline="always")
def tensions(c: Eight, x: Vector, y: Vector, z: Vector) -> tuple[Vector, Vector, Vector]:
    """Return K a, from the a (3,) of XY, XZ and YZ for each axis."""
    xx, yy, zz, yz, xz, xy, _, beta = c
    # sum of the e_I is d . s
    sx, sy, sz = y[0] + z[1], x[0] + z[2], x[1] + y[2]
    tx = beta * (xx * sx + xy * sy + xz * sz)
    ty = beta * (xy * sx + yy * sy + yz * sz)
    tz = beta * (xz * sx + yz * sy + zz * sz)
    gx, gy, gz = xx * (y[1] + z[0]), yy * (x[2] + z[0]), zz * (x[2] + y[1])
    own_x = yy * x[0] + yz * x[1], yz * x[0] + zz * x[1]
    own_y = xx * y[0] + xz * y[2], xz * y[0] + zz * y[2]
    own_z = xx * z[1] + xy * z[2], xy * z[1] + yy * z[2]
    return (
        (own_x[0] + own_x[0] + ty, own_x[1] + own_x[1] + tz, gy + gz),
        (own_y[0] + own_y[0] + tx, gx + gz, own_y[1] + own_y[1] + tz),
        (gx + gy, own_z[0] + own_z[0] + tx, own_z[1] + own_z[1] + ty),
    )


@njit(inline="always")
def along(n: Vector, xy: Vector, xz: Vector, yz: Vector) -> Vector:
    """Return the parts (3,) of three vectors along a direction."""
    return dot(n, xy), dot(n, xz), dot(n, yz)


@njit(inline="always")
def full_forces(c: Eight, e: Seven) -> tuple[float, float, float, float]:
    """Return the derivative of the share of <|G|^2> and of XYZ by the modes (4,) of a strain."""
    xx, yy, zz, yz, xz, xy, xyz, _ = c
    return (
        FULL * ((xx + yy) * e[3] + yz * e[4] + xz * e[5]),
        FULL * (yz * e[3] + (xx + zz) * e[4] + xy * e[5]),
        FULL * (xz * e[3] + xy * e[4] + (yy + zz) * e[5]),
        xyz * e[6],
    )


@njit(inline="always")
def rest_gradient(c: Eight, f: Nine, e: Strains, inverse_h4: float) -> tuple[Nine, Modes]:
    """Return the gradient of W by the slopes (9,), as they are in F, and by the modes (3 x 4).

    e : strains of positions; ``inverse_h4`` is 1 / (4 h)
    """
    xy, xz, yz = mode(e, 0), mode(e, 1), mode(e, 2)
    fx, fy, fz = column(f, 0), column(f, 1), column(f, 2)
    cx, cy, cz = direction_factor(fx), direction_factor(fy), direction_factor(fz)
    nx, ny, nz = scaled(cx, fx), scaled(cy, fy), scaled(cz, fz)
    tx, ty, tz = tensions(c, along(nx, xy, xz, yz), along(ny, xy, xz, yz), along(nz, xy, xz, yz))
    gx = turned(fx, cx, bend_factor(cx), combined(tx[0], xy, tx[1], xz, tx[2], yz))
    gy = turned(fy, cy, bend_factor(cy), combined(ty[0], xy, ty[1], xz, ty[2], yz))
    gz = turned(fz, cz, bend_factor(cz), combined(tz[0], xy, tz[1], xz, tz[2], yz))
    slopes = by_rows(scaled(inverse_h4, gx), scaled(inverse_h4, gy), scaled(inverse_h4, gz))
    of_xy = combined(tx[0], nx, ty[0], ny, tz[0], nz)
    of_xz = combined(tx[1], nx, ty[1], ny, tz[1], nz)
    of_yz = combined(tx[2], nx, ty[2], ny, tz[2], nz)
    return slopes, _with_full(c, e, of_xy, of_xz, of_yz)


@njit(inline="always")
def rest_product(c: Eight, f: Nine, p: Bent, e: Strains) -> tuple[Nine, Modes]:
    """Return the product of the Hessian of W with the strains of a displacement.

    It is the derivative of ``rest_gradient``, in terms of 4 h times the slopes.

    f : F (9,)
    p : ``kept_modes``
    """
    xy, xz, yz = mode(e, 0), mode(e, 1), mode(e, 2)
    p_xy, p_xz, p_yz = p
    fx, fy, fz = column(f, 0), column(f, 1), column(f, 2)
    cx, cy, cz = direction_factor(fx), direction_factor(fy), direction_factor(fz)
    bx, by, bz = bend_factor(cx), bend_factor(cy), bend_factor(cz)
    nx, ny, nz = scaled(cx, fx), scaled(cy, fy), scaled(cz, fz)
    gx, gy, gz = slope_column(e, 0), slope_column(e, 1), slope_column(e, 2)
    mx, my, mz = turned(fx, cx, bx, gx), turned(fy, cy, by, gy), turned(fz, cz, bz, gz)
    # tensions of the state, then their change
    sx, sy, sz = tensions(
        c, along(nx, p_xy, p_xz, p_yz), along(ny, p_xy, p_xz, p_yz), along(nz, p_xy, p_xz, p_yz)
    )
    tx, ty, tz = tensions(
        c,
        added(along(nx, xy, xz, yz), along(mx, p_xy, p_xz, p_yz)),
        added(along(ny, xy, xz, yz), along(my, p_xy, p_xz, p_yz)),
        added(along(nz, xy, xz, yz), along(mz, p_xy, p_xz, p_yz)),
    )
    of_x = added(combined(tx[0], p_xy, tx[1], p_xz, tx[2], p_yz), combined(sx[0], xy, sx[1], xz, sx[2], yz))
    of_y = added(combined(ty[0], p_xy, ty[1], p_xz, ty[2], p_yz), combined(sy[0], xy, sy[1], xz, sy[2], yz))
    of_z = added(combined(tz[0], p_xy, tz[1], p_xz, tz[2], p_yz), combined(sz[0], xy, sz[1], xz, sz[2], yz))
    rx = combined(sx[0], p_xy, sx[1], p_xz, sx[2], p_yz)
    ry = combined(sy[0], p_xy, sy[1], p_xz, sy[2], p_yz)
    rz = combined(sz[0], p_xy, sz[1], p_xz, sz[2], p_yz)
    slopes = by_rows(
        added(turned(fx, cx, bx, of_x), turned_force(fx, cx, bx, rx, gx)),
        added(turned(fy, cy, by, of_y), turned_force(fy, cy, by, ry, gy)),
        added(turned(fz, cz, bz, of_z), turned_force(fz, cz, bz, rz, gz)),
    )
    of_xy = added(combined(tx[0], nx, ty[0], ny, tz[0], nz), combined(sx[0], mx, sy[0], my, sz[0], mz))
    of_xz = added(combined(tx[1], nx, ty[1], ny, tz[1], nz), combined(sx[1], mx, sy[1], my, sz[1], mz))
    of_yz = added(combined(tx[2], nx, ty[2], ny, tz[2], nz), combined(sx[2], mx, sy[2], my, sz[2], mz))
    return slopes, _with_full(c, e, of_xy, of_xz, of_yz)


@njit(inline="always")
def frozen_product(c: Eight, f: Nine, e: Strains) -> Modes:
    """Return ``rest_product`` of a projected Hessian, whose state has no modes."""
    xy, xz, yz = mode(e, 0), mode(e, 1), mode(e, 2)
    fx, fy, fz = column(f, 0), column(f, 1), column(f, 2)
    nx, ny, nz = scaled(direction_factor(fx), fx), scaled(direction_factor(fy), fy), scaled(direction_factor(fz), fz)
    tx, ty, tz = tensions(c, along(nx, xy, xz, yz), along(ny, xy, xz, yz), along(nz, xy, xz, yz))
    of_xy = combined(tx[0], nx, ty[0], ny, tz[0], nz)
    of_xz = combined(tx[1], nx, ty[1], ny, tz[1], nz)
    of_yz = combined(tx[2], nx, ty[2], ny, tz[2], nz)
    return _with_full(c, e, of_xy, of_xz, of_yz)


@njit(inline="always")
def _with_full(c: Eight, e: Strains, xy: Vector, xz: Vector, yz: Vector) -> Modes:
    """Return the gradient by the modes: that of Q, by mode, and the rest of Eq. 4."""
    a, b, d = full_forces(c, e[0]), full_forces(c, e[1]), full_forces(c, e[2])
    return (
        (a[0] + xy[0], a[1] + xz[0], a[2] + yz[0], a[3]),
        (b[0] + xy[1], b[1] + xz[1], b[2] + yz[1], b[3]),
        (d[0] + xy[2], d[1] + xz[2], d[2] + yz[2], d[3]),
    )


@njit(inline="always")
def _change_of_parts(f: Vector, g: Vector, p: Vector, moved: Vector) -> float:
    """Return the change of n . p as the column f changes by g and p by ``moved``, with its digits.

    n' - n = c' g + (c' - c) f,    c' - c = -c c' / (1 + D) g . (f + f').
    """
    after = added(f, g)
    before, c = direction_factor(f), direction_factor(after)
    along_f = -before * c / RANGE * dot(g, added(f, after))
    change = combined(c, g, along_f, f, before, (0.0, 0.0, 0.0))
    return dot(change, added(p, moved)) + before * dot(f, moved)


@njit(inline="always")
def _changes(f: Vector, g: Vector, e: Strains, d: Strains) -> tuple[Vector, Vector]:
    """Return the change (3,) of a column's a as strains e change by d, and the mean of both a."""
    n = scaled(direction_factor(f), f)
    change = (
        _change_of_parts(f, g, mode(e, 0), mode(d, 0)),
        _change_of_parts(f, g, mode(e, 1), mode(d, 1)),
        _change_of_parts(f, g, mode(e, 2), mode(d, 2)),
    )
    before = along(n, mode(e, 0), mode(e, 1), mode(e, 2))
    return change, added(before, scaled(0.5, change))


@njit(inline="always")
def rest_change(c: Eight, f: Nine, g: Nine, e: Strains, d: Strains) -> float:
    """Return the change of W as F changes by g and the strains e by d, with the digits of d."""
    dx, ax = _changes(column(f, 0), column(g, 0), e, d)
    dy, ay = _changes(column(f, 1), column(g, 1), e, d)
    dz, az = _changes(column(f, 2), column(g, 2), e, d)
    tx, ty, tz = tensions(c, ax, ay, az)
    change = dot(dx, tx) + dot(dy, ty) + dot(dz, tz)
    for i in range(3):
        a, b = full_forces(c, d[i]), d[i]
        base = e[i]
        change += a[0] * (base[3] + 0.5 * b[3]) + a[1] * (base[4] + 0.5 * b[4])
        change += a[2] * (base[5] + 0.5 * b[5]) + a[3] * (base[6] + 0.5 * b[6])
    return change





@njit(inline="always")
def directions(f: Nine) -> Nine:
    """Return the directions n (9,) of F's columns (Eq. 1), both by rows."""
    x, y, z = column(f, 0), column(f, 1), column(f, 2)
    return by_rows(
        scaled(direction_factor(x), x),
        scaled(direction_factor(y), y),
        scaled(direction_factor(z), z),
    )


@njit(inline="always")
def corner_tensions(c: Eight, n: Nine, h: Seven) -> tuple[Nine, Nine, Nine]:
    """Return K's tensions of modes by a corner's displacement, for fixed directions n (9,).

    Result I has the rows y (3,) of the modes m: the displacement v has the tension (K a)_I,m =
    y . v.

    h : ``corner_strain`` of the corner
    """
    # A displacement along n_J has the a (3,) of axis J alone
    own, zero = (h[3], h[4], h[5]), (0.0, 0.0, 0.0)
    x, y, z = column(n, 0), column(n, 1), column(n, 2)
    xx, xy, xz = tensions(c, own, zero, zero)
    yx, yy, yz = tensions(c, zero, own, zero)
    zx, zy, zz = tensions(c, zero, zero, own)
    return (
        _along_directions(x, y, z, xx, yx, zx),
        _along_directions(x, y, z, xy, yy, zy),
        _along_directions(x, y, z, xz, yz, zz),
    )


@njit(inline="always")
def _along_directions(x: Vector, y: Vector, z: Vector, a: Vector, b: Vector, c: Vector) -> Nine:
    first, second = combined(a[0], x, b[0], y, c[0], z), combined(a[1], x, b[1], y, c[1], z)
    third = combined(a[2], x, b[2], y, c[2], z)
    return (*first, *second, *third)


@njit(inline="always")
def rest_concavity(
    c: Eight, f: Nine, e: Strains, inverse_h4: float, left: float
) -> tuple[float, float]:
    """Return a, b >= 0 for which the Hessian of W plus ``left`` |G|^2 is at least -a |G|^2 - b |h|^2.

    In units of slopes the Hessian's form is K(n . h + m . p) + 2 (K a) (m . h) + (the change of m),
    with m the change of the directions. Three bounds hold, with c the greatest of its columns':

    - 2 (K a)(m . h) <= 2 c |K a| |G| |h|
    - K(x + y) >= K(x) / 2 - K(y), and K lies between its least and greatest eigenvalue
    - the change of m is at most b |f| |r| sqrt(max(2, 1 + (4 u - 3)^2)) |g|^2 in a column, with
      u = |f|^2 / (D + |f|^2)

    So the form is at least A |G|^2 - 2 X |G| |h| + B |h|^2, which A B >= X^2 makes semidefinite.
    """
    xy, xz = scaled(inverse_h4, mode(e, 0)), scaled(inverse_h4, mode(e, 1))
    yz = scaled(inverse_h4, mode(e, 2))
    n = directions(f)
    nx, ny, nz = column(n, 0), column(n, 1), column(n, 2)
    own = tensions(c, along(nx, xy, xz, yz), along(ny, xy, xz, yz), along(nz, xy, xz, yz))
    tension, turning, factor = 0.0, 0.0, 0.0
    for i in range(3):
        x, s = column(f, i), own[i]
        r = combined(s[0], xy, s[1], xz, s[2], yz)
        of_column, square = direction_factor(x), dot(x, x)
        u = square / (SQUARE + square)
        shape = max(2.0, 1.0 + (4.0 * u - 3.0) ** 2)
        change = bend_factor(of_column) * math.sqrt(square * dot(r, r) * shape)
        turning, factor = max(turning, change), max(factor, of_column)
        tension += dot(s, s)
    least, greatest = _least_and_greatest(c)
    greatest *= max(2.0 + 2.0 * c[7], 4.0)
    parts = abs(dot(nx, ny)), abs(dot(nx, nz)), abs(dot(ny, nz))
    frame = min(
        dot(nx, nx) - parts[0] - parts[1],
        dot(ny, ny) - parts[0] - parts[2],
        dot(nz, nz) - parts[1] - parts[2],
    )
    size = dot(xy, xy) + dot(xz, xz) + dot(yz, yz)
    of_slopes = left - turning - greatest * factor * factor * size
    of_modes = 0.5 * least * max(frame, 0.0)
    mixed = factor * math.sqrt(tension)
    a = max(mixed - of_slopes, 0.0)
    b = max(mixed * mixed / max(of_slopes + a, LEAST) - of_modes, 0.0)
    # At rest there is only rounding left
    return (a, b) if mixed > 0.0 or left < 0.0 else (0.0, 0.0)


@njit(inline="always")
def _least_and_greatest(c: Eight) -> tuple[float, float]:
    """Return bounds of the eigenvalues of C in a cell's constants (Smith 1961)."""
    xx, yy, zz, yz, xz, xy, _, _ = c
    mean = (xx + yy + zz) / 3.0
    x, y, z = xx - mean, yy - mean, zz - mean
    spread = math.sqrt((x * x + y * y + z * z + 2.0 * (yz * yz + xz * xz + xy * xy)) / 6.0)
    half = 0.5 * (x * (y * z - yz * yz) - xy * (xy * z - yz * xz) + xz * (xy * yz - y * xz))
    shape = half / max(spread * spread * spread, LEAST)
    angle = math.acos(min(max(shape, -1.0), 1.0)) / 3.0
    greatest = mean + 2.0 * spread * math.cos(angle)
    least = mean + 2.0 * spread * math.cos(angle + 2.0 * math.pi / 3.0)
    return max(least, 0.0), greatest
