"""Stability: what becomes of each method over two axes, a panel a method, or with named cases, a column a method."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import EngFormatter

from msmpetsc.study import formatting
from msmpetsc.study.charts.style import INK, WIDTH, Chart, CurveStyle, Numbers, set_padding
from msmpetsc.study.metrics import MEANING, OUTCOMES
from msmpetsc.study.table import Row, grouped, mapped, records

if TYPE_CHECKING:
    from pandas import DataFrame, Series

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
GOOD = ("ok", "slow")
COLUMNS = 6  # panels side by side
CELL = 0.33  # [in]: height
FONT = 8  # [points] of symbols and ticks
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
    return formatting.seconds(value) if unit == "s" else EngFormatter(unit, sep=formatting.GAP if unit else "")(value)


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
    rows = rows.assign(i=rows["x"].map(x.values.index) + 0.5, j=rows["y"].map(y.values.index) + 0.5)
    by_label = grouped(rows, "label")
    of_cases = set(x.values) == set(by_label)
    panels = {"": rows} if of_cases else by_label
    figure, all_axes = panels_of(len(panels), (len(x.values), len(y.values)), of_cases)
    chart = Chart(f"stability_{name}", KIND, settings.get("title") or name, CAPTION, figure)
    for index, (axes, (label, group)) in enumerate(zip(all_axes, panels.items(), strict=True)):
        axes.set_title(label, loc="left", fontsize=10)
        draw_cells(chart, axes, group, x=x, y=y, of_cases=of_cases)
        if not of_cases:
            draw_limit(axes, group, x, y)
        decorate(axes, x, y, of_cases=of_cases, left=index % COLUMNS == 0, low=index + COLUMNS >= len(panels))
    has_limit = not of_cases and any(line.get_label() == LIMIT for axes in all_axes for line in axes.lines)
    add_legend(figure, set(rows["outcome"]), has_limit)
    if of_cases:
        chart.findings["By case"] = [case_line(y.text(name), group) for name, group in grouped(rows, "y").items()]
    else:
        chart.findings["By method"] = [method_line(label, group, x, y) for label, group in by_label.items()]
    return chart


def panels_of(count: int, cells: tuple[int, int], of_cases: bool) -> tuple[Figure, Sequence[Axes]]:
    """Return axes for the panels, line by line, and room for a legend below."""
    columns = 1 if of_cases else min(count, COLUMNS)
    lines = -(-count // columns)
    height = max(cells[1] * CELL, 1.2)
    figure = Figure(figsize=(WIDTH, lines * (height + 0.55) + 1.35), layout="constrained")
    set_padding(figure, w_pad=0.05, h_pad=0.06, wspace=0.01)
    axes = list(figure.subplots(lines, columns, squeeze=False, sharex=True, sharey=True).ravel())
    for unused in axes[count:]:
        unused.remove()
    return figure, axes[:count]


def draw_cells(chart: Chart, axes: Axes, rows: "DataFrame", *, x: Scale, y: Scale, of_cases: bool) -> None:
    """Draw the cells of a panel, their symbols, and what tells their numbers."""
    known = rows[rows["outcome"].isin(OUTCOMES)].drop_duplicates(["x", "y"], keep="last")
    cells = known.assign(value=known["outcome"].map(OUTCOMES.index)).pivot(index="y", columns="x", values="value")
    values = cells.reindex(index=y.values, columns=x.values).to_numpy(float)
    palette = ListedColormap([COLORS[name] for name in OUTCOMES])
    axes.pcolormesh(values, cmap=palette, vmin=-0.5, vmax=len(OUTCOMES) - 0.5, edgecolors="white", linewidth=1)
    for row in records(known):
        color = "white" if row["outcome"] in DARK else INK
        behind: dict[str, Any] = {
            "facecolor": COLORS[row["outcome"]],
            "edgecolor": "none",
            "pad": 0.8,
        }  # no line runs through it
        center: dict[str, Any] = {"ha": "center", "va": "center", "zorder": 5}
        axes.text(row["i"], row["j"], symbol(row), color=color, fontsize=FONT, bbox=behind, **center)
    y_name = y.name if y.name != "y" else "case"
    numbers: Numbers = {} if of_cases else {x.name: (x.text, "x")}
    numbers |= {y_name: (y.text, "y")} | NUMBERS
    chart.mark(axes, known, ("i", "j"), CurveStyle(INK, "s"), numbers=numbers, markersize=CELL * 72 * 0.9, alpha=0)


def symbol(row: Row) -> str:
    """Return what stands in a cell: iterations a step where all went well."""
    count = row["iterations"]
    if row["outcome"] in SYMBOLS or count is None:
        return SYMBOLS.get(row["outcome"], "")
    return f"{count:.0f}" if count < 1000 else f"{count / 1000:.{1 if count < 9950 else 0}f}k"


def draw_limit(axes: Axes, rows: "DataFrame", x: Scale, y: Scale) -> None:
    """Draw the explicit limit across the axis of time steps, for each value of the other axis, where it is known."""
    if "time.step" not in (x.key, y.key):
        return
    steps, across, column = (x, y, "y") if x.key == "time.step" else (y, x, "x")
    limits = rows[rows["explicit_limit"] > 0].groupby(column)["explicit_limit"].median()
    points: tuple[list[float], list[float]] = [], []
    for index, value in enumerate(across.values):
        at = steps.at(limits[value]) if value in limits else None
        points[0].extend([math.nan if at is None else at + 0.5] * 2 + [math.nan])
        points[1].extend([index, index + 1, math.nan])
    if all(map(math.isnan, points[0])):
        return
    if steps is y:
        points = points[1], points[0]
    axes.plot(*points, color="white", linewidth=3.4, solid_capstyle="butt", zorder=3)
    axes.plot(*points, color=INK, linewidth=1.6, solid_capstyle="butt", zorder=3, label=LIMIT)


def decorate(axes: Axes, x: Scale, y: Scale, *, of_cases: bool, left: bool, low: bool) -> None:
    """Put ticks at the middle of each cell, names at the outer panels alone."""
    axes.grid(False)
    axes.tick_params(length=0, labelsize=10 if of_cases else FONT, labelleft=left, labelbottom=low)
    for spine in axes.spines.values():
        spine.set_visible(False)
    texts = [text.replace("-", "-\n") if len(text) > 12 else text for text in x.texts] if of_cases else x.texts
    axes.set_xticks([index + 0.5 for index in range(len(x.values))], texts, rotation=0 if of_cases else 90)
    axes.set_yticks([index + 0.5 for index in range(len(y.values))], y.texts)
    if of_cases:
        axes.invert_yaxis()
        axes.xaxis.tick_top()
    else:
        axes.set_xlabel(x.name if low else "", fontsize=9)
        axes.set_ylabel(y.name if left else "", fontsize=9)


def add_legend(figure: Figure, outcomes: set[str], limit: bool) -> None:
    """Name the outcomes that there are, best first."""
    names = [name for name in reversed(OUTCOMES) if name in outcomes]
    handles: list[Patch | Line2D] = [
        Patch(facecolor=COLORS[name], label=f"{SYMBOLS.get(name, '12')}  {name}: {MEANING[name]}") for name in names
    ]
    handles += [Line2D([], [], color=INK, linewidth=2, label=LIMIT)] if limit else []
    figure.legend(handles=handles, loc="outside lower left", ncols=3, fontsize=8.5, handlelength=1.4, columnspacing=1.4)


def method_line(label: str, rows: "DataFrame", x: Scale, y: Scale) -> str:
    """Say how a method did, and where it failed."""
    counts = Counter(rows["outcome"])
    good = sum(counts[name] for name in GOOD)
    parts = [f"all {len(rows)} ok" if good == len(rows) else f"{good} of {len(rows)} ok"]
    if counts["slow"]:
        parts[0] += f", {counts['slow']} of them slowly"
    for name in OUTCOMES:
        if counts[name] and name not in GOOD:
            lost = rows[rows["outcome"] == name]
            ranges = f"{value_range(lost['i'], x)}; {value_range(lost['j'], y)}"
            parts.append(f"{name} in {len(lost)} ({ranges})")
    return f"{label}: {', '.join(parts)}."


def value_range(at: "Series", scale: Scale) -> str:
    """Return the first and the last of the values of an axis, from the middles of their cells."""
    first, last = scale.texts[int(at.min())], scale.texts[int(at.max())]
    return f"{scale.name} {first}" if first == last else f"{scale.name} {first} to {last}"


def case_line(name: str, rows: "DataFrame") -> str:
    """Say which methods failed a case, and how."""
    lost = grouped(rows[~rows["outcome"].isin(GOOD)], "outcome")
    if not lost:
        return f"{name}: every method does it."
    worst_first = sorted(lost, key=OUTCOMES.index)
    lines = "; ".join(f"{outcome}: {', '.join(lost[outcome]['label'])}" for outcome in worst_first)
    return f"{name}: {lines}."
