"""Neo-Hookean solid, cell by cell: a constant Laplacian of positions, and one volume energy for each cell.

With mu and lambda of a cell, V of it inside the surface, F the mean deformation gradient over that and J = det F,

    E = 1/2 mu (integral of |grad x|^2 - 3 V) + V U(J),     U(J) = -mu ln J + lambda/2 (J - 1)^2

above J_0, below it the Taylor polynomial of second order there (Bonet and Wood 2008, Eq. 6.27; Smith, de Goes and Kim
2018 on why the logarithm stays). The first part is that of springs of no rest length, as L of the paper's A = M + t^2 L
is, with 2 mu + 3 lambda in mu's place to be no less than the Hessian; the integral is that of lattice.cell_moments.
U'' > 0 everywhere: a cell that is turned inside out is pushed back. At rest the second variation is
2 mu |sym G|^2 + lambda (tr G)^2 >= 0 of the mean slope G of a displacement, and what the modes add is not negative:
semidefinite whatever part of a cell is inside.

The Hessian of a cell is, on G,  V (mu G + U'' (cof F : G) cof F + U' F x G),  with F x G the change of cof F. In the
singular values s of F it has the 2 x 2 blocks [mu, -U' s_k; -U' s_k, mu], and one of 3 x 3 that is not negative where
U' < 0 and J >= 1/2: with y_i = x_i / s_i it is sum (mu s_i^2 - U' J) y_i^2 + (U'' J^2 + U' J) (sum y_i)^2. Elsewhere
what U' takes from it is no more than |U'| R |F|, R^2 = 4/3: the traceless matrix of s has the norm sqrt(2) |F|. Where
U' is cut to what mu bears, the product is semidefinite: the projected Hessian.

These are its formulas for one cell, which the loops of a CPU (elasticity.cell_lanes) and of a GPU (cell_threads) share.
A Hessian keeps F, V U' and V U'' of each cell; V stands in a cell's constants.
"""

import math

from msmpetsc.backend.arrays import Floats
from msmpetsc.backend.kernel import njit
from msmpetsc.elasticity.cell_strain import Nine, Seven, Strains, modes_forces
from msmpetsc.elasticity.springs import Vector

ONSET = 0.2  # J_0: below it U is a parabola
CONVEX = 0.5  # J from which on compression takes nothing from the 3 x 3 block
NORM = math.sqrt(4 / 3)  # R
TURNS = 30  # iterations towards a cell's rotation
TURNED = 1e-12  # how little the last one changes of it


@njit(inline="always")
def cofactors(f: Nine) -> Nine:
    """Return cof F by rows."""
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
    """Return det F by its first row and that of its cofactors n."""
    return f[0] * n[0] + f[1] * n[1] + f[2] * n[2]


@njit(inline="always")
def _inner(a: Nine, b: Nine) -> float:
    rows = a[0] * b[0] + a[1] * b[1] + a[2] * b[2], a[3] * b[3] + a[4] * b[4] + a[5] * b[5]
    return rows[0] + rows[1] + (a[6] * b[6] + a[7] * b[7] + a[8] * b[8])


@njit(inline="always")
def _change_of_cofactors(f: Nine, g: Nine) -> Nine:
    """Return F x G: by how much cof F changes along G."""
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
def _slopes(j: float, mu: float, lame: float) -> tuple[float, float]:
    """Return U' and U'' at J = j."""
    above = max(j, ONSET)
    curvature = mu / (above * above) + lame
    return lame * (above - 1.0) - mu / above + curvature * (j - above), curvature


@njit(inline="always")
def volume_energy(j: float, mu: float, lame: float) -> float:
    """Return U at J = j."""
    above = max(j, ONSET)
    below, (slope, curvature) = j - above, _slopes(above, mu, lame)
    return (
        0.5 * lame * (above - 1.0) ** 2
        - mu * math.log(above)
        + below * (slope + 0.5 * curvature * below)
    )


@njit(inline="always")
def volume_change(j: float, before: float, change: float, mu: float, lame: float) -> float:
    """Return U(j) - U(before), which keeps the digits of change = j - before."""
    if j >= ONSET and before >= ONSET:
        return 0.5 * lame * change * (j + before - 2.0) - mu * math.log1p(change / before)
    if j < ONSET and before < ONSET:
        slope, curvature = _slopes(ONSET, mu, lame)
        return change * (slope + 0.5 * curvature * (j + before - 2.0 * ONSET))
    return volume_energy(j, mu, lame) - volume_energy(before, mu, lame)


@njit(inline="always")
def _borne(f: Nine, j: float, slope: float, least: float) -> float:
    """Return by what |U'| is multiplied in what it may take from mu; J above ``least`` counts as convex.

    There it is Gershgorin's bound of the greatest singular value of F, exact in a rotation, elsewhere R |F|.
    """
    xx, yy, zz = (
        f[0] ** 2 + f[3] ** 2 + f[6] ** 2,
        f[1] ** 2 + f[4] ** 2 + f[7] ** 2,
        f[2] ** 2 + f[5] ** 2 + f[8] ** 2,
    )
    xy = abs(f[0] * f[1] + f[3] * f[4] + f[6] * f[7])
    xz = abs(f[0] * f[2] + f[3] * f[5] + f[6] * f[8])
    yz = abs(f[1] * f[2] + f[4] * f[5] + f[7] * f[8])
    largest, norm = (
        math.sqrt(max(xx + xy + xz, yy + xy + yz, zz + xz + yz)),
        math.sqrt(xx + yy + zz),
    )
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
def _slope_of(e: Strains) -> Nine:
    """Return 4 h times the mean slope by rows."""
    a, b, c = e
    return a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2]


