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
- U'' > 0, except for ``log`` above J = e^(1 + mu / lambda). So an inverted cell is pushed back.
- The second variation at rest is not negative, however the cell is cut. For a mean slope G
  it is ``2 mu |sym G|^2 + lambda (tr G)^2`` plus the squares of W.

Without W the Hessian of a cell maps G to  V (mu G + U'' (cof F : G) cof F + U' F x G),  where
F x G is the change of cof F by G. In the singular frame of F, with the singular values s, it
splits into blocks:

- 2 x 2 blocks [mu, -U' s_k; -U' s_k, mu];
- a 3 x 3 block: sum (mu s_i^2 - U' J) y_i^2 + (U'' J^2 + U' J) (sum y_i)^2 with y_i = x_i / s_i.
  It is not negative if U' < 0, J >= 1/2 and U'' >= 0, for each u.

For all other F the term of U' is at most |U'| R |F| in norm, with R^2 = 4/3. The reason: its 3 x 3
block is symmetric and traceless and has the Frobenius norm sqrt(2) |U'| |F|. The projected Hessian
limits |U'| so that mu outweighs this term, and raises negative U'' to zero. If U' < 0 and
J >= J_0, the limit for the 2 x 2 blocks suffices for the 3 x 3 block, too.

The loops of a CPU (elasticity.cell_lanes) and of a GPU (elasticity.cell_threads) share these
formulas. A Hessian stores F, V U' and V U'' of each cell. Unless it is projected, it also stores
the cell's modes. A cell's constants are scaled with V.
"""

import math

from msmpetsc.backend.arrays import Floats
from msmpetsc.backend.kernel import njit
from msmpetsc.elasticity.assumed_strain import (
    full_forces,
    projected_modes,
    rest_change,
    rest_concavity,
    rest_constants,
    rest_gradient,
    rest_product,
    slopes_of,
)
from msmpetsc.elasticity.cell_strain import Eight, Modes, Seven, Strains
from msmpetsc.elasticity.vectors import (
    Three,
    change_of_cofactors,
    cofactors,
    dot,
    inner,
    times,
    total,
)

# Names of the volumetric energies u; kernels have their numbers
VOLUMETRIC = ("quadratic", "log", "simo")
QUADRATIC, LOG, SIMO = range(len(VOLUMETRIC))
# J_0 [-]; below it U is a parabola, so that the force on an inverted cell stays finite
ONSET = 0.2
# least J at which, with U' < 0, the 3 x 3 block of the true Hessian is semidefinite
# [-]; see above
CONVEX = 0.5
# R, bound of the norm of the map from G to F x G over |F| [-]; see above
NORM = math.sqrt(4 / 3)
# iterations for a cell's rotation [-]; each halves the largest stretch if it is large
ROTATION_ITERATIONS = 30


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
    """Return u(j) - u(before), accurate for a small ``change`` = j - before."""
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
    """Return U(j) - U(before) [Pa], accurate for a small ``change`` = j - before."""
    if j >= ONSET and before >= ONSET:
        change_of_u = _volumetric_change(j, before, change, u)
        return lame * change_of_u - mu * math.log1p(change / before)
    if j < ONSET and before < ONSET:
        slope, curvature = _slopes(ONSET, mu, lame, u)
        return change * (slope + 0.5 * curvature * (j + before - 2.0 * ONSET))
    return volume_energy(j, mu, lame, u) - volume_energy(before, mu, lame, u)


@njit(inline="always")
def _coupling_bound(f: Three, j: float, slope: float, least: float) -> float:
    """Return a bound c: the term of U' lowers the eigenvalues of the Hessian by at most c |U'|.

    If U' < 0 and J >= ``least``, the 3 x 3 block needs no bound. Then c is Gershgorin's bound of
    the largest singular value of F, which is exact for a rotation. Otherwise c is R |F|.
    """
    x, y, z = f
    xx, yy, zz = dot(x, x), dot(y, y), dot(z, z)
    xy, xz, yz = abs(dot(x, y)), abs(dot(x, z)), abs(dot(y, z))
    largest = math.sqrt(max(xx + xy + xz, yy + xy + yz, zz + xz + yz))
    return largest if slope < 0.0 and j >= least else NORM * math.sqrt(xx + yy + zz)


@njit(inline="always")
def gradient_of(e: Strains, inverse_h4: float) -> Three:
    """Return F from the strains of positions; ``inverse_h4`` is 1 / (4 h)."""
    return times(inverse_h4, slopes_of(e))


@njit(inline="always")
def kept_gradient(state: Floats, s: int) -> Three:
    """Return F of the cell whose entries begin at ``state[s]``."""
    return (
        (state[s], state[s + 24], state[s + 48]),
        (state[s + 8], state[s + 32], state[s + 56]),
        (state[s + 16], state[s + 40], state[s + 64]),
    )


@njit(inline="always")
def kept_modes(state: Floats, s: int) -> Three:
    """Return the modes XY, XZ and YZ over 4 h of the cell whose entries begin at ``state[s]``."""
    return (
        (state[s + 88], state[s + 96], state[s + 104]),
        (state[s + 112], state[s + 120], state[s + 128]),
        (state[s + 136], state[s + 144], state[s + 152]),
    )


@njit(inline="always")
def slope_product(e: Strains, m: float, state: Floats, s: int) -> Three:
    """Return the slopes of the product of the Hessian of E - W with a displacement.

    e        : strains of the displacement
    m        : V mu / (16 h^2)
    state, s : entries of ``write_state``, from index s on
    """
    f, g = kept_gradient(state, s), slopes_of(e)
    n = cofactors(f)
    stretched = times(state[s + 80] * inner(n, g), n)
    turned = times(state[s + 72], change_of_cofactors(f, g))
    return total(total(times(m, g), stretched), turned)


@njit(inline="always")
def cell_gradient(
    rest: Eight, m: float, lame: float, e: Strains, h4: float, u: int
) -> tuple[Three, Modes]:
    """Return the derivatives of E by 4 h times the columns of F, and by the modes (3 x 4).

    The constants are numbers, not an array, because numba would not vectorise loops over cells
    with an array.

    rest    : ``rest_constants``
    m, lame : V mu and V lambda over 16 h^2
    e       : strains of positions
    u       : number of the volumetric energy
    """
    g, inverse_h4 = slopes_of(e), 1.0 / h4
    n = cofactors(g)
    j = dot(g[0], n[0]) * (inverse_h4 * inverse_h4 * inverse_h4)
    slopes = total(times(m, g), times(inverse_h4 * _slopes(j, m, lame, u)[0], n))
    turning, modes = rest_gradient(rest, gradient_of(e, inverse_h4), e, inverse_h4)
    return total(slopes, turning), modes


@njit(inline="always")
def cell_product(c: Floats, k: int, state: Floats, s: int, e: Strains) -> tuple[Three, Modes]:
    """Return the product of the Hessian of E with a displacement of strains e.

    The product is the derivative of ``cell_gradient``.

    state, s : entries of ``write_state`` and ``write_modes``, from index s on
    """
    slopes = slope_product(e, c[k + 104], state, s)
    f, p = kept_gradient(state, s), kept_modes(state, s)
    turning, modes = rest_product(rest_constants(c, k), f, p, e)
    return total(slopes, turning), modes


@njit(inline="always")
def projected_product(c: Floats, k: int, state: Floats, s: int, e: Strains) -> tuple[Three, Modes]:
    """Return the product of the projected Hessian of E with a displacement of strains e."""
    slopes = slope_product(e, c[k + 104], state, s)
    return slopes, projected_modes(rest_constants(c, k), kept_gradient(state, s), e)


@njit(inline="always")
def forms_change(
    c: Floats, k: int, d: Three, base: Strains, moved: Strains, inverse_h4: float
) -> float:
    """Return the change of E without U, as F changes by d and the strains ``base`` by ``moved``."""
    g, f = slopes_of(moved), gradient_of(base, inverse_h4)
    own: float = c[k + 104] * (inner(slopes_of(base), g) + 0.5 * inner(g, g))
    return own + rest_change(rest_constants(c, k), f, d, base, moved, inverse_h4)


@njit(inline="always")
def write_state(store: Floats, s: int, f: Three, slope: float, curvature: float) -> None:
    """Write F by rows, V U' and V U'' of a cell into ``store``, from index s on."""
    x, y, z = f
    store[s], store[s + 8], store[s + 16] = x[0], y[0], z[0]
    store[s + 24], store[s + 32], store[s + 40] = x[1], y[1], z[1]
    store[s + 48], store[s + 56], store[s + 64] = x[2], y[2], z[2]
    store[s + 72], store[s + 80] = slope, curvature


@njit(inline="always")
def write_modes(store: Floats, s: int, e: Strains, inverse_h4: float) -> None:
    """Write the modes of strains e over 4 h into ``store``, from index s + 88 on."""
    for i in range(3):
        store[s + 88 + 8 * i] = inverse_h4 * e[i][3]
        store[s + 112 + 8 * i] = inverse_h4 * e[i][4]
        store[s + 136 + 8 * i] = inverse_h4 * e[i][5]


@njit(inline="always")
def slopes_at(f: Three, mu: float, lame: float, u: int, projected: bool) -> tuple[float, float]:
    """Return U' and U'' at F, in the unit of mu.

    If ``projected``, U'' is not negative, and |U'| is limited so that mu outweighs its term.
    """
    j = dot(f[0], cofactors(f)[0])
    slope, curvature = _slopes(j, mu, lame, u)
    if projected:
        curvature = max(curvature, 0.0)
        limit = mu / _coupling_bound(f, j, slope, ONSET)
        slope = min(max(slope, -limit), limit)
    return slope, curvature


@njit(inline="always")
def concavity_bounds(
    c: Floats, k: int, e: Strains, h4: float, u: int, spectrum: tuple[float, float]
) -> tuple[float, float]:
    """Return a, b >= 0: the Hessian's form is at least -a |G|^2 - b |h|^2.

    G are the slopes of a displacement, and h its modes XY, XZ and YZ. The bound uses that mu
    outweighs a part of the terms of U' and W (elasticity.assumed_strain).

    e        : strains of positions
    spectrum : least and greatest eigenvalue of C
    """
    f, mu, lame = gradient_of(e, 1.0 / h4), c[k + 104], c[k + 112]
    if not mu > 0.0:
        return 0.0, 0.0
    n = cofactors(f)
    j = dot(f[0], n[0])
    slope, curvature = _slopes(j, mu, lame, u)
    left = mu - abs(slope) * _coupling_bound(f, j, slope, CONVEX)
    left += min(curvature, 0.0) * inner(n, n)
    return rest_concavity(rest_constants(c, k), f, e, 1.0 / h4, left, spectrum)


@njit(inline="always")
def rotation_of(f: Three) -> tuple[Three, bool]:
    """Return the rotation R of the polar decomposition F = R S, and whether it exists.

    Newton's iteration is R <- (R + R^-T) / 2 (Higham 1986). If J <= J_0, return the identity and
    False.
    """
    if not dot(f[0], cofactors(f)[0]) > ONSET:
        return ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), False
    for _ in range(ROTATION_ITERATIONS):
        n = cofactors(f)
        f = total(times(0.5, f), times(0.5 / dot(f[0], n[0]), n))
    return f, True


@njit(inline="always")
def determinant_and_change(d: Three, f: Three) -> tuple[float, float]:
    """Return det F and its change det(F + D) - det F, accurate for a small D.

    The change is cof F : D + F : cof D + det D.
    """
    n, n_d = cofactors(f), cofactors(d)
    return dot(f[0], n[0]), inner(n, d) + inner(f, n_d) + dot(d[0], n_d[0])


@njit(inline="always")
def corner_stiffness(g: Seven, c: Floats, k: int) -> float:
    """Return the factor of I in a corner's diagonal block, from its ``corner_strain`` g."""
    x, y, z, v = full_forces(rest_constants(c, k), g)
    own: float = c[k + 104] * (g[0] * g[0] + g[1] * g[1] + g[2] * g[2])
    return own + x * g[3] + y * g[4] + z * g[5] + v * g[6]
