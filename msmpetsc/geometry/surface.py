"""Surface meshes: measured, and checked to enclose a volume."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from msmpetsc.backend.arrays import Array, Indices, Mask, Positions, Rows
from msmpetsc.comm import starts
from msmpetsc.errors import InputError

# Coordinates are often stored in single precision (1.2e-7): thinner than this, relative to its
# longest side, a body cannot be told from a flat sheet. A plate of 1:1000 lies far above.
FLAT = 1e-6


@dataclass(frozen=True)
class Surface:
    """A triangle mesh.

    points    : (v, 3) float64 [m]
    triangles : (f, 3) int64, corners of each triangle as rows of ``points``
    groups    : by the names that a file gives them, surfaces that mark parts of the body
    """

    points: Positions
    triangles: Array
    groups: "Mapping[str, Surface]" = field(default_factory=dict)

    def moved(self, move: Callable[[Positions], Positions]) -> "Surface":
        """Return the surface and its groups with their points moved."""
        groups = {name: group.moved(move) for name, group in self.groups.items()}
        return Surface(move(self.points), self.triangles, groups)


def joined(surfaces: Sequence[Surface]) -> Surface | None:
    """Return surfaces as one, one after the other; None for none."""
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
    """Return the surface of these triangles and only their points, in the order they had."""
    used, numbers = np.unique(triangles, return_inverse=True)
    return Surface(points[used], numbers.reshape(-1, 3))


def outward(surface: Surface) -> Rows:
    """Return the unit normals (v, 3) at the points of a closed surface, outward whichever way it is wound."""
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

    Edges are counted after merging points of equal position (so the loose triangles of an STL
    may be closed) and dropping the triangles that this leaves with two equal corners.

    nonmanifold_edges    : edges of more than two triangles
    inconsistent_edges   : edges whose two triangles run along them in the same direction
    """

    volume: float  # [m^3], signed: negative if wound inwards; of little meaning if open
    area: float  # [m^2]
    boundary_edges: int
    nonmanifold_edges: int
    inconsistent_edges: int

    @property
    def closed(self) -> bool:
        """Whether no edge belongs to one triangle only."""
        return self.boundary_edges == 0


def examine(surface: Surface) -> SurfaceReport:
    """Measure volume, area and edges of a surface."""
    corners = surface.points[surface.triangles]  # (f, 3 corners, 3)
    corners = corners - surface.points[surface.triangles[0, 0]]  # small numbers round less
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
    """Return a line for each doubt about a surface's inside, with its remedy; none for a clean one.

    Flatness is measured along the principal axes, so that a tilted sheet is seen too. A closed
    surface is judged by its mean thickness, 2 |volume| / area, relative to its longest side.

    Raises InputError if the surface encloses no volume.
    """
    points = surface.points[np.unique(surface.triangles)]
    if len(points) < 4:
        raise InputError("the mesh encloses no volume: it has fewer than four points")
    sides = np.ptp(points @ np.linalg.svd(np.cov(points.T))[0], axis=0)
    if sides.min() <= FLAT * sides.max():
        raise InputError("the mesh encloses no volume: it is flat")
    if report.closed and 2 * abs(report.volume) <= FLAT * report.area * sides.max():
        raise InputError(
            "the mesh encloses no volume: it is folded onto itself, or its parts are wound "
            'against each other (for the latter: prepare = ["orient"])'
        )
    doubts = {
        f"the mesh is open ({report.boundary_edges} boundary edges): the generalized winding number will decide what "
        'is inside; prepare = ["repair"] closes holes': report.boundary_edges,
        f"{report.nonmanifold_edges} edges have more than two triangles": report.nonmanifold_edges,
        f"{report.inconsistent_edges} edges have triangles wound against each other: "
        'prepare = ["orient"] mends that': report.inconsistent_edges,
        f'the faces are wound inwards (volume {report.volume:.3g} m^3): prepare = ["orient"] turns them': (
            report.volume < 0
        ),
    }
    return [line for line, doubtful in doubts.items() if doubtful]


def is_inside(surface: Surface, points: Positions) -> Mask:
    """Return which points (n, 3) are inside: their winding number is above 1/2 in size (Jacobson et al. 2013)."""
    # for open surfaces, and scenes with obstacles
    import igl

    low, high = bounds_of(surface)
    # libigl sums in single precision: lengths are measured from the middle, in longest sides
    own, asked = (
        (rows - (low + high) / 2) / (high - low).max() for rows in (surface.points, points)
    )
    inside: Mask = np.abs(igl.fast_winding_number(own, surface.triangles, asked)) > 0.5
    return inside


def merged_triangles(surface: Surface) -> Indices:
    """Return the triangles (g, 3) over merged points.

    Equal positions have the number of the first of them; triangles left with fewer than three corners are dropped.
    """
    triangles = first_of_equal(surface.points)[surface.triangles]
    a, b, c = triangles.T
    whole: Mask = (a != b) & (b != c) & (c != a)
    return triangles[whole]


def first_of_equal(points: Positions) -> Indices:
    """Return for each point (v,) the lowest number of a point of exactly the same position."""
    order = np.lexsort(points.T)  # stable: equal points stay in the order of their numbers
    sorted_points = points[order]
    starts = np.ones(len(points), bool)
    starts[1:] = (sorted_points[1:] != sorted_points[:-1]).any(axis=1)
    first = np.empty(len(points), np.int64)
    first[order] = order[starts][np.cumsum(starts) - 1]
    return first


def edge_use(triangles: Indices) -> tuple[Indices, Indices]:
    """Return for each undirected edge (e,) how many triangles use it, and how many of those run along it upwards.

    Upwards is from its lower to its higher point number.
    """
    if len(triangles) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    start, end = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
    low, high = np.minimum(start, end), np.maximum(start, end)
    # one sortable number an edge, its direction in the last bit
    key = np.sort((low * (triangles.max() + 1) + high) * 2 + (start < end))
    first = np.flatnonzero(np.diff(key >> 1, prepend=-1))
    return np.diff(first, append=len(key)), np.add.reduceat(key & 1, first)
