"""Compare two results frame by frame, without MPI and without PETSc.

Results on the same lattice are compared in the fields COMPARED. The error of a field is its largest
difference at a frame, divided by the field's scale (scripts/docs/pages/how-to/compare.md). The
scale is taken over both runs and all compared frames. Two NaN are equal, and so are two infinities
of the same sign.

Results on different lattices of the same mesh are compared by their surfaces only, point by point.
Both have the same points, so nothing is projected or interpolated. The weight of a point is a third
of the area of its triangles.
"""

from dataclasses import dataclass

import numpy as np

from msmpetsc.backend.arrays import Array, Floats, Indices, Mask, Positions
from msmpetsc.errors import InputError
from msmpetsc.fields import FRAME_FIELDS
from msmpetsc.results.reader import Result

ENERGIES = ("kinetic", "elastic", "potential", "contact")
COMPARED = ("position", "surface", *ENERGIES, "momentum")
# difference that counts as rounding [-]: a strain of a spring, a distance over the
# longest side, a time over the frames' spacing
ROUNDING = 1e-6
SURFACE_FIELDS = ("frames/surface", "surface/points", "surface/triangles")
# name of the field of root mean square distances
MEAN = "surface, rms"


@dataclass
class FieldError:
    """The difference between two results in a field.

    scale  : denominator of the relative errors, in ``unit``
    errors : (p,) relative error at each compared frame; inf if only a single run has a number
    worst  : (p,) row, a node or point, of the largest difference; 0 for plain numbers
    """

    name: str
    unit: str
    scale: float
    errors: Floats
    worst: Indices

    def first_above(self, rtol: float) -> int | None:
        """Return the first compared frame with an error above rtol, or None."""
        above = np.flatnonzero(self.errors > rtol)
        return int(above[0]) if len(above) else None


@dataclass
class Comparison:
    """The differences between two results, frame by frame.

    pairs    : (p, 2) frames of equal time in the two runs
    times    : (p,) [s]
    left_out : fields that only one run has
    """

    pairs: Indices
    times: Floats
    fields: list[FieldError]
    left_out: list[str]


# values that overflow are reported as different
@np.errstate(all="ignore")
def compare(a: Result, b: Result) -> Comparison:
    """Compare the fields COMPARED of two results on a lattice at their common times.

    Raises InputError if the results share no time.
    """
    either = [name for name in COMPARED if name in a.frames or name in b.frames]
    chosen = [name for name in either if name in a.frames and name in b.frames]
    pairs = shared_frames(a, b)
    distances = {name: _distances(a, b, name, pairs) for name in chosen}
    scales = _scales(a, {name: size for name, (_, _, size) in distances.items()})
    fields = []
    for name, (greatest, worst, _) in distances.items():
        errors = np.where(greatest == 0, 0.0, greatest / scales[name])
        fields.append(FieldError(name, a.frames[name].unit, scales[name], errors, worst))
    times = a.frames.time[pairs[:, 0]]
    return Comparison(pairs, times, fields, [name for name in either if name not in chosen])


def rest_of(run: Result, name: str) -> Positions | None:
    """Return the rest positions (r, 3) [m] of a field of positions; None for other fields."""
    at_rest = FRAME_FIELDS[name].at_rest
    return run[at_rest][:] if at_rest in run else None


