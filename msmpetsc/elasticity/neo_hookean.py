"""Neo-Hookean solid: the energy of a cell, its gradient and its Hessian.

A cell has Lame's constants mu and lambda and the volume V inside the surface. F is the mean
deformation gradient over that volume, J = det F. The energy is

    E = V (mu/2 (|F|^2 - 3) + U(J)) + W,        U(J) = -mu ln J + lambda u(J)

for J above J_0 (Bonet and Wood 2008, Eq. 6.27; Smith, de Goes and Kim 2018 on the logarithm). Below
J_0, U is continued by its Taylor polynomial of second order. W is the energy of bending and twist
within the cell (elasticity.assumed_strain). The volumetric energy u is

    quadratic    (J - 1)^2 / 2
    log          (ln J)^2 / 2
    simo         (J^2 - 1 - 2 ln J) / 4        (Simo and Taylor 1982)

- L in A = M + t^2 L is 2 mu + 3 lambda times the integral of |grad x|^2, or more
  (lattice.cell_moments.bounding_laplacians): A dominates the Hessian.
- U'' > 0, but for ``log`` above J = e^(1 + mu / lambda). So an inverted cell is pushed back.
- The second variation at rest is not negative, however the cell is cut. For a mean slope G
  it is ``2 mu |sym G|^2 + lambda (tr G)^2`` plus the squares of W.

But for W the Hessian of a cell maps G to  V (mu G + U'' (cof F : G) cof F + U' F x G),  where
F x G is the change of cof F. In the singular frame of F, with the singular values s, it splits
into blocks:

- 2 x 2 blocks [mu, -U' s_k; -U' s_k, mu];
- a 3 x 3 block: sum (mu s_i^2 - U' J) y_i^2 + (U'' J^2 + U' J) (sum y_i)^2 with y_i = x_i / s_i.
  It is not negative if U' < 0, J >= 1/2 and U'' >= 0, for each u.

For all other F the term of U' is at most |U'| R |F| in norm, with R^2 = 4/3. The reason is that
the traceless matrix of s has the norm sqrt(2) |F|. The projected Hessian limits |U'| so that mu
outweighs this term, and raises U'' to zero.

The loops of a CPU (elasticity.cell_lanes) and of a GPU (elasticity.cell_threads) share these
formulas. A Hessian stores F, V U' and V U'' of each cell, and its modes unless it is projected.
A cell's constants are scaled with V.
"""

import math

from msmpetsc.backend.arrays import Floats
from msmpetsc.backend.kernel import njit
from msmpetsc.elasticity.assumed_strain import (
    Three,
    columns,
    full_forces,
    projected_modes,
    rest_change,
    rest_concavity,
    rest_constants,
    rest_gradient,
    rest_product,
)
from msmpetsc.elasticity.cell_strain import Eight, Modes, Nine, Seven, Strains
from msmpetsc.elasticity.springs import Vector

# Names of the volumetric energies u; kernels have their numbers
VOLUMETRIC = ("quadratic", "log", "simo")
QUADRATIC, LOG, SIMO = range(len(VOLUMETRIC))
# J_0 [-]; U is a parabola below, so that the force on an inverted cell stays finite
ONSET = 0.2
# least J [-] at which compression keeps the 3 x 3 block semidefinite; see above
CONVEX = 0.5
# R, bound of the norm of G -> F x G by |F| [-]; see above
NORM = math.sqrt(4 / 3)
# iterations towards a cell's rotation [-]; Newton's method converges from any J > 0
ROTATION_ITERATIONS = 30
# change of a rotation at which its iteration ends [-]; close to rounding
ROTATION_TOLERANCE = 1e-12


