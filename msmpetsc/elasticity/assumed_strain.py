"""Energy of bending and twist in a cell, beside the energy of its mean deformation gradient.

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

    W = 1/2 mu V ((1 - s) (Q + kappa/8 tr C (h sum |p|^2)^2) + 2 s <|G|^2> + XYZ),              (4)
    Q = <2 sum e_I^2 + beta (sum e_I)^2 + sum g_IJ^2>,     beta = 2 lambda / (lambda + 2 mu).

beta is the value of plane stress, so a plate one cell thick bends correctly at any Poisson's ratio.
<|G|^2> is the mean square of the whole remainder G of the gradient. With its small share s, corners
of cells with little inside have some stiffness. XYZ is the square of the mode XYZ
(lattice.cell_moments). The quartic term, with the side h of a cell and C = <d d^T>, counts in cells
that are about to fold.

- W is a sum of squares: it is never negative, also in folded cells, and 0 for rigid motions.
- The quartic term is convex, and its Hessian at rest is 0. The projected Hessian leaves it out.
- Near rest W is at most mu V <|G|^2> (1 + 3 beta / 2) if d_x, d_y and d_z are not correlated. The
  general bound is in lattice.cell_moments.bounding_laplacians.
- Q is a quadratic form K in the nine a (3 axes, 3 modes), which depends on C and beta alone.

With r_I = sum over m of (K a)_I,m p_m, the gradient of Q / 2 has the parts

    dQ/dp_m = sum over I of (K a)_I,m n_I,        dQ/df_I = c r_I - b (f_I . r_I) f_I           (5)

with c = (1 + D) / (D + |f_I|^2) and b = 2 c^2 / (1 + D). If f_I changes by g, its direction changes
by c g - b (f_I . g) f_I, whose norm is at most c |g|. The projected Hessian keeps the directions
fixed: it is the form K of the changes n_I . dp. So the state of a projected Hessian needs no p.

Units: with the side h of a cell, the modes of a strain are 2 h^2 p and its slopes are 4 h F. A
state stores modes divided by 4 h, so that all products are in units of slopes.
"""

import math
from typing import TypeAlias

import numpy as np

from msmpetsc.backend.arrays import Floats
from msmpetsc.backend.kernel import njit
from msmpetsc.elasticity.cell_strain import Eight, Four, Modes, Seven, Strains
from msmpetsc.elasticity.vectors import (
    Three,
    Vector,
    added,
    combined,
    dot,
    each,
    inner,
    products,
    scaled,
    times,
    total,
    transposed,
)

# three vectors for each axis
NineVectors: TypeAlias = tuple[Three, Three, Three]


def _single(number: float) -> float:
    """Return a number in single precision, so that products with single numbers stay single."""
    return np.float32(number)  # type: ignore[return-value]


# D [-] of Eq. 1; bending and torsion of a single cell stretched by 0.7 to 1.5 are right
# within a factor of 2
SQUARE = _single(0.5)
# 1 + D [-]
RANGE = _single(1 + SQUARE)
# 2 s / (1 - s) [-]; with it a wall of a tenth of a cell bends 15 to 20% too little. A
# power of 2 is exact in single precision.
FULL = _single(1 / 256)
# 1 - s [-]; the factor of C in a cell's constants
ASSUMED = 2 / (2 + float(FULL))
# kappa [-] of Eq. 4; with it bars twisted by 720 degrees untwist when let go, and a
# cell bent to strains of 0.1 is stiffer by 1.5%
HARDENING = _single(2.0)
# smallest number to add to divisors that may be zero [-]
LEAST = _single(1e-30)


@njit(inline="always")
def modes_of(e: Strains) -> Three:
    """Return the modes XY, XZ and YZ of strains, a vector for each mode."""
    x, y, z = e
    return (x[3], y[3], z[3]), (x[4], y[4], z[4]), (x[5], y[5], z[5])


@njit(inline="always")
def slopes_of(e: Strains) -> Three:
    """Return the mean slopes of strains, a vector for each axis: 4 h times the columns of F."""
    x, y, z = e
    return (x[0], y[0], z[0]), (x[1], y[1], z[1]), (x[2], y[2], z[2])


