"""Resistance of cells to turning inside out, which springs cannot see: a mirrored cell has springs of the same lengths.

Each corner of a cell spans a box with the three edges that meet there; J is its signed volume over that at rest.
Where J < J_0 the corner has the energy  K (1 - J / J_0)^3,  K of its cell's material, nothing elsewhere, with two
continuous derivatives and a finite push even where J < 0: so a cell that has been turned is turned back, though its
neighbours may then hold it creased.

All positions are local, (l, 3), and a gradient is right at the owned nodes, as in elasticity.springs. Only cells that
resist are visited. On a CPU their corners add to the rows of their nodes, one after another; on a GPU each corner has a
row of its own, and each node sums those of its cells, so that sums come out the same every time.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from msmpetsc.backend.arrays import Floats, Indices, Positions, Rows, like, on_host, to_host
from msmpetsc.backend.kernel import kernel, njit
from msmpetsc.elasticity.cell_blocks import add_corners
from msmpetsc.elasticity.cell_strain import Six, strain
from msmpetsc.elasticity.springs import Product, Vector, Way, add_block, between, dot, rows_of
from msmpetsc.lattice.lattice import Lattice

# each corner of a cell (VTK's order), then the corners at the far ends of its three edges, right-handed
FRAMES = np.array(
    [[0, 1, 3, 4], [1, 2, 0, 5], [2, 3, 1, 6], [3, 0, 2, 7], [4, 7, 5, 0], [5, 4, 6, 1], [6, 5, 7, 2], [7, 6, 4, 3]]
)

Frame = tuple[Vector, Vector, Vector]  # of a corner's three edges, one each


class Resistance(NamedTuple):
    """Cells that resist, and what their corners add to.

    cells     : (c, 8) local corner nodes
    stiffness : (c,) K [J] of each
    volume    : J_0 h^3 [m^3]
    rows      : (c, 8) rows of a sum: on a CPU those of the nodes
    """

    cells: Indices
    stiffness: Floats
    volume: float
    rows: Indices


class Shapes(NamedTuple):
    """Corner nodes (c, 8) of a solid's cells, and their forms (c, FORM) (lattice.cell_moments)."""

    cells: Indices
    forms: Rows


class ResistanceAt(NamedTuple):
    """Cells that resist at positions q (l, 3) [m]; ``projected``: without what the curvature of J adds."""

    law: Resistance
    q: Positions
    projected: bool = True


@njit(inline="always")
def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit()
def edges(q: Positions, cell: Indices, frame: int) -> Frame:
    """Return the edges [m] from a corner of a cell to the far ends of its three edges."""
    corner = cell[FRAMES[frame, 0]]
    return (
        between(q, corner, cell[FRAMES[frame, 1]]),
        between(q, corner, cell[FRAMES[frame, 2]]),
        between(q, corner, cell[FRAMES[frame, 3]]),
    )


@njit()
def cofactors(e: Frame) -> Frame:
    """Return the slopes of the volume of three edges [m^2], one for each edge."""
    return _cross(e[1], e[2]), _cross(e[2], e[0]), _cross(e[0], e[1])


@njit()
def _volume(a: Vector, b: Vector, c: Vector) -> float:
    """Return a . (b x c)."""
    return dot(a, _cross(b, c))


@njit()
def corner_change(e: Frame, before: Frame, d: Frame, resistance: float, least: float) -> float:
    """Return the energy of a corner of the edges e less that of its edges ``before``, which changed by d [J].

    least : J_0 h^3 [m^3]

    It comes from how the nodes moved, so that a small change keeps its digits: with d_k = e_k -
    e'_k, J - J' = d_1 . e_2 x e_3 + d_2 . e_3 x e'_1 + d_3 . e'_1 x e'_2.
    """
    lack = 1.0 - _volume(e[0], e[1], e[2]) / least
    lack_before = 1.0 - _volume(before[0], before[1], before[2]) / least
    if lack <= 0.0 or lack_before <= 0.0:
        return resistance * (max(lack, 0.0) ** 3 - max(lack_before, 0.0) ** 3)
    larger = dot(d[0], _cross(e[1], e[2])) + dot(d[1], _cross(e[2], before[0]))
    larger += dot(d[2], _cross(before[0], before[1]))
    return -resistance * larger / least * (lack**2 + lack * lack_before + lack_before**2)


@njit()
def corner_slope(e: Frame, n: Frame, resistance: float, least: float) -> float:
    """Return d energy / d volume of a corner with the edges e and cofactors n [N/m^2]: not positive."""
    lack = max(1.0 - dot(e[0], n[0]) / least, 0.0)
    return -3.0 * resistance * lack * lack / least


