"""Measure surface meshes, and check that they enclose a volume."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from msmpetsc.backend.arrays import Array, Indices, Mask, Positions, Rows
from msmpetsc.comm import starts
from msmpetsc.errors import InputError

# tolerance of coordinates, relative to the longest side of the body [-]; ten times the
# rounding of meshes in single precision
SINGLE = 1e-6


@dataclass(frozen=True)
class Surface:
    """A triangle mesh.

    points    : (v, 3) float64 [m]
    triangles : (f, 3) int64, corners of each triangle as rows of ``points``
    groups    : surfaces that mark parts of the body, by the names that the file gives them
    """

    points: Positions
    triangles: Array
    groups: "Mapping[str, Surface]" = field(default_factory=dict)

    def moved(self, move: Callable[[Positions], Positions]) -> "Surface":
        """Return the surface and its groups with their points moved."""
        groups = {name: group.moved(move) for name, group in self.groups.items()}
        return Surface(move(self.points), self.triangles, groups)


def joined(surfaces: Sequence[Surface]) -> Surface | None:
    """Return several surfaces as a single surface, in order; None for an empty list."""
    if len(surfaces) < 2:
        return next(iter(surfaces), None)
    first = starts(np.array([len(surface.points) for surface in surfaces]))
    triangles = [
        surface.triangles + number for surface, number in zip(surfaces, first, strict=True)
    ]
    return Surface(
        np.concatenate([surface.points for surface in surfaces]), np.concatenate(triangles)
    )


def compact(points: Positions, triangles: Indices) -> Surface:
    """Return the surface of these triangles, with only the points that they use, in order."""
    used, numbers = np.unique(triangles, return_inverse=True)
    return Surface(points[used], numbers.reshape(-1, 3))


def outward(surface: Surface) -> Rows:
    """Return outward unit normals (v, 3) at the points of a closed, consistently wound surface."""
    a, b, c = surface.points[surface.triangles].transpose(1, 0, 2) - surface.points.mean(axis=0)
    areas = np.cross(b - a, c - a)
    normals = np.zeros_like(surface.points)
    np.add.at(normals, surface.triangles, areas[:, None])
    sizes = np.linalg.norm(normals, axis=1)[:, None]
    unit: Rows = (
        np.copysign(1.0, np.vdot(a, areas)) * normals / np.maximum(sizes, np.finfo(float).tiny)
    )
    return unit


def bounds_of(surface: Surface) -> Rows:
    """Return the bounding box (2, 3) [m] of all points."""
    return np.array([surface.points.min(axis=0), surface.points.max(axis=0)])


@dataclass(frozen=True)
class SurfaceReport:
    """Measures of a surface, and counts of its faults.

    Points of equal position are merged before edges are counted, so the loose triangles of an STL
    may form a closed surface. Triangles that then have two equal corners are dropped.

    volume : [m^3], negative if wound inwards; not meaningful if the surface is open
    area   : [m^2]
    nonmanifold_edges  : edges of more than two triangles
    inconsistent_edges : edges along which two triangles run in the same direction
    """

    volume: float
    area: float
    boundary_edges: int
    nonmanifold_edges: int
    inconsistent_edges: int

    @property
    def closed(self) -> bool:
        """Whether no edge belongs to a single triangle only."""
        return self.boundary_edges == 0


def examine(surface: Surface) -> SurfaceReport:
    """Return volume, area and edge counts of a surface."""
    # (f, 3 corners, 3)
    corners = surface.points[surface.triangles]
    # relative to a point of the surface, because small numbers round less
    corners = corners - surface.points[surface.triangles[0, 0]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    used, forward = edge_use(merged_triangles(surface))
    return SurfaceReport(
        volume=float(np.einsum("ij,ij->", corners[:, 0], normals) / 6),
        area=float(np.linalg.norm(normals, axis=1).sum() / 2),
        boundary_edges=int((used == 1).sum()),
        nonmanifold_edges=int((used > 2).sum()),
        inconsistent_edges=int(((used == 2) & (forward != 1)).sum()),
    )


def check_encloses(surface: Surface, report: SurfaceReport) -> list[str]:
    """Return a line for each fault that makes the inside of a surface doubtful, with its remedy.

    The flatness is measured along the principal axes, so that a tilted sheet also counts as flat.
    A closed surface is also flat if its mean thickness 2 |volume| / area is at most SINGLE of
    its longest side.

    Raises InputError if the surface encloses no volume.
    """
    points = surface.points[np.unique(surface.triangles)]
    if len(points) < 4:
        raise InputError("the mesh encloses no volume: it has fewer than four points")
    sides = np.ptp(points @ np.linalg.svd(np.cov(points.T))[0], axis=0)
    if sides.min() <= SINGLE * sides.max():
        raise InputError("the mesh encloses no volume: it is flat")
    if report.closed and 2 * abs(report.volume) <= SINGLE * report.area * sides.max():
        raise InputError(
            "the mesh encloses no volume: it is folded onto itself, or its parts are wound "
            'against each other (for the latter: prepare = ["orient"])'
        )
    doubts = {
        f"the mesh is open ({report.boundary_edges} boundary edges): the generalized winding "
        'number will decide what is inside; prepare = ["repair"] closes holes': (
            report.boundary_edges
        ),
        f"{report.nonmanifold_edges} edges have more than two triangles": report.nonmanifold_edges,
        f"{report.inconsistent_edges} edges have triangles wound against each other: "
        'prepare = ["orient"] mends that': report.inconsistent_edges,
        f"the faces are wound inwards (volume {report.volume:.3g} m^3): "
        'prepare = ["orient"] turns them': report.volume < 0,
    }
    return [line for line, doubtful in doubts.items() if doubtful]


def is_inside(surface: Surface, points: Positions) -> Mask:
    """Return which points (n, 3) have |winding number| > 1/2 (Jacobson et al. 2013)."""
    # imported here because it is slow
    import igl

    low, high = bounds_of(surface)
    # libigl sums in single precision: scale the lengths to about 1, around the middle
    own, asked = (
        (rows - (low + high) / 2) / (high - low).max() for rows in (surface.points, points)
    )
    inside: Mask = np.abs(igl.fast_winding_number(own, surface.triangles, asked)) > 0.5
    return inside


def merged_triangles(surface: Surface) -> Indices:
    """Return the triangles (g, 3) over merged points.

    Points of equal position get the lowest of their numbers; degenerate triangles are dropped.
    """
    triangles = first_of_equal(surface.points)[surface.triangles]
    return triangles[have_three_corners(triangles)]


def have_three_corners(triangles: Indices) -> Mask:
    """Return which triangles (f,) name three different points."""
    a, b, c = triangles.T
    three: Mask = (a != b) & (b != c) & (c != a)
    return three


def first_of_equal(points: Positions) -> Indices:
    """Return, for each point (v,), the lowest number of a point at exactly the same position."""
    _, first, place = np.unique(points, axis=0, return_index=True, return_inverse=True)
    # some versions of NumPy return places (v, 1)
    lowest: Indices = first[place.ravel()]
    return lowest


def edge_use(triangles: Indices) -> tuple[Indices, Indices]:
    """Return, for each undirected edge (e,), its number of triangles and of upward triangles.

    An upward triangle has the edge from the lower to the higher point number.
    """
    start, end = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
    edge = np.minimum(start, end) * (triangles.max(initial=0) + 1) + np.maximum(start, end)
    _, place, used = np.unique(edge, return_inverse=True, return_counts=True)
    return used, np.bincount(place[start < end], minlength=len(used))
