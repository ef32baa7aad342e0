"""Stability: what becomes of each method over two axes, a panel a method, or with named cases, a column a method."""

import json
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from msmpetsc.study import formatting
from msmpetsc.study.charts.plot import INK, Chart, CurveStyle, Numbers, Panel, channel, tips
from msmpetsc.study.metrics import MEANING, OUTCOMES
from msmpetsc.study.table import Row, grouped, mapped, records

if TYPE_CHECKING:
    from pandas import DataFrame

KIND = "Stability"
CAPTION = (
    "How each run went, the worst that befell it. A number is the mean of the iterations a step, where every step was "
    "solved; of verlet, its substeps. Point at a cell for its numbers and the command that repeats it."
)
LIMIT = "longest stable explicit step, 2 / ω"
# from the worst to the best: told apart by lightness as well as by hue, and each cell has its symbol
COLORS = {
    "crashed": "#000000", "timeout": "#7a4a1e", "refused": "#9a9a9a", "not finite": "#332288", "energy": "#882255",
    "diverged": "#d55e00", "not recovered": "#cc79a7", "inverted": "#e69f00", "slow": "#f0e442", "ok": "#c3e3f5",
}  # fmt: skip
SYMBOLS = {
    "crashed": "!!", "timeout": "T", "refused": "R", "not finite": "NaN", "energy": "E", "diverged": "D",
    "not recovered": "S", "inverted": "I",
}  # fmt: skip
DARK = {"crashed", "timeout", "not finite", "energy", "diverged"}  # their symbols are white
COLUMNS = 6  # panels side by side
CELL = 24  # [px]: height
NUMBERS: Numbers = {
    "outcome": (formatting.plain, "outcome"),
    "steps done": (formatting.count, "steps"),
    "iterations a step": (formatting.count, "iterations"),
    "the most of a step": (formatting.count, "most_iterations"),
    "cells inverted": (formatting.count, "inverted"),
    "shape error": (formatting.error, "shape_error"),
    "energy gained [J]": (formatting.plain, "energy_gained"),
    "shorter steps": (formatting.count, "substeps"),
    "robust steps": (formatting.count, "fallbacks"),
    "explicit limit": (formatting.seconds, "explicit_limit"),
    "reason": (formatting.plain, "reason"),
}


@dataclass(frozen=True)
class Scale:
    """One side of a map: its values in their order, as the table has them, and how a reader wants them."""

    name: str
    values: tuple[str, ...]
    texts: tuple[str, ...]
    key: str = ""

    def text(self, value: str) -> str:
        """Return a value as a reader wants it."""
        return self.texts[self.values.index(value)]

    def at(self, value: float) -> float | None:
        """Return the position of a number, in cells, between two values by its logarithm.

        None outside the outermost cells.
        """
        logs = [math.log(float(text)) for text in self.values]
        if len(logs) < 2 or value <= 0:
            return None
        index = min(max(sum(log <= math.log(value) for log in logs) - 1, 0), len(logs) - 2)
        position = index + (math.log(value) - logs[index]) / (logs[index + 1] - logs[index])
        return position if -0.5 <= position <= len(logs) - 0.5 else None


def worded(value: float, unit: str) -> str:
    """Return a number of an axis: 10 ms, 20%, 100 kPa."""
    if unit == "%":
        return f"{100 * value:.3g}%"
    return formatting.seconds(value) if unit == "s" else formatting.prefixed(value, unit)


def scale(rows: "DataFrame", column: str, axis: dict) -> Scale:
    """Return the values that the rows have on this axis, in the order of the study file, worded as it says."""
    listed = [str(float(value)) for value in axis.get("values", ())]
    measured = list(dict.fromkeys(rows[column]))
    values = [value for value in listed if value in measured] + [value for value in measured if value not in listed]
    texts = [worded(float(value), axis.get("unit", "")) if _is_number(value) else value for value in values]
    return Scale(axis.get("name", column), tuple(values), tuple(texts), axis.get("key", ""))


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def stability_charts(table: "DataFrame", study: dict) -> list[Chart]:
    """Return one chart a map; ``study``: the tables of the study file, for the names of the axes."""
    maps = {entry.get("name"): entry for entry in study.get("map", ())}
    return [stability_chart(name, rows, maps.get(name, {})) for name, rows in mapped(table).items()]


def stability_chart(name: str, rows: "DataFrame", settings: dict) -> Chart:
    """Return the chart of a map; ``settings``: its table in the study file."""
    x, y = (scale(rows, column, settings.get(column, {})) for column in ("x", "y"))
    rows = rows.assign(i=rows["x"].map(x.values.index), j=rows["y"].map(y.values.index))
    by_label = grouped(rows, "label")
    legend = {
        f"{SYMBOLS.get(outcome, '12')}  {outcome}: {MEANING[outcome]}": CurveStyle(COLORS[outcome], "square")
        for outcome in reversed(OUTCOMES)
        if outcome in set(rows["outcome"])
    }
    title, height = settings.get("title") or name, CELL * len(y.values)
    chart = Chart(f"stability_{name}", KIND, title, CAPTION, legend, columns=COLUMNS, gap=35, height=height)
    if set(x.values) == set(by_label):
        panel = chart.panel("", *axes_of_cases(x, y))
        draw_cells(panel, rows, {"case": (y.text, "y")})
        write_symbols(panel, rows)
        return chart
    for index, (label, group) in enumerate(by_label.items()):
        is_low = index + COLUMNS >= len(by_label)
        panel = chart.panel(label, axis(x, shown=is_low, labelAngle=-90), axis(y, shown=index % COLUMNS == 0))
        draw_cells(panel, group, {x.name: (x.text, "x"), y.name: (y.text, "y")})
        if draw_limit(panel, group, x, y):
            legend[LIMIT] = CurveStyle(INK, "M-1.7,-.15H1.7V.15H-1.7Z")
        write_symbols(panel, group)
    return chart


