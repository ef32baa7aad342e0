"""Elastic energy of springs, its gradient and its Hessian (paper Eq. 13-15), as compiled loops over springs.

A spring of length l = r (1 + s) pulls with k r (s + b s^3), b its ``stiffening``: Hooke's law where b = 0, and
the same stiffness k at small strain whatever b. Its energy is k r^2 (s^2 / 2 + b s^4 / 4).

All positions are local, (l, 3): owned nodes then ghosts. A gradient is right at the owned nodes,
for a rank has every spring of them; the ghosts' rows are not complete and not to be used.

What one spring does is a function of its own: the loops here are a CPU's, a GPU has others (model.spring_gather).
"""

import math

import numba
import numpy as np

# A spring of no length has no direction: it then pulls nothing and its energy stays 1/2 k r^2.
TINY = 1e-300


@numba.njit(cache=True)
def spring_energy(x: float, y: float, z: float, r: float, k: float, b: float) -> float:
    """1/2 k (|(x, y, z)| - r)^2 (Eq. 13), and what stiffening b adds, [J]."""
    stretch = math.sqrt(x * x + y * y + z * z) - r
    energy = 0.5 * k * stretch * stretch
    if b > 0.0:
        strain = stretch / r
        energy *= 1.0 + 0.5 * b * strain * strain
    return energy


@numba.njit(cache=True)
def spring_change(u: float, v: float, w: float, dx: float, dy: float, dz: float, r: float, k: float, b: float) -> float:
    """The energy of a spring that was (u, v, w) and changed by (dx, dy, dz) less what it was [J]."""
    x, y, z = u + dx, v + dy, w + dz
    length, before = math.sqrt(x * x + y * y + z * z), math.sqrt(u * u + v * v + w * w)
    total = length + before
    longer = (dx * (x + u) + dy * (y + v) + dz * (z + w)) / max(total, TINY)
    change = 0.5 * k * longer * (total - 2.0 * r)
    if b > 0.0:  # s^4 / 4 changes by (s^2 + s_0^2) / 2 for each unit that s^2 / 2 does
        strain, strain_before = length / r - 1.0, before / r - 1.0
        change *= 1.0 + 0.5 * b * (strain * strain + strain_before * strain_before)
    return change


@numba.njit(cache=True)
def spring_pull(x: float, y: float, z: float, r: float, k: float, b: float) -> float:
    """f [N/m]: the gradient at the end that (x, y, z) points to is f times that."""
    length = math.sqrt(x * x + y * y + z * z)
    f = k * (1.0 - r / max(length, TINY))
    if b > 0.0:
        strain = length / r - 1.0
        f *= 1.0 + b * strain * strain
    return f


@numba.njit(cache=True)
def spring_block(
    x: float, y: float, z: float, r: float, k: float, b: float, projected: bool
) -> tuple[float, float, float, float]:
    """c, e of the spring's Hessian c I + e e^T [N/m], [sqrt(N/m)].

    It is k (1 + 3 b s^2) along the spring and k (1 - r/l) (1 + b s^2) across it, l its length; ``projected``
    leaves out the negative part that a compressed spring has across.
    """
    length, tangent = math.sqrt(max(x * x + y * y + z * z, TINY)), 1.0
    across = 1.0 - r / length
    if b > 0.0:
        strain = length / r - 1.0
        tangent += 3.0 * b * strain * strain
        across *= 1.0 + b * strain * strain
    if projected:
        across = max(across, 0.0)
    along = math.sqrt(k * (tangent - across)) / length  # across is never the greater
    return k * across, along * x, along * y, along * z


@numba.njit(cache=True)
def block_product(
    c: float, ex: float, ey: float, ez: float, dx: float, dy: float, dz: float
) -> tuple[float, float, float]:
    """(c I + e e^T) d"""
    along = ex * dx + ey * dy + ez * dz
    return c * dx + along * ex, c * dy + along * ey, c * dz + along * ez


@numba.njit(cache=True)
def elastic_energy(
    q: np.ndarray, springs: np.ndarray, rest_length: np.ndarray, stiffness: np.ndarray, stiffening: float
) -> float:
    """Sum of 1/2 k (|p1 - p2| - r)^2 over springs (Eq. 13), and of what stiffening adds, [J]."""
    energy = 0.0
    for s in range(len(springs)):
        a, b = springs[s, 0], springs[s, 1]
        x, y, z = q[a, 0] - q[b, 0], q[a, 1] - q[b, 1], q[a, 2] - q[b, 2]
        energy += spring_energy(x, y, z, rest_length[s], stiffness[s], stiffening)
    return energy