@njit(inline="always")
def cofactors(f: Nine) -> Nine:
    """Return the cofactors cof F (9,) of a matrix F (9,), both by rows."""
    return (
        f[4] * f[8] - f[5] * f[7],
        f[5] * f[6] - f[3] * f[8],
        f[3] * f[7] - f[4] * f[6],
        f[2] * f[7] - f[1] * f[8],
        f[0] * f[8] - f[2] * f[6],
        f[1] * f[6] - f[0] * f[7],
        f[1] * f[5] - f[2] * f[4],
        f[2] * f[3] - f[0] * f[5],
        f[0] * f[4] - f[1] * f[3],
    )


@njit(inline="always")
def determinant(f: Nine, n: Nine) -> float:
    """Return det F from the first rows of F and of its cofactors n."""
    return f[0] * n[0] + f[1] * n[1] + f[2] * n[2]


@njit(inline="always")
def _inner(a: Nine, b: Nine) -> float:
    rows = a[0] * b[0] + a[1] * b[1] + a[2] * b[2], a[3] * b[3] + a[4] * b[4] + a[5] * b[5]
    return rows[0] + rows[1] + (a[6] * b[6] + a[7] * b[7] + a[8] * b[8])


@njit(inline="always")
def _change_of_cofactors(f: Nine, g: Nine) -> Nine:
    """Return F x G, the derivative of cof F in the direction G."""
    return (
        f[4] * g[8] + g[4] * f[8] - f[5] * g[7] - g[5] * f[7],
        f[5] * g[6] + g[5] * f[6] - f[3] * g[8] - g[3] * f[8],
        f[3] * g[7] + g[3] * f[7] - f[4] * g[6] - g[4] * f[6],
        f[2] * g[7] + g[2] * f[7] - f[1] * g[8] - g[1] * f[8],
        f[0] * g[8] + g[0] * f[8] - f[2] * g[6] - g[2] * f[6],
        f[1] * g[6] + g[1] * f[6] - f[0] * g[7] - g[0] * f[7],
        f[1] * g[5] + g[1] * f[5] - f[2] * g[4] - g[2] * f[4],
        f[2] * g[3] + g[2] * f[3] - f[0] * g[5] - g[0] * f[5],
        f[0] * g[4] + g[0] * f[4] - f[1] * g[3] - g[1] * f[3],
    )


@njit(inline="always")
def _volumetric_slopes(j: float, u: int) -> tuple[float, float]:
    """Return u' and u'' at J = j, for the volumetric energy of number u."""
    slope, curvature = j - 1.0, 1.0
    if u == LOG:
        slope, curvature = math.log(j) / j, (1.0 - math.log(j)) / (j * j)
    elif u == SIMO:
        slope, curvature = 0.5 * (j - 1.0 / j), 0.5 + 0.5 / (j * j)
    return slope, curvature


@njit(inline="always")
def _volumetric_change(j: float, before: float, change: float, u: int) -> float:
    """Return u(j) - u(before) with the digits of ``change`` = j - before."""
    if u == QUADRATIC:
        return 0.5 * change * (j + before - 2.0)
    growth = math.log1p(change / before)
    if u == LOG:
        return 0.5 * growth * math.log(j * before)
    return 0.25 * change * (j + before) - 0.5 * growth


@njit(inline="always")
def _slopes(j: float, mu: float, lame: float, u: int) -> tuple[float, float]:
    """Return U' and U'' [Pa] at J = j."""
    above = max(j, ONSET)
    slope, bend = _volumetric_slopes(above, u)
    curvature = mu / (above * above) + lame * bend
    return lame * slope - mu / above + curvature * (j - above), curvature


@njit(inline="always")
def volume_energy(j: float, mu: float, lame: float, u: int) -> float:
    """Return U [Pa] at J = j."""
    above = max(j, ONSET)
    below = j - above
    slope, curvature = _slopes(above, mu, lame, u)
    return (
        lame * _volumetric_change(above, 1.0, above - 1.0, u)
        - mu * math.log(above)
        + below * (slope + 0.5 * curvature * below)
    )


