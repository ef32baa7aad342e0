"""Compare two results frame by frame, without MPI and without PETSc.

Of one lattice all fields are. An error is the greatest difference at a frame over the scale of its
field (msmpetsc/results/README.md), which is that of both runs and all frames compared. What the
digits of the coarser of the two stored types cannot tell apart is equal, and so are two NaN, or two
infinities of one sign.

Of different lattices of one mesh their surfaces are, point by point: both carry the same points of the same mesh, so
that nothing is projected or interpolated. A point counts by the area around it, a third of its triangles'.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from msmpetsc.backend.arrays import Array, Floats, Indices, Mask, Positions
from msmpetsc.errors import InputError
from msmpetsc.fields import FRAME_FIELDS
from msmpetsc.results.reader import Result

ENERGIES = ("kinetic", "elastic", "potential", "contact")
COMPARED = ("position", "surface", *ENERGIES, "momentum")
LEAST_STRAIN = 1e-6  # of the body or of a spring: less is rounding
SAME_POINT = 1e-6  # of a cell
SAME_TIME = 1e-6  # of the spacing of frames
OF_SURFACES = ("frames/surface", "surface/points", "surface/triangles")
MEAN = "surface, rms"  # name of the field


class DifferentLattices(InputError):
    """Two results are not of one lattice."""


@dataclass
class FieldError:
    """The difference between two results in one field.

    scale  : what errors are relative to
    errors : (p,) relative, one a frame compared; inf where only one run has a number
    worst  : (p,) the row, node or point, that is farthest apart; 0 for plain numbers
    """

    name: str
    unit: str
    scale: float
    errors: Floats
    worst: Indices

    def first_above(self, rtol: float) -> int | None:
        """Return the first compared frame whose error is above rtol, or None."""
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


Distances = tuple[Floats, Indices, float]


@np.errstate(all="ignore")  # what overflows differs, and is reported as that
def compare(a: Result, b: Result) -> Comparison:
    """Compare the fields COMPARED that two results share, at the times that both have.

    Raises DifferentLattices if the lattices do not match, InputError if the runs have no time in common.
    """
    refuse_different_lattices(a, b)
    either = [name for name in COMPARED if name in a.frames or name in b.frames]
    chosen = [name for name in either if name in a.frames and name in b.frames]
    times = a.frames.time[:]
    pairs = common_times(times, b.frames.time[:])
    if not len(pairs):
        raise InputError(f"{a.path} and {b.path} have no finished frame of the same time")
    distances = {name: _distances(a, b, name, pairs) for name in chosen}
    scales = _scales(a, b, distances, pairs)
    fields = []
    for name, (greatest, worst, _) in distances.items():
        errors = np.where(greatest == 0, 0.0, greatest / scales[name])
        fields.append(FieldError(name, a.frames[name].unit, scales[name], errors, worst))
    return Comparison(
        pairs, times[pairs[:, 0]], fields, [name for name in either if name not in chosen]
    )


def rest_of(run: Result, name: str) -> Positions | None:
    """Return the rest positions (r, 3) [m] of a field of positions; None for other fields."""
    at_rest = FRAME_FIELDS[name].at_rest
    return run[at_rest][:] if at_rest in run else None


def _distances(a: Result, b: Result, name: str, pairs: Indices) -> Distances:
    """Return a field's greatest distance between two rows and that row, (p,) each, and the greatest size.

    The size is that in any frame, from rest where the field is one of positions.
    """
    a_rows, b_rows = a.frames[name], b.frames[name]
    if a_rows.shape[1:] != b_rows.shape[1:]:
        raise InputError(
            f"frames/{name} is {a_rows.shape[1:]} a frame in {a.path}, {b_rows.shape[1:]} in {b.path}"
        )
    rest = rest_of(a, name)
    digits = max(
        float(np.finfo(rows.dtype).eps) if rows.dtype.kind == "f" else 0.0
        for rows in (a_rows, b_rows)
    )
    greatest = np.empty(len(pairs))
    worst = np.empty(len(pairs), int)
    size = 0.0
    for number, (a_frame, b_frame) in enumerate(pairs):
        a_values, b_values = (
            np.asarray(rows, float) for rows in (a_rows[a_frame], b_rows[b_frame])
        )
        apart = _row_lengths(difference(a_values, b_values, digits))
        worst[number] = np.argmax(apart) if apart.size else 0
        greatest[number] = apart[worst[number]] if apart.size else 0.0
        for values in (a_values, b_values):
            sizes = _row_lengths(values if rest is None else values - rest)
            size = max(size, sizes[np.isfinite(sizes)].max(initial=0.0))
    return greatest, worst, float(size)


def difference(a: Array, b: Array, digits: float) -> Floats:
    """Return |a - b|, less what rounding to these relative `digits` may do.

    It is 0 of two NaN, inf of a NaN and a number.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        apart = np.abs(a - b) - digits * np.maximum(np.abs(a), np.abs(b))
    apart = np.where((a == b) | (np.isnan(a) & np.isnan(b)), 0.0, apart)
    return np.maximum(np.where(np.isnan(apart), np.inf, apart), 0.0)


