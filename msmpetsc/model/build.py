"""From a scene to what is simulated: surface, cages, lattice, embedding, loads, obstacles."""

from dataclasses import dataclass
from functools import reduce

import numpy as np
from mpi4py import MPI

from msmpetsc.comm import log, on_root
from msmpetsc.errors import InputError
from msmpetsc.geometry.cages import Body, Cages, fill
from msmpetsc.geometry.cell_size import choose_cell_size
from msmpetsc.geometry.embedding import Embedding, embed
from msmpetsc.geometry.prepare import compact, prepare
from msmpetsc.geometry.registry import load
from msmpetsc.geometry.surface import Surface, check_encloses, examine
from msmpetsc.model.anchor import Anchor
from msmpetsc.model.lattice import Lattice, build_lattice
from msmpetsc.model.loads import Load, spread_by_mass
from msmpetsc.model.motion import Path
from msmpetsc.model.obstacle import Obstacle
from msmpetsc.model.part import cell_materials
from msmpetsc.model.penalty import Penalty
from msmpetsc.model.reflection import Reflection
from msmpetsc.model.region import Finder
from msmpetsc.model.start import State, start_of
from msmpetsc.scene import Scene

SIDES = 1e-60, 1e60  # [m]: the fourth power of a length still is a double
PENALTY = 10.0  # stiffest springs: what pushes a node out of an obstacle
STICK = 1e-2  # longest sides a second: friction holds but for a creep below this; 1e-3 took Newton 5 times as long
FARTHEST = 1e9  # longest sides from the origin: leaves seven digits of the shape


@dataclass(frozen=True)
class Model:
    """A scene made ready to step. Arrays hold this rank's share; the surface is on rank 0 only.

    embedding : None where the scene stores no surface
    loads     : gravity first, where there is any
    start     : positions (l, 3) [m] and velocities (l, 3) [m/s] at time 0, ghosts included
    """

    surface: Surface | None
    lattice: Lattice
    embedding: Embedding | None
    loads: list[Load]
    anchors: list[Anchor]
    reflections: list[Reflection]
    penalties: list[Penalty]
    start: State


def build_model(comm: MPI.Comm, scene: Scene) -> Model:
    """Everything of a scene but its solver (collective). Raises InputError on all ranks."""
    body = read_body(comm, scene)
    cages = fill_cages(body, scene)
    material = scene.material
    finder = Finder(body, cages, scene.folder)
    of_cells = cell_materials(material, scene.part, finder)
    lattice = build_lattice(
        cages, material.density, material.young_modulus, material.stiffness, material.law_stiffening, of_cells
    )
    lattice = _pin(comm, scene, lattice, finder)
    anchors = _anchors(scene, lattice, finder)
    held = reduce(np.logical_or, (anchor.where for anchor in anchors), lattice.pinned)
    _check_that_something_moves(comm, lattice, held, anchors)
    embedding = None
    if scene.output.surface:
        points = np.empty((0, 3)) if body.surface is None else body.surface.points
        embedding = embed(points, cages, lattice.table, scene.cages.embedding, scene.cages.smoothing)
    return Model(
        body.surface,
        lattice,
        embedding,
        _loads(comm, scene, lattice, finder),
        anchors,
        _reflections(scene),
        _penalties(comm, scene, lattice, body),
        start_of(comm, scene.start, lattice, held, body.bounds),
    )


def read_body(comm: MPI.Comm, scene: Scene) -> Body:
    """The prepared surface on rank 0, and on all ranks what they need to know of it (collective)."""

    def read() -> tuple[Surface, tuple]:
        surface = prepare(load(scene.mesh.source, scene.folder), scene.mesh.prepare, scene.mesh.size, scene.mesh.base)
        _check_in_range(surface)
        report = examine(surface)
        for warning in check_encloses(surface, report):
            log.warning("%s: %s", scene.mesh.source, warning)
        surface = compact(surface.points, surface.triangles)  # a point of no triangle may lie in no cell
        return surface, (report, np.array([surface.points.min(axis=0), surface.points.max(axis=0)]))

    surface, facts = on_root(comm, read) or (None, None)
    report, bounds = comm.bcast(facts)
    return Body(comm, surface, report, bounds)


def _check_in_range(surface: Surface) -> None:
    """Raise InputError for a body whose volume or shape a double cannot hold."""
    points = surface.points[np.unique(surface.triangles)]
    side, reach = np.ptp(points, axis=0).max(), np.abs(points).max()
    if side > 0 and not (SIDES[0] <= side <= SIDES[1] and reach <= FARTHEST * side):
        raise InputError(
            f"the mesh is {side:.3g} m long and reaches {reach:.3g} m from the origin: "
            "too large, too small or too far away to compute with"
        )


def fill_cages(body: Body, scene: Scene) -> Cages:
    """The scene's valid cells (collective)."""
    cages = scene.cages
    cell_size = cages.cell_size or choose_cell_size(body, cages.count, cages.method, cages.max_cells)
    return fill(body, cell_size, cages.method, cages.max_cells)


def _pin(comm: MPI.Comm, scene: Scene, lattice: Lattice, finder: Finder) -> Lattice:
    for number, pin in enumerate(scene.pin):
        lattice = lattice.pin(finder.find(f"pin.{number}", pin.region, lattice))
    return lattice


def _anchors(scene: Scene, lattice: Lattice, finder: Finder) -> list[Anchor]:
    """A pin is stronger than an anchor, and of two anchors on a node the first."""
    anchors, taken = [], lattice.pinned
    for number, anchor in enumerate(scene.anchor):
        where = finder.find(f"anchor.{number}", anchor.region, lattice) & ~taken
        anchors.append(Anchor(where, Path.through(anchor.path), anchor.stop))
        taken = taken | where
    return anchors


def _check_that_something_moves(comm: MPI.Comm, lattice: Lattice, held: np.ndarray, anchors: list[Anchor]) -> None:
    if comm.allreduce(int((~held[: lattice.owned]).sum())) == 0:
        what = "pin or anchor" if anchors else "pin"
        raise InputError(f"{what}: every node of the lattice is held, nothing is left to move")


def _loads(comm: MPI.Comm, scene: Scene, lattice: Lattice, finder: Finder) -> list[Load]:
    loads = []
    if scene.gravity is not None:
        loads.append(Load(lattice.mass[:, None] * np.array(scene.gravity.acceleration), 0.0, None))
    for number, force in enumerate(scene.force):
        where = finder.find(f"force.{number}", force.region, lattice)[: lattice.owned]
        loads.append(Load(spread_by_mass(comm, force.total, where, lattice.mass), force.start, force.stop))
    return loads


def _reflections(scene: Scene) -> list[Reflection]:
    return [
        Reflection(Obstacle.of(o, f"obstacle.{number}"), 1.0 if o.restitution is None else o.restitution)
        for number, o in enumerate(scene.obstacle)
        if o.response == "reflect"
    ]


def _penalties(comm: MPI.Comm, scene: Scene, lattice: Lattice, body: Body) -> list[Penalty]:
    pressing = [(f"obstacle.{number}", o) for number, o in enumerate(scene.obstacle) if o.response == "penalty"]
    if not pressing:
        return []
    usual, stick = PENALTY * lattice.stiffest(comm), STICK * (body.bounds[1] - body.bounds[0]).max()
    return [Penalty(Obstacle.of(o, key), o.stiffness or usual, o.friction or 0.0, stick) for key, o in pressing]
