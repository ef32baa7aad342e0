"""The report of a study, from its table alone: one page with charts, numbers and the commands that repeat them."""

import json
import re
import tomllib
from collections.abc import Iterable
from datetime import datetime
from html import escape
from importlib.resources import files
from itertools import chain
from pathlib import Path

from matplotlib import style

from msmpetsc.study import formatting
from msmpetsc.study.charts.chart import Chart, Point
from msmpetsc.study.charts.convergence import convergence_charts
from msmpetsc.study.charts.figure6 import figure6_charts
from msmpetsc.study.charts.growth import growth_charts
from msmpetsc.study.charts.order import order_charts
from msmpetsc.study.charts.pareto import LEVELS, MEASURES, TRAJECTORY, cost_of, pareto_charts
from msmpetsc.study.charts.stability import stability_charts
from msmpetsc.study.charts.style import RC, looks
from msmpetsc.study.charts.svg import save_png, svg_text
from msmpetsc.study.outcome import counted
from msmpetsc.study.rows import (
    NUMBERS,
    TEXT,
    Row,
    failed,
    grouped,
    mapped,
    read_rows,
    read_traces,
    stepping,
    swept,
    timed,
)  # fmt: skip
from msmpetsc.study.spread import UNKNOWN, is_known

PRINTED = {
    "label", "scene", "x", "y", "outcome", "status", "reason", "time_step", "error", "cells", "ranks", "time_frame",
    "time_frame_min", "time_frame_max", "time_second",
    "ksp_its", "memory", "true_error", "trajectory_error",
}  # fmt: skip
NOT_PRINTED = {*TEXT, *NUMBERS} - PRINTED
ALWAYS = ("label", "status", "command")  # columns of the whole table even where all cases agree in them
PAGE = "<!DOCTYPE html>\n<html lang='en'>\n<head>\n<meta charset='utf-8'>\n"


def write_report(folder: Path) -> Path:
    """Draws everything that table.csv and traces.json in this folder hold; PNG files and report.html stand beside them.

    Returns the path of report.html. Raises InputError where there is no table.
    """
    rows, traces = read_rows(folder), read_traces(folder)
    charts = draw_charts(rows, traces, study_file(folder))
    for chart in charts:
        save_png(chart, folder)
    path = folder / "report.html"
    path.write_text(page(title(folder, rows), measured_on(folder), rows, charts), encoding="utf-8")
    return path


def draw_charts(rows: list[Row], traces: list[dict], study: dict) -> list[Chart]:
    """All charts that there are numbers for; a method looks the same in each. study: the tables of the study file."""
    named = looks([row["label"] for row in rows] + [entry["label"] for entry in traces])
    with style.context(["default", RC]):
        charts = stability_charts(rows, study)
        rows = swept(rows)
        charts += pareto_charts(rows, named) + figure6_charts(rows, named) + growth_charts(rows, named)
        charts += order_charts(rows, named, study)
        return charts + convergence_charts(traces, named, {row["case"]: row["command"] for row in rows if row["case"]})


def study_file(folder: Path) -> dict:
    """The tables of study.toml; none where there is no such file."""
    file = folder / "study.toml"
    return tomllib.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}


def title(folder: Path, rows: list[Row]) -> str:
    """The title in study.toml, else the name in the table, else that of the folder."""
    return str(
        study_file(folder).get("title")
        or next((row["study"] for row in rows if row["study"]), "")
        or folder.resolve().name
    )


def measured_on(folder: Path) -> str:
    """When the table was last written, UTC offset included."""
    return datetime.fromtimestamp((folder / "table.csv").stat().st_mtime).astimezone().strftime("%d %B %Y, %H:%M %z")


def page(title: str, date: str, rows: list[Row], charts: list[Chart]) -> str:
    """The whole page; it needs nothing beside itself."""
    body = [f"<h1>{escape(title)}</h1>", facts(date, rows), contents(charts), overview(charts)]
    body += [*sections(charts), failures(rows), table(rows)]
    here = files("msmpetsc.study")
    css, script = ((here / name).read_text(encoding="utf-8") for name in ("report.css", "report.js"))
    head = f"<title>{escape(title)}</title>\n<style>\n{css}</style>\n</head>\n<body>\n<main>\n"
    return PAGE + head + "\n".join(body) + f"\n</main>\n<script>\n{script}</script>\n</body>\n</html>\n"


def facts(date: str, rows: list[Row]) -> str:
    """Date, machine, versions and how many cases there are."""
    plain = swept(rows)
    lost = len(failed(plain))
    count = f"{len(plain)}, " + (f"{lost} of them <a href='#failed'>failed</a>" if lost else "none failed")
    entries = [("Date", escape(date))] + ([("Cases", count)] if plain or not rows else [])
    entries += [(f"Map {escape(name)}", f"{len(group)}: {counted(group)}") for name, group in mapped(rows).items()]
    entries += [("Repeats", escape(repeated(plain)))] if timed(plain) else []
    for name in ("machine", "versions"):
        texts = dict.fromkeys(readable(str(row[name])) for row in rows if row[name])
        entries += [(name.capitalize(), "<br>".join(map(escape, texts)))] if texts else []
    return "<dl class='facts'>" + "".join(f"<dt>{name}</dt><dd>{text}</dd>" for name, text in entries) + "</dl>"