def _row_lengths(rows: Array) -> Floats:
    """Return the lengths (r,) of vectors (r, 3), of one vector (3,), or the sizes of plain numbers."""
    if rows.ndim == 0:
        return np.abs(rows)[None]
    return np.ravel(np.linalg.norm(rows, axis=-1))


def _scales(
    a: Result, b: Result, distances: dict[str, Distances], pairs: Indices
) -> dict[str, float]:
    """Return the scale of each field, by which its errors are divided."""
    scales = {name: size for name, (_, _, size) in distances.items()}
    side = longest_side(a.lattice.nodes[:], a.body_of("lattice"))
    least = 0.0  # of the stiffest and longest spring, strained by LEAST_STRAIN [J]
    if all(name in a.lattice and len(a.lattice[name]) for name in ("stiffness", "rest_length")):
        longest = a.lattice.rest_length[:].max()
        least = float(0.5 * a.lattice.stiffness[:].max() * (LEAST_STRAIN * longest) ** 2)
    energy, kinetic = (
        max(least, _largest(a, b, pairs, names)) for names in (ENERGIES, ["kinetic"])
    )
    for name in scales:
        if name in ENERGIES:
            scales[name] = energy
        elif FRAME_FIELDS[name].at_rest:
            scales[name] = max(scales[name], LEAST_STRAIN * side)
    if "momentum" in scales and "mass" in a.lattice and kinetic > 0:
        scales["momentum"] = float(np.sqrt(2 * a.lattice.mass[:].sum() * kinetic))
    return scales


def longest_side(points: Positions, body: Indices) -> float:
    """Return the longest side [m] of the bounding box of any body's points (n, 3); ``body`` (n,) are their numbers."""
    of_bodies = (points[body == number] for number in np.unique(body))
    return float(max((np.ptp(own, axis=0).max() for own in of_bodies), default=0.0))


def _largest(a: Result, b: Result, pairs: Indices, names: Sequence[str]) -> float:
    """Return the largest size of the named energies at the compared frames of both results."""
    runs = (a, pairs[:, 0]), (b, pairs[:, 1])
    energies = [
        (name, run.frames[name][frames])
        for run, frames in runs
        for name in names
        if name in run.frames
    ]
    # the potential energy's zero means nothing
    values = [energy - energy[0] if name == "potential" else energy for name, energy in energies]
    sizes = np.abs(np.concatenate([np.empty(0), *values]))
    return float(sizes[np.isfinite(sizes)].max(initial=0.0))


def rows_agree(a: Array, b: Array, slack: float) -> Mask:
    """Return which rows (n,) of a and b, (n, 3) or (n,) each, differ by at most `slack`."""
    rows: Array = (a - b).reshape(len(a), -1)
    agree: Mask = np.linalg.norm(rows, axis=1) <= slack
    return agree


