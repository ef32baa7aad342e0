"""What a study measured, as the charts and the report read it: the rows of table.csv, and the traces beside it."""

import csv
import json
import math
from collections.abc import Callable, Iterable
from pathlib import Path

from msmpetsc.errors import InputError
from msmpetsc.study import formatting
from msmpetsc.study.table import COLUMNS

Row = dict[str, str | float | None]  # column -> text, or a finite number, or None where nothing was measured

TEXT = tuple(name for name, column in COLUMNS.items() if column.kind is str)
NUMBERS = tuple(name for name in COLUMNS if name not in TEXT)


def read_rows(folder: Path) -> list[Row]:
    """Rows of table.csv, one a case. A column that is missing reads as empty. Raises InputError without a table."""
    path = folder / "table.csv"
    if not path.is_file():
        raise InputError(f"no table.csv in {folder}: it is no folder of a study")
    with path.open(newline="", encoding="utf-8") as stream:
        return [typed(record) for record in csv.DictReader(stream)]


def typed(record: dict[str, str]) -> Row:
    """A row with numbers for numbers; not a number, infinite and unreadable all mean: not measured."""
    row: Row = dict.fromkeys(TEXT, "") | dict.fromkeys(NUMBERS)
    for name, text in record.items():
        row[name] = number(text) if name in NUMBERS else (text or "").strip()
    return row


def number(text: str | None) -> float | None:
    """A finite number, or None."""
    try:
        value = float(text or "")
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def read_traces(folder: Path) -> list[dict]:
    """The traces {"scene", "label", "trace"} of traces.json that have a trace; none where there is no such file."""
    path = folder / "traces.json"
    entries = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else []
    return [entry for entry in entries if entry.get("trace")]


def succeeded(rows: Iterable[Row]) -> list[Row]:
    """Rows of cases that ran to their end."""
    return [row for row in rows if row["status"] == "ok"]


def failed(rows: Iterable[Row]) -> list[Row]:
    """All other rows."""
    return [row for row in rows if row["status"] != "ok"]


def swept(rows: Iterable[Row]) -> list[Row]:
    """Rows of sweeps: those of a map stand apart, for there it is no failure of the study that a run fails."""
    return [row for row in rows if not row.get("map")]


def mapped(rows: Iterable[Row]) -> dict[str, list[Row]]:
    """Rows by their map."""
    return grouped((row for row in rows if row.get("map")), lambda row: row["map"])


def measured(rows: Iterable[Row], *columns: str) -> list[Row]:
    """Rows with a positive number in each of these columns: what a logarithmic axis can show."""
    return [row for row in rows if all(isinstance(row[name], float) and row[name] > 0 for name in columns)]


def timed(rows: Iterable[Row]) -> list[Row]:
    """Rows of cases that ran to their end and have a time."""
    return measured(succeeded(rows), "time_frame")


def stepping(row: Row) -> str:
    """How a case steps, in words; an explicit run has substeps within its time step, the time between its frames."""
    if row["integrator"] == "verlet":
        return f"substeps of {formatting.seconds(row['substep'])}" if row["substep"] else "longest stable substeps"
    return f"time step {formatting.seconds(row['time_step'])}" if row["time_step"] else ""


def grouped(items: Iterable, key: Callable) -> dict[object, list]:
    """Items by key, both in their order of first appearance."""
    groups: dict = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return groups
