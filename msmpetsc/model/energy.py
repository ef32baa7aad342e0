"""Elastic energy of springs, its gradient and its Hessian (paper Eq. 13-15), as compiled loops over springs.

All positions are local, (l, 3): owned nodes then ghosts. A gradient is right at the owned nodes,
for a rank has every spring of them; the ghosts' rows are not complete and not to be used.
"""

import numba
import numpy as np

# A spring of no length has no direction: it then pulls nothing and its energy stays 1/2 k r^2.
TINY = 1e-300


@numba.njit(cache=True)
def elastic_energy(q: np.ndarray, springs: np.ndarray, rest_length: np.ndarray, stiffness: np.ndarray) -> float:
    """Sum of 1/2 k (|p1 - p2| - r)^2 over springs (Eq. 13), [J]."""
    energy = 0.0
    for s in range(len(springs)):
        a, b = springs[s, 0], springs[s, 1]
        x, y, z = q[a, 0] - q[b, 0], q[a, 1] - q[b, 1], q[a, 2] - q[b, 2]
        stretch = np.sqrt(x * x + y * y + z * z) - rest_length[s]
        energy += 0.5 * stiffness[s] * stretch * stretch
    return energy


@numba.njit(cache=True)
def elastic_change(
    q: np.ndarray, base: np.ndarray, springs: np.ndarray, rest_length: np.ndarray, stiffness: np.ndarray
) -> float:
    """E(q) - E(base) [J], summed spring by spring so that a small change keeps its digits."""
    change = 0.0
    for s in range(len(springs)):
        a, b = springs[s, 0], springs[s, 1]
        x, y, z = q[a, 0] - q[b, 0], q[a, 1] - q[b, 1], q[a, 2] - q[b, 2]
        u, v, w = base[a, 0] - base[b, 0], base[a, 1] - base[b, 1], base[a, 2] - base[b, 2]
        total = np.sqrt(x * x + y * y + z * z) + np.sqrt(u * u + v * v + w * w)
        longer = ((x - u) * (x + u) + (y - v) * (y + v) + (z - w) * (z + w)) / max(total, TINY)
        change += 0.5 * stiffness[s] * longer * (total - 2.0 * rest_length[s])
    return change


@numba.njit(cache=True)
def add_elastic_gradient(
    q: np.ndarray, springs: np.ndarray, rest_length: np.ndarray, stiffness: np.ndarray, gradient: np.ndarray
) -> None:
    """Add grad E = L x - J d(x) (Eq. 14-15) [N] to ``gradient`` (l, 3)."""
    for s in range(len(springs)):
        a, b = springs[s, 0], springs[s, 1]
        x, y, z = q[a, 0] - q[b, 0], q[a, 1] - q[b, 1], q[a, 2] - q[b, 2]
        length = np.sqrt(x * x + y * y + z * z)
        f = stiffness[s] * (1.0 - rest_length[s] / max(length, TINY))
        gradient[a, 0] += f * x
        gradient[a, 1] += f * y
        gradient[a, 2] += f * z
        gradient[b, 0] -= f * x
        gradient[b, 1] -= f * y
        gradient[b, 2] -= f * z


@numba.njit(cache=True)
def add_elastic_hessian(
    q: np.ndarray,
    springs: np.ndarray,
    rest_length: np.ndarray,
    stiffness: np.ndarray,
    projected: bool,
    v: np.ndarray,
    product: np.ndarray,
) -> None:
    """Add (Hessian of E at q) v [N] to ``product`` (l, 3).

    A spring's block is k (d d^T + (1 - r/l) (I - d d^T)), d its direction and l its length;
    ``projected`` leaves out the negative part that a compressed spring has across its direction,
    so that the whole is positive semidefinite.
    """
    for s in range(len(springs)):
        a, b = springs[s, 0], springs[s, 1]
        x, y, z = q[a, 0] - q[b, 0], q[a, 1] - q[b, 1], q[a, 2] - q[b, 2]
        u, v_, w = v[a, 0] - v[b, 0], v[a, 1] - v[b, 1], v[a, 2] - v[b, 2]
        squared = max(x * x + y * y + z * z, TINY)
        across = 1.0 - rest_length[s] / np.sqrt(squared)
        if projected:
            across = max(across, 0.0)
        along = (1.0 - across) * (x * u + y * v_ + z * w) / squared
        fx = stiffness[s] * (across * u + along * x)
        fy = stiffness[s] * (across * v_ + along * y)
        fz = stiffness[s] * (across * w + along * z)
        product[a, 0] += fx
        product[a, 1] += fy
        product[a, 2] += fz
        product[b, 0] -= fx
        product[b, 1] -= fy
        product[b, 2] -= fz
