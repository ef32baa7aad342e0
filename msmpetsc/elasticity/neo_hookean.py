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

Whole cells of one material share their constants; a Hessian keeps F, U' and U'' of each cell (elasticity.cell_lanes).
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numba
import numpy as np

from msmpetsc.backend.arrays import Array, Floats, Indices, Positions, Rows, greatest
from msmpetsc.elasticity.cell_lanes import (
    AT_STATE,
    BY_AXIS,
    CONSTANTS,
    FAST,
    RESULT,
    ROWS,
    STATE,
    WORK,
    Blocks,
    component_in,
    gather,
    in_blocks,
    load,
    scatter,
    shared,
    strains_in,
)
from msmpetsc.elasticity.cell_strain import (
    LANES,
    Nine,
    Seven,
    Strains,
    corner_strain,
    form_of,
    modes_forces,
    strain,
    write_forces,
)
from msmpetsc.lattice.lattice import Lattice

ONSET = 0.2  # J_0: below it U is a parabola
CONVEX = 0.5  # J from which on compression takes nothing from the 3 x 3 block
NORM = math.sqrt(4 / 3)  # R


@numba.njit(cache=True, inline="always")
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


@numba.njit(cache=True, inline="always")
def determinant(f: Nine, n: Nine) -> float:
    """Return det F by its first row and that of its cofactors n."""
    return f[0] * n[0] + f[1] * n[1] + f[2] * n[2]


@numba.njit(cache=True, inline="always")
def _inner(a: Nine, b: Nine) -> float:
    rows = a[0] * b[0] + a[1] * b[1] + a[2] * b[2], a[3] * b[3] + a[4] * b[4] + a[5] * b[5]
    return rows[0] + rows[1] + (a[6] * b[6] + a[7] * b[7] + a[8] * b[8])


@numba.njit(cache=True, inline="always")
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


@numba.njit(cache=True, inline="always")
def _slopes(j: float, mu: float, lame: float) -> tuple[float, float]:
    """Return U' and U'' at J = j."""
    above = max(j, ONSET)
    curvature = mu / (above * above) + lame
    return lame * (above - 1.0) - mu / above + curvature * (j - above), curvature


@numba.njit(cache=True, inline="always")
def _volume_energy(j: float, mu: float, lame: float) -> float:
    """Return U at J = j."""
    above = max(j, ONSET)
    below, (slope, curvature) = j - above, _slopes(above, mu, lame)
    return 0.5 * lame * (above - 1.0) ** 2 - mu * math.log(above) + below * (slope + 0.5 * curvature * below)


@numba.njit(cache=True, inline="always")
def _volume_change(j: float, before: float, change: float, mu: float, lame: float) -> float:
    """Return U(j) - U(before), which keeps the digits of change = j - before."""
    if j >= ONSET and before >= ONSET:
        return 0.5 * lame * change * (j + before - 2.0) - mu * math.log1p(change / before)
    if j < ONSET and before < ONSET:
        slope, curvature = _slopes(ONSET, mu, lame)
        return change * (slope + 0.5 * curvature * (j + before - 2.0 * ONSET))
    return _volume_energy(j, mu, lame) - _volume_energy(before, mu, lame)


@numba.njit(cache=True, inline="always")
def _borne(f: Nine, j: float, slope: float, least: float) -> float:
    """Return by what |U'| is multiplied in what it may take from mu; J above ``least`` counts as convex.

    There it is Gershgorin's bound of the greatest singular value of F, exact in a rotation, elsewhere R |F|.
    """
    xx, yy, zz = f[0] ** 2 + f[3] ** 2 + f[6] ** 2, f[1] ** 2 + f[4] ** 2 + f[7] ** 2, f[2] ** 2 + f[5] ** 2 + f[8] ** 2
    xy = abs(f[0] * f[1] + f[3] * f[4] + f[6] * f[7])
    xz = abs(f[0] * f[2] + f[3] * f[5] + f[6] * f[8])
    yz = abs(f[1] * f[2] + f[4] * f[5] + f[7] * f[8])
    largest, norm = math.sqrt(max(xx + xy + xz, yy + xy + yz, zz + xz + yz)), math.sqrt(xx + yy + zz)
    return largest if slope < 0.0 and j >= least else NORM * norm


