"""Points and triangles of the surface that the lattice carries, on any number of ranks.

Points are W q, linear within a triangle. So a uniform force on a triangle acts with a third at each
corner, and forces f on points act with W^T f on nodes. Resultant and moment are exact: each row of
W sums to 1 and reproduces linear fields.
"""

import numpy as np
import trimesh
from mpi4py import MPI
from scipy.sparse import csr_array

from msmpetsc.backend.arrays import Floats, Indices, Mask, Positions, Rows
from msmpetsc.comm import Route, on_root
from msmpetsc.errors import InputError
from msmpetsc.geometry.embedding import embed
from msmpetsc.geometry.morton import encode_morton
from msmpetsc.geometry.surface import Surface, compact, first_of_equal, joined
from msmpetsc.lattice.lattice import Lattice
from msmpetsc.lattice.region import Finder, groups_named
from msmpetsc.scene.schema import OfBody

# triangles beyond which a surface is halved no more [-]; it bounds memory
MOST_TRIANGLES = 1_000_000
NO_SURFACE = Surface(np.empty((0, 3)), np.empty((0, 3), np.int64))


class Gather:
    """Rows of a distributed table that this rank reads, and to which it adds."""

    def __init__(self, comm: MPI.Comm, numbers: Indices, first: Indices, owned: int):
        """Prepare for the rows ``numbers`` (n,) (collective).

        first : number of the first row of each rank; this rank has ``owned`` rows
        """
        self.route = Route(comm, np.searchsorted(first[1:], numbers, side="right"))
        self.asked = self.route.send(numbers) - first[comm.rank]
        entries = np.ones(len(self.asked)), (self.asked, np.arange(len(self.asked)))
        self.sums = csr_array(entries, shape=(owned, len(self.asked)))

    def __call__(self, rows: Rows) -> Rows:
        """Return the rows (n, k) of a table, this rank's part of which is given (collective)."""
        return self.route.answer(rows[self.asked])

    def transposed(self, rows: Rows) -> Rows:
        """Return the sums (owned, k) of all ranks' rows (n, k) (collective)."""
        sums: Rows = self.sums @ self.route.send(rows)
        return sums


class EmbeddedPoints:
    """Points W q of this rank, from the nodes of all ranks. All methods are collective.

    weights : this rank's rows of W over the nodes that they need
    """

    def __init__(self, comm: MPI.Comm, lattice: Lattice, embedding: csr_array):
        columns, local = np.unique(embedding.indices, return_inverse=True)
        shape = embedding.shape[0], len(columns)
        self.weights = csr_array((embedding.data, local.ravel(), embedding.indptr), shape=shape)
        self.nodes = Gather(comm, columns, lattice.table.first_of_rank, lattice.owned)

    def __call__(self, q: Positions) -> Rows:
        """Return W q (v, k) of q (owned or more, k)."""
        points: Rows = self.weights @ self.nodes(q)
        return points

    def to_nodes(self, forces: Rows, weights: csr_array | None = None) -> Rows:
        """Return W^T f (owned, k) of f (v, k); ``weights`` replace W."""
        return self.nodes.transposed((self.weights if weights is None else weights).T @ forces)


