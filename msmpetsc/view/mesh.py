"""Meshes to be drawn: the surface, and cells and springs of the half of the lattice behind its middle.

Triangles of the surface that are larger than cells follow the cells that carry them, and sharp edges are sharp. Drawn
points are those of the file, in their order, then those put into long edges, then copies along sharp edges.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import pyvista as pv
from scipy.sparse import csr_array, vstack

from msmpetsc.backend.arrays import Array, Indices, Positions
from msmpetsc.geometry.surface import first_of_equal
from msmpetsc.view.camera import Camera
from msmpetsc.view.colours import BOUNDARY_CELL, INTERIOR_CELL
from msmpetsc.view.drawable import BodiesAtRest, Drawable

SHARP = 30.0  # [degrees] between the normals of two triangles: beyond it their edge is sharp
HELD = 0.5  # pinned or led share of the surface beyond which it is painted as fixed
MOST = 30_000  # triangles, roughly: however small the cells, edges are not divided into more
CORNERS = np.array(
    [[x, y, z] for z in (0, 1) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))]
)  # of a cell, VTK's order


def drawn(subject: Drawable) -> Drawable:
    """Return bodies with their surface refined and split for drawing."""
    return _split(_refined(subject))


def _refined(subject: Drawable) -> Drawable:
    """Return bodies with no edge of the surface longer than a cell; cells carry the new points."""
    rest = subject.rest
    cell = float(np.ptp(rest.nodes[rest.cells[0]], axis=0).max())
    if cell == 0:
        return subject
    a, b, c = rest.points[subject.triangles].swapaxes(0, 1)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    points, triangles, part_of = subdivided(
        rest.points, subject.triangles, max(cell, np.sqrt(2 * area / MOST))
    )
    body = np.append(rest.body_of_point, np.empty(len(points) - len(rest.points), int))
    body[triangles] = body[subject.triangles[part_of, :1]]
    T = trilinear(rest, points[len(rest.points) :], body[len(rest.points) :])
    return replace(
        subject,
        rest=replace(rest, points=points, body_of_point=body),
        triangles=triangles,
        embedding=csr_array(vstack([subject.embedding, T])),
    )


def surface_of(points: Array, triangles: Array) -> pv.PolyData:
    """Return points (v, 3) and triangles (f, 3) as VTK's data set."""
    surface: pv.PolyData = pv.PolyData.from_regular_faces(points, triangles)
    return surface


def subdivided(
    points: Positions, triangles: Indices, longest: float
) -> tuple[Positions, Indices, Indices]:
    """Return a surface whose edges longer than `longest` [m] are divided.

    It is points (p, 3), the first of which are those given, triangles (f, 3), and of each the number
    of the given triangle (f,) that it is part of.
    """
    surface = surface_of(points, triangles)
    surface.cell_data["part of"] = np.arange(len(triangles))
    fine = surface.subdivide_adaptive(max_edge_len=longest)
    return fine.points, fine.regular_faces, fine.cell_data["part of"]


def trilinear(rest: BodiesAtRest, points: Positions, body: Indices) -> csr_array:
    """Return the matrix (p, n) of trilinear weights of nodes at points (p, 3) of bodies (p,)."""
    corners = rest.cells[rest.cells_around(points, body)]
    low, high = rest.nodes[corners[:, 0]], rest.nodes[corners[:, 6]]
    u = np.clip((points - low) / (high - low), 0, 1)[:, None]
    weights = np.where(CORNERS, u, 1 - u).prod(axis=2)
    starts = 8 * np.arange(len(points) + 1)
    return csr_array((weights.ravel(), corners.ravel(), starts), (len(points), len(rest.nodes)))


def _split(subject: Drawable) -> Drawable:
    """Return bodies with a copy of each surface point for every smooth part of the surface around it."""
    rest = subject.rest
    first = first_of_equal(np.column_stack([rest.body_of_point, rest.points]))
    origin, triangles = split_at_edges(rest.points, first[subject.triangles])
    rest = replace(rest, points=rest.points[origin], body_of_point=rest.body_of_point[origin])
    return replace(subject, rest=rest, triangles=triangles, embedding=subject.embedding[origin])


def split_at_edges(points: Positions, triangles: Indices) -> tuple[Indices, Indices]:
    """Return the original (d,) of each drawn point, the first v themselves, and triangles (f, 3).

    Two corners of triangles at one point stay one drawn point where no sharp edge parts them.
    """
    surface = surface_of(points, triangles)
    options: dict[str, Any] = dict(
        consistent_normals=False, non_manifold_traversal=False, cell_normals=False
    )
    split = surface.compute_normals(split_vertices=True, feature_angle=SHARP, **options)
    return split["pyvistaOriginalPointIds"], split.regular_faces


BOUNDARY, INTERIOR = 1, 2  # lattice/cell_kind
SHRUNK = 0.86  # of a cell's size, so that neighbours are told apart
THROUGH = 0.3  # opacity of a body whose lattice is shown
Cut = dict[int, Indices]  # cells (c, 8) by their kind, of the half that remains
KINDS = {BOUNDARY: (BOUNDARY_CELL, "boundary cell"), INTERIOR: (INTERIOR_CELL, "interior cell")}


def cut_open(subject: Drawable, camera: Camera) -> Cut:
    """Return the half of the lattice behind the middle of the body at rest."""
    cells, depth = subject.rest.cells, subject.rest.nodes @ camera.to_eye
    behind = depth[cells].mean(axis=1) <= (depth.min() + depth.max()) / 2
    kind = subject.array("lattice/cell_kind")
    parts = {number: cells[behind & (kind == number)] for number in KINDS}
    return {number: part for number, part in parts.items() if len(part)}
