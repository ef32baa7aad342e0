"""How far nodes stick out of the surface, and where the body is then: corners of boundary cells, by up to a diagonal.

An obstacle should be met by the surface, not by the lattice that carries it. A node that sticks out by d meets it when
it is d deep: there the surface is. Where the surface is flat as far as a cell that is exact, however the body has
turned. Where cells count whole there is nothing to correct: the lattice is the body.
"""

from collections.abc import Sequence

import numpy as np

from msmpetsc.backend.arrays import Floats, Positions
from msmpetsc.comm import Route
from msmpetsc.geometry.cages import BodySurface, Cages
from msmpetsc.geometry.grid import encode_morton
from msmpetsc.geometry.surface import is_inside
from msmpetsc.lattice.lattice import Lattice

INNER_SPRINGS = 26  # of a node within eight cells: it may stick out into a fold, where nothing comes


def nearest_of_body(bodies: Sequence[BodySurface], cages: Cages, lattice: Lattice) -> Positions:
    """Return the point (l, 3) [m] of its body that each node is nearest to at rest (collective).

    It is the node itself but where that sticks out of the surface.
    """
    import igl  # for scenes with regions or obstacles

    owned, comm = lattice.owned, bodies[0].comm
    springs = np.bincount(lattice.springs.ravel(), minlength=len(lattice.nodes))[:owned]
    body = lattice.body
    rows = np.flatnonzero((springs < INNER_SPRINGS) & np.array(cages.fills)[body[:owned]])
    to_root = Route(comm, np.zeros(len(rows), np.int64))
    points, of_point = to_root.send(lattice.nodes[rows]), to_root.send(body[rows])
    for number in np.unique(of_point):
        own = of_point == number
        surface = bodies[number].surface
        assert surface is not None  # here
        outside = ~is_inside(surface, points[own])[:, None]
        closest = igl.point_mesh_squared_distance(points[own], surface.points, surface.triangles)[2]
        points[own] = np.where(outside, closest, points[own])
    nearest = lattice.nodes[:owned].copy()
    nearest[rows] = to_root.answer(points)
    ghosts = encode_morton(cages.grids.nearest_nodes(lattice.nodes[owned:], body[owned:]))
    return np.concatenate([nearest, lattice.table.rows_of(ghosts, nearest)])


def distance_outside(lattice: Lattice, nearest: Positions) -> Floats:
    """Return how far each node (l,) sticks out of its body at rest [m], from the nearest points (l, 3) of that."""
    outside: Floats = np.linalg.norm(lattice.nodes - nearest, axis=1)
    return outside
