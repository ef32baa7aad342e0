"""The table of a study: a row a case, written as CSV and HDF5, read as a pandas DataFrame, and its rows chosen.

pandas is imported where it is used: the commands that need no table do not wait for it.
"""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import h5py
import numpy as np

from msmpetsc.errors import EXTRAS, InputError, missing_package
from msmpetsc.fields import FRAME_FIELDS
from msmpetsc.results.disk import write_whole

if TYPE_CHECKING:
    from pandas import DataFrame

Row = dict[str, Any]  # one case, by column; None where nothing was measured


class Column(NamedTuple):
    """A column of the table; kind: str, int or float, of which only a float can be missing."""

    kind: type
    unit: str
    about: str


def _of_frames(name: str, more: str = "") -> Column:
    field = FRAME_FIELDS[name]
    return Column(float, field.unit, field.long_name + more)


COLUMNS = {
    "study": Column(str, "", "name of the study"),
    "case": Column(str, "", "what defines the case, as a number"),
    "scene": Column(str, "", "the scene's name in the study"),
    "map": Column(str, "", "the map that it is a point of"),
    "x": Column(str, "", "place on the map's horizontal axis"),
    "y": Column(str, "", "place on the map's vertical axis, or the name of its case"),
    "integrator": Column(str, "", "implicit-euler, bdf2, verlet or static"),
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
    "products": Column(float, "1", "products with the Hessian, mean of a step"),
    "substeps": _of_frames("substeps"),
    "fallbacks": _of_frames("fallbacks"),
    "inverted": _of_frames("inverted", " in the last frame"),
    "energy_gained": _of_frames("energy_gained"),
    "self_contacts": _of_frames("self_contacts", ", the most of a frame"),
    "self_distance": _of_frames("self_distance", ", the least of all frames"),
    "energy_left": Column(float, "1", "total energy at the end over that at the start, where no load acts"),
    "shape_error": Column(float, "1", "distance of the last frame from the rest shape, moved as a rigid body"),
    "explicit_limit": Column(float, "s", "longest stable explicit step of the lattice at rest"),
    "memory": Column(float, "byte", "peak of resident memory, sum of the ranks"),
    "estimated_error": Column(float, "1", "step error as estimated, rms"),
    "true_error": Column(float, "1", "step error, rms of the steps measured"),
    "energy_error": Column(float, "1", "the same in energy"),
    "trajectory_error": Column(float, "1", "distance from the reference run"),
    "surface_error": Column(float, "1", "distance of the surface from that of a reference run of other cells"),
    "machine": Column(str, "", "where it ran"),
    "versions": Column(str, "", "of the programs"),
    "command": Column(str, "", "the line that repeats the case"),
}
TEXT = tuple(name for name, column in COLUMNS.items() if column.kind is str)
NUMBERS = tuple(name for name in COLUMNS if name not in TEXT)
ONCE_NOTE = (
    "Each was run once: how much its time varies is not known, so that close times decide nothing; "
    "repeats = 3 would tell."
)


def require_extra() -> None:
    """Raise InputError where a package of a study is missing: before hours of runs."""
    for name in EXTRAS["study"]:
        if find_spec(name) is None:
            raise missing_package(name)


def write_table(folder: Path, rows: Sequence[Row]) -> None:
    """Write table.csv and table.h5, each replaced whole."""
    table = as_table(rows)
    write_whole(folder / "table.csv", table.map(_text).to_csv(index=False, lineterminator="\r\n"))
    with h5py.File("table.h5", "w", driver="core", backing_store=False) as file:  # on a full disk HDF5 may crash
        _fill(file, table)
        file.flush()
        content = file.id.get_file_image()
    write_whole(folder / "table.h5", content)


def read_table(folder: Path) -> "DataFrame":
    """Return the rows of table.csv, see ``typed``. Raises InputError without such a table."""
    import pandas

    path = folder / "table.csv"
    if not path.is_file():
        raise InputError(f"no table.csv in {folder}: it is no folder of a study")
    try:
        texts = pandas.read_csv(path, dtype=str, keep_default_na=False, index_col=False).fillna("")
    except ValueError as error:  # of pandas' parser, of text that is not UTF-8
        raise InputError(f"{path} is not the table of a study: {str(error).splitlines()[0]}") from None
    return typed(texts.to_dict("records"))  # type: ignore[arg-type]  # columns are called by text


