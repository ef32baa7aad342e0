"""Find the part of a cell that holds a point, and the point of a part nearest to a node."""

from dataclasses import dataclass

import numpy as np

from msmpetsc.backend.arrays import Indices, Rows
from msmpetsc.geometry.grid import packed
from msmpetsc.geometry.partition import places_of, rows_of
from msmpetsc.geometry.surface import Surface, is_inside


@dataclass(frozen=True)
class PartsOfPoints:
    """Finder of the part of a cell that holds a point on or near the surface.

    surface  : the body's surface
    keys     : (s,) packed grid indices of the cells with several parts, and of cells separated from
               a neighbour, ascending
    cell     : (r,) number of the cell of each row, ascending
    triangle : (r,) triangle in the cell
    part     : (r,) part that the triangle bounds
    """

    surface: Surface
    keys: Indices
    cell: Indices
    triangle: Indices
    part: Indices

    def find(self, points: Rows, ijk: Indices) -> Indices:
        """Return the part (n,) that holds each point (n, 3) [m] in its cell (n, 3).

        The part is the part that the cell's nearest triangle bounds.
        """
        import igl

        cell = places_of(self.keys, packed(ijk))
        part = np.zeros(len(points), np.int64)
        order = np.argsort(cell)
        sorted_cell = cell[order]
        # a cell of a single part has part 0
        for number in np.intersect1d(cell, self.cell[self.part > 0]):
            own = order[slice(*np.searchsorted(sorted_cell, [number, number + 1]))]
            rows = slice(*np.searchsorted(self.cell, [number, number + 1]))
            triangles = self.surface.triangles[self.triangle[rows]]
            nearest = igl.point_mesh_squared_distance(points[own], self.surface.points, triangles)
            part[own] = self.part[rows][nearest[1]]
        return part

    def nearest(self, points: Rows, ijk: Indices, part: Indices) -> Rows:
        """Return the point (n, 3) [m] nearest to each node (n, 3) [m] in the node's parts.

        A row is nan unless all of the node's parts are in cells of ``keys``.

        ijk  : (n, 8, 3) cells around each node
        part : (n, 8) part of each cell that has the node as a corner, -1 if there is none
        """
        import igl

        nearest = np.full(points.shape, np.nan)
        cell = np.where(part >= 0, places_of(self.keys, packed(ijk)), -1)
        rows = np.flatnonzero(((cell >= 0) == (part >= 0)).all(axis=1) & (cell >= 0).any(axis=1))
        of_cell = np.full(len(self.keys), -1)
        for row, is_in in zip(rows, is_inside(self.surface, points[rows]), strict=True):
            held = cell[row] >= 0
            of_cell[cell[row, held]] = part[row, held]
            around = rows_of(self.cell, np.unique(cell[row, held]))
            is_own = self.part[around] == of_cell[self.cell[around]]
            triangles = self.surface.triangles[self.triangle[around]]
            given = points[row : row + 1], self.surface.points
            # a node inside the body is in the part whose boundary is nearest
            if not is_own.any():
                continue
            if is_in and is_own[igl.point_mesh_squared_distance(*given, triangles)[1]]:
                nearest[row] = points[row]
            else:
                nearest[row] = igl.point_mesh_squared_distance(*given, triangles[is_own])[2]
        return nearest
