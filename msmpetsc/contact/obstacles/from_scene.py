"""Obstacles made from a scene's tables."""

from pathlib import Path

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Floats
from msmpetsc.comm import log, on_root, together
from msmpetsc.constraints.loads import Motion
from msmpetsc.contact.obstacles.distance import FunctionSolid
from msmpetsc.contact.obstacles.moving_solid import Obstacle
from msmpetsc.contact.obstacles.solids import BallSolid, Faces, Solid
from msmpetsc.errors import InputError
from msmpetsc.extensions import OBSTACLES
from msmpetsc.geometry.prepare import prepare
from msmpetsc.geometry.registry import load
from msmpetsc.geometry.surface import Surface, check_encloses, examine
from msmpetsc.lattice.lattice import Lattice
from msmpetsc.scene.body import MeshTable
from msmpetsc.scene.obstacles import ObstacleTable
from msmpetsc.scene.reading import Scene

MOST_OFF = 0.01  # by which the gradient of a distance may differ from a unit vector in length


def build_obstacles(comm: MPI.Comm, scene: Scene, lattice: Lattice, outside: Floats | None) -> list[Obstacle]:
    """Return the obstacles of a scene, for nodes (l,) that stick ``outside`` [m] so far (collective).

    Raises InputError on all ranks for a mesh that is not closed, and for a function that is no signed distance.
    """
    obstacles = []
    for number, table in enumerate(scene.obstacle):
        key = f"obstacle.{number}"
        solid = _solid(comm, table, key, scene.folder)
        if isinstance(solid, FunctionSolid):
            with together(comm):
                length = 1.0  # of the gradients at most nodes, as a distance's are
                if lattice.owned:
                    _, gradient = solid.distances(lattice.nodes[: lattice.owned])
                    length = float(np.median(np.linalg.norm(gradient, axis=1)))
                if abs(length - 1) > MOST_OFF:
                    wrong = f"its gradient is {length:.3g} long at most nodes, not 1"
                    raise InputError(f"{key}.function: no signed distance: {wrong}")
        path = Motion.through(table.path, table.center)
        obstacles.append(Obstacle(solid, path, table.start, table.stop, key, outside))
    return obstacles


def obstacle_surface(mesh: MeshTable, key: str, folder: Path) -> Surface:
    """Return the surface of an obstacle that is a mesh. Raises InputError if it is not closed."""
    try:
        surface = prepare(load(mesh.source, folder), mesh.prepare, mesh.size, mesh.base)
        report = examine(surface)
        warnings = check_encloses(surface, report)
    except InputError as error:
        raise InputError(f"{key}.mesh: {error}") from error
    if not report.closed:
        raise InputError(f"{key}.mesh: must be closed: {warnings[0]}")
    for warning in warnings:
        log.warning("%s.mesh: %s: %s", key, mesh.source, warning)
    return surface


def _solid(comm: MPI.Comm, table: ObstacleTable, key: str, folder: Path) -> Solid:
    if table.mesh is not None:
        from msmpetsc.contact.obstacles.mesh_solid import MeshSolid  # and igl and trimesh: other scenes need neither

        mesh = table.mesh
        surface = comm.bcast(on_root(comm, lambda: obstacle_surface(mesh, key, folder)))
        return MeshSolid(surface)
    if table.function is not None:
        with together(comm):
            return FunctionSolid(OBSTACLES.find(table.function), key)
    if table.box is not None:
        return Faces.of_box(*np.array(table.box))
    if table.center is not None:
        return BallSolid(np.array(table.center), table.radius or 0.0)
    return Faces(np.array([table.point]), np.array([table.normal]))