class SurfacePart:
    """Triangles of a surface, of which each rank has a share. All methods are collective.

    rest : (f, 3, 3) [m] corners of this rank's triangles at rest
    open : (f, 3) bool, edges from each corner to the next that no other triangle shares
    """

    def __init__(
        self, comm: MPI.Comm, lattice: Lattice, embedding: csr_array, surface: Surface | None
    ):
        """Share the triangles of a surface on rank 0; ``embedding`` has W of its points."""
        surface = surface or NO_SURFACE
        count = len(surface.triangles)
        to_rank = Route(comm, np.arange(count) * comm.size // max(count, 1))
        triangles = to_rank.send(surface.triangles)
        self.open = to_rank.send(_open_edges(surface))
        first = np.cumsum([0, *comm.allgather(embedding.shape[0])])[:-1]
        self.points = EmbeddedPoints(comm, lattice, embedding)
        self.corners = Gather(comm, triangles.ravel(), first, embedding.shape[0])
        self.rest = self(lattice.nodes)

    def __call__(self, q: Positions) -> Rows:
        """Return the corners (f, 3, 3) [m] of this rank's triangles at q (owned or more, 3)."""
        return self.corners(self.points(q)).reshape(-1, 3, 3)

    def to_nodes(self, forces: Rows) -> Rows:
        """Return the forces (owned, k) on nodes of forces (f, 3, k) on corners."""
        on_points = self.corners.transposed(forces.reshape(-1, forces.shape[-1]))
        return self.points.to_nodes(on_points)

    def areas(self) -> Rows:
        """Return the area at rest (owned, 1) [m^2] that each node carries."""
        thirds = np.linalg.norm(doubled_areas(self.rest), axis=1) / 6
        return self.to_nodes(np.repeat(thirds, 3).reshape(-1, 3, 1))

    def bounds(self, of_corners: Floats) -> Floats:
        """Return a diagonal (owned,) that is no less than W^T C W, C diagonal (f, 3) >= 0."""
        weights = abs(self.points.weights)
        on_points = self.corners.transposed(of_corners.reshape(-1, 1))
        rows = on_points * weights.sum(axis=1)[:, None]
        return self.points.to_nodes(rows, weights)[:, 0]

    def may_move(self, lattice: Lattice) -> Mask:
        """Return whether each component (f, 3, 3) of the corners may move, pins considered."""
        carried = (self.points.weights != 0).astype(float)
        moves = carried @ self.points.nodes((~lattice.held).astype(float))
        free: Mask = self.corners(moves).reshape(-1, 3, 3) > 0
        return free


def doubled_areas(corners: Rows) -> Rows:
    """Return the normals (f, 3), twice the area long, of triangles (f, 3, 3)."""
    a, b, c = corners.transpose(1, 0, 2)
    normals: Rows = np.cross(b - a, c - a)
    return normals


def _refined(surface: Surface, longest: float) -> Surface:
    """Return a surface whose triangles are halved along each edge until no edge is too long.

    All triangles are halved alike, so that a closed surface stays closed. The points lie on the
    surface at rest, so that the lattice carries the inside of a large triangle, too.

    longest : [m]
    """
    points, triangles = surface.points, surface.triangles
    while 0 < len(triangles) < MOST_TRIANGLES:
        ends = np.roll(points[triangles], -1, axis=1)
        if np.linalg.norm(ends - points[triangles], axis=2).max() <= longest:
            break
        points, triangles = trimesh.remesh.subdivide(  # type: ignore[no-untyped-call]
            points, triangles
        )
    return Surface(points, np.asarray(triangles, np.int64))


def _open_edges(surface: Surface) -> Mask:
    """Return the mask (f, 3) of edges whose opposite edge no triangle has."""
    triangles = first_of_equal(surface.points)[surface.triangles]
    start, end = triangles, np.roll(triangles, -1, axis=1)
    size = len(surface.points)
    return ~np.isin(start * size + end, end * size + start)


def surface_part(table: OfBody, finder: Finder, lattice: Lattice) -> SurfacePart:
    """Return the triangles in the region of a scene's table, wound outwards (collective).

    A region of space has the triangles whose centroids it contains. W is trilinear, whatever
    coordinates draw the surface. So the work of a load is that on the cells themselves, and a
    uniform traction leaves a nearly uniform stress.

    Raises InputError on all ranks if the region has no triangle.
    """
    comm, region = finder.comm, table.table.region
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
        return compact(surface.points, surface.triangles[where][:, :: -1 if inwards else 1])

    def refined() -> list[Surface]:
        return [
            _refined(chosen(number), 0.5 * lattice.cell_size)
            for number in range(len(finder.bodies))
        ]

    surfaces = on_root(comm, refined)
    surfaces = surfaces or [NO_SURFACE] * len(finder.bodies)
    whole = joined(surfaces)
    if not comm.bcast(whole is not None and len(whole.triangles)):
        raise InputError(
            f"{table.key}.region holds the centre of no triangle of the surface"
            f"{finder.extents(table)}"
        )
    points, grids = [surface.points for surface in surfaces], finder.cages.grids
    keys = [
        encode_morton(np.floor(grid.to_cells(x)).astype(np.int64).clip(0) + grids.first(number))
        for number, (grid, x) in enumerate(zip(grids.grids, points, strict=True))
    ]
    missing = finder.cages.table.find(np.concatenate(keys)) < 0
    if comm.allreduce(int(missing.sum())):
        raise InputError(
            f"{table.key}.region: its triangles leave the cells: mesh.prepare has changed the "
            "surface, but not the group; give a box, a sphere or a half_space"
        )
    return SurfacePart(
        comm,
        lattice,
        embed(points, finder.cages, lattice.table, "trilinear"),
        whole,
    )


def refuse_open(table: OfBody, part: SurfacePart, lattice: Lattice) -> None:
    """Raise InputError if the pressure on a part has no potential (collective).

    It has a potential if the part is closed, or if its edge may move only along itself: in a
    direction, or in the plane of a symmetry that contains the edge.
    """
    free = part.may_move(lattice)
    moves = free | np.roll(free, -1, axis=1)
    along = np.abs(np.roll(part.rest, -1, axis=1) - part.rest)
    count = moves.sum(axis=2)
    longest = along.max(axis=2)
    leaves = np.where(moves, 0.0, along).max(axis=2) > 1e-6 * longest
    # free in two directions: the edge must not leave their plane
    is_bad = part.open & ((count == 3) | ((count == 2) & leaves))
    edges, of_all = lattice.table.comm.allreduce(np.array([is_bad.sum(), part.open.sum()]))
    if edges:
        raise InputError(
            f"{table.key}.region: the surface in it is open ({of_all} edges, {edges} of them free "
            "to move), and a pressure needs a closed one, or pins that hold its edge or keep it in "
            "its plane; a traction may act on any"
        )
