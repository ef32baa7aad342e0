"""Resistance of cells to turning inside out, which springs cannot see: a mirrored cell has springs of the same lengths.

Each corner of a cell spans a box with the three edges that meet there; J is its signed volume over that at rest.
Where J < J_0 the corner has the energy  K (1 - J / J_0)^3,  K of its cell's material, nothing elsewhere, with two
continuous derivatives and a finite push even where J < 0: so a cell that has been turned is turned back, though its
neighbours may then hold it creased.

All positions are local, (l, 3), and a gradient is right at the owned nodes, as in elasticity.springs. As there, two
loops sum the corners: ``CellScatter`` on a CPU, ``CellGather`` on a GPU, which on a CPU takes 2 to 6 times as long.
"""

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numba
import numpy as np

from msmpetsc.backend.arrays import Array, Floats, Indices, Positions, Rows, like, to_host
from msmpetsc.backend.kernel import kernel
from msmpetsc.elasticity.springs import Product, Vector, between
from msmpetsc.lattice.lattice import Lattice

# each corner of a cell (VTK's order), then the corners at the far ends of its three edges, right-handed
FRAMES = np.array(
    [[0, 1, 3, 4], [1, 2, 0, 5], [2, 3, 1, 6], [3, 0, 2, 7], [4, 7, 5, 0], [5, 4, 6, 1], [6, 5, 7, 2], [7, 6, 4, 3]]
)
# which of a frame (first) a cell's corner (second) is: 0 the frame's own corner, 1 to 3 the far end of that edge,
# -1 nothing
ROLE = np.full((8, 8), -1)
np.put_along_axis(ROLE, FRAMES, np.arange(4)[None, :], axis=1)

Frame = tuple[Vector, Vector, Vector]  # of a corner's three edges, one each


@numba.njit(cache=True, inline="always")
def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@numba.njit(cache=True, inline="always")
def _dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@numba.njit(cache=True, inline="always")
def _sum(a: Vector, b: Vector, c: Vector) -> Vector:
    return a[0] + b[0] + c[0], a[1] + b[1] + c[1], a[2] + b[2] + c[2]


@numba.njit(cache=True)
def edges(q: Positions, cell: Indices, frame: int) -> Frame:
    """Return the edges [m] from a corner of a cell to the far ends of its three edges."""
    corner = cell[FRAMES[frame, 0]]
    return (
        between(q, corner, cell[FRAMES[frame, 1]]),
        between(q, corner, cell[FRAMES[frame, 2]]),
        between(q, corner, cell[FRAMES[frame, 3]]),
    )


@numba.njit(cache=True)
def cofactors(e: Frame) -> Frame:
    """Return the slopes of the volume of three edges [m^2], one for each edge."""
    return _cross(e[1], e[2]), _cross(e[2], e[0]), _cross(e[0], e[1])


@numba.njit(cache=True)
def _volume(a: Vector, b: Vector, c: Vector) -> float:
    """Return a . (b x c)."""
    return _dot(a, _cross(b, c))


@numba.njit(cache=True)
def lack_of(volume: float, least: float) -> float:
    """Return 1 - J / J_0 of a corner; ``least``: J_0 h^3 [m^3]."""
    return 1.0 - volume / least


@numba.njit(cache=True)
def corner_change(q: Positions, base: Positions, cell: Indices, frame: int, resistance: float, least: float) -> float:
    """Return the energy of a corner at q less that at base [J].

    It comes from how the nodes moved, so that a small change keeps its digits: with d_k = e_k -
    e'_k, J - J' = d_1 . e_2 x e_3 + d_2 . e_3 x e'_1 + d_3 . e'_1 x e'_2.
    """
    e, before = edges(q, cell, frame), edges(base, cell, frame)
    lack = lack_of(_volume(e[0], e[1], e[2]), least)
    lack_before = lack_of(_volume(before[0], before[1], before[2]), least)
    if lack <= 0.0 and lack_before <= 0.0:
        return 0.0
    if lack <= 0.0 or lack_before <= 0.0:
        return resistance * (max(lack, 0.0) ** 3 - max(lack_before, 0.0) ** 3)
    corner = cell[FRAMES[frame, 0]]
    d_1 = _farther(q, base, corner, cell[FRAMES[frame, 1]])
    d_2 = _farther(q, base, corner, cell[FRAMES[frame, 2]])
    d_3 = _farther(q, base, corner, cell[FRAMES[frame, 3]])
    larger = _dot(d_1, _cross(e[1], e[2])) + _dot(d_2, _cross(e[2], before[0]))
    larger += _dot(d_3, _cross(before[0], before[1]))
    return -resistance * larger / least * (lack**2 + lack * lack_before + lack_before**2)