@numba.njit(cache=True)
def elastic_change(
    q: np.ndarray,
    base: np.ndarray,
    springs: np.ndarray,
    rest_length: np.ndarray,
    stiffness: np.ndarray,
    stiffening: float,
) -> float:
    """E(q) - E(base) [J], summed spring by spring so that a small change keeps its digits."""
    change = 0.0
    moved = q - base
    for s in range(len(springs)):
        a, b = springs[s, 0], springs[s, 1]
        u, v, w = base[a, 0] - base[b, 0], base[a, 1] - base[b, 1], base[a, 2] - base[b, 2]
        # how the ends moved, from node to node: a difference of springs would keep only the digits of a spring
        dx, dy, dz = moved[a, 0] - moved[b, 0], moved[a, 1] - moved[b, 1], moved[a, 2] - moved[b, 2]
        change += spring_change(u, v, w, dx, dy, dz, rest_length[s], stiffness[s], stiffening)
    return change


@numba.njit(cache=True)
def add_elastic_gradient(
    q: np.ndarray,
    springs: np.ndarray,
    rest_length: np.ndarray,
    stiffness: np.ndarray,
    stiffening: float,
    gradient: np.ndarray,
) -> None:
    """Add grad E [N] to ``gradient`` (l, 3); without stiffening it is L x - J d(x) (Eq. 14-15)."""
    for s in range(len(springs)):
        a, b = springs[s, 0], springs[s, 1]
        x, y, z = q[a, 0] - q[b, 0], q[a, 1] - q[b, 1], q[a, 2] - q[b, 2]
        f = spring_pull(x, y, z, rest_length[s], stiffness[s], stiffening)
        gradient[a, 0] += f * x
        gradient[a, 1] += f * y
        gradient[a, 2] += f * z
        gradient[b, 0] -= f * x
        gradient[b, 1] -= f * y
        gradient[b, 2] -= f * z


@numba.njit(cache=True)
def add_spring_concavity(
    q: np.ndarray,
    springs: np.ndarray,
    rest_length: np.ndarray,
    stiffness: np.ndarray,
    stiffening: float,
    concavity: np.ndarray,
) -> None:
    """Add to ``concavity`` (l,) [N/m], at both ends of each compressed spring, twice what it pushes across itself.

    With d = v_a - v_b a spring's Hessian c I + e e^T makes  c |d|^2 + (e . d)^2 >= -2 |c| (|v_a|^2 + |v_b|^2)  for c < 0.
    """
    for s in range(len(springs)):
        a, b = springs[s, 0], springs[s, 1]
        x, y, z = q[a, 0] - q[b, 0], q[a, 1] - q[b, 1], q[a, 2] - q[b, 2]
        across = spring_pull(x, y, z, rest_length[s], stiffness[s], stiffening)
        if across < 0.0:
            concavity[a] -= 2.0 * across
            concavity[b] -= 2.0 * across


@numba.njit(cache=True)
def elastic_hessian(
    q: np.ndarray,
    springs: np.ndarray,
    rest_length: np.ndarray,
    stiffness: np.ndarray,
    stiffening: float,
    projected: bool,
) -> np.ndarray:
    """Hessian of E at q, the c and e of ``spring_block`` (s, 4); ``projected`` makes the whole positive semidefinite."""
    blocks = np.empty((len(springs), 4))
    for s in range(len(springs)):
        a, b = springs[s, 0], springs[s, 1]
        x, y, z = q[a, 0] - q[b, 0], q[a, 1] - q[b, 1], q[a, 2] - q[b, 2]
        c, ex, ey, ez = spring_block(x, y, z, rest_length[s], stiffness[s], stiffening, projected)
        blocks[s, 0], blocks[s, 1], blocks[s, 2], blocks[s, 3] = c, ex, ey, ez
    return blocks


@numba.njit(cache=True)
def add_elastic_product(springs: np.ndarray, blocks: np.ndarray, v: np.ndarray, product: np.ndarray) -> None:
    """Add (Hessian of E) v [N] to ``product`` (l, 3), its ``blocks`` those of elastic_hessian.

    Springs of the same first end follow each other: what they have in common is read and written once.
    """
    first, x, y, z, sx, sy, sz = -1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for s in range(len(springs)):
        a, b = springs[s, 0], springs[s, 1]
        if a != first:
            if first >= 0:
                product[first, 0] += sx
                product[first, 1] += sy
                product[first, 2] += sz
            first, x, y, z, sx, sy, sz = a, v[a, 0], v[a, 1], v[a, 2], 0.0, 0.0, 0.0
        dx, dy, dz = x - v[b, 0], y - v[b, 1], z - v[b, 2]
        fx, fy, fz = block_product(blocks[s, 0], blocks[s, 1], blocks[s, 2], blocks[s, 3], dx, dy, dz)
        sx += fx
        sy += fy
        sz += fz
        product[b, 0] -= fx
        product[b, 1] -= fy
        product[b, 2] -= fz
    if first >= 0:
        product[first, 0] += sx
        product[first, 1] += sy
        product[first, 2] += sz
