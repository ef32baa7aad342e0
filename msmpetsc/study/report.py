"""The report of a study: one page with charts, all numbers and the commands that repeat them.

What stands where is in report.html.j2; this file says what it is.
"""

import tomllib
from datetime import datetime
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader
from markupsafe import Markup
from pandas import DataFrame, option_context

from msmpetsc.results.disk import write_whole
from msmpetsc.study import formatting
from msmpetsc.study.charts.curves import growth_charts, pareto_charts, size_charts
from msmpetsc.study.charts.plot import Chart, curve_styles, save_png, svg_text
from msmpetsc.study.charts.stability import stability_charts
from msmpetsc.study.metrics import counted
from msmpetsc.study.table import (
    NUMBERS,
    ONCE_NOTE,
    TEXT,
    failed,
    is_repeated,
    mapped,
    read_table,
    swept,
    timed,
)

FIRST = ["scene", "label", "status"]  # columns of the whole table; the last is the command
ABOVE = ["study", "machine", "versions"]
OF_FAILURES = ["scene", "label", "time_step", "error", "status", "reason", "command"]


def write_report(folder: Path) -> Path:
    """Draw a folder's table as PNG files and report.html; return its path. Raises InputError."""
    table = read_table(folder)
    file = folder / "study.toml"
    study = tomllib.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}
    styles, sweeps = curve_styles(table["label"]), swept(table)
    charts = [
        *stability_charts(table, study),
        *size_charts(sweeps, styles),
        *pareto_charts(sweeps, styles),
        *growth_charts(sweeps, styles),
    ]
    for chart in charts:
        save_png(chart, folder)
    names = [name for name in table["study"] if name]
    title = str(study.get("title") or next(iter(names), "") or folder.resolve().name)
    written = datetime.fromtimestamp((folder / "table.csv").stat().st_mtime).astimezone()
    write_whole(folder / "report.html", page(title, f"{written:%d %B %Y, %H:%M %z}", table, charts))
    return folder / "report.html"


def page(title: str, date: str, table: DataFrame, charts: list[Chart]) -> str:
    """Return the whole page, which is self-contained."""
    environment = Environment(
        autoescape=True, loader=PackageLoader("msmpetsc.study", "."), keep_trailing_newline=True
    )
    environment.filters |= {"svg": lambda chart: Markup(svg_text(chart)), "html": html}
    between = [name for name in (*NUMBERS, *TEXT) if name not in (*FIRST, "command", *ABOVE)]
    filled = [name for name in between if (table[name].notna() & (table[name] != "")).any()]
    tables = {
        "table": table[[*FIRST, *filled, "command"]],
        "failures": failed(swept(table))[OF_FAILURES],
    }
    template = environment.get_template("report.html.j2")
    return template.render(title=title, date=date, charts=charts, **facts(table), **tables)


def facts(table: DataFrame) -> dict[str, Any]:
    """Return machine, versions and how many cases there are."""
    plain = swept(table)
    maps = {
        name: f"{len(group)}: {counted(group['outcome'])}" for name, group in mapped(table).items()
    }
    platforms = {
        name.capitalize(): [text for text in table[name].unique() if text]
        for name in ("machine", "versions")
    }
    counts = {"cases": len(plain), "failed": len(failed(plain)), "empty": table.empty}
    rows = timed(plain)
    often = " or ".join(
        map(str, sorted(set(rows["repeats"].fillna(1).astype(int))))
    )  # nothing without cases
    note = often and f"{often}. {ONCE_NOTE}"
    if not rows.empty and is_repeated(rows):
        note = f"{often}: times are medians, ranges and whiskers from the least to the greatest"
    return counts | {"maps": maps, "platforms": platforms, "repeats": note}


def html(table: DataFrame) -> Markup:
    """Return a table as HTML that is sorted by a click on a heading."""
    with option_context("display.max_colwidth", None):
        return Markup(
            table.map(formatting.plain).to_html(index=False, border=0, classes="sortable")
        )