@numba.njit(cache=True, inline="always")
def _times(a: float, x: Nine) -> Nine:
    return a * x[0], a * x[1], a * x[2], a * x[3], a * x[4], a * x[5], a * x[6], a * x[7], a * x[8]


@numba.njit(cache=True, inline="always")
def _plus(x: Nine, a: float, y: Nine) -> Nine:
    """Return x + a y."""
    return (
        x[0] + a * y[0], x[1] + a * y[1], x[2] + a * y[2],
        x[3] + a * y[3], x[4] + a * y[4], x[5] + a * y[5],
        x[6] + a * y[6], x[7] + a * y[7], x[8] + a * y[8],
    )  # fmt: skip


@numba.njit(cache=True, inline="always")
def _slope_of(e: Strains) -> Nine:
    """Return 4 h times the mean slope by rows."""
    a, b, c = e
    return a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2]


@numba.njit(cache=True, inline="always")
def gradient_of(e: Strains, over: float) -> Nine:
    """Return F by the strains of positions; ``over`` is 1 / (4 h)."""
    return _times(over, _slope_of(e))


@numba.njit(cache=True, inline="always")
def kept_gradient(state: Floats, s: int) -> Nine:
    """Return F as a Hessian keeps it."""
    rows = state[s], state[s + 8], state[s + 16], state[s + 24], state[s + 32], state[s + 40]
    return rows[0], rows[1], rows[2], rows[3], rows[4], rows[5], state[s + 48], state[s + 56], state[s + 64]


@numba.njit(cache=True, inline="always")
def _pull(e: Strains, m: float, lame: float, h4: float) -> Nine:
    """Return grad E by 4 h times the mean slope."""
    g, over = _slope_of(e), 1.0 / h4
    n = cofactors(g)
    j = determinant(g, n) * (over * over * over)
    return _plus(_times(m, g), over * _slopes(j, m, lame)[0], n)


@numba.njit(cache=True, inline="always")
def _turned_pull(e: Strains, m: float, state: Floats, s: int) -> Nine:
    """Return the Hessian's product with the strains of a displacement, as ``_pull`` does the gradient."""
    f, g = kept_gradient(state, s), _slope_of(e)
    n = cofactors(f)
    along = state[s + 80] * _inner(n, g)
    return _plus(_plus(_times(m, g), along, n), state[s + 72], _change_of_cofactors(f, g))


@numba.njit(cache=True, fastmath=FAST, error_model="numpy")
def _product_lanes(w: Floats) -> None:
    for lane in range(LANES):
        k, e = CONSTANTS + lane, strains_in(w, lane)
        write_forces(w, RESULT + lane, w, k, _turned_pull(e, w[k + 104], w, AT_STATE + lane), e)


@numba.njit(cache=True)
def add_product(nodes: Indices, which: Indices, constants: Rows, state: Rows, v: Rows, product: Rows) -> None:
    """Add (Hessian) v [N] to ``product`` (l, 3), its ``state`` that of ``linearise``; all of one dtype."""
    w = np.zeros(WORK, v.dtype)
    for b in range(len(nodes)):
        gather(nodes, b, v, w)
        load(constants, which[b], w, CONSTANTS)
        load(state, b, w, AT_STATE)
        _product_lanes(w)
        scatter(nodes, b, w, product)


@numba.njit(cache=True, fastmath=FAST, error_model="numpy")
def _gradient_lanes(w: Floats, h4: float) -> None:
    for lane in range(LANES):
        k, e = CONSTANTS + lane, strains_in(w, lane)
        write_forces(w, RESULT + lane, w, k, _pull(e, w[k + 104], w[k + 112], h4), e)


@numba.njit(cache=True)
def add_gradient(blocks: Blocks, h4: float, q: Positions, gradient: Rows) -> None:
    """Add grad E [N] at q (l, 3) [m] to ``gradient`` (l, 3); ``h4`` is 4 h [m]."""
    w = np.zeros(WORK)
    for b in range(len(blocks.nodes)):
        gather(blocks.nodes, b, q, w)
        load(blocks.constants, blocks.which[b], w, CONSTANTS)
        _gradient_lanes(w, h4)
        scatter(blocks.nodes, b, w, gradient)


