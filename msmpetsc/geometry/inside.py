"""Points in regions that are boxes, spheres or half spaces; needs numpy alone."""

import numpy as np

from msmpetsc.backend.arrays import Floats, Indices, Mask, Positions, Rows
from msmpetsc.scene.body import Region

EDGE = 1e-6  # of the longest side: what is this near to a region is on its edge; many meshes have single precision


def frame_of(region: Region, bounds: Rows) -> tuple[Floats, Floats, float]:
    """Return origin (3,), scale (3,) and length [m] of a region's coordinates."""
    sides = bounds[1] - bounds[0]
    return (bounds[0], sides, sides.max()) if region.relative else (np.zeros(3), np.ones(3), 1.0)


def inside(region: Region, points: Positions, bounds: Rows) -> Mask:
    """Return which points (n, 3) [m] lie in a region or on its edge, (n,) bool.

    Sides of a box at the body's bounding box, or beyond it, are open outwards: cells stick out there.

    bounds : (2, 3) the body's bounding box at rest [m]
    """
    origin, scale, length = frame_of(region, bounds)
    edge = EDGE * (bounds[1] - bounds[0]).max()
    if region.box is not None:
        low, high = origin + np.array(region.box) * scale
        low = np.where(low <= bounds[0] + edge, -np.inf, low)
        high = np.where(high >= bounds[1] - edge, np.inf, high)
        in_box: Mask = ((points >= low - edge) & (points <= high + edge)).all(axis=1)
        return in_box
    if region.sphere is not None:
        distance = np.linalg.norm(
            points - (origin + np.array(region.sphere.center) * scale), axis=1
        )
        in_sphere: Mask = distance <= region.sphere.radius * length + edge
        return in_sphere
    assert (
        region.half_space is not None
    )  # the schema has one, and those of the mesh are not asked for
    point = origin + np.array(region.half_space.point) * scale
    beyond: Mask = (points - point) @ np.asarray(region.half_space.normal) >= -edge
    return beyond


def inside_bodies(
    region: Region, points: Positions, bounds: Rows, body: Indices, meant: int | None
) -> Mask:
    """Return which points (n, 3) [m] of bodies lie in a region, (n,) bool.

    bounds : (b, 2, 3) each body's bounding box at rest [m]
    body   : (n,) the body of each point
    meant  : the body whose region it is; None: all
    """
    where = np.zeros(len(points), bool)
    for number in range(len(bounds)) if meant is None else (meant,):
        own = body == number
        where[own] = inside(region, points[own], bounds[number])
    return where