@njit()
def corner_product(e: Frame, n: Frame, w: Frame, resistance: float, least: float, projected: bool) -> Frame:
    """Return the product of a corner's Hessian with changes w of its edges, one vector for each edge [N].

    projected : without what the curvature of J adds
    """
    slope, curvature = corner_slope(e, n, resistance, least), corner_curvature(e, n[0], resistance, least)
    change = curvature * (dot(n[0], w[0]) + dot(n[1], w[1]) + dot(n[2], w[2]))
    if projected:
        slope = 0.0
    return (
        _turned(change, n[0], slope, _cross(w[1], e[2]), _cross(e[1], w[2])),
        _turned(change, n[1], slope, _cross(w[2], e[0]), _cross(e[2], w[0])),
        _turned(change, n[2], slope, _cross(w[0], e[1]), _cross(e[0], w[1])),
    )


@njit(inline="always")
def _turned(change: float, n: Vector, slope: float, a: Vector, b: Vector) -> Vector:
    """Return change n + slope (a + b)."""
    return (
        change * n[0] + slope * (a[0] + b[0]),
        change * n[1] + slope * (a[1] + b[1]),
        change * n[2] + slope * (a[2] + b[2]),
    )


@njit()
def least_volume(q: Positions, c: Indices) -> float:
    """Return the least of the eight corner volumes of a cell [m^3]; each edge is read once."""
    x0, x1, x2, x3 = between(q, c[0], c[1]), between(q, c[3], c[2]), between(q, c[4], c[5]), between(q, c[7], c[6])
    y0, y1, y2, y3 = between(q, c[0], c[3]), between(q, c[1], c[2]), between(q, c[4], c[7]), between(q, c[5], c[6])
    z0, z1, z2, z3 = between(q, c[0], c[4]), between(q, c[1], c[5]), between(q, c[2], c[6]), between(q, c[3], c[7])
    volume = min(_volume(x0, y0, z0), _volume(x0, y1, z1), _volume(x1, y1, z2), _volume(x1, y0, z3))
    return float(min(volume, _volume(x2, y2, z0), _volume(x2, y3, z1), _volume(x3, y3, z2), _volume(x3, y2, z3)))


@kernel
def _least_volume_of(
    first: int, count: int, step: int, q: Positions, cells: Indices, least: Floats,
) -> None:  # fmt: skip
    for i in range(first, count, step):
        least[i] = least_volume(q, cells[i])


@kernel
def _change_of(first: int, count: int, step: int, parts: Floats, law: Resistance, way: Way) -> None:
    base, q, moved = way
    for i in range(first, count, step):
        change, cell = 0.0, law.cells[i]
        if min(least_volume(q, cell), least_volume(base, cell)) < law.volume:  # of few; it reads each edge once
            for frame in range(8):
                e, before, d = edges(q, cell, frame), edges(base, cell, frame), edges(moved, cell, frame)
                change += corner_change(e, before, d, law.stiffness[i], law.volume)
        parts[i] = change


def least_volumes(q: Positions, cells: Indices) -> Floats:
    """Return the least of the eight corner volumes of each cell (c,) [m^3]: not positive in an inverted one."""
    least = np.empty(len(cells), like=q)
    _least_volume_of(len(cells), q, cells, least)
    return least


@njit(inline="always")
def _mean_slope(q: Positions, c: Indices, k: int, form: Six) -> Vector:
    corners = q[c[0], k], q[c[1], k], q[c[3], k], q[c[2], k], q[c[4], k], q[c[5], k], q[c[7], k], q[c[6], k]
    x, y, z, _, _, _, _ = strain(corners, form)
    return x, y, z


@kernel
def _mean_volume_of(first: int, count: int, step: int, volumes: Floats, q: Positions, shapes: Shapes) -> None:
    cells, forms = shapes
    for i in range(first, count, step):
        f, c = forms[i], cells[i]
        form = f[0], f[1], f[2], f[3], f[4], f[5]
        volumes[i] = _volume(_mean_slope(q, c, 0, form), _mean_slope(q, c, 1, form), _mean_slope(q, c, 2, form))


def volume_ratios(q: Positions, cells: Indices, forms: Rows, cell_size: float) -> Floats:
    """Return J (c,) of a solid's cells: det of the mean slope of q (l, 3) [m] over what is inside, 1 at rest [-]."""
    volumes: Floats = np.empty(len(cells), like=q)
    _mean_volume_of(len(cells), volumes, q, Shapes(cells, forms))
    return volumes / (4.0 * cell_size) ** 3


@njit()
def _add_corner(rows: Rows, at: Indices, frame: int, factor: float, vectors: Frame) -> None:
    """Three vectors to the far ends of a corner's edges, and what balances them to the corner."""
    for role in range(4):
        row, vector = rows[at[FRAMES[frame, role]]], vector_of(role, vectors)
        row[0] += factor * vector[0]
        row[1] += factor * vector[1]
        row[2] += factor * vector[2]


@njit()
def corner_curvature(e: Frame, n: Vector, resistance: float, least: float) -> float:
    """Return d^2 energy / d volume^2 of a corner with the edges e, n the first of its cofactors
    [N/m^5]: not negative, and 0 where it does not resist."""
    return 6.0 * resistance * max(1.0 - dot(e[0], n) / least, 0.0) / least**2


