"""The table of a study: one row for each case, written as CSV and read as a pandas DataFrame.

pandas is imported where it is used: the commands that need no table do not wait for it.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msmpetsc.errors import EXTRAS, InputError, missing_package
from msmpetsc.results.disk import write_whole

if TYPE_CHECKING:
    from pandas import DataFrame

Row = dict[str, Any]  # one case, by column; None where nothing was measured
# units and meanings stand in scenes/studies/README.md
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
    """Write table.csv, with columns of counts as integers and empty entries for what was not measured."""
    table = (
        as_table(rows).replace([math.inf, -math.inf], math.nan).convert_dtypes(convert_string=False)
    )
    write_whole(folder / "table.csv", table.to_csv(index=False, lineterminator="\r\n"))


def read_table(folder: Path) -> "DataFrame":
    """Return the rows of table.csv. Raises InputError without such a table."""
    import pandas

    path = folder / "table.csv"
    if not path.is_file():
        raise InputError(f"no table.csv in {folder}: it is no folder of a study")
    try:
        texts = pandas.read_csv(path, dtype=str, keep_default_na=False, index_col=False).fillna("")
    except ValueError as error:  # of pandas' parser, of text that is not UTF-8
        raise InputError(
            f"{path} is not the table of a study: {str(error).splitlines()[0]}"
        ) from None
    return typed(texts.to_dict("records"))  # type: ignore[arg-type]  # columns are called by text


def as_table(rows: Sequence[Row]) -> "DataFrame":
    """Return rows as a table with all columns; a number that is missing is NaN, a text empty."""
    from pandas import DataFrame

    table = DataFrame(rows, columns=COLUMNS).astype(dict.fromkeys(NUMBERS, float))
    return table.astype(dict.fromkeys(TEXT, object)).fillna(dict.fromkeys(TEXT, ""))


def typed(texts: Iterable[Mapping[str, str]]) -> "DataFrame":
    """Return rows of text as a table; a number that is missing, infinite or unreadable is NaN."""
    return as_table(
        [{**row, **{name: _number(row.get(name, "")) for name in NUMBERS}} for row in texts]
    )


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


def succeeded(table: "DataFrame") -> "DataFrame":
    return table[table["status"] == "ok"]


def failed(table: "DataFrame") -> "DataFrame":
    return table[table["status"] != "ok"]


def swept(table: "DataFrame") -> "DataFrame":
    """Return the rows of sweeps, without those of maps, where a failed run is an answer."""
    return table[table["map"] == ""]


def mapped(table: "DataFrame") -> dict[str, "DataFrame"]:
    return grouped(table[table["map"] != ""], "map")


def measured(table: "DataFrame", *columns: str) -> "DataFrame":
    """Return the rows with a positive number in each of these columns."""
    return table[(table[list(columns)] > 0).all(axis=1)]


def timed(table: "DataFrame") -> "DataFrame":
    return measured(succeeded(table), "time_frame")


def grouped(table: "DataFrame", *columns: str) -> dict[Any, "DataFrame"]:
    """Return the rows grouped by the values of columns, in order of first appearance."""
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
    return table.assign(least=least.where(known), greatest=greatest.where(known))[
        ["least", "greatest"]
    ]


def is_repeated(table: "DataFrame") -> bool:
    return bool(table["time_frame_min"].notna().all())
