"""Stability maps: outcomes of each method over two axes, or over named cases."""

import json
import math
from typing import Any, NamedTuple

from pandas import DataFrame

from msmpetsc.study import formatting
from msmpetsc.study.charts.plot import INK, Axes, Chart, CurveStyle, channel, tips
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
    """An axis of a map: its values in order, and their labels."""

    name: str
    values: tuple[str, ...]
    texts: tuple[str, ...]


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
    """Return the axis of a column, with the order and the unit that the study file gives."""
    listed = [str(float(value)) for value in axis.get("values", ())]
    measured = dict.fromkeys(rows[column])
    values = [value for value in dict.fromkeys([*listed, *measured]) if value in measured]
    texts = [entry(value, axis.get("unit", "")) for value in values]
    return Scale(axis.get("name", column), tuple(values), tuple(texts))


def stability_charts(table: DataFrame, study: dict[str, Any]) -> list[Chart]:
    """Return a chart for each map, with the axes that the study file names."""
    maps = {entry.get("name"): entry for entry in study.get("map", ())}
    return [stability_chart(name, rows, maps.get(name, {})) for name, rows in mapped(table).items()]


def stability_chart(name: str, rows: DataFrame, settings: dict[str, Any]) -> Chart:
    """Return the chart of a map; ``settings`` is the map's table in the study file."""
    x, y = (scale(rows, column, settings.get(column, {})) for column in ("x", "y"))
    rows = rows[rows["outcome"].isin(OUTCOMES)].drop_duplicates(["label", "x", "y"], keep="last")
    legend = {
        f"{SYMBOLS.get(outcome, '12')}  {outcome}: {MEANING[outcome]}": CurveStyle(
            COLORS[outcome], "square"
        )
        for outcome in reversed(OUTCOMES)
        if outcome in set(rows["outcome"])
    }
    title = settings.get("title") or name
    chart = Chart(f"stability_{name}", "Stability", title, CAPTION, legend, COLUMNS, gap=35)
    chart.height = CELL * len(y.values)
    by_label = grouped(rows, "label")
    if set(x.values) == set(by_label):
        draw_cells(
            chart.panel("", *axes_of_cases(x, y)),
            rows,
            x._replace(name="method"),
            y._replace(name="case"),
        )
        return chart
    for index, (label, group) in enumerate(by_label.items()):
        is_low = index + COLUMNS >= len(by_label)
        panel = chart.panel(
            label, axis(x, shown=is_low, labelAngle=-90), axis(y, shown=index % COLUMNS == 0)
        )
        draw_cells(panel, group, x, y)
    return chart


def axis(scale: Scale, shown: bool = True, **more: Any) -> dict[str, Any]:
    """Return an axis whose cells have width 1 around 0, 1, 2, ...; labelled if ``shown``."""
    count = len(scale.values)
    words = f"{json.dumps(scale.texts)}[datum.value]"
    made = channel(scale.name if shown else "", words, range(count), domain=[-0.5, count - 0.5])
    made["axis"] |= {"grid": False, "domain": False, "ticks": False, "labels": shown} | more
    return made


def axes_of_cases(x: Scale, y: Scale) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the axes of a map of named cases: methods along the top, cases downwards."""
    broken = [
        text.replace("-", "-\n").split("\n") if len(text) > 12 else [text] for text in x.texts
    ]
    room = 4 + 14 * (max(map(len, broken)) - 1)
    across = axis(x, orient="top", labelOverlap=False, labelPadding=room)
    down = axis(y)
    across["axis"]["labelExpr"] = f"{json.dumps(broken)}[datum.value]"
    down["scale"]["reverse"] = True
    return across | {"title": ""}, down | {"title": ""}


def draw_cells(panel: Axes, rows: DataFrame, x: Scale, y: Scale) -> None:
    """Draw a coloured cell with its symbol and tooltip for each row."""
    words = {
        given.name: rows[column].map(dict(zip(given.values, given.texts, strict=True)))
        for column, given in (("x", x), ("y", y))
    }
    placed = rows.assign(i=rows["x"].map(x.values.index), j=rows["y"].map(y.values.index), **words)
    values = [
        {
            "x": row["i"] - 0.47, "x2": row["i"] + 0.47,
            "y": row["j"] - 0.46, "y2": row["j"] + 0.46, "tip": tip,
            "i": row["i"], "j": row["j"], "text": symbol(row), "color": COLORS[row["outcome"]],
            "ink": "white" if row["outcome"] in DARK else INK,
        }
        for row, tip in zip(records(placed), tips(placed, (*words, *TIP)), strict=True)
    ]  # fmt: skip
    # the columns contain colours, so Vega must not map them
    own = {"type": "nominal", "scale": None}
    ends = {"x2": {"field": "x2"}, "y2": {"field": "y2"}}
    panel.draw(
        values,
        {"type": "rect"},
        fill={"field": "color"} | own,
        description={"field": "tip"},
        **ends,
    )
    text = {"text": {"field": "text"}, "x": {"field": "i"} | panel.x, "y": {"field": "j"} | panel.y}
    panel.draw(values, {"type": "text", "fontSize": 10.5}, **text, color={"field": "ink"} | own)


def symbol(row: Row) -> str:
    """Return the text of a cell: the symbol of its outcome, or the iterations per step."""
    count = row["iterations"]
    if row["outcome"] in SYMBOLS or count is None:
        return SYMBOLS.get(row["outcome"], "")
    if count < 1000:
        return f"{count:.0f}"
    return f"{count / 1000:.{int(count < 9950)}f}k"
