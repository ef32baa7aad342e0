"""Points of bodies that are nearest to given points."""

from collections.abc import Sequence

import numpy as np

from msmpetsc.backend.arrays import Indices, Positions
from msmpetsc.comm import Route
from msmpetsc.geometry.cages import BodySurface
from msmpetsc.geometry.surface import Surface, is_inside


def nearest_in_bodies(bodies: Sequence[BodySurface], points: Positions, body: Indices) -> Positions:
    """Return the nearest points (n, 3) [m] of bodies (n,) to points (n, 3) (collective)."""
    to_root = Route(bodies[0].comm, np.zeros(len(points), np.int64))
    nearest, of_point = to_root.send(points), to_root.send(body)
    for number in np.unique(of_point):
        own = of_point == number
        surface = bodies[number].surface
        assert surface is not None  # here
        nearest[own] = _drawn_in(surface, nearest[own])
    answer: Positions = to_root.answer(nearest)
    return answer


def _drawn_in(surface: Surface, points: Positions) -> Positions:
    """Return points (n, 3), those outside a surface projected onto it."""
    import igl  # for scenes with regions or obstacles

    closest = igl.point_mesh_squared_distance(points, surface.points, surface.triangles)[2]
    return np.where(is_inside(surface, points)[:, None], points, closest)
