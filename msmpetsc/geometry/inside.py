"""Find the points in regions of space: boxes, spheres and half-spaces."""

import numpy as np

from msmpetsc.backend.arrays import Indices, Mask, Positions, Rows
from msmpetsc.geometry.surface import SINGLE
from msmpetsc.scene.body import Region


def inside(region: Region, points: Positions, bounds: Rows) -> Mask:
    """Return whether points (n, 3) [m] lie in a region or on its edge, (n,) bool.

    A box that reaches the body's bounding box has no limit there, because cells stick out.

    bounds : (2, 3) the body's bounding box at rest [m]
    """
    origin, scale, length = np.zeros(3), np.ones(3), 1.0
    if region.relative:
        origin, scale = bounds[0], bounds[1] - bounds[0]
        length = scale.max()
    edge = SINGLE * (bounds[1] - bounds[0]).max()
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
    # the schema requires a shape, and regions of the mesh do not come here
    assert region.half_space is not None
    point = origin + np.array(region.half_space.point) * scale
    beyond: Mask = (points - point) @ np.asarray(region.half_space.normal) >= -edge
    return beyond


def inside_bodies(
    region: Region, points: Positions, bounds: Rows, body: Indices, target: int | None
) -> Mask:
    """Return whether points (n, 3) [m] of several bodies lie in a region, (n,) bool.

    bounds : (b, 2, 3) each body's bounding box at rest [m]
    body   : (n,) the body of each point
    target : the body that the region applies to; None for all bodies
    """
    is_inside = np.zeros(len(points), bool)
    for number in range(len(bounds)) if target is None else (target,):
        own = body == number
        is_inside[own] = inside(region, points[own], bounds[number])
    return is_inside