@numba.njit(cache=True, fastmath=FAST, error_model="numpy")
def _state_lanes(w: Floats, over: float, projected: bool) -> None:
    for lane in range(LANES):
        f = gradient_of(strains_in(w, lane), over)
        m, lame, n = w[CONSTANTS + 104 + lane], w[CONSTANTS + 112 + lane], cofactors(f)
        j = determinant(f, n)
        slope, curvature = _slopes(j, m, lame)
        if projected:
            most = m / _borne(f, j, slope, ONSET)
            slope = min(max(slope, -most), most)
        s = AT_STATE + lane
        w[s], w[s + 8], w[s + 16], w[s + 24], w[s + 32] = f[0], f[1], f[2], f[3], f[4]
        w[s + 40], w[s + 48], w[s + 56], w[s + 64] = f[5], f[6], f[7], f[8]
        w[s + 72], w[s + 80] = slope, curvature


@numba.njit(cache=True)
def linearise(blocks: Blocks, h4: float, q: Positions, projected: bool, state: Rows) -> None:
    """Write what a Hessian keeps of each cell into ``state`` (b, STATE * LANES)."""
    w = np.zeros(WORK)
    for b in range(len(blocks.nodes)):
        gather(blocks.nodes, b, q, w)
        load(blocks.constants, blocks.which[b], w, CONSTANTS)
        _state_lanes(w, 1.0 / h4, projected)
        for i in range(STATE * LANES):
            state[b, i] = w[AT_STATE + i]


@numba.njit(cache=True, inline="always")
def _quadratic(w: Floats, k: int, a: Strains, b: Strains) -> float:
    """Return the inner product of two strains in the form that mu has: mean slopes and modes, times m."""
    total: float = w[k + 104] * _inner(_slope_of(a), _slope_of(b))
    for i in range(3):
        x, y, z, v = modes_forces(w, k, b[i])
        total += a[i][3] * x + a[i][4] * y + a[i][5] * z + a[i][6] * v
    return total


@numba.njit(cache=True, fastmath=FAST, error_model="numpy")
def _energy_lanes(w: Floats, over: float) -> None:
    for lane in range(LANES):
        e, s = strains_in(w, lane), AT_STATE + lane
        f = gradient_of(e, over)
        w[s] = determinant(f, cofactors(f))
        w[s + 8] = 0.5 * _quadratic(w, CONSTANTS + lane, e, e)


@numba.njit(cache=True)
def cell_energies(blocks: Blocks, h4: float, q: Positions, energies: Rows) -> None:
    """Write the energy of cells [J] at q (l, 3) [m], 0 at rest, into ``energies`` (b, LANES), of the first b blocks."""
    w = np.zeros(WORK)
    for b in range(len(energies)):
        gather(blocks.nodes, b, q, w)
        load(blocks.constants, blocks.which[b], w, CONSTANTS)
        _energy_lanes(w, 1.0 / h4)
        for lane in range(LANES):  # logarithms, which are no lanes'
            s, m, lame = AT_STATE + lane, w[CONSTANTS + 104 + lane], w[CONSTANTS + 112 + lane]
            volume = _volume_energy(w[s], m, lame) if m > 0.0 else 0.0
            energies[b, lane] = w[s + 8] + h4 * h4 * (volume - 1.5 * m)


@numba.njit(cache=True, inline="always")
def _between(a: Seven, b: Seven) -> Seven:
    """Return b + a / 2."""
    return (
        b[0] + 0.5 * a[0], b[1] + 0.5 * a[1], b[2] + 0.5 * a[2],
        b[3] + 0.5 * a[3], b[4] + 0.5 * a[4], b[5] + 0.5 * a[5], b[6] + 0.5 * a[6],
    )  # fmt: skip


