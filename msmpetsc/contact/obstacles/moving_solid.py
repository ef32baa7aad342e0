"""Moving obstacles, built from a scene's tables, and the depths of nodes in obstacles."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Floats, Indices, Mask, Positions, Rows, greatest, like
from msmpetsc.comm import log, on_root, reduced, together
from msmpetsc.constraints.time_functions import Motion, Timed
from msmpetsc.contact.obstacles.distance import FunctionSolid, MeshSolid
from msmpetsc.contact.obstacles.solids import BallSolid, Faces, Planes, Send, Solid, no_sides
from msmpetsc.elasticity.locate import node_of_greatest
from msmpetsc.errors import InputError
from msmpetsc.extensions import OBSTACLES
from msmpetsc.geometry.prepare import prepare
from msmpetsc.geometry.registry import load
from msmpetsc.geometry.surface import Surface, check_encloses, examine
from msmpetsc.lattice.lattice import Lattice
from msmpetsc.scene.body import MeshTable
from msmpetsc.scene.obstacles import ObstacleTable

# greatest depth that counts as touching, not as overlap [cells]; above rounding
TOUCHING = 1e-6
# greatest deviation of a signed distance's gradient from unit length [-]; a rough test
GRADIENT_TOLERANCE = 0.01


@dataclass(frozen=True)
class Obstacle(Timed):
    """A solid that may move, and may act for a limited time.

    solid   : the solid in its pose at time 0
    path    : motion of the solid
    key     : key of its table in the scene, for messages
    outside : (l,) distance by which nodes lie outside the surface at rest [m]
              (lattice.nearest_points), subtracted from their depth; None for whole cells
    """

    solid: Solid
    path: Motion
    key: str = "obstacle"
    outside: Floats | None = None

    def seen_from(self, q: Positions, time: float) -> Positions:
        """Return positions (n, 3) [m] at a time [s] in the frame of the solid."""
        return q - like(q, self.path.displacement_at(time)) if self.path.is_moving else q

    def depths(
        self, q: Positions, time: float, sides: Indices | None = None
    ) -> tuple[Floats, Indices]:
        """Return depths (n,) [m] of the surface at nodes q (n, 3) [m], and faces (n,).

        sides : (n or more,) sides of the nodes (solids.side_of); None for the nearest face
        """
        depths, face = self.solid.depths(self.seen_from(q, time), sides)
        return depths if self.outside is None else depths - self.outside[: len(q)], face

    def normals_at(self, q: Positions, time: float, face: Indices) -> Rows:
        """Return unit normals (n, 3) of faces (n,) at positions (n, 3) [m] in the solid."""
        return self.solid.normals(self.seen_from(q, time), face)

    def sides(
        self,
        q: Positions,
        end: Positions,
        time: float,
        time_step: float,
        before: Indices | None = None,
    ) -> Indices:
        """Return the sides (n,) of nodes on straight paths from q to ``end`` (n, 3) [m] in a step.

        If the obstacle begins to act in the step, a node inside gets the nearest face.

        time   : end of the step [s]
        before : (n,) sides at the beginning of the step
        """
        if not (self.acts_at(time) and isinstance(self.solid, Faces)):
            return no_sides(q)
        begin = max(time - time_step, 0.0)
        if not self.acts_at(begin):
            q, begin = end, time
        before = no_sides(q) if before is None else before
        return self.solid.sides_of(self.seen_from(q, begin), self.seen_from(end, time), before)

    def sent(self, send: Send) -> "Obstacle":
        """Return the obstacle with the arrays that a step uses, moved to a device by ``send``."""
        outside = None if self.outside is None else send(self.outside)
        return replace(self, solid=self.solid.sent(send), outside=outside)


def build_obstacles(
    comm: MPI.Comm,
    tables: Sequence[ObstacleTable],
    folder: Path,
    lattice: Lattice,
    outside: Floats | None,
) -> list[Obstacle]:
    """Return the obstacles of a scene's tables (collective).

    folder  : folder that paths of meshes start from
    outside : (l,) distance by which nodes lie outside the surface at rest [m]

    Raises InputError on all ranks if a mesh is not closed or a function is not a signed distance.
    """
    obstacles = []
    for number, table in enumerate(tables):
        key = f"obstacle.{number}"
        solid = _solid(comm, table, key, folder, lattice.nodes[: lattice.owned])
        path = Motion.through(table.path, table.center)
        obstacles.append(Obstacle(solid, path, key, outside, start=table.start, stop=table.stop))
    return obstacles


def obstacle_surface(mesh: MeshTable, key: str, folder: Path) -> Surface:
    """Return the surface of an obstacle's mesh. Raises InputError if the mesh is not closed."""
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


def _solid(comm: MPI.Comm, table: ObstacleTable, key: str, folder: Path, nodes: Positions) -> Solid:
    """Return the solid of a table. A function is tested at the nodes (owned, 3) [m] at rest.

    Raises InputError if a mesh is not closed or a function is not a signed distance.
    """
    if table.mesh is not None:
        mesh = table.mesh
        surface = comm.bcast(on_root(comm, lambda: obstacle_surface(mesh, key, folder)))
        return MeshSolid(surface)
    if table.function is not None:
        with together(comm):
            solid = FunctionSolid(OBSTACLES.find(table.function), key)
            lengths = np.linalg.norm(solid.distances(nodes)[1], axis=1)
            if len(nodes) and abs(np.median(lengths) - 1) > GRADIENT_TOLERANCE:
                wrong = f"its gradient is {np.median(lengths):.3g} long at most nodes, not 1"
                raise InputError(f"{key}.function: no signed distance: {wrong}")
            return solid
    if table.box is not None:
        return Faces.of_box(*np.array(table.box))
    if table.center is not None:
        return BallSolid(np.array(table.center), table.radius or 0.0)
    return Faces(Planes(np.array([table.point]), np.array([table.normal])))


def describe_overlap(
    comm: MPI.Comm, lattice: Lattice, obstacle: Obstacle, q: Positions, fixed: Mask, time: float
) -> str | None:
    """Return a message about free nodes inside an obstacle; None if there are none (collective).

    Users seldom intend an overlap, and an obstacle that reflects does not remove it.

    q     : (l, 3) positions [m]
    fixed : (l,) bool, the nodes that are not free
    """
    owned = slice(lattice.owned)
    inside, _ = obstacle.depths(q[owned], time)
    rows = np.flatnonzero((inside > TOUCHING * lattice.cell_size) & ~fixed[owned])
    count = reduced(comm, len(rows))
    if not count:
        return None
    deepest = reduced(comm, greatest(inside[rows]), MPI.MAX)
    nodes = f"{count} node{'s' if count > 1 else ''}"
    worst = node_of_greatest(comm, lattice, rows, inside[rows])
    cells = deepest / lattice.cell_size
    return f"{nodes} inside {obstacle.key}, up to {deepest:.3g} m ({cells:.2g} cells) deep: {worst}"