# ---- directions


@njit(inline="always")
def _factor(f: Vector) -> float:
    return RANGE / (SQUARE + dot(f, f))


@njit(inline="always")
def factors(f: Three) -> Vector:
    """Return c of each column: the length of its direction (Eq. 1) over the column's length."""
    return _factor(f[0]), _factor(f[1]), _factor(f[2])


@njit(inline="always")
def directions(f: Three, c: Vector) -> Three:
    """Return the directions n (Eq. 1) of the columns f, from their factors c."""
    return scaled(c[0], f[0]), scaled(c[1], f[1]), scaled(c[2], f[2])


@njit(inline="always")
def _lag(c: float) -> float:
    """Return b of Eq. 5: a direction grows more slowly than its column."""
    return c * (c + c) / RANGE


@njit(inline="always")
def _turned(f: Vector, c: float, g: Vector) -> Vector:
    along = _lag(c) * dot(f, g)
    return c * g[0] - along * f[0], c * g[1] - along * f[1], c * g[2] - along * f[2]


@njit(inline="always")
def turned(f: Three, c: Vector, g: Three) -> Three:
    """Return the change of the directions as the columns f change by g.

    The map is symmetric, so it also takes forces on directions to forces on columns.
    """
    return _turned(f[0], c[0], g[0]), _turned(f[1], c[1], g[1]), _turned(f[2], c[2], g[2])


@njit(inline="always")
def _change_of_turned(f: Vector, c: float, r: Vector, g: Vector) -> Vector:
    b = _lag(c)
    fg, fr = b * dot(f, g), b * dot(f, r)
    along = (b + b) * (c + c) / RANGE * dot(f, r) * dot(f, g) - b * dot(g, r)
    return combined((along, -fg, -fr), (f, r, g))


@njit(inline="always")
def change_of_turned(f: Three, c: Vector, r: Three, g: Three) -> Three:
    """Return the change of ``turned(f, c, r)`` as the columns f change by g."""
    return (
        _change_of_turned(f[0], c[0], r[0], g[0]),
        _change_of_turned(f[1], c[1], r[1], g[1]),
        _change_of_turned(f[2], c[2], r[2], g[2]),
    )


# ---- the form K


@njit(inline="always")
def rest_constants(c: Floats, k: int) -> Eight:
    """Return 4 m (1 - s) C (6,) as xx, yy, zz, yz, xz, xy, then the constant of XYZ, and beta.

    c, k : constants of the cell, from index k on
    """
    # Avoid a division by zero in a cell without stiffness
    m, lame = c[k + 104], c[k + 112]
    beta = (lame + lame) / (lame + m + m + LEAST)
    return (
        c[k + 48], c[k + 56], c[k + 64], c[k + 72], c[k + 80], c[k + 88], c[k + 96], beta,
    )  # fmt: skip


@njit(inline="always")
def tensions(c: Eight, a: Three) -> Three:
    """Return K a: for each axis, its parts for the modes XY, XZ and YZ."""
    xx, yy, zz, yz, xz, xy, _, beta = c
    x, y, z = a
    # The sum of the e_I is d . s
    sx, sy, sz = y[0] + z[1], x[0] + z[2], x[1] + y[2]
    tx = beta * (xx * sx + xy * sy + xz * sz)
    ty = beta * (xy * sx + yy * sy + yz * sz)
    tz = beta * (xz * sx + yz * sy + zz * sz)
    # C_xx g_yz, C_yy g_xz and C_zz g_xy
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
def full_forces(c: Eight, e: Seven) -> Four:
    """Return the derivatives of the last two terms of W by a component's four modes."""
    xx, yy, zz, yz, xz, xy, xyz, _ = c
    return (
        FULL * ((xx + yy) * e[3] + yz * e[4] + xz * e[5]),
        FULL * (yz * e[3] + (xx + zz) * e[4] + xy * e[5]),
        FULL * (xz * e[3] + xy * e[4] + (yy + zz) * e[5]),
        xyz * e[6],
    )


@njit(inline="always")
def _hardening(c: Eight) -> float:
    """Return the factor of the quartic term of W."""
    return HARDENING * (c[0] + c[1] + c[2])