@numba.njit(cache=True, inline="always")
def _farther(q: Positions, base: Positions, a: int, b: int) -> Vector:
    """Return how an edge changed, from how its ends moved."""
    return (
        (q[b, 0] - base[b, 0]) - (q[a, 0] - base[a, 0]),
        (q[b, 1] - base[b, 1]) - (q[a, 1] - base[a, 1]),
        (q[b, 2] - base[b, 2]) - (q[a, 2] - base[a, 2]),
    )


@numba.njit(cache=True)
def corner_slope(e: Frame, n: Frame, resistance: float, least: float) -> float:
    """Return d energy / d volume of a corner with the edges e and cofactors n [N/m^2]: not positive."""
    lack = max(lack_of(_dot(e[0], n[0]), least), 0.0)
    return -3.0 * resistance * lack * lack / least


@numba.njit(cache=True)
def corner_product(e: Frame, n: Frame, w: Frame, resistance: float, least: float, projected: bool) -> Frame:
    """Return the product of a corner's Hessian with changes w of its edges, one vector for each edge [N].

    projected : without what the curvature of J adds
    """
    lack = lack_of(_dot(e[0], n[0]), least)
    slope, curvature = -3.0 * resistance * lack * lack / least, 6.0 * resistance * lack / least**2
    change = curvature * (_dot(n[0], w[0]) + _dot(n[1], w[1]) + _dot(n[2], w[2]))
    if projected:
        slope = 0.0
    return (
        _turned(change, n[0], slope, w[1], e[2], e[1], w[2]),
        _turned(change, n[1], slope, w[2], e[0], e[2], w[0]),
        _turned(change, n[2], slope, w[0], e[1], e[0], w[1]),
    )


@numba.njit(cache=True, inline="always")
def _turned(change: float, n: Vector, slope: float, w_1: Vector, e_2: Vector, e_1: Vector, w_2: Vector) -> Vector:
    """Return change n + slope (w_1 x e_2 + e_1 x w_2)."""
    a, b = _cross(w_1, e_2), _cross(e_1, w_2)
    return (
        change * n[0] + slope * (a[0] + b[0]),
        change * n[1] + slope * (a[1] + b[1]),
        change * n[2] + slope * (a[2] + b[2]),
    )


@numba.njit(cache=True)
def least_volume(q: Positions, c: Indices) -> float:
    """Return the least of the eight corner volumes of a cell [m^3]; each edge is read once."""
    x0, x1, x2, x3 = between(q, c[0], c[1]), between(q, c[3], c[2]), between(q, c[4], c[5]), between(q, c[7], c[6])
    y0, y1, y2, y3 = between(q, c[0], c[3]), between(q, c[1], c[2]), between(q, c[4], c[7]), between(q, c[5], c[6])
    z0, z1, z2, z3 = between(q, c[0], c[4]), between(q, c[1], c[5]), between(q, c[2], c[6]), between(q, c[3], c[7])
    volume = min(_volume(x0, y0, z0), _volume(x0, y1, z1), _volume(x1, y1, z2), _volume(x1, y0, z3))
    return float(min(volume, _volume(x2, y2, z0), _volume(x2, y3, z1), _volume(x3, y3, z2), _volume(x3, y2, z3)))


@kernel
def _least_volume_of(first: int, count: int, step: int, q: Positions, cells: Indices, least: Floats) -> None:
    for i in range(first, count, step):
        least[i] = least_volume(q, cells[i])


