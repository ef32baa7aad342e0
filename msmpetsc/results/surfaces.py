"""Two runs of one mesh, on lattices of any cells, held against each other by their surfaces, point by point.

Both runs carry the same points of the same mesh, so that nothing is projected or interpolated. A
point counts by the area around it, a third of its triangles'.
"""

import math
from dataclasses import dataclass

import numpy as np

from msmpetsc.backend.arrays import Array, Floats, Indices
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


@dataclass(frozen=True)
class SurfaceDistance:
    """How far the surface of a run is from that of a reference run.

    pairs    : (p, 2) frames of equal time in the run and the reference
    times    : (p,) [s]
    rms      : (p,) distance of the points [m], root mean square over the area
    greatest : (p,) greatest distance of a point [m]
    worst    : (p,) the point that is so far
    moved    : greatest distance of a point of the reference from its place at rest, [m]; 0 if none moves
    """

    pairs: Indices
    times: Floats
    rms: Floats
    greatest: Floats
    worst: Indices
    moved: float

    @property
    def overall(self) -> float:
        """Distance [m], root mean square over the surface and the times."""
        return float(np.sqrt(np.mean(self.rms**2)))


@np.errstate(over="ignore", invalid="ignore")  # what overflows is far apart, and is reported as that
def surface_distance(run: Result, reference: Result, until: float = math.inf) -> SurfaceDistance:
    """Return the distance of a run's surface from that of a reference run, at the times that both have.

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
    rms, greatest, worst, moved = np.empty(len(pairs)), np.empty(len(pairs)), np.empty(len(pairs), int), 0.0
    for number, (of_run, of_reference) in enumerate(pairs):
        true = np.asarray(reference.frames.surface[of_reference], float)
        apart = np.linalg.norm(run.frames.surface[of_run] - true, axis=1)
        apart[np.isnan(apart)] = np.inf
        rms[number] = np.sqrt(area @ apart**2 / area.sum())
        worst[number] = np.argmax(apart)
        greatest[number] = apart[worst[number]]
        moved = max(moved, np.nanmax(np.linalg.norm(true - rest, axis=1), initial=0.0))
    moved = (
        moved if moved > LEAST_STRAIN * longest_side(rest, reference.body_of("surface")) else 0.0
    )  # less is rounding
    return SurfaceDistance(pairs, times[pairs[:, 0]], rms, greatest, worst, float(moved))


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


def compare_surfaces(a: Result, b: Result) -> Comparison:
    """Return the surfaces of two runs compared as fields of the greatest distance and of its mean over the surface.

    Errors are relative to the largest displacement in `b`. Raises InputError as ``surface_distance`` does.
    """
    distance = surface_distance(a, b)
    scale = distance.moved or 1.0
    fields = [
        FieldError(name, "m", scale, values / scale, distance.worst)
        for name, values in (("surface", distance.greatest), (MEAN, distance.rms))
    ]
    return Comparison(distance.pairs, distance.times, fields, [])
