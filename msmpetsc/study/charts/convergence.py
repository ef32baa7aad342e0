"""Convergence within one step: the error over the iterations, and over the seconds."""

import math
from typing import TYPE_CHECKING

from matplotlib.axes import Axes
from matplotlib.ticker import Formatter

from msmpetsc.study import formatting
from msmpetsc.study.charts.style import (
    COUNT,
    ERROR,
    SECONDS,
    Chart,
    Numbers,
    Styles,
    around,
    legend_below,
    log_ticks,
    new_figure,
    title_axes,
)
from msmpetsc.study.table import grouped

if TYPE_CHECKING:
    from pandas import DataFrame

KIND = "Convergence within one step"
CAPTION = (
    "One step, followed iterate by iterate. Both horizontal axes start at 0 and are logarithmic from their second "
    "number on. Of several cases of a method the one that went furthest is shown."
)
MANY = 40  # iterates: where there are more, their markers are smaller
ITERATE = ("iteration", "ksp_its", "seconds", "position_error", "energy_error")
NUMBERS: Numbers = {
    "iteration": (formatting.count, "iteration"),
    "computing time": (formatting.seconds, "seconds"),
    "step error": (formatting.error, "position_error"),
    "energy error": (formatting.error, "energy_error"),
    "KSP iterations": (formatting.count, "ksp_its"),
}


def iterates(entry: dict, commands: dict[str, str]) -> "DataFrame":
    """Return a trace as a row an iterate; those without a positive error are left out."""
    from pandas import DataFrame, to_numeric

    trace = entry["trace"]
    length = len(trace.get("position_error") or [])
    columns = {name: (trace.get(name) or [None] * length)[:length] for name in ITERATE}
    rows = DataFrame(columns, dtype=object).apply(to_numeric, errors="coerce").astype(float)
    rows = rows.assign(label=entry["label"], command=commands.get(entry.get("case", ""), ""))
    return rows[(rows["position_error"] > 0) & (rows["position_error"] < 1e300)]


def convergence_charts(traces: list[dict], styles: Styles, commands: dict[str, str]) -> list[Chart]:
    """Return one chart for each scene with traces; ``commands``: by case, for traces that name theirs."""
    charts = []
    for scene in dict.fromkeys(entry["scene"] for entry in traces):
        entries = [entry for entry in traces if entry["scene"] == scene]
        curves = furthest([iterates(entry, commands) for entry in entries])
        frames = {entry["trace"].get("frame") for entry in entries}
        if curves:
            charts.append(convergence_chart(scene, frames, curves, styles))
    return charts


def furthest(curves: list["DataFrame"]) -> dict[str, "DataFrame"]:
    """Return the trace of each method that ends with the least error: cases of looser targets are parts of it."""
    best: dict[str, DataFrame] = {}
    for curve in curves:
        for label, rows in grouped(curve, "label").items():
            if label not in best or rows["position_error"].iloc[-1] < best[label]["position_error"].iloc[-1]:
                best[label] = rows
    return best


def convergence_chart(scene: str, frames: set, curves: dict[str, "DataFrame"], styles: Styles) -> Chart:
    """Return two panels with one vertical scale."""
    handles = {label: styles[label].handle() for label in curves}
    figure, axes = new_figure(2, list(handles))
    step = f", step {frames.pop()}" if len(frames) == 1 else ""
    chart = Chart(f"convergence_{scene}", KIND, f"{KIND}: {scene}{step}", CAPTION, figure)
    y_label = "true step error |x \N{MINUS SIGN} x*| / |y \N{MINUS SIGN} x*|"
    title_axes(axes[0], "over the iterations", "iteration", y_label)
    title_axes(axes[1], "over the computing time", "computing time within the step", y_label)
    draw_panel(chart, axes[0], curves, styles, column="iteration", tick=COUNT)
    draw_panel(chart, axes[1], curves, styles, column="seconds", tick=SECONDS)
    legend_below(figure, handles)
    return chart


def draw_panel(
    chart: Chart, axes: Axes, curves: dict[str, "DataFrame"], styles: Styles, *, column: str, tick: Formatter
) -> None:
    """Draw the error over a column."""
    shown = {label: rows.dropna(subset=[column]) for label, rows in curves.items()}
    axes.set_yscale("log")
    errors = [error for rows in shown.values() for error in rows["position_error"]]
    if errors:
        axes.set_ylim(around(errors))
        log_ticks(axes.yaxis, around(errors), ERROR)
    axis_from_zero(axes, [value for rows in shown.values() for value in rows[column]], tick)
    for label, rows in shown.items():
        style = styles[label]
        size = style.size if len(rows) <= MANY else style.size / 2
        columns = column, "position_error"
        chart.curve(axes, rows, columns, style, numbers=NUMBERS, linewidth=1.4, markersize=size)


def axis_from_zero(axes: Axes, values: list[float], formatter: Formatter) -> None:
    """Make an axis with 0 at the left, logarithmic from the decade of the least positive value on.

    Methods differ by powers of ten.
    """
    positive = [value for value in values if value > 0]
    if positive:
        first = 10.0 ** math.floor(math.log10(min(positive)))
        axes.set_xscale("symlog", linthresh=first, linscale=0.6)
        decades = round(math.log10(max(positive) / first)) + 1
        steps = (1, 2, 5) if decades <= 2 else (1,)
        axes.set_xticks([0, *(first * 10**decade * step for decade in range(decades) for step in steps)])
        axes.set_xlim(-0.15 * first, 1.3 * max(positive))
    axes.xaxis.set_major_formatter(formatter)
