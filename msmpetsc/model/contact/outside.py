"""How far nodes stick out of the surface: the corners of boundary cells, by up to the diagonal of a cell.

An obstacle should be met by the surface, not by the lattice that carries it. A node that sticks out by d meets it when
it is d deep: there the surface is. Where the surface is flat as far as a cell that is exact, however the body has
turned. Where cells count whole there is nothing to correct: the lattice is the body.
"""

from collections.abc import Sequence

import numpy as np

from msmpetsc.comm import Route
from msmpetsc.geometry.cages import Body, Cages
from msmpetsc.geometry.grid import encode_morton
from msmpetsc.geometry.surface import Surface, is_inside
from msmpetsc.model.lattice import Lattice

INNER_SPRINGS = 26  # of a node within eight cells: it may stick out into a fold, where nothing comes


def distance_outside(bodies: Sequence[Body], cages: Cages, lattice: Lattice) -> np.ndarray:
    """Return how far each node (l,) sticks out of its body's surface at rest [m], 0 within it (collective)."""
    owned, comm = lattice.owned, bodies[0].comm
    springs = np.bincount(lattice.springs.ravel(), minlength=len(lattice.nodes))[:owned]
    body = lattice.body
    rows = np.flatnonzero((springs < INNER_SPRINGS) & np.array(cages.fills)[body[:owned]])
    to_root = Route(comm, np.zeros(len(rows), np.int64))
    points, of_point = to_root.send(lattice.nodes[rows]), to_root.send(body[rows])
    distance = np.zeros(len(points))
    for number in np.unique(of_point):
        own = of_point == number
        surface = bodies[number].surface
        assert surface is not None  # here
        distance[own] = np.maximum(-depth_below(surface, points[own]), 0.0)
    outside = np.zeros(owned)
    outside[rows] = to_root.answer(distance)
    ghosts = encode_morton(cages.grids.nearest_nodes(lattice.nodes[owned:], body[owned:]))
    return np.concatenate([outside, lattice.table.rows_of(ghosts, outside)])


def depth_below(surface: Surface, points: np.ndarray) -> np.ndarray:
    """Return how deep points (n, 3) lie below a surface (n,) [m], negative outside."""
    import igl  # for scenes with obstacles

    distance = np.sqrt(igl.point_mesh_squared_distance(points, surface.points, surface.triangles)[0])
    return np.where(is_inside(surface, points), distance, -distance)