@kernel
def _energy_of(
    first: int, count: int, step: int, q: Rows, cells: Indices, resistance: Floats, least: float, parts: Floats
) -> None:
    for i in range(first, count, step):
        energy = 0.0
        for frame in range(8):
            e = edges(q, cells[i], frame)
            lack = max(lack_of(_volume(e[0], e[1], e[2]), least), 0.0)
            energy += resistance[i] * lack**3
        parts[i] = energy


@kernel
def _change_of(
    first: int, count: int, step: int, q: Rows, base: Rows, cells: Indices, stiffness: Floats, least: float, parts: Rows
) -> None:
    for i in range(first, count, step):
        change = 0.0
        if min(least_volume(q, cells[i]), least_volume(base, cells[i])) < least:  # of few; it reads each edge once
            for frame in range(8):
                change += corner_change(q, base, cells[i], frame, stiffness[i], least)
        parts[i] = change


def least_volumes(q: Positions, cells: Indices) -> Floats:
    """Return the least of the eight corner volumes of each cell (c,) [m^3]: not positive in an inverted one."""
    least = np.empty(len(cells), like=q)
    _least_volume_of(len(cells), q, cells, least)
    return least


class Resistance(NamedTuple):
    """Cells that resist: their local corner nodes (c, 8), K (c,) [J] of each, and J_0 h^3 [m^3]."""

    cells: Indices
    stiffness: Floats
    volume: float


def resistance_energy(q: Positions, law: Resistance) -> float:
    """Return the energy [J]."""
    parts = np.empty(len(law.cells), like=q)
    _energy_of(len(parts), q, *law, parts)
    return float(parts.sum())


def resistance_change(q: Positions, base: Positions, law: Resistance) -> float:
    """Return the energy at q less that at base [J], summed corner by corner so that a small change keeps its digits."""
    parts = np.empty(len(law.cells), like=q)
    _change_of(len(parts), q, base, *law, parts)
    return float(parts.sum())


@numba.njit(cache=True, inline="always")
def _add(rows: Rows, row: int, factor: float, vector: Vector) -> None:
    rows[row, 0] += factor * vector[0]
    rows[row, 1] += factor * vector[1]
    rows[row, 2] += factor * vector[2]


@numba.njit(cache=True)
def _add_corner(rows: Rows, cell: Indices, frame: int, factor: float, vectors: Frame) -> None:
    """Three vectors to the far ends of a corner's edges, and what balances them to the corner."""
    a, b, c = vectors
    _add(rows, cell[FRAMES[frame, 1]], factor, a)
    _add(rows, cell[FRAMES[frame, 2]], factor, b)
    _add(rows, cell[FRAMES[frame, 3]], factor, c)
    _add(rows, cell[FRAMES[frame, 0]], -factor, _sum(a, b, c))


@numba.njit(cache=True)
def add_resistance_gradient(q: Positions, law: Resistance, gradient: Rows) -> None:
    """Add the gradient [N] to ``gradient`` (l, 3)."""
    cells, stiffness, volume = law
    for i in range(len(cells)):
        for frame in range(8):
            e = edges(q, cells[i], frame)
            n = cofactors(e)
            slope = corner_slope(e, n, stiffness[i], volume)
            if slope < 0.0:
                _add_corner(gradient, cells[i], frame, slope, n)


@numba.njit(cache=True)
def add_resistance_hessian(q: Positions, law: Resistance, projected: bool, v: Rows, product: Rows) -> None:
    """Add (Hessian at q) v [N] to ``product`` (l, 3); ``projected`` leaves out what the curvature of J adds."""
    cells, stiffness, volume = law
    for i in range(len(cells)):
        for frame in range(8):
            e = edges(q, cells[i], frame)
            n = cofactors(e)
            if corner_slope(e, n, stiffness[i], volume) < 0.0:
                p = corner_product(e, n, edges(v, cells[i], frame), stiffness[i], volume, projected)
                _add_corner(product, cells[i], frame, 1.0, p)