@numba.njit(cache=True, fastmath=FAST, error_model="numpy")
def _change_lanes(w: Floats, over: float) -> None:
    for lane in range(LANES):
        moved, base, s = strains_in(w, lane), strains_in(w, lane, RESULT), AT_STATE + lane
        d, f = gradient_of(moved, over), gradient_of(base, over)
        n, n_d = cofactors(f), cofactors(d)
        w[s], w[s + 8] = determinant(f, n), _inner(n, d) + _inner(f, n_d) + determinant(d, n_d)
        mean = _between(moved[0], base[0]), _between(moved[1], base[1]), _between(moved[2], base[2])
        w[s + 16] = _quadratic(w, CONSTANTS + lane, moved, mean)


@numba.njit(cache=True)
def elastic_change(blocks: Blocks, owned: int, h4: float, q: Positions, base: Positions) -> float:
    """Return E(q) - E(base) [J] of the first ``owned`` blocks, from how the nodes moved, so that it keeps its digits.

    With D the change of F_0, J - J_0 = cof F_0 : D + F_0 : cof D + det D.
    """
    moved, w, change = q - base, np.zeros(WORK), 0.0
    for b in range(owned):
        gather(blocks.nodes, b, moved, w)
        gather(blocks.nodes, b, base, w, RESULT)
        load(blocks.constants, blocks.which[b], w, CONSTANTS)
        _change_lanes(w, 1.0 / h4)
        for lane in range(LANES):
            s, m, lame = AT_STATE + lane, w[CONSTANTS + 104 + lane], w[CONSTANTS + 112 + lane]
            before, more = w[s], w[s + 8]
            if m > 0.0:
                change += w[s + 16] + h4 * h4 * _volume_change(before + more, before, more, m, lame)
    return change


@numba.njit(cache=True)
def add_diagonal(blocks: Blocks, state: Rows, diagonal: Rows) -> None:
    """Add the diagonal blocks of the Hessian whose ``state`` it is to ``diagonal`` (l, 9) [N/m]."""
    w = np.zeros(WORK)
    for b in range(len(blocks.nodes)):
        load(blocks.constants, blocks.which[b], w, CONSTANTS)
        load(state, b, w, AT_STATE)
        for lane in range(LANES):
            s, k = AT_STATE + lane, CONSTANTS + lane
            n, form = cofactors(kept_gradient(w, s)), form_of(w, k)
            for a in range(8):
                g, block = corner_strain(a, form), diagonal[blocks.nodes[b, lane, a]]
                x, y, z, v = modes_forces(w, k, g)
                own = w[k + 104] * (g[0] * g[0] + g[1] * g[1] + g[2] * g[2])
                own += x * g[3] + y * g[4] + z * g[5] + v * g[6]
                e = (
                    n[0] * g[0] + n[1] * g[1] + n[2] * g[2],
                    n[3] * g[0] + n[4] * g[1] + n[5] * g[2],
                    n[6] * g[0] + n[7] * g[1] + n[8] * g[2],
                )
                for r in range(3):
                    block[4 * r] += own
                    for c in range(3):
                        block[3 * r + c] += w[s + 80] * e[r] * e[c]


@numba.njit(cache=True)
def add_concavity(blocks: Blocks, h4: float, q: Positions, concavity: Floats) -> None:
    """Add to ``concavity`` (l,) [N/m] what the Hessian at q (l, 3) [m] takes from mu at the most.

    V |G|^2 is no more than sum_a |g_a| (sum_b |g_b|) V |v_a|^2, with g_a the mean slope of corner a.
    """
    w, sizes = np.zeros(WORK), np.empty(8)
    for b in range(len(blocks.nodes)):
        gather(blocks.nodes, b, q, w)
        load(blocks.constants, blocks.which[b], w, CONSTANTS)
        for lane in range(LANES):
            f, m = gradient_of(strains_in(w, lane), 1.0 / h4), w[CONSTANTS + 104 + lane]
            n = cofactors(f)
            j = determinant(f, n)
            slope = _slopes(j, m, w[CONSTANTS + 112 + lane])[0]
            lost, form = max(abs(slope) * _borne(f, j, slope, CONVEX) - m, 0.0), form_of(w, CONSTANTS + lane)
            for a in range(8):
                g = corner_strain(a, form)
                sizes[a] = math.sqrt(g[0] * g[0] + g[1] * g[1] + g[2] * g[2])
            lost *= sizes.sum()
            for a in range(8):
                concavity[blocks.nodes[b, lane, a]] += lost * sizes[a]