@njit()
def vector_of(role: int, vectors: Frame) -> Vector:
    """Return, of three vectors at the far ends of a corner's edges, that of a role; the corner's balances them."""
    a, b, c = vectors
    if role == 0:
        return -(a[0] + b[0] + c[0]), -(a[1] + b[1] + c[1]), -(a[2] + b[2] + c[2])
    if role == 1:
        return a
    return b if role == 2 else c


@kernel
def _add_gradient(first: int, count: int, step: int, gradient: Rows, cells: ResistanceAt) -> None:
    law, q, _ = cells
    for i in range(first, count, step):
        for frame in range(8):
            e = edges(q, law.cells[i], frame)
            n = cofactors(e)
            slope = corner_slope(e, n, law.stiffness[i], law.volume)
            if slope < 0.0:
                _add_corner(gradient, law.rows[i], frame, slope, n)


@kernel
def _add_product(first: int, count: int, step: int, product: Rows, cells: ResistanceAt, v: Rows) -> None:
    law, q, projected = cells
    for i in range(first, count, step):
        for frame in range(8):
            e = edges(q, law.cells[i], frame)
            n = cofactors(e)
            if corner_slope(e, n, law.stiffness[i], law.volume) < 0.0:
                w = edges(v, law.cells[i], frame)
                _add_corner(
                    product, law.rows[i], frame, 1.0, corner_product(e, n, w, law.stiffness[i], law.volume, projected)
                )


@kernel
def _add_bound(first: int, count: int, step: int, blocks: Rows, cells: ResistanceAt) -> None:
    law, q, _ = cells
    for i in range(first, count, step):
        for frame in range(8):
            e = edges(q, law.cells[i], frame)
            n = cofactors(e)
            curvature = corner_curvature(e, n[0], law.stiffness[i], law.volume)
            if curvature > 0.0:
                for role in range(4):
                    block = blocks[law.rows[i, FRAMES[frame, role]]]
                    add_block(block, 0.0, 2.0 * curvature, vector_of(role, n))


@dataclass(frozen=True)
class Cells:
    """The cells of a rank that resist: all that its nodes are corners of, those that it owns first.

    owned  : number of cells that it owns
    around : (8, owned) on a GPU the rows of each owned node among those of all cells' corners, the last row past them;
        (8, 0) on a CPU
    """

    law: Resistance
    owned: int
    around: Indices

    @classmethod
    def of_lattice(cls, lattice: Lattice, stiffness: Floats, volume: float) -> "Cells":
        """Return the cells of a lattice, in the memory that its nodes are in."""
        cells, around = lattice.local_cells, np.empty((8, 0), np.int64)
        if not on_host(cells):
            around = rows_of(to_host(cells).ravel(), lattice.owned)
        law = Resistance(cells, like(cells, stiffness), volume, cells)
        return cls(law, lattice.cells_owned, like(cells, around))

    def change(self, q: Positions, base: Positions) -> float:
        """Return the energy at q less that at base [J] of the cells that this rank owns,
        corner by corner so that a small change keeps its digits."""
        parts = np.empty(self.owned, like=q)
        _change_of(len(parts), parts, self.law, Way.to(q, base))
        return float(parts.sum())

    def resisting(self, q: Positions) -> Resistance:
        """Return the cells that resist at q, few, so that sums need not visit the others."""
        few = np.flatnonzero(least_volumes(q, self.law.cells) < self.law.volume)
        cells = self.law.cells[few]
        rows = cells if on_host(cells) else 8 * few[:, None] + like(few, np.arange(8))
        return Resistance(cells, self.law.stiffness[few], self.law.volume, rows)

    def _sum(self, loop: Callable[..., None], cells: ResistanceAt, rows: Rows, *given: Rows) -> None:
        """Let a loop over the cells add to rows of nodes."""
        count, corners = len(cells.law.cells), 8 * len(self.law.cells)
        add_corners(lambda to: loop(count, to, cells, *given), self.around, corners, rows)

    def add_gradient(self, q: Positions, gradient: Rows) -> None:
        """Add the gradient [N] to the owned rows of ``gradient`` (l, 3)."""
        self._sum(_add_gradient, ResistanceAt(self.resisting(q), q), gradient)

    def hessian_at(self, q: Positions, projected: bool, _: type = np.float64) -> Product:
        """Return what adds (Hessian at q) v [N] to its second argument, ``projected`` without the curvature of J."""
        cells = ResistanceAt(self.resisting(q), q.copy(), projected)
        return lambda v, product: self._sum(_add_product, cells, product, v)

    def add_bound(self, q: Positions, blocks: Rows) -> None:
        """Add twice the diagonal blocks of the projected Hessian at q to ``blocks`` (l, 9) [N/m]."""
        self._sum(_add_bound, ResistanceAt(self.resisting(q), q), blocks)
