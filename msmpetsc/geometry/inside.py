"""Which points lie in a region of a scene that is a box, a sphere or a half space; needs numpy alone."""

import numpy as np

from msmpetsc.scene.body import Region

EDGE = 1e-9  # of the body's longest side: a node this near to a region counts as on its edge, whatever was rounded


def inside(region: Region, points: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Return which points (n, 3) [m] lie in a region or on its edge, (n,) bool.

    bounds : (2, 3) the body's bounding box at rest [m]
    """
    sides = bounds[1] - bounds[0]
    origin, scale, length = (bounds[0], sides, sides.max()) if region.relative else (np.zeros(3), np.ones(3), 1.0)
    edge = EDGE * sides.max()

    def to_body(point: tuple[float, ...]) -> np.ndarray:
        return origin + np.asarray(point) * scale

    if region.box is not None:
        low, high = region.box
        return ((points >= to_body(low) - edge) & (points <= to_body(high) + edge)).all(axis=1)
    if region.sphere is not None:
        distance = np.linalg.norm(points - to_body(region.sphere.center), axis=1)
        return distance <= region.sphere.radius * length + edge
    assert region.half_space is not None  # the schema has one of the four, and the painted ones are not asked for
    return (points - to_body(region.half_space.point)) @ np.asarray(region.half_space.normal) >= -edge


def inside_bodies(
    region: Region, points: np.ndarray, bounds: np.ndarray, body: np.ndarray, meant: int | None
) -> np.ndarray:
    """Return which points (n, 3) [m] of bodies lie in a region, (n,) bool.

    bounds : (b, 2, 3) each body's bounding box at rest [m]
    body   : (n,) the body of each point
    meant  : the body whose region it is; None: all
    """
    if len(bounds) == 1:
        return inside(region, points, bounds[0])
    where = np.zeros(len(points), bool)
    for number in range(len(bounds)) if meant is None else (meant,):
        own = body == number
        where[own] = inside(region, points[own], bounds[number])
    return where