@njit(inline="always")
def _with_full(c: Eight, e: Strains, forces: Three) -> Modes:
    """Return the derivative of W by all modes, from the derivative of Q by XY, XZ and YZ."""
    x, y, z = full_forces(c, e[0]), full_forces(c, e[1]), full_forces(c, e[2])
    xy, xz, yz = forces
    return (
        (x[0] + xy[0], x[1] + xz[0], x[2] + yz[0], x[3]),
        (y[0] + xy[1], y[1] + xz[1], y[2] + yz[1], y[3]),
        (z[0] + xy[2], z[1] + xz[2], z[2] + yz[2], z[3]),
    )


# ---- gradient, Hessian and change


@njit(inline="always")
def rest_gradient(c: Eight, f: Three, e: Strains, inverse_h4: float) -> tuple[Three, Modes]:
    """Return the derivatives of W (Eq. 5) by 4 h times the columns of F, and by the modes (3 x 4).

    f          : columns of F
    e          : strains of positions
    inverse_h4 : 1 / (4 h)
    """
    p, factor = modes_of(e), factors(f)
    n = directions(f, factor)
    t = tensions(c, products(n, p))
    slopes = times(inverse_h4, turned(f, factor, each(t, p)))
    hardening = _hardening(c) * inverse_h4 * inverse_h4 * inner(p, p)
    forces = total(each(transposed(t), n), times(hardening, p))
    return slopes, _with_full(c, e, forces)


@njit(inline="always")
def rest_product(c: Eight, f: Three, p: Three, e: Strains) -> tuple[Three, Modes]:
    """Return the product of the Hessian of W with a displacement, in the form of ``rest_gradient``.

    f : columns of F
    p : modes of positions over 4 h
    e : strains of the displacement
    """
    h, g, factor = modes_of(e), slopes_of(e), factors(f)
    n, m = directions(f, factor), turned(f, factor, g)
    s = tensions(c, products(n, p))
    t = tensions(c, total(products(n, h), products(m, p)))
    slopes = total(
        turned(f, factor, total(each(t, p), each(s, h))),
        change_of_turned(f, factor, each(s, p), g),
    )
    hardening = _hardening(c)
    along = hardening * inner(p, h)
    hard = total(times(hardening * inner(p, p), h), times(along + along, p))
    forces = total(total(each(transposed(t), n), each(transposed(s), m)), hard)
    return slopes, _with_full(c, e, forces)


@njit(inline="always")
def projected_modes(c: Eight, f: Three, e: Strains) -> Modes:
    """Return the modes (3 x 4) of the product of W's projected Hessian with a displacement.

    The directions are fixed, so the product has no slopes.

    f : columns of F
    e : strains of the displacement
    """
    n = directions(f, factors(f))
    t = tensions(c, products(n, modes_of(e)))
    return _with_full(c, e, each(transposed(t), n))


@njit(inline="always")
def _change_of_direction(f: Vector, g: Vector) -> Vector:
    """Return the change of a direction as its column f changes by g, accurate for a small g.

    n' - n = c' g + (c' - c) f,    c' - c = -c c' / (1 + D) g . (f + f').
    """
    after = added(f, g)
    c = _factor(after)
    along = -_factor(f) * c / RANGE * dot(g, added(f, after))
    return added(scaled(c, g), scaled(along, f))


@njit(inline="always")
def rest_change(c: Eight, f: Three, g: Three, e: Strains, d: Strains, inverse_h4: float) -> float:
    """Return the change of W as columns f change by g and strains e by d, accurate for small d.

    Q(a') - Q(a) = (a' - a) . K (a' + a), and likewise for the other squares.
    """
    p, moved = modes_of(e), modes_of(d)
    n = directions(f, factors(f))
    m = (
        _change_of_direction(f[0], g[0]),
        _change_of_direction(f[1], g[1]),
        _change_of_direction(f[2], g[2]),
    )
    changes = total(products(m, total(p, moved)), products(n, moved))
    t = tensions(c, total(products(n, p), times(0.5, changes)))
    change = inner(changes, t)
    # q'^2 - q^2 = (q' - q) (q' + q), with q = p . p
    growth = inner(moved, total(p, total(p, moved)))
    hardening = 0.25 * _hardening(c) * inverse_h4 * inverse_h4
    change += hardening * growth * (2.0 * inner(p, p) + growth)
    for i in range(3):
        forces, own, before = full_forces(c, d[i]), d[i], e[i]
        change += forces[0] * (before[3] + 0.5 * own[3]) + forces[1] * (before[4] + 0.5 * own[4])
        change += forces[2] * (before[5] + 0.5 * own[5]) + forces[3] * (before[6] + 0.5 * own[6])
    return change


