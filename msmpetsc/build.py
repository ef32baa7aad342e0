"""From a scene to what is simulated: surfaces, cages, lattice, embedding, loads, obstacles."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, reduce

import numpy as np
from mpi4py import MPI
from scipy.sparse import csr_array

from msmpetsc.backend.arrays import Array, Floats, Indices, Positions, Rows
from msmpetsc.comm import log, on_root
from msmpetsc.constraints.holders import Holders, Regions, clamped, taken
from msmpetsc.constraints.loads import Anchor, Load, Motion, OwnForce, shares_by_mass, total_of
from msmpetsc.contact.obstacles.distance import DistanceSolid
from msmpetsc.contact.obstacles.friction import STICK, smallest
from msmpetsc.contact.obstacles.moving_solid import Obstacle, build_obstacles
from msmpetsc.contact.obstacles.penalty import Penalty
from msmpetsc.contact.obstacles.reflection import Exchange
from msmpetsc.contact.surface.collision_surface import collision_surface
from msmpetsc.contact.surface.pairs import CollisionSurface
from msmpetsc.errors import InputError
from msmpetsc.extensions import FORCES
from msmpetsc.geometry.cages import BodySurface, Cages, choose_cell_size, fill, warn_of_thin_bodies
from msmpetsc.geometry.embedding import embed
from msmpetsc.geometry.grid import encode_morton
from msmpetsc.geometry.prepare import prepare
from msmpetsc.geometry.registry import load
from msmpetsc.geometry.surface import (
    Surface,
    SurfaceReport,
    bounds_of,
    check_encloses,
    compact,
    examine,
    joined,
)
from msmpetsc.lattice.initial_state import InitialState, initial_state
from msmpetsc.lattice.lattice import Lattice, Topology, build_lattice, topology_of
from msmpetsc.lattice.region import Finder, cell_materials, nearest_in_bodies
from msmpetsc.scene.motion import Gravity
from msmpetsc.scene.obstacles import BARRIER, ObstacleTable
from msmpetsc.scene.reading import Scene
from msmpetsc.scene.schema import OfBody, held_by

SIDES = 1e-60, 1e60  # [m]: the fourth power of a length still is a double
PENALTY = 10.0  # stiffest springs: what pushes a node out of an obstacle
FARTHEST = 1e9  # longest sides from the origin: leaves seven digits of the shape
USUAL = 1e-3, 20.0  # [m]: a body beyond these may well be given in another unit


@dataclass(frozen=True)
class Model:
    """A scene made ready to step. Arrays hold this rank's share; the surfaces are on rank 0 only.

    embedding : this rank's rows of W (geometry.embedding); None where the scene stores no surface
    loads     : gravity first, where there is any
    own_forces : forces that are functions of the state that starts a step
    start     : positions (l, 3) [m] and velocities (l, 3) [m/s] at time 0, ghosts included
    surface   : of all bodies, one after the other
    damping   : of velocities, by the mass [1/s]
    retardation : viscosity over stiffness [s]
    collision : the surface that meets itself, where it does
    obstacles : in the scene's order
    holders   : pins and anchors, and which nodes each has
    bodies    : surfaces, and what all ranks know of them
    taken     : what anchors and forces take, in words
    """

    surface: Surface | None
    lattice: Lattice
    embedding: csr_array | None
    loads: list[Load]
    anchors: list[Anchor]
    exchanges: list[Exchange]
    penalties: list[Penalty]
    start: InitialState
    collision: CollisionSurface | None = None
    bodies: tuple[BodySurface, ...] = ()
    taken: tuple[str, ...] = ()
    damping: float = 0.0
    retardation: float = 0.0
    own_forces: tuple[OwnForce, ...] = ()
    obstacles: tuple[Obstacle, ...] = ()
    holders: Holders = field(
        default_factory=lambda: Holders((), np.zeros(0, np.int64), np.zeros((0, 3)))
    )

    @property
    def body_of_point(self) -> Indices:
        """Return the number (v,) of the body of each surface point, on rank 0."""
        points = [0 if body.surface is None else len(body.surface.points) for body in self.bodies]
        return np.repeat(np.arange(len(points)), points)

    @cached_property
    def solids(self) -> dict[int, Surface]:
        """Return the surfaces of obstacles that are meshes or functions, by number, on rank 0 (collective at first)."""
        solids = {number: obstacle.solid for number, obstacle in enumerate(self.obstacles)}
        drawn = {
            number: solid for number, solid in solids.items() if isinstance(solid, DistanceSolid)
        }
        if not drawn:
            return {}
        low = np.min([body.bounds[0] for body in self.bodies], axis=0)
        high = np.max([body.bounds[1] for body in self.bodies], axis=0)
        comm = self.lattice.table.comm
        return (
            on_root(
                comm, lambda: {number: solid.surface(low, high) for number, solid in drawn.items()}
            )
            or {}
        )


class Geometry:
    """What meshes and cages alone decide, which runs of other materials, loads and times may share.

    bodies, cages, topology : surfaces, valid cells, and the nodes and springs that these make
    """

    def __init__(self, comm: MPI.Comm, scene: Scene):
        """Read the meshes and fill them (collective). Raises InputError on all ranks."""
        self.source = scene.folder, scene.meshes, scene.cages
        self.bodies = read_bodies(comm, scene)
        self.cages = fill_cages(self.bodies, scene)
        self.topology = topology_of(self.cages)

    def fits(self, scene: Scene) -> bool:
        """Return whether a scene has these meshes and these cages."""
        return self.source == (scene.folder, scene.meshes, scene.cages)

    @cached_property
    def embedding(self) -> csr_array:
        """Return how the surfaces follow the nodes (collective)."""
        points = [
            np.empty((0, 3)) if body.surface is None else body.surface.points
            for body in self.bodies
        ]
        _, _, cages = self.source
        return embed(points, self.cages, self.topology.table, cages.embedding, cages.smoothing)

    @cached_property
    def nearest(self) -> Positions:
        """Return the points (l, 3) [m] of the bodies that nodes are nearest to (collective)."""
        return nearest_of_body(self.bodies, self.cages, self.topology)

    def outside(self, nodes: Positions) -> Floats | None:
        """Return how far nodes (l, 3) stick out of surfaces [m]; None where cells are whole (collective)."""
        return None if self.cages.share is None else np.linalg.norm(nodes - self.nearest, axis=1)


def nearest_of_body(bodies: Sequence[BodySurface], cages: Cages, topology: Topology) -> Positions:
    """Return the point (l, 3) [m] of its body that each node is nearest to at rest (collective).

    It is the node itself but where that sticks out of the surface: corners of boundary cells, by up to a diagonal. An
    obstacle should be met by the surface, not by the lattice that carries it. A node that sticks out by d meets it when
    it is d deep: there the surface is. Where the surface is flat as far as a cell that is exact, however the body has
    turned. Where cells count whole there is nothing to correct: the lattice is the body.
    """
    owned, ghosts = np.split(topology.ijk, [len(topology.octants)])
    body = cages.grids.body_of(owned)
    # a node within eight cells may stick out into a fold only
    rows = np.flatnonzero(~topology.octants.all(axis=1) & np.array(cages.fills)[body])
    nearest = cages.grids.node_positions(owned)
    nearest[rows] = nearest_in_bodies(bodies, nearest[rows], body[rows])
    return np.concatenate([nearest, topology.table.rows_of(encode_morton(ghosts), nearest)])


def build_model(comm: MPI.Comm, scene: Scene, shape: Geometry | None = None) -> Model:
    """Build everything of a scene but its solver (collective). Raises InputError on all ranks.

    shape : of the scene's meshes and cages, where it is known already
    """
    shape = shape or Geometry(comm, scene)
    bodies, cages = shape.bodies, shape.cages
    finder = Finder(bodies, cages, scene.folder)
    lattice = build_lattice(cages, scene.material, cell_materials(scene, finder), shape.topology)
    tables = [table for kind in ("pin", "anchor", "force") for table in scene.tables(kind)]
    points = shape.nearest if tables else lattice.nodes
    masks = {table.key: finder.find(table, lattice, points) for table in tables}
    lattice = lattice.pin(
        reduce(np.logical_or, (masks[pin.key] for pin in scene.tables("pin")), lattice.pinned)
    )
    holders = Holders.of_masks({table.key: masks[table.key] for table in held_by(scene)}, lattice)
    anchors = _anchors(scene.tables("anchor"), lattice, masks, holders)
    fixed = reduce(np.logical_or, (anchor.where for anchor in anchors), lattice.pinned)
    outside = shape.outside(lattice.nodes) if scene.obstacle else None
    obstacles = build_obstacles(comm, scene, lattice, outside)
    loads, own_forces = _loads(comm, scene.gravity, scene.tables("force"), lattice, masks)
    exchanges, penalties = _contacts(comm, scene.obstacle, lattice, finder.bounds, obstacles)
    return Model(
        surface=joined([body.surface for body in bodies if body.surface is not None]),
        lattice=clamped(scene, lattice, masks, finder, points),
        embedding=shape.embedding if scene.output.surface else None,
        loads=loads,
        own_forces=own_forces,
        anchors=anchors,
        exchanges=exchanges,
        penalties=penalties,
        start=initial_state(comm, scene.starts, lattice, fixed, finder.bounds),
        bodies=bodies,
        collision=collision_surface(scene, bodies, cages, lattice, obstacles),
        taken=taken(comm, scene, lattice, anchors, masks),
        damping=scene.material.damping,
        retardation=scene.material.retardation_time,
        obstacles=tuple(obstacles),
        holders=holders,
    )


def to_device(model: Model, send: Callable[[Array], Array]) -> Model:
    """Return the model with the arrays that each step works with sent where ``send`` takes them.

    What only prepares steps stays in the memory of the CPU.
    """

    lattice, (positions, velocities), solid = model.lattice, model.start, model.lattice.solid
    return replace(
        model,
        lattice=replace(
            lattice,
            nodes=send(lattice.nodes),
            mass=send(lattice.mass),
            pinned=send(lattice.pinned),
            local_cells=send(lattice.local_cells),
            solid=solid and solid._replace(forms=send(solid.forms)),
        ),
        loads=[replace(load, share=send(load.share)) for load in model.loads],
        anchors=[replace(anchor, where=send(anchor.where)) for anchor in model.anchors],
        holders=replace(model.holders, number=send(model.holders.number)),
        exchanges=[
            replace(contact, obstacle=contact.obstacle.sent(send)) for contact in model.exchanges
        ],
        penalties=[
            replace(contact, obstacle=contact.obstacle.sent(send)) for contact in model.penalties
        ],
        start=(send(positions), send(velocities)),
    )


def read_bodies(comm: MPI.Comm, scene: Scene) -> tuple[BodySurface, ...]:
    """Return the prepared surfaces, on rank 0, and what all ranks must know (collective)."""
    found = on_root(comm, lambda: [*_prepared(scene)]) or []
    facts = comm.bcast([(report, bounds_of(surface)) for surface, report in found])
    surfaces: list[Surface | None] = [surface for surface, _ in found] or [None] * len(facts)
    return tuple(
        BodySurface(comm, surface, *known) for surface, known in zip(surfaces, facts, strict=True)
    )


def _prepared(scene: Scene) -> Iterator[tuple[Surface, SurfaceReport]]:
    """Yield each body's surface and report, checked; bodies of one shape are prepared once."""
    shapes: dict[str, Surface] = {}
    for path, mesh in scene.meshes.items():
        whose = "" if path == ("mesh",) else f"{'.'.join(map(str, path))}: "
        shape = repr(mesh.model_copy(update={"base": None}))
        try:
            if shape not in shapes:
                shapes[shape] = prepare(load(mesh.source, scene.folder), mesh.prepare, mesh.size)
            surface = prepare(shapes[shape], (), base=mesh.base)
            of_size = _doubtful_unit(surface, mesh.size)
            report = examine(surface)
            warnings = *check_encloses(surface, report), *of_size
        except InputError as error:
            raise InputError(f"{whose}{error}") from error
        for warning in warnings:
            log.warning("%s%s: %s", whose, mesh.source, warning)
        # an unused point may lie in no cell
        yield replace(compact(surface.points, surface.triangles), groups=surface.groups), report