@njit(inline="always")
def volume_change(j: float, before: float, change: float, mu: float, lame: float, u: int) -> float:
    """Return U(j) - U(before) [Pa] with the digits of ``change`` = j - before."""
    if j >= ONSET and before >= ONSET:
        change_of_u = _volumetric_change(j, before, change, u)
        return lame * change_of_u - mu * math.log1p(change / before)
    if j < ONSET and before < ONSET:
        slope, curvature = _slopes(ONSET, mu, lame, u)
        return change * (slope + 0.5 * curvature * (j + before - 2.0 * ONSET))
    return volume_energy(j, mu, lame, u) - volume_energy(before, mu, lame, u)


@njit(inline="always")
def _coupling_bound(f: Nine, j: float, slope: float, least: float) -> float:
    """Return a bound c: the term of U' in the Hessian takes at most c |U'| from mu.

    Under compression (U' < 0) with J >= ``least`` the 3 x 3 block needs no bound. Then c is
    Gershgorin's bound of the largest singular value of F, exact in a rotation. Otherwise c is R
    |F|.
    """
    xx = f[0] ** 2 + f[3] ** 2 + f[6] ** 2
    yy = f[1] ** 2 + f[4] ** 2 + f[7] ** 2
    zz = f[2] ** 2 + f[5] ** 2 + f[8] ** 2
    xy = abs(f[0] * f[1] + f[3] * f[4] + f[6] * f[7])
    xz = abs(f[0] * f[2] + f[3] * f[5] + f[6] * f[8])
    yz = abs(f[1] * f[2] + f[4] * f[5] + f[7] * f[8])
    largest = math.sqrt(max(xx + xy + xz, yy + xy + yz, zz + xz + yz))
    norm = math.sqrt(xx + yy + zz)
    return largest if slope < 0.0 and j >= least else NORM * norm


@njit(inline="always")
def _times(a: float, x: Nine) -> Nine:
    return a * x[0], a * x[1], a * x[2], a * x[3], a * x[4], a * x[5], a * x[6], a * x[7], a * x[8]


@njit(inline="always")
def _plus(x: Nine, a: float, y: Nine) -> Nine:
    """Return x + a y."""
    return (
        x[0] + a * y[0], x[1] + a * y[1], x[2] + a * y[2],
        x[3] + a * y[3], x[4] + a * y[4], x[5] + a * y[5],
        x[6] + a * y[6], x[7] + a * y[7], x[8] + a * y[8],
    )  # fmt: skip


@njit(inline="always")
def _sum(x: Nine, y: Nine) -> Nine:
    return (
        x[0] + y[0], x[1] + y[1], x[2] + y[2],
        x[3] + y[3], x[4] + y[4], x[5] + y[5],
        x[6] + y[6], x[7] + y[7], x[8] + y[8],
    )  # fmt: skip


@njit(inline="always")
def _slope_of(e: Strains) -> Nine:
    """Return 4 h times the mean slope (9,) by rows, from the strains of three components."""
    a, b, c = e
    return a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2]


@njit(inline="always")
def gradient_of(e: Strains, inverse_h4: float) -> Nine:
    """Return F (9,) from the strains of positions; ``inverse_h4`` is 1 / (4 h)."""
    return _times(inverse_h4, _slope_of(e))


@njit(inline="always")
def kept_gradient(state: Floats, s: int) -> Nine:
    """Return F (9,) of the cell whose entries begin at ``state[s]``."""
    return (
        state[s], state[s + 8], state[s + 16],
        state[s + 24], state[s + 32], state[s + 40],
        state[s + 48], state[s + 56], state[s + 64],
    )  # fmt: skip


@njit(inline="always")
def kept_modes(state: Floats, s: int) -> Three:
    """Return the modes XY, XZ and YZ over 4 h of the cell whose entries begin at ``state[s]``."""
    return (
        (state[s + 88], state[s + 96], state[s + 104]),
        (state[s + 112], state[s + 120], state[s + 128]),
        (state[s + 136], state[s + 144], state[s + 152]),
    )


