"""What a run says of itself, in its result file and its measure file, as the figures of a table's row."""

import json
from collections.abc import Sequence
from pathlib import Path
from statistics import median

import numpy as np

from msmpetsc.output.reader import Result
from msmpetsc.study.shape import shape_error
from msmpetsc.study.table import Row

COUNTS = ("cells", "nodes", "unknowns", "springs")
PARTS = ("setup", "factor", "local", "ksp", "output")


def measured(path: Path) -> Row:
    """Figures of the measure file that ``msmpetsc run --measure`` leaves."""
    told = json.loads(path.read_text())
    row = {name: told.get(name) for name in (*COUNTS, "memory", "explicit_limit")}
    row |= {f"time_{part}": told.get("time", {}).get(part) for part in PARTS}
    return row | {"machine": _machine(told.get("machine", {})), "versions": _versions(told.get("versions", {}))}


def failure(path: Path) -> str:
    """What kind of failure the measure file tells of; "" for none, or where there is no such file."""
    try:
        told = json.loads(path.read_text()).get("failure")
    except (OSError, ValueError):
        return ""
    return told["kind"] if told else ""


def trace(path: Path) -> dict | None:
    return json.loads(path.read_text()).get("trace") if path.is_file() else None


def of_frames(result: Path, time_step: float) -> Row:
    """Figures of the result file: times and iterations are means a step, the first frame left out."""
    with Result(result) as run:
        count = len(run.frames.time)
        series = {name: array[:] for name, array in run.frames.items() if array.ndim == 1}
        shape = {"shape_error": shape_error(run, count - 1)} if count else {}
    if count < 2:
        return {"frames": count, "steps": 0} | shape
    steps = np.rint(np.diff(series["time"]) / time_step).astype(int)  # between frames
    kept = slice(2 if count > 2 else 1, None)  # what is only done once shows in the first
    mean = {
        name: series[name][kept].sum() / steps[kept.start - 1 :].sum()
        for name in ("wall_time", "iterations", "ksp_its")
    }
    row = {"frames": count, "steps": int(steps.sum()), "time_frame": float(mean["wall_time"])}
    row |= {"iterations": float(mean["iterations"]), "ksp_its": float(mean["ksp_its"])}
    row["most_iterations"] = float((series["iterations"][1:] / steps.clip(1)).max())
    return row | shape | _errors(series) | _soundness(series) | {"energy_left": _energy_left(series)}


def _soundness(series: dict[str, np.ndarray]) -> Row:
    """What went wrong on the way, as far as the file tells; cells inverted count in the last frame alone."""
    row = {name: float(series[name][1:].sum()) for name in ("substeps", "fallbacks") if name in series}
    if "energy_gained" in series:
        row["energy_gained"] = float(np.nansum(series["energy_gained"][1:]))
    if "inverted" in series:
        row["inverted"] = float(series["inverted"][-1])
    return row


def _energy_left(series: dict[str, np.ndarray]) -> float | None:
    """Of a body on which no load acts: energy at the end over that at the start; None for others."""
    energy = series["kinetic"] + series["elastic"] + series["contact"]
    return float(energy[-1] / energy[0]) if energy[0] > 0 and not series["potential"].any() else None


def _errors(series: dict[str, np.ndarray]) -> Row:
    """Root mean squares over the steps whose true error was measured, or over all."""
    estimated = series["step_error"][1:]
    nothing = np.full(len(estimated), np.nan)
    true = series["true_error"][1:] if "true_error" in series else nothing
    energy = series["energy_error"][1:] if "energy_error" in series else nothing
    where = np.isfinite(true) if np.isfinite(true).any() else ~np.isnan(estimated)
    return {  # of a step with no minimum near the estimate is infinite: then there is none of the run
        "estimated_error": None if np.isinf(estimated[where]).any() else _rms(estimated[where]),
        "true_error": _rms(true[where]),
        "energy_error": _rms(energy[where]),
    }


def _rms(values: np.ndarray) -> float | None:
    values = values[np.isfinite(values)]
    return float(np.sqrt((values**2).mean())) if len(values) else None


def together(runs: Sequence[Row]) -> Row:
    """One row of the repeats' figures: medians of times, and the range of a step's; what was measured once, from the
    run that measured it.

    Memory is that of the leanest: the first run may have measured errors beside its work.
    """
    row = dict(runs[0])
    for name in row:
        given = [run[name] for run in runs if run.get(name) is not None]
        if name.startswith("time_") and given:
            row[name] = median(given)
        elif name == "memory" and given:
            row[name] = min(given)
    times = [run["time_frame"] for run in runs if run.get("time_frame") is not None]
    return row | ({"time_frame_min": min(times), "time_frame_max": max(times)} if len(times) > 1 else {})


def rates(row: Row, time_step: float) -> Row:
    """Frames a second, and computing seconds a simulated second."""
    time = row.get("time_frame")
    return {"fps": 1 / time, "time_second": time / time_step} if time else {}


def _machine(told: dict) -> str:
    parts = [told.get("cpu"), told.get("cores") and f"{told['cores']} cores"]
    parts += [told.get("memory") and f"{told['memory'] / 2**30:.0f} GiB", told.get("system")]
    return ", ".join(str(part) for part in parts if part)


def _versions(told: dict) -> str:
    return ", ".join(f"{name} {version}" for name, version in told.items())
