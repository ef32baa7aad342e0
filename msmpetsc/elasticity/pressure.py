"""Pressure p on surfaces that the lattice carries: a potential p V, and its derivatives.

A triangle (a, b, c) has the force -p (b - a) x (c - a) / 6 at each corner: the uniform pressure on
the linear triangle, at its present position. On a closed surface the forces are -p grad V, with V
the volume inside, positive if the normals point outwards. So the resultant is zero, and the Hessian
p grad grad V is symmetric. V is cubic along a straight path, so Simpson's rule, applied to the
derivative of V, gives the change of V exactly.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from msmpetsc.backend.arrays import Array, Floats, Positions, Rows
from msmpetsc.lattice.embedded_surface import SurfacePart, doubled_areas


class Pressures:
    """The potential of pressures, with the methods that Elasticity needs of a law (collective).

    parts  : surfaces under pressure
    values : pressure on each surface [Pa]; 0 until a step sets it
    """

    def __init__(self, parts: Sequence[SurfacePart], values: Sequence[float] = ()):
        self.parts, self.values = parts, tuple(values) or (0.0,) * len(parts)

    def change(self, q: Positions, base: Positions) -> float:
        """Return this rank's part of p (V(q) - V(base)) [J]."""
        change = 0.0
        for part, pressure in self._acting():
            start, way = part(base), part(q - base)
            ends = doubled_areas(start) + doubled_areas(start + way)
            mean = (ends + 4 * doubled_areas(start + 0.5 * way)) / 6
            change += pressure / 6 * float(np.vdot(mean, way.sum(axis=0)))
        return change

    def add_gradient(self, q: Positions, gradient: Rows) -> None:
        """Add p grad V [N] to the owned rows of ``gradient`` (l, 3)."""
        for part, pressure in self._acting():
            _add(part, pressure / 6 * doubled_areas(part(q)), gradient)

    def hessian_at(
        self, q: Positions, projected: bool, dtype: type = np.float64
    ) -> "PressureHessian":
        """Return p grad grad V at q, or zero if ``projected``, because it is indefinite."""
        acting = [] if projected else self._acting()
        return PressureHessian([(part, pressure, part(q)) for part, pressure in acting])

    def add_concavity(self, q: Positions, concavity: Floats) -> None:
        """Add a bound of the Hessian's negative part to the owned rows (l,) [N/m].

        The block of corners i, j of a triangle is p / 6 [e_j]x, with e_j the edge opposite j. A
        row of the symmetric part is at most p / 12 times the sum of |e_i| + |e_j| over j.
        """
        for part, pressure in self._acting():
            at = part(q)
            edges = np.linalg.norm(np.roll(at, -1, axis=0) - np.roll(at, 1, axis=0), axis=2)
            rows = 3 * edges + edges.sum(axis=0)
            _add(part, abs(pressure) / 12 * rows[:, :, None], concavity[:, None])

    def add_bound(self, q: Positions, blocks: Rows) -> None:
        """Add nothing, because multigrid leaves pressure out."""

    def resultants(self, q: Positions) -> Rows:
        """Return the force (p, 3) [N] of each pressure on this rank's triangles at q (l, 3) [m]."""
        areas = [0.5 * doubled_areas(part(q)).sum(axis=0) for part in self.parts]
        forces: Rows = -np.array(self.values)[:, None] * np.array(areas).reshape(-1, 3)
        return forces

    def _acting(self) -> list[tuple[SurfacePart, float]]:
        return [pair for pair in zip(self.parts, self.values, strict=True) if pair[1]]


@dataclass(frozen=True)
class PressureHessian:
    """The Hessian p grad grad V of surfaces under pressure (collective).

    A call adds the product with v (l, 3) [N] to the owned rows of ``product`` (l, 3).

    acting : for each surface its pressure [Pa] and the corners (3, f, 3) [m] of its triangles
    """

    acting: list[tuple[SurfacePart, float, Rows]]

    def __call__(self, v: Array, product: Array) -> None:
        for part, pressure, corners in self.acting:
            _add(part, _turned(corners, part(v), pressure), product)

    def triangles(self) -> Iterator[tuple[SurfacePart, Rows]]:
        """Yield each surface with the symmetric part (f, 9, 9) [N/m] of each triangle's matrix.

        Rows are ordered by corner, then by x, y and z. The antisymmetric parts cancel in the sum
        over the triangles.
        """
        unit = np.eye(9).reshape(9, 3, 1, 3).swapaxes(0, 1)
        for part, pressure, corners in self.acting:
            columns = _turned(corners, unit, pressure)
            matrices = np.tile(columns.transpose(1, 2, 0), (1, 3, 1))
            yield part, 0.5 * (matrices + matrices.transpose(0, 2, 1))


def _turned(corners: Rows, moves: Rows, pressure: float) -> Rows:
    """Return the change of p / 6 (b - a) x (c - a) as corners (a, b, c) move."""
    (a, b, c), (u, w, x) = corners, moves
    change: Rows = pressure / 6 * (np.cross(w - u, c - a) + np.cross(b - a, x - u))
    return change


def _add(part: SurfacePart, forces: Rows, rows: Rows) -> None:
    """Add forces on corners to the owned rows of ``rows`` (l, k).

    forces : (3, f, k) for each corner of the triangles, or (f, k) for all three corners
    """
    of_nodes = part.to_nodes(forces)
    rows[: len(of_nodes)] += of_nodes