@numba.njit(cache=True)
def corner_curvature(e: Frame, n: Vector, resistance: float, least: float) -> float:
    """Return d^2 energy / d volume^2 of a corner with the edges e, n the first of its cofactors
    [N/m^5]: not negative, and 0 where it does not resist."""
    return 6.0 * resistance * max(lack_of(_dot(e[0], n), least), 0.0) / least**2


@numba.njit(cache=True)
def add_square(block: Floats, factor: float, g: Vector) -> None:
    """Add factor g g^T to a block (9,)."""
    for r in range(3):
        for c in range(3):
            block[3 * r + c] += factor * g[r] * g[c]


@numba.njit(cache=True)
def add_resistance_bound(q: Positions, law: Resistance, blocks: Rows) -> None:
    """Add twice the diagonal blocks of the Hessian at q, without what the curvature of J adds, to ``blocks`` (l, 9)."""
    cells, stiffness, volume = law
    for i in range(len(cells)):
        for frame in range(8):
            e = edges(q, cells[i], frame)
            n = cofactors(e)
            curvature = corner_curvature(e, n[0], stiffness[i], volume)
            if curvature > 0.0:
                for role in range(4):
                    add_square(blocks[cells[i, FRAMES[frame, role]]], 2.0 * curvature, vector_of(role, n))


@numba.njit(cache=True)
def vector_of(role: int, vectors: Frame) -> Vector:
    """Return, of three vectors at the far ends of a corner's edges, that of a role; the corner's balances them."""
    a, b, c = vectors
    if role == 0:
        return -(a[0] + b[0] + c[0]), -(a[1] + b[1] + c[1]), -(a[2] + b[2] + c[2])
    if role == 1:
        return a
    return b if role == 2 else c


@dataclass(frozen=True)
class Cells:
    """The cells of a rank that resist: all that its nodes are corners of, and those that it ``owns``."""

    law: Resistance
    owned: Resistance

    @property
    def cells(self) -> Indices:
        """Local corner nodes (c, 8)."""
        return self.law.cells

    def energy(self, q: Positions) -> float:
        """Return the energy [J] of the cells that this rank owns."""
        return resistance_energy(q, self.owned)

    def change(self, q: Positions, base: Positions) -> float:
        """Return the energy at q less that at base [J], of the cells that this rank owns."""
        return resistance_change(q, base, self.owned)


def _laws_of(lattice: Lattice, stiffness: Floats, volume: float) -> tuple[Resistance, Resistance]:
    """Return the cells around the nodes of a rank, and those that it owns."""
    owned = slice(lattice.cells_owned)
    cells = lattice.local_cells
    return Resistance(cells, stiffness, volume), Resistance(cells[owned], stiffness[owned], volume)


@dataclass(frozen=True)
class CellScatter(Cells):
    """The cells one after another, those that the rank owns first: how a CPU sums them."""

    @classmethod
    def of_lattice(cls, lattice: Lattice, stiffness: Floats, volume: float) -> "CellScatter":
        """Return the cells of a lattice whose arrays are in the memory of the CPU."""
        return cls(*_laws_of(lattice, stiffness, volume))

    def add_gradient(self, q: Positions, gradient: Rows) -> None:
        """Add the gradient [N] to ``gradient`` (l, 3)."""
        add_resistance_gradient(q, self.law, gradient)

    def resisting(self, q: Positions) -> Resistance:
        """Return the cells that resist at q: few, so that products with the Hessian need not visit the others."""
        few = np.flatnonzero(least_volumes(q, self.cells) < self.law.volume)
        return Resistance(self.cells[few], self.law.stiffness[few], self.law.volume)

    def hessian_at(self, q: Positions, projected: bool, _: type = np.float64) -> Product:
        """Return what adds (Hessian at q) v [N] to its second argument."""
        return partial(add_resistance_hessian, q.copy(), self.resisting(q), projected)

    def add_bound(self, q: Positions, blocks: Rows) -> None:
        """Add what Elasticity.add_bound says to ``blocks`` (l, 9) [N/m]."""
        add_resistance_bound(q, self.resisting(q), blocks)


