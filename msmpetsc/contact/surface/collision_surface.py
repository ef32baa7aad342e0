"""Construction of the contact surface: the bodies' own surface or a coarser surface, and obstacles.

Triangles that cross at rest are left out.
"""

from collections.abc import Sequence

import numpy as np
from mpi4py import MPI

from msmpetsc.comm import log, on_root
from msmpetsc.contact.friction import smallest
from msmpetsc.contact.obstacles.moving_solid import Obstacle
from msmpetsc.contact.surface.barrier import Barrier, BarrierLaw
from msmpetsc.contact.surface.creases import NEAREST
from msmpetsc.contact.surface.obstacle_surfaces import obstacle_surfaces
from msmpetsc.contact.surface.pairs import CollisionSurface
from msmpetsc.contact.surface.points import SurfacePoints
from msmpetsc.errors import InputError, body_names
from msmpetsc.geometry.cages import BodySurface, Cages
from msmpetsc.geometry.embedding import embed
from msmpetsc.geometry.prepare import simplify
from msmpetsc.geometry.surface import SINGLE, Surface, compact, have_three_corners, joined, outward
from msmpetsc.lattice.lattice import Lattice
from msmpetsc.scene.obstacles import SelfContactTable
from msmpetsc.scene.reading import Scene

# Least default distance [largest diagonal of a body's bounding box]
NEAR = 3e-4
# Default distance, before gaps at rest reduce it [cells]; a thinner barrier detects
# impacts late and takes more iterations, a wider barrier stiffens pressed contacts
# (scripts/results/impact.md)
SHARE = 1 / 24
# Greatest share of triangles that may be left out [-]; if more were left out, too few
# would keep bodies apart
MOST_CUT = 0.1
# Edge length beyond which a triangle is long [cells]
LONG = 2.0
# Fewest triangles of a coarser body
FEWEST = 20
# Speed of the decimation; its default, 7, gives a surface two to four times as far off
HASTE = 4


def collision_surface(
    scene: Scene,
    bodies: Sequence[BodySurface],
    cages: Cages,
    lattice: Lattice,
    obstacles: list[Obstacle],
) -> CollisionSurface | None:
    """Return the contact surface of all bodies and of obstacles with a barrier (collective).

    Return None if the scene has neither self-contact nor an obstacle with a barrier.

    obstacles : in the scene's order

    Raises InputError on all ranks if over a tenth of the triangles cross at rest, or if an
    obstacle cuts or nearly touches a body.
    """
    table, comm = scene.touching, bodies[0].comm
    if table is None:
        return None
    whole = [body.surface for body in bodies if body.surface]
    meets_itself = scene.self_contact is not None
    prepared = on_root(comm, lambda: _prepared(whole, table, meets_itself, lattice.cell_size))
    surfaces, *lengths = prepared or ([],)
    off, edge = comm.bcast(lengths)
    met = obstacle_surfaces(scene.obstacle, obstacles, edge)
    points = [surface.points for surface in surfaces] or [np.empty((0, 3))] * len(bodies)
    embedding = embed(points, cages, lattice.table, scene.cages.embedding, scene.cages.smoothing)
    sides = max((body.bounds[1] - body.bounds[0] for body in bodies), key=np.linalg.norm)
    joint = on_root(comm, lambda: joined([*surfaces, *met.solids]))
    least, bodies_end = NEAR * float(np.linalg.norm(sides)), sum(map(len, points))
    widest = min(SHARE * lattice.cell_size, edge / 2)
    distance = table.distance or max(
        least, off, _gap(comm, joint, widest, bodies_end, meets_itself)
    )
    side = smallest(np.array([body.bounds for body in bodies]))
    law = BarrierLaw.of_lattice(distance, table, lattice, scene.time.step, side)
    carried = SurfacePoints(comm, lattice, embedding, met)
    names = body_names(len(bodies)) + [f"obstacle.{number}" for number in met.numbers]
    counts = [len(part.points) for part in (*surfaces, *met.solids)]
    parts = list(zip(names, counts, strict=True)) if surfaces else []
    surface = CollisionSurface(joint, carried, law, meets_itself, parts)
    on_root(comm, lambda: _refuse_touching(surface))
    return surface


