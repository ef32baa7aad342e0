"""What keeps cells from turning inside out, which springs cannot see: a mirrored cell has springs of the same lengths.

Each corner of a cell spans a box with the three edges that meet there; J is its signed volume over that at rest.
Where J < J_0 the corner has the energy  K (1 - J / J_0)^3,  K of its cell's material, nothing elsewhere, with two
continuous derivatives and a finite push even where J < 0: so a cell that has been turned is turned back, though its
neighbours may then hold it creased.

All positions are local, (l, 3), and a gradient is right at the owned nodes, as in model.energy.
"""

import numba
import numpy as np

# each corner of a cell (VTK's order), then the corners at the far ends of its three edges, right-handed
FRAMES = np.array(
    [[0, 1, 3, 4], [1, 2, 0, 5], [2, 3, 1, 6], [3, 0, 2, 7], [4, 7, 5, 0], [5, 4, 6, 1], [6, 5, 7, 2], [7, 6, 4, 3]]
)


@numba.njit(cache=True)
def _edge(q, cell, frame, end, e):
    for c in range(3):
        e[c] = q[cell[frame[end]], c] - q[cell[frame[0]], c]


@numba.njit(cache=True)
def _cross(a, b, c):
    c[0] = a[1] * b[2] - a[2] * b[1]
    c[1] = a[2] * b[0] - a[0] * b[2]
    c[2] = a[0] * b[1] - a[1] * b[0]


@numba.njit(cache=True)
def _frame(q, cell, frame, e, n):
    """Edges e (3, 3) of a corner, the cofactors n (3, 3) that are the slopes of their volume, and the volume."""
    for k in range(3):
        _edge(q, cell, frame, k + 1, e[k])
    for k in range(3):
        _cross(e[(k + 1) % 3], e[(k + 2) % 3], n[k])
    return e[0, 0] * n[0, 0] + e[0, 1] * n[0, 1] + e[0, 2] * n[0, 2]


