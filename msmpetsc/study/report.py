"""HTML report of a study: charts, all numbers, and the commands that repeat the runs.

The layout is in report.html.j2; this module computes the values that the template shows.
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
from msmpetsc.study.charts.profile import profile_charts
from msmpetsc.study.charts.stability import stability_charts
from msmpetsc.study.outcomes import counted
from msmpetsc.study.table import NUMBERS, TEXT, failed, mapped, read_table, succeeded, swept

# leading columns of the table of all cases
FIRST = ["scene", "label", "status"]
# columns that the report shows above its charts
ABOVE = ["study", "machine", "versions"]
# columns of the table of failed cases
FAILURE_COLUMNS = ["scene", "label", "time_step", "error", "status", "reason", "command"]
# number of scenes with charts of their own; a chart takes about a second
MOST_SCENES = 40


def write_report(folder: Path, most_scenes: int = MOST_SCENES) -> Path:
    """Write report.html and its charts as PNG files from a folder's table.csv; return its path.

    Only the first ``most_scenes`` scenes have charts of their own.
    Raises InputError if the table is missing or not readable.
    """
    table = read_table(folder)
    file = folder / "study.toml"
    study = tomllib.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}
    styles = curve_styles(table["label"])
    sweeps = swept(table)
    scenes = sweeps["scene"].unique()
    drawn = sweeps[sweeps["scene"].isin(scenes[:most_scenes])]
    charts = [
        *stability_charts(table, study),
        *size_charts(drawn, styles),
        *pareto_charts(drawn, styles),
        *profile_charts(sweeps, styles),
        *growth_charts(drawn),
    ]
    for chart in charts:
        save_png(chart, folder)
    title = str(study.get("title") or folder.resolve().name)
    written = datetime.fromtimestamp((folder / "table.csv").stat().st_mtime).astimezone()
    left_out = list(scenes[most_scenes:])
    date = f"{written:%d %B %Y, %H:%M %z}"
    write_whole(folder / "report.html", page(title, date, table, charts, left_out))
    return folder / "report.html"


def page(title: str, date: str, table: DataFrame, charts: list[Chart], left_out: list[str]) -> str:
    """Return the report as a self-contained HTML page.

    left_out : names of the scenes without charts
    """
    environment = Environment(
        autoescape=True, loader=PackageLoader("msmpetsc.study", "."), keep_trailing_newline=True
    )
    environment.filters |= {"svg": lambda chart: Markup(svg_text(chart)), "html": html}
    between = [name for name in (*NUMBERS, *TEXT) if name not in (*FIRST, "command", *ABOVE)]
    filled = [name for name in between if (table[name].notna() & (table[name] != "")).any()]
    tables = {
        "table": table[[*FIRST, *filled, "command"]],
        "failures": failed(swept(table))[FAILURE_COLUMNS],
    }
    template = environment.get_template("report.html.j2")
    shown = {"charts": charts, "left_out": left_out}
    return template.render(title=title, date=date, **shown, **facts(table), **tables)


def facts(table: DataFrame) -> dict[str, Any]:
    """Return the template's values: machines, versions, numbers of cases and of repeats."""
    plain = swept(table)
    maps = {
        name: f"{len(rows)}: {counted(rows['outcome'])}" for name, rows in mapped(table).items()
    }
    platforms = {
        name.capitalize(): [text for text in table[name].unique() if text]
        for name in ("machine", "versions")
    }
    counts = {"cases": len(plain), "failed": len(failed(plain)), "empty": table.empty}
    repeats = sorted(set(succeeded(plain)["repeats"].fillna(1).astype(int)))
    # empty if no case succeeded
    often = " or ".join(map(str, repeats))
    note = often and f"{often}: times are medians, whiskers from the least to the greatest"
    return counts | {"maps": maps, "platforms": platforms, "repeats": note}


def html(table: DataFrame) -> Markup:
    """Return a table as HTML; a click on a column's heading sorts it."""
    plain = table.map(formatting.plain)
    with option_context("display.max_colwidth", None):
        return Markup(plain.to_html(index=False, border=0, classes="sortable"))
