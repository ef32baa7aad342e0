"""The table of a study: a row for each case, stored as CSV and read as a pandas DataFrame.

The functions import pandas themselves, so that commands without a table need not wait for it.
"""

import math
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msmpetsc.errors import EXTRAS, InputError, missing_package
from msmpetsc.results.disk import write_whole

if TYPE_CHECKING:
    from pandas import DataFrame

# values of a case by column; None for a value that was not measured
Row = dict[str, Any]
# scripts/docs/pages/reference/study-table.md gives units and meanings
COLUMNS = (
    "study", "case", "scene", "map", "x", "y", "integrator", "preset", "options", "label",
    "ranks", "repeats", "time_step", "substep", "error", "max_iterations", "status", "reason",
    "outcome", "cells", "nodes", "unknowns", "springs", "frames", "steps", "time_frame",
    "time_frame_min", "time_frame_max", "fps", "time_second", "time_setup", "time_factor",
    "time_local", "time_ksp", "time_output", "iterations", "most_iterations", "ksp_its",
    "products", "substeps", "fallbacks", "inverted", "energy_gained", "self_contacts",
    "self_distance", "energy_left", "shape_error", "memory", "estimated_error",
    "true_error", "energy_error", "trajectory_error", "surface_error", "machine", "versions",
    "command",
)  # fmt: skip
TEXT = (
    "study", "case", "scene", "map", "x", "y", "integrator", "preset", "options", "label",
    "status", "reason", "outcome", "machine", "versions", "command",
)  # fmt: skip
NUMBERS = tuple(name for name in COLUMNS if name not in TEXT)


def require_extra() -> None:
    """Raise InputError if a package for studies is missing, before any run starts."""
    for name in EXTRAS["study"]:
        if find_spec(name) is None:
            raise missing_package(name)


def write_table(folder: Path, rows: Sequence[Row]) -> None:
    """Write table.csv: counts as integers, an empty entry for a value that was not measured."""
    table = as_table(rows).convert_dtypes(convert_string=False)
    write_whole(folder / "table.csv", table.to_csv(index=False, lineterminator="\r\n"))


def read_table(folder: Path) -> "DataFrame":
    """Return the rows of table.csv. Raises InputError if the file is missing or not readable."""
    import pandas

    path = folder / "table.csv"
    if not path.is_file():
        raise InputError(f"no table.csv in {folder}: it is no folder of a study")
    try:
        texts = pandas.read_csv(path, dtype=str, keep_default_na=False, index_col=False)
    except ValueError as error:
        # from pandas' parser, or for text that is not UTF-8
        raise InputError(
            f"{path} is not the table of a study: {str(error).splitlines()[0]}"
        ) from None
    return as_table(texts)


def as_table(rows: "Sequence[Row] | DataFrame") -> "DataFrame":
    """Return rows of values or texts as a DataFrame with all columns.

    A number that is missing, not finite or not readable is NaN; a missing text is "".
    """
    from pandas import DataFrame

    table = DataFrame(rows, columns=COLUMNS).astype(object)
    numbers = {name: table[name].map(_number).astype(float) for name in NUMBERS}
    return table.assign(**numbers).fillna(dict.fromkeys(TEXT, ""))


def records(table: "DataFrame") -> list[Row]:
    """Return the rows of a table as dictionaries, with None for NaN."""
    plain = table.astype(object)
    # mypy cannot know that the columns' names are strings
    return plain.where(plain.notna(), None).to_dict("records")  # type: ignore[return-value]


def _number(value: Any) -> float:
    """Return a value, or a text as Python reads it, as a finite number; otherwise NaN."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        return math.nan
    return number if math.isfinite(number) else math.nan


def succeeded(table: "DataFrame") -> "DataFrame":
    """Return the rows of cases that succeeded."""
    return table[table["status"] == "ok"]


def failed(table: "DataFrame") -> "DataFrame":
    """Return the rows of cases that failed."""
    return table[table["status"] != "ok"]


def swept(table: "DataFrame") -> "DataFrame":
    """Return the rows of sweeps, without maps, in which a failure is a result."""
    return table[table["map"] == ""]


def mapped(table: "DataFrame") -> dict[str, "DataFrame"]:
    """Return the rows of each map by its name."""
    return grouped(table[table["map"] != ""], "map")


def measured(table: "DataFrame", *columns: str) -> "DataFrame":
    """Return the rows with a positive number in each of these columns."""
    return table[(table[list(columns)] > 0).all(axis=1)]


def grouped(table: "DataFrame", *columns: str) -> dict[Any, "DataFrame"]:
    """Return the rows grouped by the values of columns, in order of first appearance."""
    by: Any = columns[0] if len(columns) == 1 else list(columns)
    return dict(iter(table.groupby(by, sort=False, dropna=False)))


# ---- the spread of a case's repeats, unknown after a single run


def spread(table: "DataFrame", cost: str) -> "DataFrame":
    """Return columns "least" and "greatest" of a cost over the repeats; NaN if not repeated.

    cost : a column proportional to the time of a step, or "fps", its inverse
    """
    ends = (table["time_frame_min"], table["time_frame_max"])
    if cost == "fps":
        greatest, least = (table[cost] * table["time_frame"] / end for end in ends)
    else:
        least, greatest = (table[cost] / table["time_frame"] * end for end in ends)
    known = least.notna() & greatest.notna()
    return table.assign(least=least.where(known), greatest=greatest.where(known))[
        ["least", "greatest"]
    ]