@njit(inline="always")
def gradient_of(e: Strains, over: float) -> Nine:
    """Return F by the strains of positions; ``over`` is 1 / (4 h)."""
    return _times(over, _slope_of(e))


@njit(inline="always")
def kept_gradient(state: Floats, s: int) -> Nine:
    """Return F as a Hessian keeps it."""
    rows = state[s], state[s + 8], state[s + 16], state[s + 24], state[s + 32], state[s + 40]
    return (
        rows[0],
        rows[1],
        rows[2],
        rows[3],
        rows[4],
        rows[5],
        state[s + 48],
        state[s + 56],
        state[s + 64],
    )


@njit(inline="always")
def pull(e: Strains, m: float, lame: float, h4: float) -> Nine:
    """Return grad E by 4 h times the mean slope."""
    g, over = _slope_of(e), 1.0 / h4
    n = cofactors(g)
    j = determinant(g, n) * (over * over * over)
    return _plus(_times(m, g), over * _slopes(j, m, lame)[0], n)


@njit(inline="always")
def turned_pull(e: Strains, m: float, state: Floats, s: int) -> Nine:
    """Return the Hessian's product with the strains of a displacement, as ``pull`` does the gradient."""
    f, g = kept_gradient(state, s), _slope_of(e)
    n = cofactors(f)
    along = state[s + 80] * _inner(n, g)
    return _plus(_plus(_times(m, g), along, n), state[s + 72], _change_of_cofactors(f, g))


@njit(inline="always")
def quadratic(w: Floats, k: int, a: Strains, b: Strains) -> float:
    """Return the inner product of two strains in the form that mu has: mean slopes and modes, times m."""
    total: float = w[k + 104] * _inner(_slope_of(a), _slope_of(b))
    for i in range(3):
        x, y, z, v = modes_forces(w, k, b[i])
        total += a[i][3] * x + a[i][4] * y + a[i][5] * z + a[i][6] * v
    return total


@njit(inline="always")
def quadratic_change(w: Floats, k: int, moved: Strains, base: Strains) -> float:
    """Return by how much half of ``quadratic`` changes as strains go from ``base`` by ``moved``."""
    return quadratic(w, k, moved, base) + 0.5 * quadratic(w, k, moved, moved)


@njit(inline="always")
def write_state(store: Floats, s: int, f: Nine, slope: float, curvature: float) -> None:
    """Write what a Hessian keeps of a cell: F, V U' and V U''."""
    store[s], store[s + 8], store[s + 16], store[s + 24], store[s + 32] = (
        f[0],
        f[1],
        f[2],
        f[3],
        f[4],
    )
    store[s + 40], store[s + 48], store[s + 56], store[s + 64] = f[5], f[6], f[7], f[8]
    store[s + 72], store[s + 80] = slope, curvature


@njit(inline="always")
def slopes_at(f: Nine, mu: float, lame: float, projected: bool) -> tuple[float, float]:
    """Return U' and U'' at F, U' ``projected`` to what mu bears."""
    n = cofactors(f)
    j = determinant(f, n)
    slope, curvature = _slopes(j, mu, lame)
    if projected:
        most = mu / _borne(f, j, slope, ONSET)
        slope = min(max(slope, -most), most)
    return slope, curvature


@njit(inline="always")
def lost(f: Nine, mu: float, lame: float) -> float:
    """Return what the Hessian takes from mu |G|^2 at the most, beyond mu itself."""
    n = cofactors(f)
    j = determinant(f, n)
    slope = _slopes(j, mu, lame)[0]
    return max(abs(slope) * _borne(f, j, slope, CONVEX) - mu, 0.0)


@njit(inline="always")
def rotation_of(f: Nine) -> tuple[Nine, bool]:
    """Return the rotation of F, by Newton's iteration R <- (R + R^-T) / 2 (Higham 1986), and whether it has one.

    Where J is below J_0 none is looked for, and it is said to be that of rest.
    """
    if not determinant(f, cofactors(f)) > ONSET:
        return (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0), False
    for _ in range(TURNS):
        n = cofactors(f)
        step = _plus(_times(-0.5, f), 0.5 / determinant(f, n), n)
        f = _plus(f, 1.0, step)
        if not _inner(step, step) > TURNED * TURNED:
            break
    return f, True


@njit(inline="always")
def changes(d: Nine, f: Nine) -> tuple[float, float]:
    """Return J at F, and by how much D changes it: cof F : D + F : cof D + det D, which keeps its digits."""
    n, n_d = cofactors(f), cofactors(d)
    return determinant(f, n), _inner(n, d) + _inner(f, n_d) + determinant(d, n_d)


@njit(inline="always")
def kept_cofactors(state: Floats, s: int) -> Nine:
    """Return cof F of the F that a Hessian keeps."""
    return cofactors(kept_gradient(state, s))


@njit(inline="always")
def along_cofactors(n: Nine, g: Seven) -> Vector:
    """Return cof F g of the mean slope g of a strain."""
    return (
        n[0] * g[0] + n[1] * g[1] + n[2] * g[2],
        n[3] * g[0] + n[4] * g[1] + n[5] * g[2],
        n[6] * g[0] + n[7] * g[1] + n[8] * g[2],
    )


@njit(inline="always")
def corner_stiffness(g: Seven, c: Floats, k: int) -> float:
    """Return what a Hessian has of mu on the diagonal at the corner whose strain ``corner_strain`` gives."""
    x, y, z, v = modes_forces(c, k, g)
    own: float = c[k + 104] * (g[0] * g[0] + g[1] * g[1] + g[2] * g[2])
    return own + x * g[3] + y * g[4] + z * g[5] + v * g[6]
