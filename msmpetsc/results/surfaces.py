"""Two runs of one mesh, on lattices of any cells, held against each other by their surfaces, point by point.

Both runs carry the same points of the same mesh, so that nothing is projected or interpolated. A
point counts by the area around it, a third of its triangles'.
"""

import math

import numpy as np

from msmpetsc.backend.arrays import Array
from msmpetsc.errors import InputError
from msmpetsc.results.comparison import (
    LEAST_STRAIN,
    SAME_POINT,
    SAME_TIME,
    Comparison,
    FieldError,
    common_times,
    longest_side,
    point_text,
)
from msmpetsc.results.reader import Result

NEEDED = ("frames/surface", "surface/points", "surface/triangles")
MEAN = "surface, rms"  # name of the field


@np.errstate(over="ignore", invalid="ignore")  # what overflows is far apart, and is reported as that
def compare_surfaces(run: Result, reference: Result, until: float = math.inf) -> Comparison:
    """Return how far the surface of a run is from that of a reference run, at the times that both have.

    Its fields are the greatest distance of a point, and the root mean square over the area (MEAN).
    Both are relative to the largest displacement of a point in the reference, their scale [m]; if
    that is 0, as none moves, they are in metres.

    until : times after it do not count [s]

    Raises InputError where a file has no surface, the meshes differ or no time is common.
    """
    refuse_different_meshes(run, reference)
    rest, area = reference["surface/points"][:], point_areas(reference)
    times = run.frames.time[:]
    pairs = common_times(times, reference.frames.time[:])
    pairs = pairs[times[pairs[:, 0]] <= until * (1 + SAME_TIME)]
    if reference.scene.get("time", {}).get("integrator") == "static":
        pairs = pairs[times[pairs[:, 0]] > 0]  # when it is in its rest shape, which is no state of equilibrium
    if not len(pairs):
        raise InputError(f"{run.path} and {reference.path} have no finished frame of the same time")
    worst = np.empty(len(pairs), int)
    greatest, rms = np.empty((2, len(pairs)))
    moved = 0.0
    for number, (of_run, of_reference) in enumerate(pairs):
        true = np.asarray(reference.frames.surface[of_reference], float)
        apart = np.linalg.norm(run.frames.surface[of_run] - true, axis=1)
        apart[np.isnan(apart)] = np.inf
        rms[number] = np.sqrt(area @ apart**2 / area.sum())
        worst[number] = np.argmax(apart)
        greatest[number] = apart[worst[number]]
        moved = max(moved, float(np.nanmax(np.linalg.norm(true - rest, axis=1), initial=0.0)))
    if moved <= LEAST_STRAIN * longest_side(rest, reference.body_of("surface")):
        moved = 0.0  # less is rounding
    scale = moved or 1.0
    surface = FieldError("surface", "m", moved, greatest / scale, worst)
    mean = FieldError(MEAN, "m", moved, rms / scale, worst)
    return Comparison(pairs, times[pairs[:, 0]], [surface, mean], [])


def point_areas(run: Result) -> Array:
    """Return the area around each surface point at rest, (v,) [m^2]: a third of its triangles'."""
    points, triangles = run["surface/points"][:], run.indices("surface/triangles")
    a, b, c = (points[triangles[:, corner]] for corner in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    around = np.bincount(triangles.ravel(), np.repeat(areas / 3, 3), len(points))
    return around if around.sum() > 0 else np.ones(len(points))


def refuse_different_meshes(a: Result, b: Result) -> None:
    """Raise InputError with the first reason why the two do not carry the same surface."""
    for run in (a, b):
        missing = next((name for name in NEEDED if name not in run), None)
        if missing is not None:
            raise InputError(f"{run.path} has no {missing}: it was run with output.surface = false")

    def refuse(reason: str) -> None:
        raise InputError(f"{a.path} and {b.path} are runs of different meshes: {reason}")

    points, b_points = a["surface/points"][:], b["surface/points"][:]
    if len(points) != len(b_points) or not len(points):
        refuse(f"{len(points)} and {len(b_points)} surface points")
    apart = np.linalg.norm(points - b_points, axis=1)
    point = int(np.argmax(apart))
    if apart[point] > SAME_POINT * np.ptp(points, axis=0).max():
        refuse(
            f"point {point} rests at {point_text(points[point])} in one, at {point_text(b_points[point])} in the other"
        )
    if not np.array_equal(a["surface/triangles"][:], b["surface/triangles"][:]):
        refuse("their triangles join other points")
