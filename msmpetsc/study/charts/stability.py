"""Stability: what becomes of each method over two axes, a panel a method, or with named cases, a column a method."""

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import median

from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import EngFormatter

from msmpetsc.study import formatting
from msmpetsc.study.charts.chart import WIDTH, Chart, Point
from msmpetsc.study.charts.style import INK, Look
from msmpetsc.study.outcome import MEANING, OUTCOMES
from msmpetsc.study.rows import Row, grouped, mapped

KIND = "Stability"
CAPTION = (
    "How each run went, the worst that befell it. A number is the mean of the iterations a step, where every step was "
    "solved; of verlet, its substeps. Point at a cell for its numbers and the command that repeats it."
)
LIMIT = "longest stable explicit step, 2 / ω"
# from the worst to the best: told apart by lightness as well as by hue, and each cell has its mark
COLORS = {
    "crashed": "#000000", "timeout": "#7a4a1e", "refused": "#9a9a9a", "not finite": "#332288", "energy": "#882255",
    "diverged": "#d55e00", "not recovered": "#cc79a7", "inverted": "#e69f00", "slow": "#f0e442", "ok": "#c3e3f5",
}  # fmt: skip
MARKS = {
    "crashed": "!!", "timeout": "T", "refused": "R", "not finite": "NaN", "energy": "E", "diverged": "D",
    "not recovered": "S", "inverted": "I",
}  # fmt: skip
DARK = {"crashed", "timeout", "not finite", "energy", "diverged"}  # their marks are white
COLUMNS = 6  # panels side by side
CELL = 0.33  # [in]: height
FONT = 8  # [points] of marks and ticks


@dataclass(frozen=True)
class Scale:
    """One side of a map: its places in their order, as the table has them, and how a reader wants them."""

    name: str
    places: tuple[str, ...]
    texts: tuple[str, ...]
    key: str = ""

    def at(self, value: float) -> float | None:
        """Where a number lies, in cells, between two places by its logarithm; None outside the outermost cells."""
        logs = [math.log(float(place)) for place in self.places]
        if len(logs) < 2 or value <= 0:
            return None
        index = min(max(sum(log <= math.log(value) for log in logs) - 1, 0), len(logs) - 2)
        found = index + (math.log(value) - logs[index]) / (logs[index + 1] - logs[index])
        return found if -0.5 <= found <= len(logs) - 0.5 else None


def worded(value: float, unit: str) -> str:
    """A number of an axis: 10 ms, 20%, 100 kPa."""
    if unit == "%":
        return f"{100 * value:.3g}%"
    return formatting.seconds(value) if unit == "s" else EngFormatter(unit, sep=formatting.GAP if unit else "")(value)


def scale(rows: list[Row], column: str, told: dict) -> Scale:
    """The places that the rows have on this axis, in the order of the study file, worded as it says."""
    listed = [str(float(value)) for value in told.get("values", ())]
    found = list(dict.fromkeys(row[column] for row in rows))
    places = [place for place in listed if place in found] + [place for place in found if place not in listed]
    texts = [worded(float(place), told.get("unit", "")) if _is_number(place) else place for place in places]
    return Scale(told.get("name", column), tuple(places), tuple(texts), told.get("key", ""))


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def stability_charts(rows: list[Row], study: dict) -> list[Chart]:
    """One chart a map; ``study``: the tables of the study file, for the names of the axes."""
    told = {entry.get("name"): entry for entry in study.get("map", ())}
    return [stability_chart(name, group, told.get(name, {})) for name, group in mapped(rows).items()]


def stability_chart(name: str, rows: list[Row], told: dict) -> Chart:
    x, y = scale(rows, "x", told.get("x", {})), scale(rows, "y", told.get("y", {}))
    by_label = grouped(rows, lambda row: row["label"])
    of_cases = set(x.places) == set(by_label)
    panels = {"": rows} if of_cases else by_label
    figure, all_axes = panels_of(len(panels), (len(x.places), len(y.places)), of_cases)
    chart = Chart(f"stability_{name}", KIND, told.get("title") or name, CAPTION, figure)
    for index, (axes, (label, group)) in enumerate(zip(all_axes, panels.items())):
        axes.set_title(label, loc="left", fontsize=10)
        draw(chart, axes, group, x, y)
        if not of_cases:
            draw_limit(axes, group, x, y)
        decorate(axes, x, y, of_cases, left=index % COLUMNS == 0, low=index + COLUMNS >= len(panels))
    has_limit = not of_cases and any(line.get_label() == LIMIT for axes in all_axes for line in axes.lines)
    legend(figure, rows, has_limit)
    heading = "By case" if of_cases else "By method"
    of_methods = [finding(label, group, x, y) for label, group in by_label.items()]
    chart.findings[heading] = by_case(rows, y) if of_cases else of_methods
    return chart


