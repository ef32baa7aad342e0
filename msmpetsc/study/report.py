"""The report of a study, from its table alone: one page with charts, numbers and the commands that repeat them.

What stands where is in report.html.j2; this file says what it is.
"""

import json
import re
import tomllib
from collections.abc import Callable, Iterable
from datetime import datetime
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import matplotlib.style
from jinja2 import Environment, PackageLoader
from markupsafe import Markup, escape

from msmpetsc.output.disk import write_whole
from msmpetsc.study import formatting
from msmpetsc.study.charts.cells import figure6_charts, growth_charts
from msmpetsc.study.charts.convergence import convergence_charts
from msmpetsc.study.charts.order import order_charts
from msmpetsc.study.charts.pareto import LEVELS, MEASURES, TRAJECTORY, cost_of, pareto_charts
from msmpetsc.study.charts.sizes import size_charts
from msmpetsc.study.charts.stability import stability_charts
from msmpetsc.study.charts.style import RC, Chart, Point, curve_styles, save_png, svg_text
from msmpetsc.study.metrics import counted
from msmpetsc.study.table import (
    COLUMNS,
    NUMBERS,
    ONCE_NOTE,
    TEXT,
    Row,
    failed,
    is_repeated,
    mapped,
    read_table,
    records,
    swept,
    timed,
)

if TYPE_CHECKING:
    from pandas import DataFrame

PRINTED = {
    "label", "scene", "x", "y", "outcome", "status", "reason", "time_step", "error", "cells", "ranks", "time_frame",
    "time_frame_min", "time_frame_max", "time_second",
    "ksp_its", "products", "memory", "true_error", "trajectory_error", "surface_error",
}  # fmt: skip
NOT_PRINTED = {*COLUMNS} - PRINTED
FIRST, LAST = ("label", "status"), "command"  # columns of the whole table even where all cases agree in them
OVERVIEW_NOTE = (
    "The cheapest measured method{}; for the step error with its time a frame, for the trajectory error with its time "
    "a simulated second and its time step."
)
HYPHENATED = re.compile(r"(?<!\S)(\S{0,40}-\S{1,40})(?!\S)")


class Cell(NamedTuple):
    """An entry of a table of the page, and what it is sorted by."""

    text: str
    key: str


class HtmlTable(NamedTuple):
    """A table of the page: its headings, and its lines of cells."""

    head: list[str]
    lines: list[list[Cell]]


def write_report(folder: Path) -> Path:
    """Draw everything that table.csv and traces.json in a folder hold: PNG files and report.html beside them.

    Returns the path of report.html. Raises InputError where there is no table.
    """
    table, traces, study = read_table(folder), read_traces(folder), study_file(folder)
    charts = draw_charts(table, traces, study)
    for chart in charts:
        save_png(chart, folder)
    names = [name for name in table["study"] if name]
    title = str(study.get("title") or next(iter(names), "") or folder.resolve().name)
    path = folder / "report.html"
    write_whole(path, page(title, measured_on(folder), table, charts))
    return path


def draw_charts(table: "DataFrame", traces: list[dict], study: dict) -> list[Chart]:
    """Return all charts that there are numbers for; a method looks the same in each.

    study : the tables of the study file
    """
    styles = curve_styles([*table["label"], *(entry["label"] for entry in traces)])
    with matplotlib.style.context(["default", RC]):
        charts = stability_charts(table, study)
        sweeps = swept(table)
        for draw in (size_charts, pareto_charts, figure6_charts, growth_charts):
            charts += draw(sweeps, styles)
        charts += order_charts(sweeps, styles, study)
        commands = dict(zip(sweeps["case"], sweeps["command"], strict=True))
        commands.pop("", None)
        return charts + convergence_charts(traces, styles, commands)


def read_traces(folder: Path) -> list[dict]:
    """Return the entries of traces.json that have a trace; none where there is no such file."""
    path = folder / "traces.json"
    entries = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else []
    return [entry for entry in entries if entry.get("trace")]