def _prepared(
    bodies: list[Surface], table: SelfContactTable, meets_itself: bool, cell_size: float
) -> tuple[list[Surface], float, float]:
    """Return the contact surfaces, their distance from the bodies' surfaces, and their mean edge.

    The surfaces have about as many triangles as ``table.surface`` says, or all triangles without
    it. Triangles that name a point twice are left out. If the bodies meet themselves, crossing
    triangles are left out, too. The distance is the median over the bodies' points [m].

    Raises InputError if too many triangles cross.
    """
    off, three = 0.0, [have_three_corners(body.triangles) for body in bodies]
    bodies = [
        body if kept.all() else compact(body.points, body.triangles[kept])
        for body, kept in zip(bodies, three, strict=True)
    ]
    if table.surface is not None:
        share = table.surface / sum(len(body.triangles) for body in bodies)
        coarser = [
            _coarser(body, max(round(share * len(body.triangles)), FEWEST)) for body in bodies
        ]
        bodies, off = coarser, _off(bodies, coarser, table.distance or 0.0)
    if meets_itself:
        longest = max(float(np.linalg.norm(np.ptp(body.points, axis=0))) for body in bodies)
        # Points within SINGLE of a plane of the grid snap to the plane, which would
        # close a smaller gap
        gap = max(NEAREST * (table.distance or NEAR * longest), 2 * SINGLE * longest)
        bodies = _without_crossing_triangles(_parted(bodies, gap), table.surface is not None)
    ends = np.concatenate(
        [b.points[b.triangles] - b.points[np.roll(b.triangles, 1, axis=1)] for b in bodies]
    )
    edges = np.linalg.norm(ends, axis=2)
    if table.surface is None:
        _warn_of_long_triangles(edges.max(), max(cell_size, 2 * (table.distance or 0.0)))
    return bodies, off, float(edges.mean())


def _gap(
    comm: MPI.Comm, surface: Surface | None, widest: float, bodies: int, meets_itself: bool
) -> float:
    """Return the least rest distance [m] of parts that may touch, at most ``widest`` (collective).

    A barrier wider than this gap would throw apart bodies that a scene puts side by side.

    surface : all surfaces in contact, on rank 0
    bodies  : number of the bodies' points, which come first
    """

    def of_root() -> float:
        assert surface is not None
        barrier = Barrier(surface, BarrierLaw(widest, 1.0, 0.0, 1.0), bodies, meets_itself)
        barrier.leave_out_neighbours(surface.points)
        near = barrier.contacts(barrier.candidates(surface.points, 0.0), surface.points)
        return min(barrier.least(near, surface.points), widest)

    gap: float = comm.bcast(on_root(comm, of_root))
    return gap


def _refuse_touching(surface: CollisionSurface) -> None:
    """Raise InputError if an obstacle cuts a body at rest, or nearly touches it."""
    whole, law = surface.surface, surface.law
    if whole is None or not surface.points.obstacles.total:
        return
    barrier = Barrier(whole, law, surface.points.bodies, meets_itself=False)
    cut = barrier.crossings()
    if len(cut):
        raise InputError(
            f"obstacle: a surface with a barrier cuts a body at rest, at {_place(whole, cut[0])} m"
        )
    near = barrier.contacts(barrier.candidates(whole.points, 0.0), whole.points)
    if (least := barrier.least(near, whole.points)) < NEAREST * law.distance:
        raise InputError(
            f"obstacle: a surface with a barrier is {least:.2g} m from a body at rest: "
            "leave a wider gap"
        )


def _place(surface: Surface, triangle: int) -> str:
    """Return the centre of a triangle as text."""
    middle = surface.points[surface.triangles[triangle]].mean(axis=0)
    return "(" + ", ".join(f"{c:.4g}" for c in middle) + ")"