def axis(scale: Scale, shown: bool = True, **look: Any) -> dict[str, Any]:
    """Return an axis whose cells are 1 wide, around 0, 1, 2; its values are written if shown."""
    count = len(scale.values)
    words = f"{json.dumps(scale.texts)}[datum.value]"
    made = channel(scale.name if shown else "", words, range(count), domain=[-0.5, count - 0.5])
    made["axis"] |= {"grid": False, "domain": False, "ticks": False, "labels": shown} | look
    return made


def axes_of_cases(x: Scale, y: Scale) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the axes of named cases, the first at the top, with the methods above them."""
    broken = [text.replace("-", "-\n").split("\n") if len(text) > 12 else [text] for text in x.texts]
    room = 4 + 14 * (max(map(len, broken)) - 1)
    across, down = axis(x, orient="top", labelOverlap=False, labelPadding=room), axis(y)
    across["axis"]["labelExpr"] = f"{json.dumps(broken)}[datum.value]"
    down["scale"]["reverse"] = True
    return across | {"title": ""}, down | {"title": ""}


def draw_cells(panel: Panel, rows: "DataFrame", numbers: Numbers) -> None:
    """Draw the cells of a panel, which tell their numbers."""
    known = known_of(rows)
    values = [
        {
            "x": row["i"] - 0.47, "x2": row["i"] + 0.47, "y": row["j"] - 0.46, "y2": row["j"] + 0.46,
            "color": COLORS[row["outcome"]], "tip": tip,
        }
        for row, tip in zip(records(known), tips(known, numbers | NUMBERS), strict=True)
    ]  # fmt: skip
    ends = {"x2": {"field": "x2"}, "y2": {"field": "y2"}}
    panel.draw(values, {"type": "rect"}, fill=color_of("color"), description={"field": "tip"}, **ends)


def write_symbols(panel: Panel, rows: "DataFrame") -> None:
    """Write the symbols of the cells, over the line of the limit, which does not run through them."""
    texts = [
        {
            "x": row["i"], "y": row["j"], "text": symbol(row),
            "behind": COLORS[row["outcome"]], "color": "white" if row["outcome"] in DARK else INK,
        }
        for row in records(known_of(rows))
    ]  # fmt: skip
    look, text = {"type": "text", "fontSize": 10.5}, {"text": {"field": "text"}}
    halo = {"stroke": color_of("behind"), "strokeWidth": {"value": 5}}
    panel.draw(texts, look, **text, **halo)
    panel.draw(texts, look, **text, color=color_of("color"))


def known_of(rows: "DataFrame") -> "DataFrame":
    """Return the rows of the cells whose outcome is known, each once."""
    return rows[rows["outcome"].isin(OUTCOMES)].drop_duplicates(["x", "y"], keep="last")


def color_of(column: str) -> dict[str, Any]:
    """Return the channel of colours that stand in a column."""
    return {"field": column, "type": "nominal", "scale": None}


def symbol(row: Row) -> str:
    """Return what stands in a cell: iterations a step where all went well."""
    count = row["iterations"]
    if row["outcome"] in SYMBOLS or count is None:
        return SYMBOLS.get(row["outcome"], "")
    return f"{count:.0f}" if count < 1000 else f"{count / 1000:.{1 if count < 9950 else 0}f}k"


def draw_limit(panel: Panel, rows: "DataFrame", x: Scale, y: Scale) -> bool:
    """Draw the explicit limit across the axis of time steps, for each value of the other axis; tell if it is known."""
    if "time.step" not in (x.key, y.key):
        return False
    steps, across, column = (x, y, "y") if x.key == "time.step" else (y, x, "x")
    along, other = ("x", "y") if steps is x else ("y", "x")
    limits = rows[rows["explicit_limit"] > 0].groupby(column)["explicit_limit"].median()
    places = [(index, steps.at(limits[value])) for index, value in enumerate(across.values) if value in limits]
    lines = [
        {along: at, f"{along}2": at, other: index - 0.5, f"{other}2": index + 0.5}
        for index, at in places
        if at is not None
    ]
    ends = {"x2": {"field": "x2"}, "y2": {"field": "y2"}}
    panel.draw(lines, {"type": "rule", "color": "white", "strokeWidth": 3.4}, **ends)
    panel.draw(lines, {"type": "rule", "color": INK, "strokeWidth": 1.7}, **ends)
    return bool(lines)