def study_file(folder: Path) -> dict:
    """Return the tables of study.toml; none where there is no such file."""
    file = folder / "study.toml"
    return tomllib.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}


def measured_on(folder: Path) -> str:
    """Return when the table was last written, UTC offset included."""
    return datetime.fromtimestamp((folder / "table.csv").stat().st_mtime).astimezone().strftime("%d %B %Y, %H:%M %z")


# The page


def page(title: str, date: str, table: "DataFrame", charts: list[Chart]) -> str:
    """Return the whole page; it needs nothing beside itself."""
    environment = Environment(autoescape=True, loader=PackageLoader("msmpetsc.study", "."), keep_trailing_newline=True)
    filters: dict[str, Callable] = {
        "anchor": anchor, "svg": lambda chart: Markup(svg_text(chart)), "unbroken": unbroken, "by_reason": by_reason,
        "points_table": points_table,
    }  # fmt: skip
    environment.filters.update(filters)
    folder = files("msmpetsc.study")
    css, script = (Markup((folder / f"report.{kind}").read_text(encoding="utf-8")) for kind in ("css", "js"))
    content = facts(table) | whole_table(table) | {"failures": failures(table), "charts": charts}
    content |= {"overview": overview(charts), "overview_note": overview_note(charts)}
    layout = {"css": css, "script": script, "not_printed": NOT_PRINTED}
    return environment.get_template("report.html.j2").render(title=title, date=date, **content, **layout)


def facts(table: "DataFrame") -> dict[str, Any]:
    """Return machine, versions and how many cases there are."""
    plain = swept(table)
    maps = {name: f"{len(group)}: {counted(group['outcome'])}" for name, group in mapped(table).items()}
    platforms = {
        name.capitalize(): list(dict.fromkeys(readable(text) for text in table[name] if text))
        for name in ("machine", "versions")
    }
    counts = {"cases": len(plain), "failed": len(failed(plain)), "empty": table.empty}
    return counts | {"maps": maps, "platforms": platforms, "repeats": repeats_note(timed(plain))}


def repeats_note(rows: "DataFrame") -> str:
    """Say how often cases were run, and what follows for their times; empty without cases."""
    counts = " or ".join(map(str, sorted(set(rows["repeats"].fillna(1).astype(int)))))
    if rows.empty or not is_repeated(rows):
        return counts and f"{counts}. {ONCE_NOTE}"
    return f"{counts}: times are medians, ranges and whiskers from the least to the greatest"


def readable(text: str) -> str:
    """Return a JSON object as words: {"cores": 2} -> cores 2."""
    try:
        value = json.loads(text)
    except json.JSONDecodeError:
        return text
    if not isinstance(value, dict):
        return text
    return ", ".join(f"{name} {formatting.size(entry) if name == 'memory' else entry}" for name, entry in value.items())


def overview(charts: list[Chart]) -> HtmlTable | None:
    """Return who wins at each level of error, scene by scene, where there are several."""
    charts = [chart for chart in charts if chart.cheapest]
    if len(charts) < 2:
        return None
    lines = [
        [chart.title.partition(": ")[2], name, *(winner(name, rows) for rows in best)]
        for chart in charts
        for name, best in chart.cheapest.items()
    ]
    return HtmlTable(["", "error", *(f"{formatting.error(level)} or less" for level in LEVELS)], cells_of(lines))


def overview_note(charts: list[Chart]) -> str:
    """Say what the overview shows."""
    rows = [row for chart in charts for levels in chart.cheapest.values() for best in levels for row in best]
    if all(row["time_frame_min"] is not None for row in rows):
        return OVERVIEW_NOTE.format(", then those whose repeats overlap with its own")
    return f"{OVERVIEW_NOTE.format('')} {ONCE_NOTE}"