@numba.njit(cache=True)
def least_volumes(q: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """The least of the eight corner volumes of each cell (c,) [m^3]; a cell is inverted where it is not positive."""
    least = np.full(len(cells), np.inf)
    e, n = np.empty((3, 3)), np.empty((3, 3))
    for i in range(len(cells)):
        for frame in FRAMES:
            least[i] = min(least[i], _frame(q, cells[i], frame, e, n))
    return least


@numba.njit(cache=True, inline="always")
def _between(q, a, b):
    return q[b, 0] - q[a, 0], q[b, 1] - q[a, 1], q[b, 2] - q[a, 2]


@numba.njit(cache=True, inline="always")
def _volume(a, b, c):
    """a . (b x c)"""
    return (
        a[0] * (b[1] * c[2] - b[2] * c[1]) + a[1] * (b[2] * c[0] - b[0] * c[2]) + a[2] * (b[0] * c[1] - b[1] * c[0])
    )


@numba.njit(cache=True)
def inverted_cells(q: np.ndarray, cells: np.ndarray) -> tuple[int, int, float]:
    """How many cells are inverted, which has the least corner volume (-1 if there are none), and that volume [m^3].

    What least_volumes tells, with each edge looked at once: every frame is looked through.
    """
    count, worst, least = 0, -1, np.inf
    for i in range(len(cells)):
        c = cells[i]
        x0, x1, x2, x3 = _between(q, c[0], c[1]), _between(q, c[3], c[2]), _between(q, c[4], c[5]), _between(q, c[7], c[6])
        y0, y1, y2, y3 = _between(q, c[0], c[3]), _between(q, c[1], c[2]), _between(q, c[4], c[7]), _between(q, c[5], c[6])
        z0, z1, z2, z3 = _between(q, c[0], c[4]), _between(q, c[1], c[5]), _between(q, c[2], c[6]), _between(q, c[3], c[7])
        volume = min(_volume(x0, y0, z0), _volume(x0, y1, z1), _volume(x1, y1, z2), _volume(x1, y0, z3))
        volume = min(volume, _volume(x2, y2, z0), _volume(x2, y3, z1), _volume(x3, y3, z2), _volume(x3, y2, z3))
        count += volume <= 0
        if volume < least:
            least, worst = volume, i
    return count, worst, least


@numba.njit(cache=True)
def resistance_energy(q: np.ndarray, cells: np.ndarray, resistance: np.ndarray, volume: float) -> float:
    """Energy [J]. resistance: K (c,) [J]; volume: J_0 h^3 [m^3]."""
    energy = 0.0
    e, n = np.empty((3, 3)), np.empty((3, 3))
    for i in range(len(cells)):
        for frame in FRAMES:
            lack = 1.0 - _frame(q, cells[i], frame, e, n) / volume
            if lack > 0.0:
                energy += resistance[i] * lack**3
    return energy


@numba.njit(cache=True)
def resistance_change(
    q: np.ndarray, base: np.ndarray, cells: np.ndarray, resistance: np.ndarray, volume: float
) -> float:
    """Energy at q less that at base [J], corner by corner from how the nodes moved, so that a small change keeps
    its digits: with d_k = e_k - e'_k,  J - J' = d_1 . e_2 x e_3 + d_2 . e_3 x e'_1 + d_3 . e'_1 x e'_2."""
    change = 0.0
    e, n, before, moved = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for i in range(len(cells)):
        cell, k_c = cells[i], resistance[i]
        for frame in FRAMES:
            lack_before = 1.0 - _frame(base, cell, frame, before, n) / volume
            lack = 1.0 - _frame(q, cell, frame, e, n) / volume
            if lack <= 0.0 and lack_before <= 0.0:
                continue
            if lack <= 0.0 or lack_before <= 0.0:
                change += k_c * (max(lack, 0.0) ** 3 - max(lack_before, 0.0) ** 3)
                continue
            for k in range(3):
                for c in range(3):
                    end, corner = cell[frame[k + 1]], cell[frame[0]]
                    moved[k, c] = (q[end, c] - base[end, c]) - (q[corner, c] - base[corner, c])
            _cross(e[2], before[0], n[1])
            _cross(before[0], before[1], n[2])  # n[0] is e_2 x e_3 from above
            larger = (moved * n).sum()
            change -= k_c * larger / volume * (lack**2 + lack * lack_before + lack_before**2)
    return change


@numba.njit(cache=True)
def add_resistance_gradient(
    q: np.ndarray, cells: np.ndarray, resistance: np.ndarray, volume: float, gradient: np.ndarray
) -> None:
    """Add the gradient [N] to ``gradient`` (l, 3)."""
    e, n = np.empty((3, 3)), np.empty((3, 3))
    for i in range(len(cells)):
        cell = cells[i]
        for frame in FRAMES:
            lack = 1.0 - _frame(q, cell, frame, e, n) / volume
            if lack > 0.0:
                slope = -3.0 * resistance[i] * lack * lack / volume
                for k in range(3):
                    for c in range(3):
                        gradient[cell[frame[k + 1]], c] += slope * n[k, c]
                        gradient[cell[frame[0]], c] -= slope * n[k, c]


@numba.njit(cache=True)
def add_resistance_hessian(
    q: np.ndarray,
    cells: np.ndarray,
    resistance: np.ndarray,
    volume: float,
    projected: bool,
    v: np.ndarray,
    product: np.ndarray,
) -> None:
    """Add (Hessian at q) v [N] to ``product`` (l, 3); ``projected`` leaves out what the curvature of J adds."""
    e, n, w, turned = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    for number in range(len(cells)):
        cell, k_c = cells[number], resistance[number]
        for frame in FRAMES:
            lack = 1.0 - _frame(q, cell, frame, e, n) / volume
            if lack <= 0.0:
                continue
            slope, curvature = -3.0 * k_c * lack * lack / volume, 6.0 * k_c * lack / volume**2
            change = 0.0
            for k in range(3):
                _edge(v, cell, frame, k + 1, w[k])
                change += n[k, 0] * w[k, 0] + n[k, 1] * w[k, 1] + n[k, 2] * w[k, 2]
            for k in range(3):
                one, two = (k + 1) % 3, (k + 2) % 3
                for c in range(3):
                    turned[c] = curvature * change * n[k, c]
                    if not projected:
                        i, j = (c + 1) % 3, (c + 2) % 3
                        turned[c] += slope * (
                            w[one, i] * e[two, j] - w[one, j] * e[two, i] + e[one, i] * w[two, j] - e[one, j] * w[two, i]
                        )
                    product[cell[frame[k + 1]], c] += turned[c]
                    product[cell[frame[0]], c] -= turned[c]
