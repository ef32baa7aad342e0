"""Build the model of a scene: surfaces, cages, lattice, embedding, loads and obstacles."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, reduce

import numpy as np
from mpi4py import MPI
from scipy.sparse import csr_array

from msmpetsc.backend.arrays import Array, Floats, Indices, Positions, Rows
from msmpetsc.comm import log, on_root
from msmpetsc.constraints.anchors import Anchor
from msmpetsc.constraints.forces import Load, OwnForce, PressureLoad, shares_by_mass
from msmpetsc.constraints.holders import Holders, Regions, clamped, taken
from msmpetsc.constraints.time_functions import Motion, total_of
from msmpetsc.contact.friction import smallest
from msmpetsc.contact.obstacles.distance import DistanceSolid
from msmpetsc.contact.obstacles.moving_solid import Obstacle, build_obstacles
from msmpetsc.contact.obstacles.penalty import Penalty
from msmpetsc.contact.obstacles.reflection import Exchange
from msmpetsc.contact.surface.collision_surface import collision_surface
from msmpetsc.contact.surface.pairs import CollisionSurface
from msmpetsc.errors import InputError
from msmpetsc.extensions import FORCES
from msmpetsc.geometry.cages import BodySurface, Cages, fill
from msmpetsc.geometry.cell_size import choose_cell_size, warn_of_thin_bodies
from msmpetsc.geometry.embedding import embed
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
from msmpetsc.geometry.thickness import Thickness, thickness_of
from msmpetsc.lattice.cell_materials import cell_materials
from msmpetsc.lattice.embedded_surface import surface_part
from msmpetsc.lattice.initial_state import InitialState, ReadState, initial_state
from msmpetsc.lattice.lattice import Lattice, build_lattice
from msmpetsc.lattice.nearest_points import NodePoints, nearest_of_body
from msmpetsc.lattice.probes import ProbePoints, probe_points
from msmpetsc.lattice.region import Finder
from msmpetsc.lattice.topology import topology_of
from msmpetsc.scene.body import CagesTable
from msmpetsc.scene.motion import Gravity, Traction
from msmpetsc.scene.obstacles import BARRIER, ObstacleTable
from msmpetsc.scene.reading import Scene
from msmpetsc.scene.schema import HOLDERS, SURFACE_LOADS, OfBody

# range of a body's longest side [m]; its fourth power stays within a double
SIDE_LIMITS = 1e-60, 1e60
# largest coordinate of a body [its longest side]; seven digits of the shape remain
MAX_OFFSET = 1e9
# usual range of a body's longest side [m]; a mesh beyond it is probably not in metres
USUAL_SIDES = 1e-3, 20.0


@dataclass(frozen=True)
class Model:
    """A scene ready for its first step. Arrays hold this rank's rows; surfaces are on rank 0 only.

    surface     : surfaces of all bodies, joined in the scene's order
    embedding   : this rank's rows of W (geometry.embedding); None if the scene stores no surface
    loads       : gravity, if there is any, then the forces of given total, then the tractions
    tractions   : number of tractions, the last of the loads
    pressures   : pressures on the surface
    exchanges   : obstacles with response = "exchange"
    penalties   : obstacles with response = "reflect" or "penalty"
    start       : positions (l, 3) [m] and velocities (l, 3) [m/s] at time 0, ghosts included
    collision   : the surface in contact with itself or barriers; None without such contact
    bodies      : each body's surface and report
    node_counts : lines of the log: how many nodes each anchor leads and each force pulls
    damping     : mass-proportional damping rate [1/s]
    retardation : viscosity over stiffness [s]
    own_forces  : forces that are functions of the state at the start of a step
    obstacles   : all obstacles in the scene's order
    holders     : pins and anchors, and the nodes that each holds
    probe       : points to probe; None if there are none
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
    node_counts: tuple[str, ...] = ()
    damping: float = 0.0
    retardation: float = 0.0
    own_forces: tuple[OwnForce, ...] = ()
    tractions: int = 0
    pressures: tuple[PressureLoad, ...] = ()
    obstacles: tuple[Obstacle, ...] = ()
    holders: Holders = field(
        default_factory=lambda: Holders((), np.zeros(0, np.int64), np.zeros((0, 3)))
    )
    probe: ProbePoints | None = None

    @property
    def body_of_point(self) -> Indices:
        """Return the body number (v,) of each surface point, on rank 0."""
        points = [0 if body.surface is None else len(body.surface.points) for body in self.bodies]
        return np.repeat(np.arange(len(points)), points)

    @cached_property
    def solids(self) -> dict[int, Surface]:
        """Return the surfaces of mesh and function obstacles by number, on rank 0.

        The first access is collective.
        """
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
    """Surfaces, cages and topology: the part of a model that depends on meshes and cages alone.

    Runs with other materials, loads and times may share it.

    bodies   : prepared surfaces
    cages    : valid cells
    topology : nodes and springs of the cells
    """

    def __init__(self, comm: MPI.Comm, scene: Scene):
        """Read the meshes and fill them with cells (collective). Raises InputError on all ranks."""
        self.source = scene.folder, scene.meshes, scene.cages
        self.bodies = read_bodies(comm, scene)
        self.cages = fill_cages(self.bodies, scene.cages)
        self.topology = topology_of(self.cages)
        nodes = self.topology.table.total
        if nodes < comm.size:
            raise InputError(f"cages: {comm.size} ranks are more than the {nodes} nodes to share")

    def fits(self, scene: Scene) -> bool:
        """Return whether a scene has the meshes and cages of this geometry."""
        return self.source == (scene.folder, scene.meshes, scene.cages)

    @cached_property
    def embedding(self) -> csr_array:
        """Return this rank's rows of W, surface points = W @ node positions (collective)."""
        points = [
            np.empty((0, 3)) if body.surface is None else body.surface.points
            for body in self.bodies
        ]
        _, _, cages = self.source
        return embed(points, self.cages, self.topology.table, cages.embedding, cages.smoothing)

    @cached_property
    def nearest(self) -> NodePoints:
        """Return the nearest point of its body for each node (collective)."""
        return nearest_of_body(self.bodies, self.cages, self.topology)

    def outside(self, nodes: Positions) -> Floats | None:
        """Return the distance (l,) [m] from nodes (l, 3) to their body, 0 for a node inside.

        Return None with whole cells, where the lattice is the body (collective).
        """
        if not self.cages.is_weighted:
            return None
        distance: Floats = np.linalg.norm(nodes - self.nearest.points, axis=1)
        return distance