def repeated(rows: list[Row]) -> str:
    """How often cases were run, and what follows for their times."""
    counts = sorted({int(row["repeats"] or 1) for row in timed(rows)})
    if not is_known(timed(rows)):
        return f"{' or '.join(map(str, counts))}. {UNKNOWN}"
    return f"{' or '.join(map(str, counts))}: times are medians, ranges and whiskers from the least to the greatest"


def readable(text: str) -> str:
    """JSON objects as words: {"cores": 2} -> cores 2."""
    try:
        value = json.loads(text)
    except json.JSONDecodeError:
        return text
    if not isinstance(value, dict):
        return text
    return ", ".join(f"{name} {formatting.size(entry) if name == 'memory' else entry}" for name, entry in value.items())


def contents(charts: list[Chart]) -> str:
    """Links to the charts."""
    links = [f"<a href='#{escape(anchor(chart))}'>{escape(chart.title)}</a>" for chart in charts]
    return f"<nav>{''.join(f'<span>{link}</span>' for link in [*links, '<a href=#all>All cases</a>'])}</nav>"


def anchor(chart: Chart) -> str:
    return "chart-" + "".join(letter if letter.isalnum() else "-" for letter in chart.name)


def overview(charts: list[Chart]) -> str:
    """Who wins at each level of error, scene by scene, where there are several."""
    charts = [chart for chart in charts if chart.cheapest]
    if len(charts) < 2:
        return ""
    head = ["", "error", *(f"{formatting.error(level)} or less" for level in LEVELS)]
    lines = [
        [chart.title.partition(": ")[2], name, *(winner(name, row) for row in best)]
        for chart in charts for name, best in chart.cheapest.items()
    ]  # fmt: skip
    known = all(is_known(best) for chart in charts for levels in chart.cheapest.values() for best in levels)
    note = f"The cheapest measured method{', then those whose repeats overlap with its own' if known else ''}; for the "
    note += "step error with its time a frame, for the trajectory error with its time a simulated second and its "
    note += "time step."
    caption = f"<p class='caption'>{escape(note if known else f'{note} {UNKNOWN}')}</p>"
    cells = [[(text, text) for text in line] for line in lines]
    return f"<section class='overview'><h2>At a glance</h2>{caption}{html_table(head, cells)}</section>"


def winner(name: str, best: list[Row]) -> str:
    """The label of the cheapest and what it costs; then those within its noise."""
    if not best:
        return "none"
    row, *others = best
    step = f", {stepping(row)}" if name == TRAJECTORY.name else ""
    near = f"; or {', '.join(other['label'] for other in others)}" if others else ""
    return f"{row['label']}: {cost_of(row, MEASURES[name])}{step}{near}"


def sections(charts: Iterable[Chart]) -> list[str]:
    """Charts under their headings."""
    parts, kind = [], None
    for chart in charts:
        if chart.kind != kind:
            kind = chart.kind
            parts.append(f"<h2>{escape(kind)}</h2>\n<p class='caption'>{escape(chart.caption)}</p>")
        parts.append(figure(chart))
    return parts


def figure(chart: Chart) -> str:
    """A chart, what it shows, which cases are missing from it, and its numbers."""
    parts = [f"<figure id='{escape(anchor(chart))}'>", f"<h3>{escape(chart.title)}</h3>", svg_text(chart)]
    if chart.findings:
        parts.append("<div class='findings'>" + "".join(map(listed, *zip(*chart.findings.items()))) + "</div>")
    if chart.failed:
        reasons = grouped(chart.failed, reason_of)
        lines = [f"{reason}: {'; '.join(map(name_of, lost))}" for reason, lost in reasons.items()]
        state = " open" if len(lines) <= 4 else ""
        heading = f"Not in the chart, for they failed: {len(chart.failed)} of this scene's cases"
        parts.append(f"<details class='failed'{state}><summary>{heading}</summary>{bullets(lines)}</details>")
    tables = "".join(panel_table(panel, chain(*groups.values())) for panel, groups in chart.points.items())
    parts.append(f"<details><summary>The numbers of this chart</summary>{tables}</details>")
    return "\n".join([*parts, "</figure>"])


def listed(heading: str, lines: Iterable[str]) -> str:
    """A short list under its heading."""
    return f"<div><h4>{escape(heading)}</h4>{bullets(lines)}</div>"


