"""Stability maps: outcomes of each method over two axes, or over named cases."""

import math
from typing import Any, NamedTuple

from pandas import DataFrame

from msmpetsc.study import formatting
from msmpetsc.study.charts.plot import INK, Axes, Chart, CurveStyle, tips
from msmpetsc.study.outcomes import MEANING, OUTCOMES
from msmpetsc.study.table import Row, grouped, mapped, records

CAPTION = (
    "The worst outcome of each run. If every step was solved, a number gives the mean iterations a "
    "step, or the substeps of verlet. The tooltip of a cell gives its numbers and the command that "
    "repeats it."
)
# colours differ in lightness as well as in hue, for colour-blind readers
COLORS = {
    "crashed": "#000000", "timeout": "#7a4a1e", "refused": "#9a9a9a", "not finite": "#332288",
    "energy": "#882255", "diverged": "#d55e00", "not recovered": "#cc79a7", "inverted": "#e69f00",
    "slow": "#f0e442", "ok": "#c3e3f5",
}  # fmt: skip
SYMBOLS = {
    "crashed": "!!", "timeout": "T", "refused": "R", "not finite": "NaN", "energy": "E",
    "diverged": "D", "not recovered": "S", "inverted": "I",
}  # fmt: skip
# outcomes whose symbols are white
DARK = {"crashed", "timeout", "not finite", "energy", "diverged"}
# panels side by side, and height of a cell [px]
COLUMNS, CELL = 6, 24
# columns of a cell's tooltip
TIP = (
    "outcome", "steps", "iterations", "most_iterations", "inverted", "shape_error",
    "energy_gained", "substeps", "fallbacks", "reason",
)  # fmt: skip


class Scale(NamedTuple):
    """An axis of a map: its name, and the label of each value in order."""

    name: str
    texts: dict[str, str]


def entry(value: str, unit: str) -> str:
    """Return the label of a value on an axis: 10 ms, 20%, 100 kPa, or the name of a case."""
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        return value
    if unit == "%":
        return f"{100 * number:.3g}%"
    return formatting.seconds(number) if unit == "s" else formatting.prefixed(number, unit)


def scale(rows: DataFrame, column: str, axis: dict[str, Any]) -> Scale:
    """Return the axis of a column, in the order and with the unit that the study file gives."""
    listed = [str(float(value)) for value in axis.get("values", ())]
    measured = dict.fromkeys(rows[column])
    values = [value for value in dict.fromkeys([*listed, *measured]) if value in measured]
    texts = {value: entry(value, axis.get("unit", "")) for value in values}
    return Scale(axis.get("name", column), texts)


def stability_charts(table: DataFrame, study: dict[str, Any]) -> list[Chart]:
    """Return a chart for each map, with the axes that the study file names."""
    maps = {entry.get("name"): entry for entry in study.get("map", ())}
    return [stability_chart(name, rows, maps.get(name, {})) for name, rows in mapped(table).items()]


def stability_chart(name: str, rows: DataFrame, settings: dict[str, Any]) -> Chart:
    """Return the chart of a map; ``settings`` is the map's table in the study file."""
    x, y = (scale(rows, column, settings.get(column, {})) for column in ("x", "y"))
    rows = rows[rows["outcome"].isin(OUTCOMES)].drop_duplicates(["label", "x", "y"], keep="last")
    shown = [outcome for outcome in reversed(OUTCOMES) if outcome in set(rows["outcome"])]
    legend = {
        f"{SYMBOLS.get(each, '12')}  {each}: {MEANING[each]}": CurveStyle(COLORS[each], "square")
        for each in shown
    }
    title = settings.get("title") or name
    chart = Chart(f"stability_{name}", "Stability", title, CAPTION, legend, COLUMNS, gap=35)
    chart.height = CELL * len(y.texts)
    by_label = grouped(rows, "label")
    if set(x.texts) == set(by_label):
        # named cases: methods along the top, cases downwards
        across = axis(x, orient="top", labelAngle=-20, labelOverlap=False)
        panel = chart.panel("", across, axis(y))
        draw_cells(panel, rows, x._replace(name="method"), y._replace(name="case"))
        return chart
    for index, (label, group) in enumerate(by_label.items()):
        is_low = index + COLUMNS >= len(by_label)
        is_left = index % COLUMNS == 0
        across = axis(x, x.name if is_low else "", labels=is_low)
        up = axis(y, y.name if is_left else "", labels=is_left)
        up["scale"]["reverse"] = True
        draw_cells(chart.panel(label, across, up), group, x, y)
    return chart


def axis(scale: Scale, title: str = "", **axis: Any) -> dict[str, Any]:
    """Return an axis with a cell for each value."""
    cells = {"domain": list(scale.texts.values()), "padding": 0.06}
    plain = {"domain": False, "ticks": False}
    return {"type": "ordinal", "title": title, "scale": cells, "axis": plain | axis}


def draw_cells(panel: Axes, rows: DataFrame, x: Scale, y: Scale) -> None:
    """Draw a coloured cell with its symbol and tooltip for each row."""
    words = {x.name: rows["x"].map(x.texts), y.name: rows["y"].map(y.texts)}
    placed = rows.assign(**words)
    values = [
        {
            "x": row[x.name], "y": row[y.name], "tip": tip, "text": symbol(row),
            "color": COLORS[row["outcome"]], "ink": "white" if row["outcome"] in DARK else INK,
        }
        for row, tip in zip(records(placed), tips(placed, (*words, *TIP)), strict=True)
    ]  # fmt: skip
    # the fields contain colours, which Vega must use as they are
    own = {"type": "nominal", "scale": None}
    fill = {"fill": {"field": "color"} | own, "description": {"field": "tip"}}
    panel.draw(values, {"type": "rect"}, **fill)
    text = {"text": {"field": "text"}, "color": {"field": "ink"} | own}
    panel.draw(values, {"type": "text", "fontSize": 10.5}, **text)


def symbol(row: Row) -> str:
    """Return the text of a cell: the symbol of its outcome, or the iterations per step."""
    count = row["iterations"]
    if row["outcome"] in SYMBOLS or count is None:
        return SYMBOLS.get(row["outcome"], "")
    return f"{count:.0f}" if count < 1000 else formatting.prefixed(count)
