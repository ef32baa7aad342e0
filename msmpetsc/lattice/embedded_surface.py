"""Points and triangles of the surface that the lattice carries, on any number of ranks.

Points are W q, and positions are linear within a triangle. So each corner of a triangle has a third
of a uniform force, and forces f on points are W^T f on nodes. Resultant and moment are exact,
because each row of W sums to 1 and reproduces linear fields.
"""

from collections.abc import Sequence

import numpy as np
from mpi4py import MPI
from scipy.sparse import csr_array, vstack

from msmpetsc.backend.arrays import Positions, Rows
from msmpetsc.comm import Route, on_root
from msmpetsc.errors import InputError
from msmpetsc.geometry.embedding import embed
from msmpetsc.geometry.grid import MOST_ON_PLANE
from msmpetsc.geometry.surface import SINGLE, Surface, compact, first_of_equal, have_three_corners
from msmpetsc.lattice.lattice import Lattice
from msmpetsc.lattice.region import Finder, groups_named
from msmpetsc.scene.motion import Pressure
from msmpetsc.scene.schema import OfBody

# triangles from which a surface is not refined further [-]; bounds the memory
MOST_TRIANGLES = 1_000_000
NO_SURFACE = Surface(np.empty((0, 3)), np.empty((0, 3), np.int64))


class EmbeddedPoints:
    """Points W q of this rank; their nodes may be on any rank. All methods are collective.

    weights : this rank's rows of W over the nodes that they need
    """

    def __init__(self, comm: MPI.Comm, lattice: Lattice, embedding: csr_array):
        # Route needs the same type on all ranks; scipy chooses the type by the size
        columns, local = np.unique(embedding.indices.astype(np.int64), return_inverse=True)
        shape = embedding.shape[0], len(columns)
        self.weights = csr_array((embedding.data, local.ravel(), embedding.indptr), shape=shape)
        self.to_owner = Route(comm, lattice.table.owner_of_index(columns))
        self.asked = self.to_owner.send(columns) - lattice.table.first
        entries = np.ones(len(self.asked)), (self.asked, np.arange(len(self.asked)))
        self.sums = csr_array(entries, shape=(lattice.owned, len(self.asked)))

    def __call__(self, q: Positions) -> Rows:
        """Return W q (v, k) of q (owned or more, k)."""
        points: Rows = self.weights @ self.to_owner.answer(q[self.asked])
        return points

    def to_nodes(self, forces: Rows) -> Rows:
        """Return W^T f (owned, k) of f (v, k)."""
        on_nodes: Rows = self.sums @ self.to_owner.send(self.weights.T @ forces)
        return on_nodes


class SurfacePart:
    """Faces of a surface, edges (c = 2) or triangles (c = 3), distributed over the ranks.

    W is trilinear here, whatever embedding draws the surface. So a load does the same work on the
    surface as on the cells, and a uniform traction gives a nearly uniform stress. All calls are
    collective.

    rest : (c, f, 3) [m] corners at rest
    """

    def __init__(self, finder: Finder, lattice: Lattice, corners: Sequence[Sequence[Positions]]):
        """Distribute faces of rank 0.

        corners : for each of c corners, for each body, the points (f, 3) [m]
        """
        parts = [embed(of, finder.cages, lattice.table, "trilinear") for of in corners]
        self.corners = len(parts)
        self.points = EmbeddedPoints(finder.comm, lattice, csr_array(vstack(parts)))
        self.rest = self(lattice.nodes)

    def __call__(self, q: Positions) -> Rows:
        """Return the corners (c, f, 3) [m] of this rank's faces at q (owned or more, 3)."""
        return self.points(q).reshape(self.corners, -1, 3)

    def to_nodes(self, forces: Rows) -> Rows:
        """Return the forces (owned, k) on nodes.

        forces : (c, f, k) on the corners of this rank's faces, or (f, k) for all corners alike
        """
        f, k = forces.shape[-2:]
        return self.points.to_nodes(np.broadcast_to(forces, (self.corners, f, k)).reshape(-1, k))

    def areas(self) -> Rows:
        """Return the area at rest (owned, 1) [m^2] that each node carries."""
        return self.to_nodes(np.linalg.norm(doubled_areas(self.rest), axis=1)[:, None] / 6)


def doubled_areas(corners: Rows) -> Rows:
    """Return normals (f, 3) of triangles (3, f, 3), with twice the area as length."""
    a, b, c = corners
    normals: Rows = np.cross(b - a, c - a)
    return normals