# ---- for multigrid and for the proof of a minimum


@njit(inline="always")
def corner_tensions(c: Eight, f: Three, g: Seven) -> NineVectors:
    """Return the tensions that a corner's displacement v causes, with directions fixed.

    Entry [I][m] of the result is a vector y (3,): the tension (K a)_I,m is y . v.

    f : columns of F
    g : ``corner_strain`` of the corner
    """
    n, h, zero = directions(f, factors(f)), (g[3], g[4], g[5]), (0.0, 0.0, 0.0)
    # A displacement along n_J has the a (3,) of axis J alone
    x, y, z = (
        tensions(c, (h, zero, zero)),
        tensions(c, (zero, h, zero)),
        tensions(c, (zero, zero, h)),
    )
    return (
        each(transposed((x[0], y[0], z[0])), n),
        each(transposed((x[1], y[1], z[1])), n),
        each(transposed((x[2], y[2], z[2])), n),
    )


@njit(inline="always")
def rest_concavity(
    c: Eight,
    f: Three,
    e: Strains,
    inverse_h4: float,
    left: float,
    spectrum: tuple[float, float],
) -> tuple[float, float]:
    """Return a, b >= 0: the Hessian of W plus ``left`` |G|^2 is at least -a |G|^2 - b |h|^2.

    G are the slopes of a displacement, h its modes, and m the change of the directions. In units of
    slopes the Hessian's form is K(n . h + m . p) + 2 (K a) (m . h), plus a term from the change of
    m. Three bounds hold, with c the greatest factor of a column:

    - 2 (K a)(m . h) <= 2 c |K a| |G| |h|
    - K(x + y) >= K(x) / 2 - K(y); K lies between its least and its greatest eigenvalue
    - the last term is at most b |f| |r| sqrt(max(2, 1 + (4 u - 3)^2)) |g|^2 in each column. Here
      u = |f|^2 / (D + |f|^2).

    So the form is at least A |G|^2 - 2 X |G| |h| + B |h|^2, which is semidefinite if A B >= X^2.

    spectrum : least and greatest eigenvalue of C in the constants
    """
    p, factor = times(inverse_h4, modes_of(e)), factors(f)
    n = directions(f, factor)
    t = tensions(c, products(n, p))
    r = each(t, p)
    largest, turning = max(factor[0], max(factor[1], factor[2])), 0.0
    for i in range(3):
        square = dot(f[i], f[i])
        u = square / (SQUARE + square)
        shape = max(2.0, 1.0 + (4.0 * u - 3.0) ** 2)
        change = _lag(factor[i]) * math.sqrt(square * dot(r[i], r[i]) * shape)
        turning = max(turning, change)
    least, greatest = spectrum
    greatest *= max(2.0 + 2.0 * c[7], 4.0)
    # Gershgorin's bound of the least eigenvalue of n_I . n_J
    xy, xz, yz = abs(dot(n[0], n[1])), abs(dot(n[0], n[2])), abs(dot(n[1], n[2]))
    x, y, z = dot(n[0], n[0]) - xy - xz, dot(n[1], n[1]) - xy - yz, dot(n[2], n[2]) - xz - yz
    frame = max(min(x, min(y, z)), 0.0)
    of_slopes = left - turning - greatest * largest * largest * inner(p, p)
    of_modes = 0.5 * least * frame
    mixed = largest * math.sqrt(inner(t, t))
    a = max(mixed - of_slopes, 0.0)
    b = max(mixed * mixed / max(of_slopes + a, float(LEAST)) - of_modes, 0.0)
    return a, b