@njit(inline="always")
def slope_gradient(e: Strains, m: float, lame: float, h4: float, u: int) -> Nine:
    """Return the derivative (9,) of E with respect to 4 h times the mean slope."""
    g, inverse_h4 = _slope_of(e), 1.0 / h4
    n = cofactors(g)
    j = determinant(g, n) * (inverse_h4 * inverse_h4 * inverse_h4)
    return _plus(_times(m, g), inverse_h4 * _slopes(j, m, lame, u)[0], n)


@njit(inline="always")
def slope_product(e: Strains, m: float, state: Floats, s: int) -> Nine:
    """Return the product of the Hessian of E with a displacement (9,), by the mean slope.

    It is the derivative of ``slope_gradient``, in terms of 4 h times the mean slope.

    e        : strains of the displacement
    m        : V mu / (16 h^2)
    state, s : entries of ``write_state``, from index s on
    """
    f, g = kept_gradient(state, s), _slope_of(e)
    n = cofactors(f)
    along = state[s + 80] * _inner(n, g)
    return _plus(_plus(_times(m, g), along, n), state[s + 72], _change_of_cofactors(f, g))


@njit(inline="always")
def cell_gradient(
    rest: Eight, m: float, lame: float, e: Strains, h4: float, u: int
) -> tuple[Nine, Modes]:
    """Return the gradient of E by 4 h times the mean slopes (9,) and by the modes (3 x 4).

    The constants are not in an array, because numba would then not vectorise loops over cells.

    rest    : ``rest_constants``
    m, lame : V mu and V lambda over 16 h^2
    e       : strains of positions
    u       : number of the volumetric energy
    """
    slopes = slope_gradient(e, m, lame, h4, u)
    turning, modes = rest_gradient(rest, columns(gradient_of(e, 1.0 / h4)), e, 1.0 / h4)
    return _sum(slopes, turning), modes


@njit(inline="always")
def cell_product(c: Floats, k: int, state: Floats, s: int, e: Strains) -> tuple[Nine, Modes]:
    """Return the product of the Hessian of E with a displacement of strains e.

    It is the derivative of ``cell_gradient``.

    state, s : entries of ``write_state``, from index s on
    """
    slopes = slope_product(e, c[k + 104], state, s)
    f, p = columns(kept_gradient(state, s)), kept_modes(state, s)
    turning, modes = rest_product(rest_constants(c, k), f, p, e)
    return _sum(slopes, turning), modes


@njit(inline="always")
def projected_product(c: Floats, k: int, state: Floats, s: int, e: Strains) -> tuple[Nine, Modes]:
    """Return ``cell_product`` of a state without modes."""
    slopes = slope_product(e, c[k + 104], state, s)
    return slopes, projected_modes(rest_constants(c, k), columns(kept_gradient(state, s)), e)


@njit(inline="always")
def forms_change(
    c: Floats, k: int, d: Nine, base: Strains, moved: Strains, inverse_h4: float
) -> float:
    """Return the change of E but for U as F changes by d and the strains by ``moved``."""
    g, f = _slope_of(moved), columns(gradient_of(base, inverse_h4))
    own: float = c[k + 104] * (_inner(_slope_of(base), g) + 0.5 * _inner(g, g))
    rest = rest_constants(c, k)
    return own + rest_change(rest, f, columns(d), base, moved, inverse_h4)


@njit(inline="always")
def write_state(store: Floats, s: int, f: Nine, slope: float, curvature: float) -> None:
    """Write F, V U' and V U'' of a cell into ``store`` from index s, for its Hessian."""
    store[s], store[s + 8], store[s + 16] = f[0], f[1], f[2]
    store[s + 24], store[s + 32], store[s + 40] = f[3], f[4], f[5]
    store[s + 48], store[s + 56], store[s + 64] = f[6], f[7], f[8]
    store[s + 72], store[s + 80] = slope, curvature


@njit(inline="always")
def write_modes(store: Floats, s: int, e: Strains, inverse_h4: float) -> None:
    """Write the modes over 4 h of the strains e of positions into ``store``, from index s + 88."""
    for i in range(3):
        store[s + 88 + 8 * i] = inverse_h4 * e[i][3]
        store[s + 112 + 8 * i] = inverse_h4 * e[i][4]
        store[s + 136 + 8 * i] = inverse_h4 * e[i][5]