def _refined(surface: Surface, longest: float) -> Surface:
    """Return a surface whose edges are halved until no edge is too long.

    A long edge is halved in all its triangles, so that a closed surface stays closed. The new
    points lie on the surface at rest, so that the lattice also carries the inside of a triangle.

    longest : longest edge [m]
    """
    points, triangles = surface.points, surface.triangles
    while 0 < len(triangles) < MOST_TRIANGLES:
        ends = np.sort([triangles, np.roll(triangles, -1, axis=1)], axis=0)
        _, first, edge = np.unique(
            ends[0] * len(points) + ends[1], return_index=True, return_inverse=True
        )
        low, high = points[ends.reshape(2, -1)[:, first]]
        # equal edges are halved alike, wherever the body lies
        is_long = np.linalg.norm(high - low, axis=1) > longest * (1 + SINGLE)
        if not is_long.any():
            break
        middle = len(points) + np.cumsum(is_long) - 1
        points = np.concatenate([points, 0.5 * (low + high)[is_long]])
        # the first end stands for the middle of a short edge
        edge = edge.reshape(-1, 3)
        a, b, c = triangles.T
        ab, bc, ca = np.where(is_long[edge], middle[edge], triangles).T
        parts = np.array([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]])
        triangles = parts.swapaxes(1, 2).reshape(-1, 3)
        triangles = triangles[have_three_corners(triangles)]
    return Surface(points, triangles)


def _open_edges(surface: Surface) -> Rows:
    """Return the ends (2, e, 3) [m] of edges that no other triangle has in reverse."""
    start = first_of_equal(surface.points)[surface.triangles]
    end, size = np.roll(start, -1, axis=1), len(surface.points)
    is_open = ~np.isin(start * size + end, end * size + start)
    ends: Rows = surface.points[np.array([start[is_open], end[is_open]])]
    return ends


def surface_part(table: OfBody, finder: Finder, lattice: Lattice) -> SurfacePart:
    """Return the triangles in the region of a scene's table, wound outwards (collective).

    A region of space contains a triangle if it contains the triangle's centroid.

    Raises InputError on all ranks if the region has no triangle or leaves the cells, or if a
    pressure has no potential.
    """
    comm, region = finder.comm, table.table.region
    left = InputError(
        f"{table.key}.region: its triangles leave the cells: mesh.prepare has changed the "
        "surface, but not the group; give a box, a sphere or a half_space"
    )
    if region.group is not None:
        groups = groups_named(finder.bodies, f"{table.key}.region", region.group, table.body)

    def chosen(number: int) -> Surface:
        surface = finder.bodies[number].surface
        assert surface is not None
        if region.group is not None:
            surface = groups.get(number, NO_SURFACE)
            where = np.ones(len(surface.triangles), bool)
        else:
            middles = surface.points[surface.triangles].mean(axis=1)
            where = finder.inside(table, middles, np.full(len(middles), number))
        inwards = finder.bodies[number].report.volume < 0
        part = compact(surface.points, surface.triangles[where][:, :: -1 if inwards else 1])
        low, high = finder.bounds[number]
        # refused here, because the grid would move points outside onto its faces
        outside = np.maximum(low - part.points, part.points - high).max(initial=0)
        if outside > MOST_ON_PLANE * lattice.cell_size:
            raise left
        return _refined(part, 0.5 * lattice.cell_size)

    bodies = range(len(finder.bodies))
    surfaces = on_root(comm, lambda: [*map(chosen, bodies)]) or [NO_SURFACE] * len(bodies)
    if not comm.bcast(sum(len(surface.triangles) for surface in surfaces)):
        raise InputError(
            f"{table.key}.region holds the centre of no triangle of the surface"
            f"{finder.extents(table)}"
        )
    corners = [[x.points[x.triangles[:, c]] for x in surfaces] for c in range(3)]
    try:
        part = SurfacePart(finder, lattice, corners)
    except ValueError as error:
        raise left from error
    if isinstance(table.table, Pressure):
        ends = [_open_edges(surface) for surface in surfaces]
        refuse_open(table, SurfacePart(finder, lattice, [*zip(*ends, strict=True)]), lattice)
    return part


def refuse_open(table: OfBody, edges: SurfacePart, lattice: Lattice) -> None:
    """Raise InputError if the pressure on a part with open edges has no potential (collective).

    A closed part has a potential. An open edge must be fixed, free along one axis only, or free in
    a plane of two axes that contains the edge.
    """
    moves = (edges((~lattice.fixed).astype(float)) > 1e-9).any(axis=0)
    along = np.abs(edges.rest[1] - edges.rest[0])
    count = moves.sum(axis=1)
    leaves = np.where(moves, 0.0, along).max(axis=1) > 1e-6 * along.max(axis=1)
    # an edge that is free along two axes must lie in their plane
    is_bad = (count == 3) | ((count == 2) & leaves)
    bad, of_all = lattice.table.comm.allreduce(np.array([is_bad.sum(), len(is_bad)]))
    if bad:
        raise InputError(
            f"{table.key}.region: the surface in it is open ({of_all} edges, {bad} of them free "
            "to move), and a pressure needs a closed surface, or pins that hold its edge or "
            "keep it in its plane; a traction may act on any surface"
        )