def panels_of(count: int, cells: tuple[int, int], of_cases: bool) -> tuple[Figure, Sequence[Axes]]:
    """Axes for the panels, row by row, and room for a legend below."""
    columns = 1 if of_cases else min(count, COLUMNS)
    lines = -(-count // columns)
    height = max(cells[1] * CELL, 1.2)
    figure = Figure(figsize=(WIDTH, lines * (height + 0.55) + 1.35), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.05, h_pad=0.06, wspace=0.01)
    axes = figure.subplots(lines, columns, squeeze=False, sharex=True, sharey=True).ravel()
    for unused in axes[count:]:
        unused.remove()
    return figure, axes[:count]


def draw(chart: Chart, axes: Axes, rows: list[Row], x: Scale, y: Scale) -> None:
    """The cells of one panel, their marks, and what tells their numbers."""
    here = {(row["x"], row["y"]): row for row in rows}
    values = [
        [OUTCOMES.index(here[i, j]["outcome"]) if known(here.get((i, j))) else math.nan for i in x.places]
        for j in y.places
    ]
    palette = ListedColormap([COLORS[name] for name in OUTCOMES])
    axes.pcolormesh(values, cmap=palette, vmin=-0.5, vmax=len(OUTCOMES) - 0.5, edgecolors="white", linewidth=1)
    shown = [(i, j, row) for (i, j), row in here.items() if known(row)]
    for i, j, row in shown:
        color = "white" if row["outcome"] in DARK else INK
        at = x.places.index(i) + 0.5, y.places.index(j) + 0.5
        behind = {"facecolor": COLORS[row["outcome"]], "edgecolor": "none", "pad": 0.8}  # no line runs through it
        axes.text(*at, mark(row), color=color, fontsize=FONT, ha="center", va="center", zorder=5, bbox=behind)
    look = Look(INK, "s")
    at = [x.places.index(i) + 0.5 for i, _, _ in shown], [y.places.index(j) + 0.5 for _, j, _ in shown]
    chart.mark(axes, *at, [point(row, x, y) for _, _, row in shown], look, markersize=CELL * 72 * 0.9, alpha=0)


def known(row: Row | None) -> bool:
    return row is not None and row["outcome"] in OUTCOMES


def mark(row: Row) -> str:
    """What stands in a cell: iterations a step where all went well."""
    if row["outcome"] in MARKS:
        return MARKS[row["outcome"]]
    count = row["iterations"]
    if count is None:
        return ""
    return f"{count:.0f}" if count < 1000 else f"{count / 1000:.{1 if count < 9950 else 0}f}k"


def point(row: Row, x: Scale, y: Scale) -> Point:
    """The numbers of one cell."""
    text: Callable[[str], str] = str
    places = {} if row["x"] == row["label"] else {x.name: (lambda place: x.texts[x.places.index(place)], row["x"])}
    numbers = places | {
        y.name if y.name != "y" else "case": (lambda place: y.texts[y.places.index(place)], row["y"]),
        "outcome": (text, row["outcome"]),
        "steps done": (formatting.count, row["steps"]),
        "iterations a step": (formatting.count, row["iterations"]),
        "the most of a step": (formatting.count, row["most_iterations"]),
        "cells inverted": (formatting.count, row["inverted"]),
        "shape error": (formatting.error, row["shape_error"]),
        "energy gained [J]": (formatting.plain, row["energy_gained"]),
        "shorter steps": (formatting.count, row["substeps"]),
        "robust steps": (formatting.count, row["fallbacks"]),
        "explicit limit": (formatting.seconds, row["explicit_limit"]),
        "reason": (text, row["reason"]),
    }
    return Point(row["label"], numbers, row["command"])


def draw_limit(axes: Axes, rows: list[Row], x: Scale, y: Scale) -> None:
    """The explicit limit across the axis of time steps, for each place of the other, where it is known."""
    if "time.step" not in (x.key, y.key):
        return
    steps, other, column = (x, y, "y") if x.key == "time.step" else (y, x, "x")
    limits = grouped([row for row in rows if row["explicit_limit"]], lambda row: row[column])
    along, across = [], []
    for index, place in enumerate(other.places):
        at = steps.at(median(row["explicit_limit"] for row in limits[place])) if place in limits else None
        along += [math.nan if at is None else at + 0.5] * 2 + [math.nan]
        across += [index, index + 1, math.nan]
    if all(map(math.isnan, along)):
        return
    points = (along, across) if steps is x else (across, along)
    axes.plot(*points, color="white", linewidth=3.4, solid_capstyle="butt", zorder=3)
    axes.plot(*points, color=INK, linewidth=1.6, solid_capstyle="butt", zorder=3, label=LIMIT)


def decorate(axes: Axes, x: Scale, y: Scale, of_cases: bool, left: bool, low: bool) -> None:
    """Ticks at the middle of each cell, names at the outer panels alone."""
    axes.grid(False)
    axes.tick_params(length=0, labelsize=10 if of_cases else FONT, labelleft=left, labelbottom=low)
    for spine in axes.spines.values():
        spine.set_visible(False)
    texts = [text.replace("-", "-\n") if len(text) > 12 else text for text in x.texts] if of_cases else x.texts
    axes.set_xticks([index + 0.5 for index in range(len(x.places))], texts, rotation=0 if of_cases else 90)
    axes.set_yticks([index + 0.5 for index in range(len(y.places))], y.texts)
    if of_cases:
        axes.invert_yaxis()
        axes.xaxis.tick_top()
    else:
        axes.set_xlabel(x.name if low else "", fontsize=9)
        axes.set_ylabel(y.name if left else "", fontsize=9)


def legend(figure: Figure, rows: list[Row], limit: bool) -> None:
    """The outcomes that there are, best first."""
    names = [name for name in reversed(OUTCOMES) if any(row["outcome"] == name for row in rows)]
    handles = [
        Patch(facecolor=COLORS[name], label=f"{MARKS.get(name, '12')}  {name}: {MEANING[name]}") for name in names
    ]
    handles += [Line2D([], [], color=INK, linewidth=2, label=LIMIT)] if limit else []
    figure.legend(handles=handles, loc="outside lower left", ncols=3, fontsize=8.5, handlelength=1.4, columnspacing=1.4)


def finding(label: str, rows: list[Row], x: Scale, y: Scale) -> str:
    """How a method did, and where it failed, in plain words."""
    counts = Counter(row["outcome"] for row in rows)
    good = counts["ok"] + counts["slow"]
    parts = [f"all {len(rows)} ok" if good == len(rows) else f"{good} of {len(rows)} ok"]
    if counts["slow"]:
        parts[0] += f", {counts['slow']} of them slowly"
    for name in OUTCOMES:
        if counts[name] and name not in ("ok", "slow"):
            lost = [row for row in rows if row["outcome"] == name]
            parts.append(f"{name} in {len(lost)} ({reach(lost, 'x', x)}; {reach(lost, 'y', y)})")
    return f"{label}: {', '.join(parts)}."


def reach(rows: list[Row], column: str, of: Scale) -> str:
    """From where to where, on one axis."""
    at = sorted(of.places.index(row[column]) for row in rows)
    first, last = of.texts[at[0]], of.texts[at[-1]]
    return f"{of.name} {first}" if first == last else f"{of.name} {first} to {last}"


def by_case(rows: list[Row], y: Scale) -> list[str]:
    """Of each case, which methods failed and how."""
    groups = grouped(rows, lambda row: row["y"])
    return [case_finding(y.texts[y.places.index(name)], group) for name, group in groups.items()]


def case_finding(name: str, rows: list[Row]) -> str:
    lost = grouped([row for row in rows if row["outcome"] not in ("ok", "slow")], lambda row: row["outcome"])
    if not lost:
        return f"{name}: every method does it."
    worst_first = sorted(lost, key=OUTCOMES.index)
    told = "; ".join(f"{outcome}: {', '.join(row['label'] for row in lost[outcome])}" for outcome in worst_first)
    return f"{name}: {told}."
