"""Convergence within one step: the error over the iterations, and over the seconds."""

import math
from collections.abc import Sequence
from typing import NamedTuple

from matplotlib.axes import Axes

from msmpetsc.study import formatting
from msmpetsc.study.charts.chart import Chart, Point, handle, legend_below, new_figure
from msmpetsc.study.charts.style import COUNT, ERROR, SECONDS, Look, around, log_ticks
from msmpetsc.study.rows import grouped

KIND = "Convergence within one step"
CAPTION = (
    "One step, followed iterate by iterate. Both horizontal axes start at 0 and are logarithmic from their second "
    "number on. Of several cases of a method the one that went furthest is shown."
)
MANY = 40  # iterates: where there are more, their marks are smaller
Iterate = dict[str, float | None]


class Curve(NamedTuple):
    """One trace; command: empty where its case is not known."""

    label: str
    iterates: list[Iterate]
    command: str


def iterates(trace: dict) -> list[Iterate]:
    """A trace as one dict an iterate; those without a positive error are left out."""
    names = ("iteration", "ksp_its", "seconds", "position_error", "energy_error")
    length = len(trace.get("position_error") or [])
    full = {name: (trace.get(name) or [None] * length)[:length] for name in names}
    rows = [dict(zip(full, values)) for values in zip(*full.values())]
    return [row for row in rows if isinstance(row["position_error"], int | float) and 0 < row["position_error"] < 1e300]


def convergence_charts(traces: list[dict], looks: dict[str, Look], commands: dict[str, str]) -> list[Chart]:
    """One chart for each scene with traces; commands: by case, for traces that name theirs."""
    charts = []
    for scene, entries in grouped(traces, lambda entry: entry["scene"]).items():
        curves = furthest([curve_of(entry, commands) for entry in entries])
        frames = {entry["trace"].get("frame") for entry in entries}
        if curves:
            charts.append(convergence_chart(scene, frames, curves, looks))
    return charts


def curve_of(entry: dict, commands: dict[str, str]) -> Curve:
    return Curve(entry["label"], iterates(entry["trace"]), commands.get(entry.get("case", ""), ""))


def furthest(curves: list[Curve]) -> list[Curve]:
    """Of each method the trace that ends with the least error: cases of other targets are parts of it."""
    by_label = grouped((curve for curve in curves if curve.iterates), lambda curve: curve.label)
    return [min(group, key=lambda curve: curve.iterates[-1]["position_error"]) for group in by_label.values()]


def convergence_chart(scene: str, frames: set, curves: list[Curve], looks: dict[str, Look]) -> Chart:
    """Two panels with one vertical scale."""
    handles = {curve.label: handle(looks[curve.label]) for curve in curves}
    figure, axes = new_figure(2, list(handles))
    step = f", step {frames.pop()}" if len(frames) == 1 else ""
    chart = Chart(f"convergence_{scene}", KIND, f"{KIND}: {scene}{step}", CAPTION, figure)
    draw(chart, axes[0], "iteration", "over the iterations", "iteration", curves, looks)
    draw(chart, axes[1], "seconds", "over the computing time", "computing time within the step", curves, looks)
    legend_below(figure, handles)
    return chart


def draw(
    chart: Chart, axes: Axes, column: str, title: str, x_label: str, curves: list[Curve], looks: dict[str, Look]
) -> None:
    """One panel."""
    axes.set_title(title, loc="left")
    axes.set_xlabel(x_label)
    axes.set_ylabel("true step error |x − x*| / |y − x*|")
    shown = [(curve, [row for row in curve.iterates if row[column] is not None]) for curve in curves]
    error_axis(axes, [row["position_error"] for _, rows in shown for row in rows])
    tick = COUNT if column == "iteration" else SECONDS
    axis_from_zero(axes, [row[column] for _, rows in shown for row in rows], tick)
    for curve, rows in shown:
        look = looks[curve.label]
        x, y = [row[column] for row in rows], [row["position_error"] for row in rows]
        size = look.size if len(rows) <= MANY else look.size / 2
        axes.plot(x, y, color=look.color, linewidth=1.4)
        chart.mark(axes, x, y, [point(curve, row) for row in rows], look, markersize=size)


def error_axis(axes: Axes, errors: Sequence[float]) -> None:
    axes.set_yscale("log")
    if errors:
        axes.set_ylim(around(errors))
        log_ticks(axes.yaxis, around(errors), ERROR)


def axis_from_zero(axes: Axes, values: Sequence[float], formatter) -> None:
    """0 at the left, logarithmic from the decade of the least positive value on: methods differ by powers of ten."""
    positive = [value for value in values if value > 0]
    if positive:
        first = 10.0 ** math.floor(math.log10(min(positive)))
        axes.set_xscale("symlog", linthresh=first, linscale=0.6)
        decades = round(math.log10(max(positive) / first)) + 1
        steps = (1, 2, 5) if decades <= 2 else (1,)
        axes.set_xticks([0, *(first * 10**decade * step for decade in range(decades) for step in steps)])
        axes.set_xlim(-0.15 * first, 1.3 * max(positive))
    axes.xaxis.set_major_formatter(formatter)


def point(curve: Curve, row: Iterate) -> Point:
    """The numbers of one iterate."""
    numbers = {
        "iteration": (formatting.count, row["iteration"]),
        "computing time": (formatting.seconds, row["seconds"]),
        "step error": (formatting.error, row["position_error"]),
        "energy error": (formatting.error, row["energy_error"]),
        "KSP iterations": (formatting.count, row["ksp_its"]),
    }
    return Point(curve.label, numbers, curve.command)
