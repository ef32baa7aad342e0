"""How far nodes stick out of the surface: the corners of boundary cells, by up to the diagonal of a cell.

An obstacle should be met by the surface, not by the lattice that carries it. A node that sticks out by d meets it when
it is d deep: there the surface is. Where the surface is flat as far as a cell that is exact, however the body has
turned. Where cells count whole there is nothing to correct: the lattice is the body.
"""

import numpy as np

from msmpetsc.comm import Route
from msmpetsc.geometry.cages import Body, Cages
from msmpetsc.geometry.grid import encode_morton
from msmpetsc.geometry.surface import is_inside
from msmpetsc.model.lattice import Lattice

INNER_SPRINGS = 26  # of a node within eight cells: it may stick out into a fold, where nothing comes


def distance_outside(body: Body, cages: Cages, lattice: Lattice) -> np.ndarray:
    """Return how far each node (l,) sticks out of the surface at rest [m], 0 within it (collective)."""
    owned = lattice.owned
    springs = np.bincount(lattice.springs.ravel(), minlength=len(lattice.nodes))[:owned]
    rows = np.flatnonzero(springs < INNER_SPRINGS)
    to_root = Route(body.comm, np.zeros(len(rows), np.int64))
    points = to_root.send(lattice.nodes[rows])
    distance = np.empty(0) if body.surface is None else _distance_outside(body, points)
    outside = np.zeros(owned)
    outside[rows] = to_root.answer(distance)
    ghosts = encode_morton(cages.grid.nearest_nodes(lattice.nodes[owned:]))
    return np.concatenate([outside, lattice.table.rows_of(ghosts, outside)])


def _distance_outside(body: Body, points: np.ndarray) -> np.ndarray:
    """Return how far points (n, 3) lie outside the surface, which is here (n,) [m]."""
    import igl  # for scenes with obstacles

    surface = body.surface
    assert surface is not None
    if len(points) == 0:
        return np.empty(0)
    squares = igl.point_mesh_squared_distance(points, surface.points, surface.triangles)[0]
    return np.where(is_inside(surface, points), 0.0, np.sqrt(squares))
