"""The surface that is pushed out of the body's cells: what its points and the cells are at rest."""

from collections.abc import Sequence

import numpy as np
from mpi4py import MPI

from msmpetsc.geometry.cages import Body
from msmpetsc.geometry.surface import Surface, joined
from msmpetsc.model.contact.outside import depth_below
from msmpetsc.model.lattice import Lattice
from msmpetsc.model.self_contact.cell_contacts import OverlappingSurface
from msmpetsc.model.self_contact.cells import Cells, Places
from msmpetsc.model.self_contact.points import SurfacePoints

PENALTY = 10.0  # stiffest springs for each face of a cell, as nodes in an obstacle have


def overlapping_surface(
    comm: MPI.Comm,
    surfaces: Sequence[Surface],
    bodies: Sequence[Body],
    points: SurfacePoints,
    lattice: Lattice,
    around: np.ndarray,
) -> OverlappingSurface:
    """Return the surfaces of bodies as what is pushed out of their cells (collective).

    surfaces : on rank 0, of which ``points`` are the points
    around   : (c, 8) local corner nodes of the cells around the nodes of this rank
    """
    surface, edge = joined(list(surfaces)), lattice.cell_size
    known = (surface.points, _areas(surface), [len(each.points) for each in surfaces]) if surface else None
    rest, areas, counts = comm.bcast(known)
    stiffness = PENALTY * lattice.stiffest(comm) * areas / edge**2
    places = Places(rest, np.repeat(np.arange(len(counts)), counts))
    owned = around[:, 0] < lattice.owned
    around = np.concatenate([around[owned], around[~owned]])
    first = around[:, 0]
    depth = _depths(comm, bodies, lattice)[around]
    cells = Cells(around, lattice.nodes[first], depth, lattice.body[first], edge)
    return OverlappingSurface(surface, points, places, stiffness, cells, int(owned.sum()))


def _areas(surface: Surface) -> np.ndarray:
    """Return a third of the area (p,) of the triangles around each point [m^2]."""
    corners = surface.points[surface.triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    thirds = np.repeat(np.linalg.norm(normals, axis=1) / 6, 3)
    return np.bincount(surface.triangles.ravel(), thirds, len(surface.points))


def _depths(comm: MPI.Comm, bodies: Sequence[Body], lattice: Lattice) -> np.ndarray:
    """Return how deep each node (l,) is below its body's surface at rest [m], negative outside (collective)."""
    depths, of_node = np.zeros(len(lattice.nodes)), lattice.body
    for number, body in enumerate(bodies):
        surface, rows = comm.bcast(body.surface), np.flatnonzero(of_node == number)
        if len(rows):
            depths[rows] = depth_below(surface, lattice.nodes[rows])
    return depths