@njit(inline="always")
def slopes_at(f: Nine, mu: float, lame: float, u: int, projected: bool) -> tuple[float, float]:
    """Return U' and U'' at F.

    If ``projected``, U'' is not negative, and |U'| is limited so that mu outweighs it.
    """
    n = cofactors(f)
    j = determinant(f, n)
    slope, curvature = _slopes(j, mu, lame, u)
    if projected:
        curvature = max(curvature, 0.0)
        limit = mu / _coupling_bound(f, j, slope, ONSET)
        slope = min(max(slope, -limit), limit)
    return slope, curvature


@njit(inline="always")
def concavity_bounds(c: Floats, k: int, e: Strains, h4: float, u: int) -> tuple[float, float]:
    """Return a, b >= 0: the Hessian's form is at least -a |G|^2 - b |h|^2.

    G are the slopes of a displacement, and h its modes XY, XZ and YZ. mu outweighs a part of the
    terms of U' and of W (elasticity.assumed_strain).

    e : strains of positions
    """
    f, mu, lame = gradient_of(e, 1.0 / h4), c[k + 104], c[k + 112]
    if not mu > 0.0:
        return 0.0, 0.0
    n = cofactors(f)
    j = determinant(f, n)
    slope, curvature = _slopes(j, mu, lame, u)
    left = mu - abs(slope) * _coupling_bound(f, j, slope, CONVEX)
    left += min(curvature, 0.0) * _inner(n, n)
    return rest_concavity(rest_constants(c, k), columns(f), e, 1.0 / h4, left)


@njit(inline="always")
def rotation_of(f: Nine) -> tuple[Nine, bool]:
    """Return the rotation R of F = R S, and whether it was computed.

    Newton's iteration is R <- (R + R^-T) / 2 (Higham 1986). If J <= J_0, R is the identity.
    """
    if not determinant(f, cofactors(f)) > ONSET:
        return (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0), False
    for _ in range(ROTATION_ITERATIONS):
        n = cofactors(f)
        step = _plus(_times(-0.5, f), 0.5 / determinant(f, n), n)
        f = _plus(f, 1.0, step)
        if not _inner(step, step) > ROTATION_TOLERANCE * ROTATION_TOLERANCE:
            break
    return f, True


@njit(inline="always")
def determinant_and_change(d: Nine, f: Nine) -> tuple[float, float]:
    """Return det F and the change of it, det(F + D) - det F, with the digits of a small D.

    The change is cof F : D + F : cof D + det D.
    """
    n, n_d = cofactors(f), cofactors(d)
    return determinant(f, n), _inner(n, d) + _inner(f, n_d) + determinant(d, n_d)


@njit(inline="always")
def kept_cofactors(state: Floats, s: int) -> Nine:
    """Return cof F (9,) of the cell whose entries begin at ``state[s]``."""
    return cofactors(kept_gradient(state, s))


@njit(inline="always")
def along_cofactors(n: Nine, g: Seven) -> Vector:
    """Return cof F g (3,), with g the mean slope of a strain and n = cof F."""
    return (
        n[0] * g[0] + n[1] * g[1] + n[2] * g[2],
        n[3] * g[0] + n[4] * g[1] + n[5] * g[2],
        n[6] * g[0] + n[7] * g[1] + n[8] * g[2],
    )


@njit(inline="always")
def corner_stiffness(g: Seven, c: Floats, k: int) -> float:
    """Return the factor of I in a corner's diagonal block, from its ``corner_strain`` g."""
    x, y, z, v = full_forces(rest_constants(c, k), g)
    own: float = c[k + 104] * (g[0] * g[0] + g[1] * g[1] + g[2] * g[2])
    return own + x * g[3] + y * g[4] + z * g[5] + v * g[6]
