"""Metrics of a run: its cost and its errors against a reference."""

import json
import warnings
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from msmpetsc.backend.arrays import Floats
from msmpetsc.errors import InputError
from msmpetsc.results.comparison import compare_surfaces, different_lattices, shared_frames
from msmpetsc.results.reader import Result
from msmpetsc.study.table import Row

# sums per frame in a result file
SUMMED = ("wall_time", "iterations", "ksp_its", "products")


# ---- the measure file, written by ``msmpetsc run --measure``


def read_record(path: Path) -> dict[str, Any]:
    """Return the contents of a measure file, or {} if the run was killed before writing it."""
    try:
        return dict(json.loads(path.read_text()))
    except (OSError, ValueError, TypeError):
        return {}


def costs(record: dict[str, Any]) -> Row:
    """Return counts, times, memory, machine and versions from a measure file's contents."""
    names = ("cells", "nodes", "unknowns", "springs", "memory")
    row = {name: record.get(name) for name in names}
    for part in ("setup", "factor", "local", "ksp", "output"):
        row[f"time_{part}"] = record.get("time", {}).get(part)
    machine = ""
    if host := record.get("machine"):
        memory = f"{host['memory'] / 2**30:.0f} GiB"
        machine = f"{host['cpu']}, {host['cores']} cores, {memory}, {host['system']}"
    versions = ", ".join(
        f"{name} {version}" for name, version in record.get("versions", {}).items()
    )
    return row | {"machine": machine, "versions": versions}


def frame_metrics(result: Path, time_step: float) -> Row:
    """Return metrics of a result file; times and iterations are means per step without start-up."""
    with Result(result) as run:
        count = len(run.frames.time)
        series = {name: array[:] for name, array in run.frames.items() if array.ndim == 1}
        shape = {"shape_error": shape_error(run, count - 1)} if count else {}
    if count < 2:
        return {"frames": count, "steps": 0} | shape
    # steps between consecutive frames
    steps = np.rint(np.diff(series["time"]) / time_step).astype(int)
    # frame 0 is the initial state; frame 1 contains work that is done once
    start = 2 if count > 2 else 1
    mean = {name: float(series[name][start:].sum() / steps[start - 1 :].sum()) for name in SUMMED}
    row = {"frames": count, "steps": int(steps.sum()), "time_frame": mean.pop("wall_time"), **mean}
    row["most_iterations"] = float((series["iterations"][1:] / steps.clip(1)).max())
    return row | shape | _errors(series) | _soundness(series)


def _soundness(series: dict[str, Floats]) -> Row:
    """Return counts of failures and contacts, final inverted cells, and the energy left.

    Without potential energy, the energy left is the final over the initial energy.
    """
    row: Row = {
        name: float(np.nansum(series[name][1:]))
        for name in ("substeps", "fallbacks", "energy_gained")
    }
    row["inverted"] = float(series["inverted"][-1])
    if series["self_contacts"].any():
        row["self_contacts"] = float(series["self_contacts"].max())
        row["self_distance"] = float(np.nanmin(series["self_distance"]))
    energy = np.sum(
        [series[name] for name in ("kinetic", "elastic", "contact", "self_contact")], axis=0
    )
    if energy[0] > 0 and not series["potential"].any():
        row["energy_left"] = float(energy[-1] / energy[0])
    return row


def _errors(series: dict[str, Floats]) -> Row:
    """Return rms errors over the steps whose true error was measured, or else over all steps."""
    estimated, true = series["step_error"][1:], series["true_error"][1:]
    where = np.isfinite(true) if np.isfinite(true).any() else ~np.isnan(estimated)
    # a step without a minimum nearby has an infinite estimate: then the run has none
    return {
        "estimated_error": None if np.isinf(estimated[where]).any() else _rms(estimated[where]),
        "true_error": _rms(true[where]),
        "energy_error": _rms(series["energy_error"][1:][where]),
    }


def _rms(values: Floats) -> float | None:
    values = values[np.isfinite(values)]
    return float(np.sqrt((values**2).mean())) if len(values) else None


