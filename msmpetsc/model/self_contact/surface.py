"""The surface that meets itself: the body's own or a coarser one, without the triangles that cut others at rest."""

import numpy as np
from mpi4py import MPI

from msmpetsc.comm import log, on_root
from msmpetsc.errors import InputError
from msmpetsc.geometry.cages import Body, Cages
from msmpetsc.geometry.embedding import embed
from msmpetsc.geometry.prepare import compact, simplify
from msmpetsc.geometry.surface import Surface
from msmpetsc.model.lattice import Lattice
from msmpetsc.model.self_contact.barrier import BarrierLaw, crossings
from msmpetsc.model.self_contact.contacts import CollisionSurface
from msmpetsc.model.self_contact.points import SurfacePoints
from msmpetsc.scene.motion import SelfContactTable
from msmpetsc.scene.schema import Scene

NEAR = 1e-3  # of the bounding box's diagonal: the distance, if none is given
STICK = 1e-2  # longest sides a second: friction holds but for a creep below this, as an obstacle's does
MOST_CUT = 0.1  # of all triangles: with more of them out little would keep the rest apart
PER_EDGE = 7 / 4  # Young's modulus over k_1 / h (model.material)


def collision_surface(
    comm: MPI.Comm, table: SelfContactTable, scene: Scene, body: Body, cages: Cages, lattice: Lattice
) -> CollisionSurface:
    """Return the surface that meets itself (collective). Raises InputError where more than a tenth of it cuts
    itself."""
    surface = on_root(comm, lambda: _prepared(body.surface, table.surface))
    points = np.empty((0, 3)) if surface is None else surface.points
    embedding = embed(points, cages, lattice.table, scene.cages.embedding, scene.cages.smoothing)
    sides = body.bounds[1] - body.bounds[0]
    distance = table.distance or NEAR * float(np.linalg.norm(sides))
    stiffness = _stiffness(comm, lattice, distance, scene.time.step)
    law = BarrierLaw(distance, stiffness, table.friction, STICK * float(sides.max()))
    return CollisionSurface(surface, SurfacePoints(comm, lattice, embedding), law)


def _stiffness(comm: MPI.Comm, lattice: Lattice, distance: float, time_step: float) -> float:
    """Return kappa [J/m^2]: over dhat^2 it is the stiffness, of an area, of a layer of whole cells, E / h, and what
    its inertia adds in a step, rho h / t^2.

    Ando (2024, A cubic barrier with elasticity-inclusive dynamic stiffness) takes both of each contact; with those of
    the stiffest cell it is the same at all times, and so is the energy of a given state.
    """
    mass = comm.allreduce(float(lattice.mass.max(initial=0)), MPI.MAX)
    layer = (PER_EDGE * lattice.stiffest(comm) + mass / time_step**2) / lattice.cell_size**2
    return distance**2 * layer


def _prepared(surface: Surface | None, triangles: int | None) -> Surface | None:
    """Return the surface of about so many triangles, all of them if None, without those that cut others."""
    if surface is None:
        return None
    if triangles is not None:
        surface = _coarser(surface, triangles)
    cut = crossings(surface)
    if len(cut) == 0:
        return surface
    points = surface.points[surface.triangles[cut]]
    share = len(cut) / len(surface.triangles)
    at = ", ".join(f"{c:.4g}" for c in points[0].mean(axis=0))
    what = f"self_contact: {len(cut)} of {len(surface.triangles)} triangles cut others at rest, the first at ({at}) m"
    if share > MOST_CUT:
        raise InputError(f'{what}: too many to do without; mesh.prepare = ["union"] or "repair" may mend the mesh')
    log.warning("%s: they are left out, and may be crossed", what)
    return compact(surface.points, np.delete(surface.triangles, cut, axis=0))


def _coarser(surface: Surface, triangles: int) -> Surface:
    """Return a surface of about so many triangles with its points on the given one, so that they lie in its cells."""
    import igl

    reduced = simplify(surface, triangles)
    _, _, nearest = igl.point_mesh_squared_distance(reduced.points, surface.points, surface.triangles)
    return compact(np.ascontiguousarray(nearest), reduced.triangles)