def build_model(
    comm: MPI.Comm,
    scene: Scene,
    geometry: Geometry | None = None,
    read_state: ReadState | None = None,
) -> Model:
    """Build the model of a scene (collective). Raises InputError on all ranks.

    geometry   : geometry of the scene's meshes and cages; built here if None
    read_state : reader of the state that ``start.from`` names; None if the scene has no such key
    """
    geometry = geometry or Geometry(comm, scene)
    bodies, cages = geometry.bodies, geometry.cages
    finder = Finder(bodies, cages, scene.folder)
    own_materials = [body.material for body in scene.body]
    materials = cell_materials(scene.material, own_materials, scene.tables("part"), finder)
    lattice = build_lattice(cages, scene.material, materials, geometry.topology)
    pins, leading, forces = ([*scene.tables(kind)] for kind in (*HOLDERS, "force"))
    held, tables = [*pins, *leading], [*pins, *leading, *forces]
    own = NodePoints(lattice.nodes, np.zeros(len(lattice.nodes), bool))
    nearest = geometry.nearest if tables else own
    masks = {table.key: finder.find(table, lattice, nearest) for table in tables}
    components = {t.key: masks[t.key][:, None] & np.array(t.table.fixed) for t in held}
    lattice = lattice.pin(
        reduce(np.logical_or, (components[pin.key] for pin in pins), lattice.fixed)
    )
    holders = Holders.of_masks(components, lattice)
    anchors = _anchors(leading, lattice, components, holders)
    fixed = reduce(np.logical_or, (anchor.where for anchor in anchors), lattice.fixed)
    outside = geometry.outside(lattice.nodes) if scene.obstacle else None
    obstacles = build_obstacles(comm, scene.obstacle, scene.folder, lattice, outside)
    loads, own_forces = _loads(comm, scene.gravity, forces, lattice, masks)
    areas, pressures = _surface_loads(scene.tables(*SURFACE_LOADS), finder, lattice)
    loads += areas
    lattice = replace(lattice, pressed=tuple(pressure.part for pressure in pressures))
    probes = probe_points(bodies, scene.output.probe)
    exchanges, penalties = _contacts(comm, scene.obstacle, lattice, finder.bounds, obstacles)
    model = Model(
        surface=joined([body.surface for body in bodies if body.surface is not None]),
        lattice=clamped(held, lattice, masks, finder, nearest.points),
        embedding=geometry.embedding if scene.output.surface else None,
        loads=loads,
        own_forces=own_forces,
        tractions=len(areas),
        pressures=tuple(pressures),
        anchors=anchors,
        exchanges=exchanges,
        penalties=penalties,
        start=initial_state(comm, scene.starts, lattice, fixed, finder.bounds, read_state),
        bodies=bodies,
        collision=collision_surface(scene, bodies, cages, lattice, obstacles),
        node_counts=taken(comm, (pins, leading, forces), lattice, anchors, masks),
        damping=scene.material.damping,
        retardation=scene.material.retardation_time,
        obstacles=tuple(obstacles),
        holders=holders,
        probe=ProbePoints(lattice, cages, probes) if probes else None,
    )
    # at the end, because a refused scene needs no advice
    warn_of_thin_bodies(bodies, lattice.cell_size, scene.material.law)
    return model


