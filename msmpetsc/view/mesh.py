"""Meshes to be drawn: the refined surface, and the cells of the rear half of the lattice.

Surface triangles larger than a cell are refined, so that they follow the cells that carry them.
Points on sharp edges are duplicated. The drawn points are the file's points in their order, then
points on divided edges, then duplicates.
"""

from dataclasses import replace
from typing import Any

import igl
import numpy as np
import pyvista as pv
from scipy.sparse import csr_array, vstack

from msmpetsc.backend.arrays import Array, Indices, Positions
from msmpetsc.geometry.surface import first_of_equal
from msmpetsc.view.camera import Camera
from msmpetsc.view.colours import BOUNDARY_CELL, INTERIOR_CELL
from msmpetsc.view.drawable import BodiesAtRest, Drawable

# approximate limit of triangles after refinement
MAX_TRIANGLES = 30_000
# corners of a cell in VTK's order
CORNERS = np.array([[x, y, z] for z in (0, 1) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))])


def drawn(subject: Drawable) -> Drawable:
    """Return bodies with their surface refined and split at sharp edges."""
    return _split(_refined(subject))


def _refined(subject: Drawable) -> Drawable:
    """Return bodies with surface edges no longer than a cell, up to about MAX_TRIANGLES triangles.

    The cells carry the new points.
    """
    rest = subject.rest
    cell = float(np.ptp(rest.nodes[rest.cells[0]], axis=0).max())
    if cell == 0:
        return subject
    doubled = igl.doublearea(rest.points, subject.triangles).sum()
    longest = max(cell, np.sqrt(doubled / MAX_TRIANGLES))
    points, triangles, part_of = subdivided(rest.points, subject.triangles, longest)
    body = np.append(rest.body_of_point, np.empty(len(points) - len(rest.points), int))
    given = subject.triangles[part_of]
    body[triangles] = body[given[:, :1]]
    # the corners of a given triangle at each point
    around = np.zeros((len(points), 3), int)
    around[triangles] = given[:, None]
    new = slice(len(rest.points), None)
    T = trilinear(rest, points[new], body[new], (around[new], subject.embedding))
    return replace(
        subject,
        rest=replace(rest, points=points, body_of_point=body),
        triangles=triangles,
        embedding=csr_array(vstack([subject.embedding, T])),
    )


def surface_of(points: Array, triangles: Array) -> pv.PolyData:
    """Return points (v, 3) and triangles (f, 3) as a VTK data set."""
    surface: pv.PolyData = pv.PolyData.from_regular_faces(points, triangles)
    return surface


def subdivided(
    points: Positions, triangles: Indices, longest: float
) -> tuple[Positions, Indices, Indices]:
    """Return a surface whose edges longer than ``longest`` [m] are divided.

    Returns points (p, 3), the given points first; triangles (f, 3); and for each triangle the
    number (f,) of the given triangle that contains it.
    """
    surface = surface_of(points, triangles)
    surface.cell_data["part of"] = np.arange(len(triangles))
    fine = surface.subdivide_adaptive(max_edge_len=longest)
    return fine.points, fine.regular_faces, fine.cell_data["part of"]


def trilinear(
    rest: BodiesAtRest,
    points: Positions,
    body: Indices,
    carried: tuple[Indices, csr_array] | None = None,
) -> csr_array:
    """Return the matrix (p, n) of trilinear weights of nodes at points (p, 3) of bodies (p,).

    carried : surface points (p, k) next to each point, and the embedding of the surface points; of
              the copies of a cell, the copy that shares most nodes with these points is used
    """
    cells = rest.cells_around(points, body)
    if carried is not None:
        _choose_copies(rest, cells, *carried)
    corners = rest.cells[cells]
    low = rest.nodes[corners[:, 0]]
    high = rest.nodes[corners[:, 6]]
    u = np.clip((points - low) / (high - low), 0, 1)[:, None]
    weights = np.where(CORNERS, u, 1 - u).prod(axis=2)
    starts = 8 * np.arange(len(points) + 1)
    return csr_array((weights.ravel(), corners.ravel(), starts), (len(points), len(rest.nodes)))


def _choose_copies(
    rest: BodiesAtRest, cells: Indices, neighbours: Indices, embedding: csr_array
) -> None:
    """Replace each of ``cells`` (p,) by the copy of it that carries ``neighbours`` (p, k)."""
    order = np.lexsort(rest.middles.T)
    is_copy = (np.diff(rest.middles[order], axis=0) == 0).all(axis=1)
    place = np.empty(len(order), int)
    place[order] = np.append(0, np.cumsum(~is_copy))
    copies = np.bincount(place)[place] > 1
    for row in np.flatnonzero(copies[cells]):
        candidates = np.flatnonzero(place == place[cells[row]])
        nodes = embedding[neighbours[row]].indices
        cells[row] = candidates[np.isin(rest.cells[candidates], nodes).sum(axis=1).argmax()]


def _split(subject: Drawable) -> Drawable:
    """Return bodies with a surface point for each smooth patch around the point."""
    rest = subject.rest
    first = first_of_equal(np.column_stack([rest.body_of_point, rest.points]))
    origin, triangles = split_at_edges(rest.points, first[subject.triangles])
    rest = replace(rest, points=rest.points[origin], body_of_point=rest.body_of_point[origin])
    return replace(subject, rest=rest, triangles=triangles, embedding=subject.embedding[origin])


def split_at_edges(points: Positions, triangles: Indices) -> tuple[Indices, Indices]:
    """Return the original point (d,) of each drawn point, and triangles (f, 3) of drawn points.

    The first v drawn points are the originals. Edges of more than VTK's 30 degrees separate smooth
    patches around a point; it has a duplicate for each patch after the first.
    """
    surface = surface_of(points, triangles)
    options: dict[str, Any] = dict(
        consistent_normals=False, non_manifold_traversal=False, cell_normals=False
    )
    split = surface.compute_normals(split_vertices=True, **options)
    return split["pyvistaOriginalPointIds"], split.regular_faces


# cells (c, 8) of the remaining half, by their kind
Cut = dict[int, Indices]
# colour and legend of each value of lattice/cell_kind
KINDS = {1: (BOUNDARY_CELL, "boundary cell"), 2: (INTERIOR_CELL, "interior cell")}


def cut_open(subject: Drawable, camera: Camera) -> Cut:
    """Return the cells behind the middle of the body at rest, as seen by the camera."""
    cells = subject.rest.cells
    depth = subject.rest.nodes @ camera.to_eye
    behind = depth[cells].mean(axis=1) <= (depth.min() + depth.max()) / 2
    kind = subject.array("lattice/cell_kind")
    parts = {number: cells[behind & (kind == number)] for number in KINDS}
    return {number: part for number, part in parts.items() if len(part)}