def _distances(a: Result, b: Result, name: str, pairs: Indices) -> tuple[Floats, Indices, float]:
    """Return the largest difference of a field and its row, (p,) each, and the largest size.

    The size is the field's largest value in all compared frames of both runs. Positions count
    relative to rest. The zero of the potential energy is arbitrary, so potential energies count
    relative to the first compared frame.
    """
    a_rows, b_rows = a.frames[name], b.frames[name]
    if a_rows.shape[1:] != b_rows.shape[1:]:
        raise InputError(
            f"frames/{name} is {a_rows.shape[1:]} a frame in {a.path}, "
            f"{b_rows.shape[1:]} in {b.path}"
        )
    rest = rest_of(a, name)
    origins = [
        rows[first] if name == "potential" else rest
        for rows, first in zip((a_rows, b_rows), pairs[0], strict=True)
    ]
    greatest = np.empty(len(pairs))
    worst = np.empty(len(pairs), int)
    size = 0.0
    for number, (a_frame, b_frame) in enumerate(pairs):
        a_values, b_values = (
            np.asarray(rows, float) for rows in (a_rows[a_frame], b_rows[b_frame])
        )
        distance = _row_lengths(difference(a_values, b_values))
        worst[number] = np.argmax(distance) if distance.size else 0
        greatest[number] = distance[worst[number]] if distance.size else 0.0
        for values, origin in zip((a_values, b_values), origins, strict=True):
            sizes = _row_lengths(values if origin is None else values - origin)
            size = max(size, sizes[np.isfinite(sizes)].max(initial=0.0))
    return greatest, worst, float(size)


@np.errstate(invalid="ignore", over="ignore")
def difference(a: Array, b: Array) -> Floats:
    """Return |a - b|: 0 for two NaN, inf for a NaN and a number."""
    distance = np.where((a == b) | (np.isnan(a) & np.isnan(b)), 0.0, np.abs(a - b))
    return np.where(np.isnan(distance), np.inf, distance)


def _row_lengths(rows: Array) -> Floats:
    """Return the lengths (r,) of vectors (r, 3) or (3,), or absolute values of plain numbers."""
    if rows.ndim == 0:
        return np.abs(rows)[None]
    return np.ravel(np.linalg.norm(rows, axis=-1))


def _scales(a: Result, sizes: dict[str, float]) -> dict[str, float]:
    """Return the scale of each field, by which its errors are divided, from the fields' sizes."""
    side = longest_side(a.lattice.nodes[:], a.body_of("lattice"))
    # energy [J] of the stiffest and longest spring at ROUNDING
    least = 0.0
    if all(name in a.lattice and len(a.lattice[name]) for name in ("stiffness", "rest_length")):
        longest = a.lattice.rest_length[:].max()
        least = float(0.5 * a.lattice.stiffness[:].max() * (ROUNDING * longest) ** 2)
    scales = dict(sizes)
    for name in sizes:
        if name in ENERGIES:
            scales[name] = max([least, *(sizes[of] for of in ENERGIES if of in sizes)])
        elif FRAME_FIELDS[name].at_rest:
            scales[name] = max(sizes[name], ROUNDING * side)
    kinetic = max(least, sizes.get("kinetic", 0.0))
    if "momentum" in sizes and "mass" in a.lattice and kinetic > 0:
        scales["momentum"] = float(np.sqrt(2 * a.lattice.mass[:].sum() * kinetic))
    return scales


def longest_side(points: Positions, body: Indices) -> float:
    """Return the longest side [m] of the bounding boxes of bodies with points (n, 3).

    body : (n,) the body of each point
    """
    of_bodies = (points[body == number] for number in np.unique(body))
    return float(max((np.ptp(own, axis=0).max() for own in of_bodies), default=0.0))


def rows_agree(a: Array, b: Array, tolerance: float) -> Mask:
    """Return whether the rows (n,) of a and b, (n, 3) or (n,), differ by at most ``tolerance``."""
    rows: Array = (a - b).reshape(len(a), *a.shape[1:] or (1,))
    agree: Mask = np.linalg.norm(rows, axis=1) <= tolerance
    return agree


def different_lattices(a: Result, b: Result) -> str:
    """Return in words how the lattices of two results differ; "" if they are the same."""
    reason = first_mismatch(a.lattice.nodes[:], b.lattice.nodes[:], "node")
    return reason and f"{a.path} and {b.path} are runs of different lattices: {reason}"


def first_mismatch(a: Positions, b: Positions, kind: str) -> str:
    """Return in words how points (n, 3) [m] at rest first differ; "" if they are the same."""
    if len(a) != len(b):
        return f"{len(a)} and {len(b)} {kind}s"
    same = rows_agree(a, b, ROUNDING * longest_side(a, np.zeros(len(a), int)))
    if same.all():
        return ""
    first = int(np.argmin(same))
    return (
        f"{kind} {first} rests at {point_text(a[first])} in one, "
        f"at {point_text(b[first])} in the other"
    )


