"""A mesh measured for a first scene: its unit and its upward axis are guessed, its faults and parts counted."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from msmpetsc.build import USUAL
from msmpetsc.geometry.prepare import part_labels
from msmpetsc.geometry.surface import Surface, SurfaceReport, examine

MILLIMETRE = 1e-3  # [m]
SOLE = 0.02  # of the height: what lies so near to the lowest point may stand on the ground
FEET = 0.5  # share of the sole that counts less where it is flat, as a table's top is: feet are likelier below
SURER = 0.1  # by so much y must stand better than z to be upwards
Y_BY_DEFINITION = (".glb", ".gltf")


@dataclass(frozen=True)
class MeshMeasures:
    """What a first scene rests on.

    sides  : (3,) of the bounding box, in the file's unit
    report : volume, area and faults, in the file's unit
    parts  : (p,) share of the area that each connected part has, the largest first
    unit   : what the file's unit is taken for [m]; None where neither metres nor millimetres give a usual body
    y_up   : whether y points upwards, not z
    """

    sides: np.ndarray
    triangles: int
    report: SurfaceReport
    parts: np.ndarray
    unit: float | None
    y_up: bool

    @property
    def thickness(self) -> float:
        """Mean thickness, twice the volume over the area; in the file's unit."""
        return 2 * abs(self.report.volume) / self.report.area


def measured(surface: Surface, suffix: str = "") -> MeshMeasures:
    """Measure a surface as its file has it; ``suffix`` of the file: the axes of glTF are defined."""
    sides = np.ptp(surface.points[np.unique(surface.triangles)], axis=0)
    areas = np.bincount(part_labels(surface), triangle_areas(surface))
    return MeshMeasures(
        sides=sides,
        triangles=len(surface.triangles),
        report=examine(surface),
        parts=np.sort(areas / areas.sum())[::-1],
        unit=unit_of(float(sides.max())),
        y_up=suffix.lower() in Y_BY_DEFINITION or uprightness(surface, 1) > uprightness(surface, 2) + SURER,
    )


def unit_of(side: float) -> float | None:
    """Return the unit [m] in which a body of this longest side has a usual size, metres before millimetres."""
    usual = (unit for unit in (1.0, MILLIMETRE) if USUAL[0] <= side * unit <= USUAL[1])
    return next(usual, None)


def uprightness(surface: Surface, axis: int) -> float:
    """Return how much likelier a body stands with this axis upwards than downwards, in [-1, 1].

    A chair stands well on its feet and badly on its head; lying on its back it does both, a little.
    """
    return stands(surface, axis, 1) - stands(surface, axis, -1)


def stands(surface: Surface, axis: int, way: int) -> float:
    """Return how well a body stands with this axis upwards (way 1) or downwards (-1): the share of its ground plan
    that it stands on, less where it stands on a face rather than on feet.

    That is the convex hull of its lowest points; nothing where its centre is not above it.
    """
    points, plan = surface.points[np.unique(surface.triangles)], [a for a in range(3) if a != axis]
    height = way * points[:, axis] - (way * points[:, axis]).min()
    sole = points[height <= SOLE * height.max()][:, plan]
    try:
        hull, ground = ConvexHull(sole), ConvexHull(points[:, plan])
    except QhullError:  # an edge or a corner
        return 0.0
    areas = triangle_areas(surface)
    centre = areas @ surface.points[surface.triangles].mean(axis=1)[:, plan] / areas.sum()
    above = (hull.equations[:, :2] @ centre + hull.equations[:, 2] <= 0).all()
    if not above:
        return 0.0
    top = height.max()
    lowest = ((way * surface.points[:, axis] - (way * points[:, axis]).min())[surface.triangles] <= SOLE * top).all(
        axis=1
    )
    a, b, c = surface.points[surface.triangles[lowest]][:, :, plan].swapaxes(0, 1)
    (ux, uy), (vx, vy) = (b - a).T, (c - a).T
    face = np.abs(ux * vy - uy * vx).sum() / 2 / hull.volume  # in two dimensions the volume is an area
    return float(hull.volume / ground.volume * (1 - FEET * min(face, 1.0)))


def triangle_areas(surface: Surface) -> np.ndarray:
    """Return the area of each triangle (f,)."""
    a, b, c = surface.points[surface.triangles].swapaxes(0, 1)
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