def read_traces(folder: Path) -> dict[str, dict]:
    """Return the traces of traces.json by case; none without the file. Raises InputError."""
    path = folder / "traces.json"
    try:
        traces = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
        return dict(traces.items())
    except (ValueError, AttributeError):
        raise InputError(f"{path} is not what a study left: --restart begins anew") from None


def as_table(rows: Sequence[Row]) -> "DataFrame":
    """Return rows as a table with all columns; a number that is missing is NaN, a text empty."""
    from pandas import DataFrame

    table = DataFrame(rows, columns=list(COLUMNS)).astype(dict.fromkeys(NUMBERS, float))
    return table.astype(dict.fromkeys(TEXT, object)).fillna(dict.fromkeys(TEXT, ""))


def typed(texts: Iterable[Mapping[str, str]]) -> "DataFrame":
    """Return rows of text as a table; a number that is missing, infinite or unreadable was not measured: NaN."""
    return as_table([{**row, **{name: _number(row.get(name, "")) for name in NUMBERS}} for row in texts])


def records(table: "DataFrame") -> list[Row]:
    """Return the rows of a table one by one, None for what is missing."""
    plain = table.astype(object)
    return plain.where(plain.notna(), None).to_dict("records")  # type: ignore[return-value]  # columns are called by text


def _number(text: str) -> float:
    """Return a finite number exactly as Python reads it, or NaN."""
    try:
        value = float(text)
    except ValueError:
        return math.nan
    return value if math.isfinite(value) else math.nan


def _text(value: Any) -> str:
    """Return a value as the table has it: a count as a whole number, a text in one line, NaN as nothing."""
    if isinstance(value, float):
        if math.isnan(value):
            return ""
        return str(int(value)) if value.is_integer() and abs(value) < 1e15 else repr(float(value))
    return " ".join(str(value).split())


def _fill(file: h5py.File, table: "DataFrame") -> None:
    """Write one dataset a column along one dimension, so that xarray finds them; what is missing is NaN."""
    file["row"] = np.arange(len(table))
    file["row"].make_scale("row")
    kinds = {str: h5py.string_dtype(), int: "i8", float: "f8"}
    for name, column in COLUMNS.items():
        file.create_dataset(name, data=table[name].to_numpy(), dtype=kinds[column.kind], shape=(len(table),))
        file[name].dims[0].attach_scale(file["row"])
        file[name].attrs.update({"units": column.unit, "long_name": column.about})


def succeeded(table: "DataFrame") -> "DataFrame":
    return table[table["status"] == "ok"]


def failed(table: "DataFrame") -> "DataFrame":
    return table[table["status"] != "ok"]


def swept(table: "DataFrame") -> "DataFrame":
    """Return the rows of sweeps; those of maps stand apart: a run that fails there is an answer."""
    return table[table["map"] == ""]


def mapped(table: "DataFrame") -> dict[str, "DataFrame"]:
    return grouped(table[table["map"] != ""], "map")


def measured(table: "DataFrame", *columns: str) -> "DataFrame":
    """Return the rows with a positive number in each of these columns: what a logarithmic axis can show."""
    return table[(table[list(columns)] > 0).all(axis=1)]


def timed(table: "DataFrame") -> "DataFrame":
    return measured(succeeded(table), "time_frame")


def grouped(table: "DataFrame", *columns: str) -> dict[Any, "DataFrame"]:
    """Return a table's parts by the values of columns, values and rows in their order."""
    by: Any = columns[0] if len(columns) == 1 else list(columns)
    return dict(iter(table.groupby(by, sort=False, dropna=False)))


# The spread of the repeats of a case; from one run alone nothing is known of it


def spread(table: "DataFrame", cost: str) -> "DataFrame":
    """Return the least and the greatest of the repeats of a cost, as columns; NaN where they are not known.

    cost : a column in proportion to the time of a step, or "fps", in inverse proportion
    """
    ends = (table["time_frame_min"], table["time_frame_max"])
    if cost == "fps":
        greatest, least = (table[cost] * table["time_frame"] / end for end in ends)
    else:
        least, greatest = (table[cost] / table["time_frame"] * end for end in ends)
    known = least.notna() & greatest.notna()
    return table.assign(least=least.where(known), greatest=greatest.where(known))[["least", "greatest"]]


def reach(table: "DataFrame", cost: str) -> "DataFrame":
    """Return the spread; where it is not known, twice the cost itself."""
    return spread(table, cost).apply(lambda column: column.fillna(table[cost]))


def is_repeated(table: "DataFrame") -> bool:
    return bool(table["time_frame_min"].notna().all())