def _doubtful_unit(surface: Surface, size: float | None) -> list[str]:
    """Return a warning of a body whose longest side is unusual, unless the scene says what it is.

    Raises InputError for a body whose volume or shape a double cannot hold.
    """
    points = surface.points[np.unique(surface.triangles)]
    side, reach = np.ptp(points, axis=0).max(), np.abs(points).max()
    if side > 0 and not (SIDES[0] <= side <= SIDES[1] and reach <= FARTHEST * side):
        raise InputError(
            f"the mesh is {side:.3g} m long and reaches {reach:.3g} m from the origin: "
            "too large, too small or too far away to compute with"
        )
    if size is not None or USUAL[0] <= side <= USUAL[1]:
        return []
    unit = "millimetres" if side > USUAL[1] else "another unit than metres"
    return [
        f"the body is {side:.3g} m long, and the scene gives no mesh.size: is the mesh in {unit}?"
    ]


def fill_cages(bodies: Sequence[BodySurface], scene: Scene) -> Cages:
    """Return the scene's valid cells (collective)."""
    cages = scene.cages  # which have a cell size or a count
    cell_size = cages.cell_size or choose_cell_size(
        bodies, cages.count or 0, cages.max_cells, cages.boundary
    )
    warn_of_thin_bodies(bodies, cell_size)
    return fill(bodies, cell_size, cages.max_cells, cages.boundary)


