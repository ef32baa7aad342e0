"""The table of a study: one row a case, as CSV and as HDF5, each replaced whole when a case is done."""

import csv
import math
import os
from collections.abc import Iterable, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np

from msmpetsc.errors import InputError
from msmpetsc.model.fields import FRAME_FIELDS

Row = dict[str, Any]


class Column(NamedTuple):
    """kind: str, int or float; only a float can be missing."""

    kind: type
    unit: str
    about: str


def _of_frames(name: str, more: str = "") -> Column:
    """Return the column of a number that every frame has, with its unit and meaning."""
    field = FRAME_FIELDS[name]
    return Column(float, field.unit, field.long_name + more)


COLUMNS = {
    "study": Column(str, "", "name of the study"),
    "case": Column(str, "", "what defines the case, as a number"),
    "scene": Column(str, "", "the scene's name in the study"),
    "map": Column(str, "", "the map that it is a place of"),
    "x": Column(str, "", "place on the map's horizontal axis"),
    "y": Column(str, "", "place on the map's vertical axis, or the name of its case"),
    "integrator": Column(str, "", "implicit-euler, bdf2 or verlet"),
    "preset": Column(str, "", "solver preset"),
    "options": Column(str, "", "PETSc options"),
    "label": Column(str, "", "what its curve is called"),
    "ranks": Column(int, "1", "MPI ranks"),
    "repeats": Column(int, "1", "runs, of which medians are taken"),
    "time_step": Column(float, "s", "time step; of verlet, the time between frames"),
    "substep": Column(float, "s", "verlet: longest substep asked for"),
    "error": Column(float, "1", "relative error of a step aimed at"),
    "max_iterations": Column(float, "1", "outer iterations allowed in a step"),
    "status": Column(str, "", "ok, failed or timeout"),
    "reason": Column(str, "", "why it has no figures"),
    "outcome": Column(str, "", "of a place of a map: how it went, in a word"),
    "cells": Column(float, "1", "valid cells"),
    "nodes": Column(float, "1", "nodes"),
    "unknowns": Column(float, "1", "nodes that are not held"),
    "springs": Column(float, "1", "springs"),
    "frames": Column(float, "1", "frames stored"),
    "steps": Column(float, "1", "steps done"),
    "time_frame": Column(float, "s", "mean time of a step, the first left out, median of the repeats"),
    "time_frame_min": Column(float, "s", "the least of the repeats; none of a single run"),
    "time_frame_max": Column(float, "s", "the greatest of the repeats; none of a single run"),
    "fps": Column(float, "1/s", "steps a second: 1 / time_frame"),
    "time_second": Column(float, "1", "computing seconds a simulated second"),
    "time_setup": Column(float, "s", "whole run: mesh, cages, lattice"),
    "time_factor": Column(float, "s", "whole run: preconditioner"),
    "time_local": Column(float, "s", "whole run: residuals and energies"),
    "time_ksp": Column(float, "s", "whole run: linear solves"),
    "time_output": Column(float, "s", "whole run: files"),
    "iterations": Column(float, "1", "outer iterations, mean of a step"),
    "most_iterations": Column(float, "1", "outer iterations, the most of a step"),
    "ksp_its": Column(float, "1", "KSP iterations, mean of a step"),
    "substeps": _of_frames("substeps"),
    "fallbacks": _of_frames("fallbacks"),
    "inverted": _of_frames("inverted", " in the last frame"),
    "energy_gained": _of_frames("energy_gained"),
    "energy_left": Column(float, "1", "total energy at the end over that at the start, where no load acts"),
    "shape_error": Column(float, "1", "distance of the last frame from the rest shape, moved as a rigid body"),
    "explicit_limit": Column(float, "s", "longest stable explicit step of the lattice at rest"),
    "memory": Column(float, "byte", "peak of resident memory, sum of the ranks"),
    "estimated_error": Column(float, "1", "step error as estimated, rms"),
    "true_error": Column(float, "1", "step error, rms of the steps measured"),
    "energy_error": Column(float, "1", "the same in energy"),
    "trajectory_error": Column(float, "1", "distance from the reference run"),
    "machine": Column(str, "", "where it ran"),
    "versions": Column(str, "", "of the programs"),
    "command": Column(str, "", "the line that repeats the case"),
}


def write_table(folder: Path, rows: Sequence[Row]) -> None:
    """Write table.csv and table.h5."""
    with _replaced(folder / "table.csv") as part, open(part, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows({name: _text(row.get(name)) for name in COLUMNS} for row in rows)
    with _replaced(folder / "table.h5") as part, h5py.File(part, "w") as file:
        _fill(file, rows)


def read_table(folder: Path) -> list[Row]:
    """The rows of table.csv; none where there is no table. Raises InputError for one that is no such table."""
    path = folder / "table.csv"
    if not path.is_file():
        return []
    try:
        with open(path, newline="", encoding="utf-8") as file:
            return [{name: _value(name, row.get(name) or "") for name in COLUMNS} for row in csv.DictReader(file)]
    except (KeyError, ValueError, TypeError, csv.Error):
        raise InputError(f"{path} is not the table of a study of this version: --restart begins anew") from None


def _fill(file: h5py.File, rows: Sequence[Row]) -> None:
    """One dataset a column along one dimension, so that xarray finds them; a figure that is missing is NaN."""
    file["row"] = np.arange(len(rows))
    file["row"].make_scale("row")
    for name, column in COLUMNS.items():
        values = [row.get(name) for row in rows]
        if column.kind is str:
            file.create_dataset(
                name, data=[value or "" for value in values], dtype=h5py.string_dtype(), shape=(len(rows),)
            )
        elif column.kind is int:
            file[name] = np.array(values, dtype="i8")
        else:
            file[name] = np.array([math.nan if value is None else value for value in values], dtype="f8")
        file[name].dims[0].attach_scale(file["row"])
        file[name].attrs.update({"units": column.unit, "long_name": column.about})


def _text(value: Any) -> str:
    """The same for a value as it came and as it was read again: a count comes back as a float."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    if isinstance(value, float):
        return str(int(value)) if value.is_integer() and abs(value) < 1e15 else repr(float(value))
    return " ".join(str(value).split())


def _value(name: str, text: str) -> Any:
    kind = COLUMNS[name].kind
    return None if kind is float and text == "" else kind(text)


@contextmanager
def _replaced(path: Path) -> Iterable[Path]:
    """A name to write under; what stands there afterwards takes the place of ``path`` at once."""
    part = path.with_name(path.name + ".part")
    try:
        yield part
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)