def to_device(model: Model, send: Callable[[Array], Array]) -> Model:
    """Return the model with ``send`` applied to the arrays that each step uses.

    Arrays that only set up a step stay in CPU memory.
    """

    lattice = model.lattice
    solid = lattice.solid
    positions, velocities = model.start
    return replace(
        model,
        lattice=replace(
            lattice,
            nodes=send(lattice.nodes),
            mass=send(lattice.mass),
            fixed=send(lattice.fixed),
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
    """Return the prepared bodies, with their surfaces on rank 0 only (collective)."""
    prepared = on_root(comm, lambda: [*_prepared(scene)]) or []
    facts = comm.bcast(
        [(report, bounds_of(surface), thickness) for surface, report, thickness in prepared]
    )
    surfaces: list[Surface | None] = [surface for surface, _, _ in prepared]
    return tuple(
        BodySurface(comm, surface, *of_body)
        for surface, of_body in zip(surfaces or [None] * len(facts), facts, strict=True)
    )


def _prepared(scene: Scene) -> Iterator[tuple[Surface, SurfaceReport, Thickness | None]]:
    """Yield each body's checked surface, report and thickness.

    Each distinct mesh is prepared and measured once.
    """
    shapes: dict[str, Surface] = {}
    measured: dict[str, Thickness | None] = {}
    for path, mesh in scene.meshes.items():
        prefix = "" if path == ("mesh",) else f"{'.'.join(map(str, path))}: "
        shape = repr(mesh.model_copy(update={"base": None}))
        try:
            if shape not in shapes:
                shapes[shape] = prepare(load(mesh.source, scene.folder), mesh.prepare, mesh.size)
            surface = prepare(shapes[shape], (), base=mesh.base)
            unit_warnings = _check_size(surface, mesh.size)
            report = examine(surface)
            warnings = *check_encloses(surface, report), *unit_warnings
        except InputError as error:
            raise InputError(f"{prefix}{error}") from error
        for warning in warnings:
            log.warning("%s%s: %s", prefix, mesh.source, warning)
        # a point of no triangle may lie in no cell: compact() drops it
        whole = compact(surface.points, surface.triangles)
        if shape not in measured:
            measured[shape] = thickness_of(whole, report)
        yield replace(whole, groups=surface.groups), report, measured[shape]


def _check_size(surface: Surface, size: float | None) -> list[str]:
    """Return a warning if the body's longest side is unusual and the scene sets no mesh.size.

    Raises InputError for a body whose volume or shape a double cannot hold.
    """
    points = surface.points[np.unique(surface.triangles)]
    side = np.ptp(points, axis=0).max()
    offset = np.abs(points).max()
    low, high = SIDE_LIMITS
    if side > 0 and not (low <= side <= high and offset <= MAX_OFFSET * side):
        raise InputError(
            f"the mesh is {side:.3g} m long and reaches {offset:.3g} m from the origin: "
            "too large, too small or too far away to compute with"
        )
    low, high = USUAL_SIDES
    if size is not None or low <= side <= high:
        return []
    unit = "millimetres" if side > high else "another unit than metres"
    return [
        f"the body is {side:.3g} m long, and the scene gives no mesh.size: is the mesh in {unit}?"
    ]


def fill_cages(bodies: Sequence[BodySurface], table: CagesTable) -> Cages:
    """Return the valid cells of the bodies (collective)."""
    cell_size = table.cell_size or choose_cell_size(bodies, table.count or 0, table.max_cells)
    return fill(bodies, cell_size, table.max_cells, table.boundary)


def _anchors(
    tables: Iterable[OfBody], lattice: Lattice, components: Regions, holders: Holders
) -> list[Anchor]:
    """Return the anchors, without components that a pin or an earlier anchor holds (collective).

    components : fixed components (l, 3) in the region of each table

    Raises InputError if pins and anchors leave no node to move.
    """
    anchors = []
    prescribed = lattice.fixed
    for anchor in tables:
        where = components[anchor.key] & ~prescribed
        center_of_mass = holders.centers[holders.keys.index(anchor.key)]
        center = center_of_mass if anchor.table.center is None else np.array(anchor.table.center)
        path = Motion.through(anchor.table.path, center)
        anchors.append(Anchor(where, path, stop=anchor.table.stop))
        prescribed = prescribed | where
    if lattice.table.comm.allreduce(int((~prescribed[: lattice.owned]).sum())) == 0:
        tables_named = "pin or anchor" if anchors else "pin"
        raise InputError(
            f"{tables_named}: every node of the lattice is held, nothing is left to move"
        )
    return anchors


def _loads(
    comm: MPI.Comm,
    gravity: Gravity | None,
    forces: Iterable[OfBody],
    lattice: Lattice,
    masks: Regions,
) -> tuple[list[Load], tuple[OwnForce, ...]]:
    """Return the forces of given total, gravity first, and the forces that are functions.

    Raises InputError for a function that is neither registered nor installed.
    """
    loads, own_forces = [], []
    if gravity is not None:
        loads.append(Load(share=lattice.mass[:, None], total=total_of(gravity.acceleration)))
    for table in forces:
        force = table.table
        where = masks[table.key][: lattice.owned]
        acts = {"start": force.start, "stop": force.stop}
        if force.total is not None:
            share = shares_by_mass(comm, where, lattice.mass)
            loads.append(Load(share=share, total=total_of(force.total), **acts))
        else:
            rows = np.flatnonzero(where)
            function = FORCES.find(force.function)
            own_forces.append(OwnForce(table.key, function, rows, lattice.mass[rows], **acts))
    return loads, tuple(own_forces)


def _surface_loads(
    tables: Iterable[OfBody], finder: Finder, lattice: Lattice
) -> tuple[list[Load], list[PressureLoad]]:
    """Return the tractions and the pressures (collective).

    Raises InputError for a region without triangles, or a pressure without a potential.
    """
    tractions, pressures = [], []
    for table in tables:
        part, load = surface_part(table, finder, lattice), table.table
        acts = {"start": load.start, "stop": load.stop, "total": total_of(load.value)}
        if isinstance(load, Traction):
            tractions.append(Load(share=part.areas(), **acts))
        else:
            pressures.append(PressureLoad(part=part, **acts))
    return tractions, pressures


def _contacts(
    comm: MPI.Comm,
    tables: Sequence[ObstacleTable],
    lattice: Lattice,
    bounds: Rows,
    obstacles: list[Obstacle],
) -> tuple[list[Exchange], list[Penalty]]:
    """Return the obstacles of response "exchange", then of "reflect" and "penalty" (collective).

    bounds : bounding boxes (b, 2, 3) of the bodies at rest [m]
    """
    exchanges, penalties = [], []
    stiffest = lattice.stiffest(comm)
    for obstacle, table in zip(obstacles, tables, strict=True):
        if table.response == "exchange":
            exchanges.append(
                Exchange(obstacle, 1.0 if table.restitution is None else table.restitution)
            )
        elif table.response != BARRIER:
            penalties.append(Penalty.of_table(obstacle, table, stiffest, smallest(bounds)))
    return exchanges, penalties