def _anchors(
    tables: Iterable[OfBody], lattice: Lattice, masks: Regions, holders: Holders
) -> list[Anchor]:
    """Return the anchors: a pin prevails over an anchor, and of two anchors on a node the first (collective).

    Raises InputError where pins and anchors leave no node to move.
    """
    anchors = []
    taken = lattice.pinned
    for anchor in tables:
        where = masks[anchor.key] & ~taken
        middle = holders.centers[holders.keys.index(anchor.key)]
        center = middle if anchor.table.center is None else np.array(anchor.table.center)
        path = Motion.through(anchor.table.path, center)
        anchors.append(Anchor(where, path, stop=anchor.table.stop))
        taken = taken | where
    if lattice.table.comm.allreduce(int((~taken[: lattice.owned]).sum())) == 0:
        what = "pin or anchor" if anchors else "pin"
        raise InputError(f"{what}: every node of the lattice is held, nothing is left to move")
    return anchors


def _loads(
    comm: MPI.Comm,
    gravity: Gravity | None,
    forces: Iterable[OfBody],
    lattice: Lattice,
    masks: Regions,
) -> tuple[list[Load], tuple[OwnForce, ...]]:
    """Return the forces, and those that are functions.

    Raises InputError for a function's name that is neither registered nor installed.
    """
    loads, own_forces = [], []
    if gravity is not None:
        loads.append(Load(lattice.mass[:, None], total_of(gravity.acceleration)))
    for table in forces:
        force = table.table
        where = masks[table.key][: lattice.owned]
        acts = {"start": force.start, "stop": force.stop}
        if force.total is not None:
            share = shares_by_mass(comm, where, lattice.mass)
            loads.append(Load(share, total_of(force.total), **acts))
        else:
            rows, function = np.flatnonzero(where), FORCES.find(force.function)
            own_forces.append(OwnForce(table.key, function, rows, lattice.mass[rows], **acts))
    return loads, tuple(own_forces)


def _contacts(
    comm: MPI.Comm,
    tables: Sequence[ObstacleTable],
    lattice: Lattice,
    bounds: Rows,
    obstacles: list[Obstacle],
) -> tuple[list[Exchange], list[Penalty]]:
    """Return how nodes meet the obstacles, by their tables (collective).

    bounds : (b, 2, 3) of the bodies at rest [m]
    """
    exchanges, penalties = [], []
    usual, stick = PENALTY * lattice.stiffest(comm), STICK * smallest(bounds)
    for obstacle, table in zip(obstacles, tables, strict=True):
        if table.response == "exchange":
            exchanges.append(
                Exchange(obstacle, 1.0 if table.restitution is None else table.restitution)
            )
        elif table.response != BARRIER:
            given = table.stiffness or usual, table.friction or 0.0, table.friction_speed or stick
            slows = None if table.restitution == 1 else table.restitution
            penalties.append(Penalty(obstacle, *given, slows))
    return exchanges, penalties