def merge_repeats(runs: Sequence[Row]) -> Row:
    """Return a row for all repeats: medians of times, the range of a step's time, least memory.

    The least memory counts because the first run may also store data to measure true errors.
    """
    row = dict(runs[0])
    for name in row:
        known = [run[name] for run in runs if run.get(name) is not None]
        if name.startswith("time_") and known:
            row[name] = median(known)
        elif name == "memory" and known:
            row[name] = min(known)
    times = [run["time_frame"] for run in runs if run.get("time_frame") is not None]
    if len(times) > 1:
        row |= {"time_frame_min": min(times), "time_frame_max": max(times)}
    return row


# ---- distances from the rest shape and from the reference motion


def shape_error(run: Result, frame: int) -> float | None:
    """Return the largest distance of any body from its rest shape in a frame [-].

    Returns None if a position is not finite.
    """
    position = run.frames.position[frame]
    if not np.isfinite(position).all():
        return None
    rest, mass, body = run["lattice/nodes"][:], run["lattice/mass"][:], run.body_of("lattice")
    of_bodies = (body == number for number in np.unique(body))
    return max(distance_of_shapes(position[own], rest[own], mass[own]) for own in of_bodies)


def distance_of_shapes(x: Floats, rest: Floats, mass: Floats) -> float:
    """Return the distance of x (n, 3) from ``rest`` (n, 3) after the best rigid motion [-].

        min over R, c of sqrt( sum_i m_i |x_i - R rest_i - c|^2 / sum_i m_i ) / side

    R is a rotation without reflection, so that a mirrored body has a distance. ``side`` is the
    longest side of the rest shape's bounding box. Source: Kabsch 1976, as implemented by scipy.
    """
    side = np.ptp(rest, axis=0).max()
    # a single node has no shape
    if side == 0:
        return 0.0
    x, rest = (points - mass @ points / mass.sum() for points in (x, rest))
    # scaled, so that the squares of a diverged motion do not overflow
    size = max(np.abs(x).max(), side)
    with warnings.catch_warnings():
        # scipy warns if the best rotation is not unique, as for a flat body
        warnings.simplefilter("ignore", UserWarning)
        rotation, _ = Rotation.align_vectors(x / size, rest / size, weights=mass / mass.sum())
    # computed here, because scipy's own residual is accurate to 1e-8 only
    squared = ((x - rotation.apply(rest)) ** 2).sum(axis=1) / size**2
    return float(np.sqrt(mass @ squared / mass.sum()) * size / side)


def trajectory_error(result: Path, reference: Path) -> float:
    """Return the distance of a run from a reference run, relative to the reference's motion [-].

        sqrt( sum_times |x - x_ref|_M^2 / sum_times |x_ref - x_rest|_M^2 )

    The sums run over the times that both files have. x_ref stands for the limit of zero time step.
    Rigid motion of the reference counts as motion. Raises InputError if the files have different
    lattices or no common time, or if nothing moves.
    """
    with Result(result) as run, Result(reference) as true:
        if differ := different_lattices(run, true):
            raise InputError(differ)
        rest, mass = true["lattice/nodes"][:], true["lattice/mass"][:]
        off = moved = 0.0
        for of_run, of_reference in shared_frames(run, true):
            x, x_ref = run.frames.position[of_run], true.frames.position[of_reference]
            off += mass @ ((x - x_ref) ** 2).sum(axis=1)
            moved += mass @ ((x_ref - rest) ** 2).sum(axis=1)
    if moved == 0:
        raise InputError(f"{reference}: nothing moves in it at the times of {result}")
    return float(np.sqrt(off / moved))


def surface_error(result: Path, reference: Path) -> float:
    """Return the distance of a run's surface from a reference run's surface [-].

        sqrt( mean over times and area of |s - s_ref|^2 ) / greatest |s_ref - s_rest|

    The lattices may differ, the mesh may not. Raises InputError if the meshes differ, a file has no
    surface, the files have no common time, or nothing moves.
    """
    with Result(result) as run, Result(reference) as true:
        _, mean = compare_surfaces(run, true).fields
    if mean.scale == 0:
        raise InputError(f"{reference}: nothing moves in it")
    return float(np.sqrt(np.mean(mean.errors**2)))