@dataclass(frozen=True)
class CellGather(Cells):
    """The cells around each owned node, a column of the arrays for each: how a GPU sums them.

    around : (8, owned) int32, which of the cells, -1 past the last
    corner : (8, owned) u1, which of its corners the node is
    """

    around: Indices
    corner: Array

    @classmethod
    def of_lattice(cls, lattice: Lattice, stiffness: Floats, volume: float) -> "CellGather":
        """Return the cells of a lattice, in the memory that its nodes are in."""
        nodes, owned = to_host(lattice.local_cells).ravel(), lattice.owned
        by_node = np.argsort(nodes, kind="stable")
        by_node = by_node[: np.searchsorted(nodes[by_node], owned)]
        node = nodes[by_node]
        slot = np.arange(len(node)) - np.searchsorted(node, node)
        around, corner = np.full((8, owned), -1, np.int32), np.zeros((8, owned), np.uint8)
        around[slot, node], corner[slot, node] = by_node // 8, by_node % 8
        stiffness, around, corner = (like(lattice.nodes, a) for a in (stiffness, around, corner))
        return cls(*_laws_of(lattice, stiffness, volume), around, corner)

    def add_gradient(self, q: Positions, gradient: Rows) -> None:
        """Add the gradient [N] to the owned rows of ``gradient``."""
        _cell_gradient_around(self.around.shape[1], q, *self._all, gradient)

    def hessian_at(self, q: Positions, projected: bool, _: type = np.float64) -> Product:
        """Return what adds (Hessian at q) v [N] to the owned rows of its second argument."""
        return partial(_cell_product_around, self.around.shape[1], q.copy(), *self._all, projected)

    def add_bound(self, q: Positions, blocks: Rows) -> None:
        """Add what Elasticity.add_bound says to the owned rows of ``blocks`` (l, 9) [N/m]."""
        _cell_bound_around(self.around.shape[1], q, *self._all, blocks)

    @property
    def _all(self) -> tuple[Indices, Floats, float, Indices, Array]:
        return *self.law, self.around, self.corner


@kernel
def _cell_gradient_around(first, count, step, q, cells, resistance, volume, around, corner, gradient):
    for i in range(first, count, step):
        gx, gy, gz = 0.0, 0.0, 0.0
        for a in range(8):
            c = around[a, i]
            if c < 0:
                break
            for frame in range(8):
                role = ROLE[frame, corner[a, i]]
                if role < 0:
                    continue
                e = edges(q, cells[c], frame)
                n = cofactors(e)
                slope = corner_slope(e, n, resistance[c], volume)
                x, y, z = vector_of(role, n)
                gx += slope * x
                gy += slope * y
                gz += slope * z
        gradient[i, 0] += gx
        gradient[i, 1] += gy
        gradient[i, 2] += gz


@kernel
def _cell_product_around(first, count, step, q, cells, resistance, volume, around, corner, projected, v, product):
    for i in range(first, count, step):
        px, py, pz = 0.0, 0.0, 0.0
        for a in range(8):
            c = around[a, i]
            if c < 0:
                break
            for frame in range(8):
                role = ROLE[frame, corner[a, i]]
                if role < 0:
                    continue
                e = edges(q, cells[c], frame)
                n = cofactors(e)
                if corner_slope(e, n, resistance[c], volume) >= 0.0:
                    continue
                p = corner_product(e, n, edges(v, cells[c], frame), resistance[c], volume, projected)
                x, y, z = vector_of(role, p)
                px += x
                py += y
                pz += z
        product[i, 0] += px
        product[i, 1] += py
        product[i, 2] += pz


@kernel
def _cell_bound_around(first, count, step, q, cells, resistance, volume, around, corner, blocks):
    for i in range(first, count, step):
        for a in range(8):
            c = around[a, i]
            if c < 0:
                break
            for frame in range(8):
                role = ROLE[frame, corner[a, i]]
                if role < 0:
                    continue
                e = edges(q, cells[c], frame)
                n = cofactors(e)
                add_square(blocks[i], 2.0 * corner_curvature(e, n[0], resistance[c], volume), vector_of(role, n))