def refuse_different_lattices(a: Result, b: Result) -> None:
    """Raise DifferentLattices with the first reason why the two are not of one lattice."""

    def refuse(reason: str) -> None:
        raise DifferentLattices(f"{a.path} and {b.path} are runs of different lattices: {reason}")

    nodes, b_nodes = a.lattice.nodes[:], b.lattice.nodes[:]
    sizes = cell_size(a, nodes), cell_size(b, b_nodes)
    if len(nodes) != len(b_nodes):
        refuse(
            f"{len(nodes)} and {len(b_nodes)} nodes, cells of {sizes[0]:.4g} m and {sizes[1]:.4g} m"
        )
    if abs(sizes[0] - sizes[1]) > SAME_POINT * sizes[0]:
        refuse(f"cells of {sizes[0]:.6g} m and {sizes[1]:.6g} m")
    if where := first_apart(nodes, b_nodes, SAME_POINT * (sizes[0] or 1.0)):
        refuse(f"node {where}")


def first_apart(a: Positions, b: Positions, slack: float) -> str:
    """Return in words the first of points (n, 3) [m] that differs between two results by more than `slack`."""
    same = rows_agree(a, b, slack)
    if same.all():
        return ""
    first = int(np.argmin(same))
    return f"{first} rests at {point_text(a[first])} in one, at {point_text(b[first])} in the other"


def cell_size(run: Result, nodes: Positions) -> float:
    """Return the edge length [m] of the first cell; 0 for a file without cells."""
    if "cells" not in run.lattice or not len(run.lattice.cells):
        return 0.0
    corners = run.indices("lattice/cells")[0]
    return float(np.ptp(nodes[corners], axis=0).max())


def point_text(point: Floats) -> str:
    """Return a point (3,) [m] as text for a message."""
    return "(" + ", ".join(f"{x:.6g}" for x in point) + ") m"


def common_times(a: Floats, b: Floats) -> Indices:
    """Return the indices (p, 2) of equal times in two ascending series [s], equal to rounding."""
    if not len(b):
        return np.empty((0, 2), int)
    slack = SAME_TIME * np.diff(b).min(initial=1.0)
    near = np.searchsorted(b, a - slack).clip(max=len(b) - 1)
    same = np.abs(b[near] - a) <= slack
    return np.column_stack([np.nonzero(same)[0], near[same]])


@np.errstate(
    over="ignore", invalid="ignore"
)  # what overflows is far apart, and is reported as that
def compare_surfaces(run: Result, reference: Result) -> Comparison:
    """Return the distances between the surfaces of a result and its reference, at the times that both have.

    Its fields are the greatest distance of a point, and the root mean square over the area (MEAN).
    Both are relative to the largest displacement of a point in the reference, their scale [m]; if
    that is 0, as none moves, they are in metres.

    Raises InputError where a file has no surface, the meshes differ or no time is common.
    """
    refuse_different_meshes(run, reference)
    rest, area = reference["surface/points"][:], point_areas(reference)
    times = run.frames.time[:]
    pairs = common_times(times, reference.frames.time[:])
    if reference.scene.get("time", {}).get("integrator") == "static":
        pairs = pairs[
            times[pairs[:, 0]] > 0
        ]  # when it is in its rest shape, which is no state of equilibrium
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
    """Return the area (v,) [m^2] of each surface point at rest: a third of its triangles'."""
    points, triangles = run["surface/points"][:], run.indices("surface/triangles")
    a, b, c = (points[triangles[:, corner]] for corner in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    around = np.bincount(triangles.ravel(), np.repeat(areas / 3, 3), len(points))
    return around if around.sum() > 0 else np.ones(len(points))


def refuse_different_meshes(a: Result, b: Result) -> None:
    """Raise InputError with the first reason why the two do not carry the same surface."""
    for run in (a, b):
        missing = next((name for name in OF_SURFACES if name not in run), None)
        if missing is not None:
            raise InputError(f"{run.path} has no {missing}: it was run with output.surface = false")

    def refuse(reason: str) -> None:
        raise InputError(f"{a.path} and {b.path} are runs of different meshes: {reason}")

    points, b_points = a["surface/points"][:], b["surface/points"][:]
    if len(points) != len(b_points) or not len(points):
        refuse(f"{len(points)} and {len(b_points)} surface points")
    if where := first_apart(points, b_points, SAME_POINT * np.ptp(points, axis=0).max()):
        refuse(f"point {where}")
    if not np.array_equal(a["surface/triangles"][:], b["surface/triangles"][:]):
        refuse("their triangles join other points")