def _parted(bodies: list[Surface], gap: float) -> list[Surface]:
    """Return the surfaces, drawn in by ``gap`` [m] if any two bodies are closer at rest.

    A barrier needs a gap.
    """
    whole = joined(bodies)
    assert whole is not None
    owner = np.repeat(np.arange(len(bodies)), [len(body.points) for body in bodies])
    barrier = Barrier(whole, BarrierLaw(gap, 1.0, 0.0, 1.0), len(owner))
    touching = barrier.touching(owner)
    if not touching:
        return bodies
    names = ", ".join(f"body.{i} and body.{j}" for i, j in touching)
    log.info(
        "self_contact: %s touch at rest: all surfaces that meet are drawn in by %.2g m", names, gap
    )
    return [Surface(body.points - gap * outward(body), body.triangles) for body in bodies]


def _without_crossing_triangles(bodies: list[Surface], are_coarser: bool) -> list[Surface]:
    """Return surfaces without crossing triangles. Raises InputError if too many cross.

    are_coarser : whether the surfaces are coarser than the mesh, so that they may cross
    """
    whole = joined(bodies)
    assert whole is not None
    cut = Barrier(whole, BarrierLaw(1.0, 1.0, 0.0, 1.0), len(whole.points)).crossings()
    if len(cut) == 0:
        return bodies
    fault = f"self_contact: {len(cut)} of {len(whole.triangles)} triangles cut others at rest, "
    fault += f"the first at {_place(whole, cut[0])} m"
    ends = np.cumsum([len(body.triangles) for body in bodies])[:-1]
    if len(of := np.unique(np.searchsorted(ends, cut, side="right"))) > 1:
        names = ", ".join(f"body.{number}" for number in of)
        fault += f" (of {names}, which must be moved apart if they overlap)"
    if len(cut) > MOST_CUT * len(whole.triangles):
        remedy = 'mesh.prepare = ["union"] or ["repair"] may mend the mesh'
        if are_coarser:
            remedy = f"leave out self_contact.surface, or raise it; if that fails, {remedy}"
        raise InputError(f"{fault}, too many to leave out: {remedy}")
    log.warning("%s: they are left out, and may be crossed", fault)
    of_body = np.split(~np.isin(np.arange(len(whole.triangles)), cut), ends)
    return [compact(b.points, b.triangles[kept]) for b, kept in zip(bodies, of_body, strict=True)]


def _off(bodies: list[Surface], coarser: list[Surface], distance: float) -> float:
    """Return the median distance [m] of the bodies' points from the coarser surfaces.

    Warn if a point is farther from them than ``distance`` [m].
    """
    import igl

    squares = [
        igl.point_mesh_squared_distance(body.points, coarse.points, coarse.triangles)[0]
        for body, coarse in zip(bodies, coarser, strict=True)
    ]
    off = np.sqrt(np.concatenate(squares))
    if off.max() > distance:
        log.warning(
            "self_contact.surface: the contact surface of %d triangles is up to %.2g m off the "
            "drawn surface, half of it by more than %.2g m: drawn surfaces may cross by as much; "
            "more triangles bring it nearer",
            sum(len(coarse.triangles) for coarse in coarser),
            off.max(),
            np.median(off),
        )
    return float(np.median(off))


def _warn_of_long_triangles(longest: float, length: float) -> None:
    """Warn if the longest edge is much longer than ``length`` [m].

    Only the points of the surface follow the body. If two cubes of twelve triangles touch at their
    corners, bulges between the corners pass through each other.
    """
    if longest > LONG * length:
        log.warning(
            "self_contact: a triangle is %.2g m long in cells of %.2g m: bulges between its "
            "corners may pass unseen; mesh.prepare = [{ refine = 0.05 }] splits edges longer than "
            "a twentieth of the body",
            longest,
            length,
        )


def _coarser(surface: Surface, triangles: int) -> Surface:
    """Return a surface of about ``triangles`` triangles, with its points on the given surface.

    The points then lie in cells of the body.
    """
    import igl

    reduced = simplify(surface, triangles, HASTE)
    _, _, nearest = igl.point_mesh_squared_distance(
        reduced.points, surface.points, surface.triangles
    )
    return compact(np.ascontiguousarray(nearest), reduced.triangles)