def bullets(lines: Iterable[str]) -> str:
    """A list; words such as -pc_type, fast-msm and 1e-3 are not torn at their hyphen."""
    hyphenated = re.compile(r"(?<!\S)(\S{0,40}-\S{1,40})(?!\S)")
    whole = (hyphenated.sub(r"<span class='whole'>\1</span>", escape(line)) for line in lines)
    return "<ul>" + "".join(f"<li>{line}</li>" for line in whole) + "</ul>"


def name_of(row: Row) -> str:
    """A failed case in words."""
    settings = [
        stepping(row),
        f"error {formatting.error(row['error'])}" if row["error"] else "",
        f"{formatting.count(row['max_iterations'])} iterations" if row["max_iterations"] else "",
        f"{formatting.count(row['cells'])} cells" if row["cells"] else "",
        f"{formatting.count(row['ranks'])} ranks" if (row["ranks"] or 1) > 1 else "",
    ]
    return ", ".join(filter(None, [row["label"] or row["case"], *settings]))


def reason_of(row: Row) -> str:
    return str(row["reason"] or row["status"] or "no reason given")


def panel_table(panel: str, points: Iterable[Point]) -> str:
    """The points of a panel under its title; columns that are empty in all are left out."""
    points = list(points)
    names = [name for name in points[0].numbers if any(point.texts()[name] for point in points)]
    last = ["command"] if any(point.command for point in points) else []
    heading = f"<h4>{escape(panel)}</h4>" if panel else ""
    return heading + html_table(["curve", *names, *last], [point_line(point, names, bool(last)) for point in points])


def point_line(point: Point, names: list[str], with_command: bool) -> list[tuple[str, str]]:
    """One line of a panel's table: texts, and numbers to sort them by."""
    numbers = [(point.texts()[name], sort_key(point.numbers[name][1])) for name in names]
    return [(point.label, point.label), *numbers, *([(point.command, point.command)] if with_command else [])]


def failures(rows: list[Row]) -> str:
    """All failed cases with their commands; those of maps are answers, and stand there."""
    lost = failed(swept(rows))
    if not lost:
        return ""
    lines = [[row["scene"], name_of(row), row["status"], reason_of(row), row["command"]] for row in lost]
    cells = [[(str(text), str(text)) for text in line] for line in lines]
    return "<h2 id='failed'>Failed cases</h2>" + html_table(["scene", "what", "status", "reason", "command"], cells)


def table(rows: list[Row]) -> str:
    """The whole table; what all cases share stands above it."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    columns = [name for name in columns if any(row.get(name) not in (None, "") for row in rows)]
    shared = [name for name in columns if name not in ALWAYS and len(rows) > 1 and is_shared(name, rows)]
    numbers_first = sorted(columns, key=lambda name: name in TEXT and name != "scene")
    shown = [*ALWAYS[:2], *(name for name in numbers_first if name not in (*shared, *ALWAYS)), ALWAYS[2]]
    same = "".join(map(shared_entry, shared, (rows[0][name] for name in shared)))
    lines = [[(formatting.plain(row.get(name)), sort_key(row.get(name))) for name in shown] for row in rows]
    above = f"<details><summary>The same in all cases</summary><dl class='facts'>{same}</dl></details>" if same else ""
    note = "<p class='caption'>SI units; a heading sorts. The same numbers to all digits are in table.csv; "
    note += "on paper stand the main columns only.</p>"
    return "<h2 id='all'>All cases</h2>" + note + above + html_table(shown, lines)


def shared_entry(name: str, value: float | str | None) -> str:
    return f"<dt>{escape(name)}</dt><dd>{escape(readable(formatting.plain(value)))}</dd>"


def is_shared(name: str, rows: list[Row]) -> bool:
    return len({row.get(name) for row in rows}) == 1


def sort_key(value: float | str | None) -> str:
    return "" if value is None else str(value)


def html_table(head: list[str], lines: list[list[tuple[str, str]]]) -> str:
    """Lines of (text, what to sort by)."""
    top = "".join(f"<th scope='col'{kind(name)}>{escape(name)}</th>" for name in head)
    body = "".join("<tr>" + "".join(map(html_cell, line, head)) + "</tr>\n" for line in lines)
    inside = f"<thead><tr>{top}</tr></thead><tbody>\n{body}</tbody>"
    return f"<div class='wide'><table class='sortable'>{inside}</table></div>"


def kind(column: str) -> str:
    """Class of a column: the reason may take several lines, and paper has no room for what is not asked for most."""
    name = "text" if column == "reason" else "more" if column in NOT_PRINTED else ""
    return f" class='{name}'" if name else ""


def html_cell(entry: tuple[str, str], column: str) -> str:
    text, key = entry
    sort = f' data-key="{escape(key)}"' if key != text else ""
    content = f"<code>{escape(text)}</code>" if column == "command" and text else escape(text)
    return f"<td{sort}{kind(column)}>{content}</td>"