def winner(name: str, best: list[Row]) -> str:
    """Return the label of the cheapest and what it costs; then those within its noise."""
    if not best:
        return "none"
    row, *near = best
    step = f", {formatting.stepping(row)}" if name == TRAJECTORY.name else ""
    rivals = f"; or {', '.join(rival['label'] for rival in near)}" if near else ""
    return f"{row['label']}: {cost_of(row, MEASURES[name])}{step}{rivals}"


def failures(table: "DataFrame") -> HtmlTable:
    """Return all failed cases with their commands; those of maps are answers, and stand there."""
    lost = records(failed(swept(table)))
    lines = [[row["scene"], name_of(row), row["status"], reason_of(row), row["command"]] for row in lost]
    return HtmlTable(["scene", "what", "status", "reason", "command"], cells_of(lines))


def whole_table(table: "DataFrame") -> dict[str, Any]:
    """Return the whole table, and what all its cases share, which stands above it."""
    unknown = [str(name) for name in table if name not in COLUMNS]
    order = [name for name in (*TEXT, *NUMBERS, *unknown) if name not in (*FIRST, LAST)]
    filled = [name for name in order if (table[name].notna() & (table[name] != "")).any()]
    agreed = [name for name in filled if len(table) > 1 and table[name].nunique(dropna=False) == 1]
    differing = sorted(
        set(filled) - set(agreed), key=lambda name: (name in TEXT and name != "scene", order.index(name))
    )
    shown = [*FIRST, *differing, LAST]
    rows = records(table)
    lines = [[Cell(formatting.plain(row[name]), sort_key(row[name])) for name in shown] for row in rows]
    shared = {name: readable(formatting.plain(rows[0][name])) for name in agreed}
    return {"table": HtmlTable(shown, lines), "shared": shared}


# Its parts, as the template asks for them


def anchor(chart: Chart) -> str:
    """Return the id of a chart's element."""
    return "chart-" + "".join(letter if letter.isalnum() else "-" for letter in chart.name)


def unbroken(line: str) -> Markup:
    """Return a line in which words such as -pc_type, fast-msm and 1e-3 are not torn at their hyphen."""
    return Markup(HYPHENATED.sub(r"<span class='whole'>\1</span>", str(escape(line))))


def by_reason(rows: Iterable[Row]) -> list[str]:
    """Return a line for each reason of failure, with its cases."""
    reasons: dict[str, list[str]] = {}
    for row in rows:
        reasons.setdefault(reason_of(row), []).append(name_of(row))
    return [f"{reason}: {'; '.join(names)}" for reason, names in reasons.items()]


def name_of(row: Row) -> str:
    """Return a failed case in words."""
    names = [name for name in formatting.SETTINGS if name != "ranks" or (row["ranks"] or 1) > 1]
    settings = [formatting.stepping(row), *(formatting.setting(row, name) for name in names)]
    return ", ".join(filter(None, [row["label"] or row["case"], *settings]))


def reason_of(row: Row) -> str:
    """Return why a case failed, as far as is known."""
    return str(row["reason"] or row["status"] or "no reason given")


def points_table(groups: dict[str, list[Point]]) -> HtmlTable:
    """Return the points of a panel; columns that are empty in all are left out."""
    points = [point for group in groups.values() for point in group]
    texts = [point.texts() for point in points]
    names = [name for name in points[0].numbers if any(text[name] for text in texts)]
    last = ["command"] if any(point.command for point in points) else []
    lines = [
        [
            Cell(point.label, point.label),
            *(Cell(text[name], sort_key(point.numbers[name][1])) for name in names),
            *(Cell(point.command, point.command) for _ in last),
        ]
        for point, text in zip(points, texts, strict=True)
    ]
    return HtmlTable(["curve", *names, *last], lines)


def cells_of(lines: Iterable[Iterable[Any]]) -> list[list[Cell]]:
    """Return lines of cells that are sorted by what they show."""
    return [[Cell(str(text), str(text)) for text in line] for line in lines]


def sort_key(value: float | str | None) -> str:
    """Return what a value is sorted by."""
    return "" if value is None else str(value)