@numba.njit(cache=True)
def add_coarse(
    fine: tuple[Indices, Indices, Array], blocks: Blocks, state: Rows, weights: Rows, places: Indices, values: Rows
) -> None:
    """Add t^2 times the Hessians of cells, whose corners follow coarse cells of 2 x 2 x 2, to these cells' blocks.

    fine           : the fine cells of each coarse one (solve.multigrid.galerkin.ByCell)
    weights        : (28, 8) of a coarse cell's corners at the place of each code, times t [s]
    places, values : (c, 36) rows of values (b, 9), the blocks of a coarse cell's pairs of corners; -1 of none
    """
    w, g, modes, pushed, n = np.zeros(WORK), np.empty((8, 3)), np.empty((8, 4)), np.empty((8, 4)), np.empty((8, 3))
    f = np.empty((3, 3))
    start, order, code = fine
    for i in range(len(start) - 1):
        for at in range(start[i], start[i + 1]):
            b, lane = order[at] // LANES, order[at] % LANES
            load(blocks.constants, blocks.which[b], w, CONSTANTS)
            load(state, b, w, AT_STATE)
            s, row, m = AT_STATE + lane, CONSTANTS + lane, w[CONSTANTS + 104 + lane]
            of_f, form = kept_gradient(w, s), form_of(w, row)
            slope, curvature, k = w[s + 72], w[s + 80], cofactors(of_f)
            for r in range(9):
                f[r // 3, r % 3] = of_f[r]
            for a in range(8):
                for corner in range(8):
                    w[24 * corner + lane] = weights[code[at, corner], a]
                e = strain(component_in(w, lane), form)
                g[a, 0], g[a, 1], g[a, 2] = e[0], e[1], e[2]
                modes[a, 0], modes[a, 1], modes[a, 2], modes[a, 3] = e[3], e[4], e[5], e[6]
                pushed[a, 0], pushed[a, 1], pushed[a, 2], pushed[a, 3] = modes_forces(w, row, e)
                n[a, 0] = k[0] * e[0] + k[1] * e[1] + k[2] * e[2]
                n[a, 1] = k[3] * e[0] + k[4] * e[1] + k[5] * e[2]
                n[a, 2] = k[6] * e[0] + k[7] * e[1] + k[8] * e[2]
            pair = -1
            for a in range(8):
                for c in range(a, 8):
                    pair += 1
                    if places[i, pair] >= 0:
                        own = m * (g[a, 0] * g[c, 0] + g[a, 1] * g[c, 1] + g[a, 2] * g[c, 2])
                        for mode in range(4):
                            own += modes[a, mode] * pushed[c, mode]
                        _add_block(values[places[i, pair]], own, curvature, n[a], n[c], slope, f, g[a], g[c])


@numba.njit(cache=True)
def _add_block(
    block: Floats, own: float, curvature: float, m: Floats, n: Floats, slope: float, f: Rows, g: Floats, h: Floats
) -> None:
    """Add own I + curvature m n^T + slope [t]_x with t = F (h x g), what v . (F x (u (x) h)) g is of u and v."""
    x, y, z = h[1] * g[2] - h[2] * g[1], h[2] * g[0] - h[0] * g[2], h[0] * g[1] - h[1] * g[0]
    for r in range(3):
        block[4 * r] += own
        for c in range(3):
            block[3 * r + c] += curvature * m[r] * n[c]
        t = slope * (f[r, 0] * x + f[r, 1] * y + f[r, 2] * z)
        one, two = (r + 1) % 3, (r + 2) % 3
        block[3 * two + one] += t
        block[3 * one + two] -= t


@dataclass(frozen=True)
class CellHessians:
    """Hessians of cells, as ``linearise`` leaves them in ``state``: what adds their product with v [N]."""

    blocks: Blocks
    state: Array

    def __call__(self, v: Array, product: Array) -> None:
        add_product(*self.blocks, self.state, v, product)

    @property
    def slopes(self) -> Array:
        """V U' (b, LANES) of the cells, to be read or written: by it a cell's J bends with F."""
        return self.state[:, 9 * LANES : 10 * LANES]


@dataclass(frozen=True)
class NeoHookean:
    """The cells around this rank's nodes, those that it owns first: what Elasticity asks of a law.

    owned : number of blocks of cells that this rank owns
    h4    : four times the side of a cell [m]
    """

    blocks: Blocks
    owned: int
    h4: float

    @classmethod
    def of_lattice(cls, lattice: Lattice) -> "NeoHookean":
        """Return the solid of a lattice."""
        assert lattice.solid is not None
        h4 = 4 * lattice.cell_size
        forms, volume, shear, lame = lattice.solid
        m = (shear * volume / h4**2)[:, None]
        constants = np.concatenate([forms[:, :6], m * forms[:, 6:], m, (lame * volume / h4**2)[:, None]], axis=1)
        owned = np.arange(len(forms)) < lattice.cells_owned
        nodes, rows, blocks = [], [], []
        for kind in (owned, ~owned):
            own = np.flatnonzero(kind)
            order = own[np.argsort((constants[own] != constants[:1]).any(axis=1), kind="stable")]
            of_kind, values = in_blocks(lattice.local_cells[order][:, BY_AXIS], constants[order])
            nodes.append(of_kind)
            rows.append(values)
            blocks.append(len(of_kind))
        which, distinct = shared(np.concatenate(rows))
        cells = Blocks(np.concatenate(nodes), which, distinct)
        return cls(cells, blocks[0], h4)

    @property
    def corners(self) -> Indices:
        """Corner nodes (c, 8) of the cells that this rank owns, in the order of its blocks."""
        return self.blocks.nodes[: self.owned].reshape(-1, 8)

    @property
    def stiffest(self) -> float:
        """The greatest lambda of a cell, in mu."""
        mu, lame = self.blocks.constants.reshape(-1, ROWS, LANES)[:, -2:].swapaxes(0, 1)
        return float(greatest(lame / np.where(mu > 0, mu, 1.0)))

    @contextmanager
    def softened(self, ratio: float) -> Iterator[None]:
        """Take no lambda for more than ``ratio`` mu meanwhile."""
        mu, lame = self.blocks.constants.reshape(-1, ROWS, LANES)[:, -2:].swapaxes(0, 1)
        true = lame.copy()
        np.minimum(true, ratio * mu, out=lame)
        try:
            yield
        finally:
            lame[:] = true

    def energy(self, q: Positions) -> float:
        """Return E [J] of the cells that this rank owns."""
        energies = np.empty((self.owned, LANES))
        cell_energies(self.blocks, self.h4, q, energies)
        return float(energies.sum())

    def change(self, q: Positions, base: Positions) -> float:
        """Return E(q) - E(base) [J] of the cells that this rank owns."""
        return elastic_change(self.blocks, self.owned, self.h4, q, base)

    def add_gradient(self, q: Positions, gradient: Rows) -> None:
        """Add grad E [N] to ``gradient`` (l, 3)."""
        add_gradient(self.blocks, self.h4, q, gradient)

    def add_concavity(self, q: Positions, concavity: Floats) -> None:
        """Add to ``concavity`` (l,) [N/m] how much less than 0 the Hessian may be."""
        add_concavity(self.blocks, self.h4, q, concavity)

    def state(self, q: Positions, projected: bool, dtype: type = np.float64) -> Array:
        """Return F, V U' and V U'' of all cells at q, as ``add_product`` takes them."""
        state: Rows = np.empty((len(self.blocks.nodes), STATE * LANES), dtype)
        linearise(self.blocks, self.h4, q, projected, state)
        return state

    def hessian_at(self, q: Positions, projected: bool, dtype: type = np.float64) -> "CellHessians":
        """Return what adds (Hessian of E at q) v [N] to its second argument."""
        constants: Rows = self.blocks.constants.astype(dtype, copy=False)
        return CellHessians(self.blocks._replace(constants=constants), self.state(q, projected, dtype))

    def add_bound(self, q: Positions, blocks: Rows) -> None:
        """Add the diagonal blocks of the projected Hessian to ``blocks`` (l, 9) [N/m]: an eighth of what bounds it."""
        add_diagonal(self.blocks, self.state(q, True), blocks)