def point_text(point: Floats) -> str:
    """Return a point (3,) [m] as text for a message."""
    return "(" + ", ".join(f"{x:.6g}" for x in point) + ") m"


def shared_frames(a: Result, b: Result, start: float = -np.inf) -> Indices:
    """Return the indices (p, 2) of frames after ``start`` [s] whose times agree up to rounding.

    Raises InputError if there are none.
    """
    times, others = a.frames.time[:], b.frames.time[:]
    pairs = np.empty((0, 2), int)
    if len(others):
        tolerance = ROUNDING * np.diff(others).min(initial=1.0)
        near = np.searchsorted(others, times - tolerance).clip(max=len(others) - 1)
        same = (np.abs(others[near] - times) <= tolerance) & (times > start)
        pairs = np.column_stack([np.nonzero(same)[0], near[same]])
    if not len(pairs):
        raise InputError(f"{a.path} and {b.path} have no finished frame of the same time")
    return pairs


# values that overflow are reported as far apart
@np.errstate(over="ignore", invalid="ignore")
def compare_surfaces(run: Result, reference: Result) -> Comparison:
    """Return the distances of a result's surface from its reference, at their common times.

    The two fields are the largest distance of a point, and the root mean square over the area
    (MEAN). Both are relative to their scale [m], the largest displacement in the reference. If no
    point of the reference moves, the errors are in metres and the scale is 0.

    Raises InputError if a file has no surface, the meshes differ, or the results share no time.
    """
    refuse_different_meshes(run, reference)
    rest = reference["surface/points"][:]
    area = point_areas(rest, reference.indices("surface/triangles"))
    # a static run starts at rest, which is no equilibrium
    is_static = reference.scene.get("time", {}).get("integrator") == "static"
    pairs = shared_frames(run, reference, start=0.0 if is_static else -np.inf)
    worst = np.empty(len(pairs), int)
    greatest, rms = np.empty((2, len(pairs)))
    displacement = 0.0
    for number, (of_run, of_reference) in enumerate(pairs):
        true = np.asarray(reference.frames.surface[of_reference], float)
        distance = np.linalg.norm(run.frames.surface[of_run] - true, axis=1)
        distance[np.isnan(distance)] = np.inf
        rms[number] = np.sqrt(area @ distance**2 / area.sum())
        worst[number] = np.argmax(distance)
        greatest[number] = distance[worst[number]]
        largest = np.nanmax(np.linalg.norm(true - rest, axis=1), initial=0.0)
        displacement = max(displacement, float(largest))
    if displacement <= ROUNDING * longest_side(rest, reference.body_of("surface")):
        # a smaller displacement is rounding
        displacement = 0.0
    scale = displacement or 1.0
    surface = FieldError("surface", "m", displacement, greatest / scale, worst)
    mean = FieldError(MEAN, "m", displacement, rms / scale, worst)
    return Comparison(pairs, run.frames.time[pairs[:, 0]], [surface, mean], [])


def point_areas(points: Positions, triangles: Indices) -> Array:
    """Return the area (v,) [m^2] around each point: a third of its triangles' area."""
    a, b, c = points[triangles].swapaxes(0, 1)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    around = np.bincount(triangles.ravel(), np.repeat(areas / 3, 3), len(points))
    return around if around.sum() > 0 else np.ones(len(points))


def refuse_different_meshes(a: Result, b: Result) -> None:
    """Raise InputError, with the first reason, if two results do not have the same surface."""
    for run in (a, b):
        missing = next((name for name in SURFACE_FIELDS if name not in run), None)
        if missing is not None:
            raise InputError(f"{run.path} has no {missing}: it was run with output.surface = false")

    reason = first_mismatch(a["surface/points"][:], b["surface/points"][:], "surface point")
    if not np.array_equal(a["surface/triangles"][:], b["surface/triangles"][:]):
        reason = reason or "their triangles join other points"
    if reason:
        raise InputError(f"{a.path} and {b.path} are runs of different meshes: {reason}")
