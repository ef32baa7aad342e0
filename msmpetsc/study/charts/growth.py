"""Growth: what a cell costs as their number rises, in time, in memory and in KSP iterations."""

from collections.abc import Callable
from dataclasses import dataclass
from operator import itemgetter

from matplotlib.axes import Axes
from matplotlib.ticker import Formatter

from msmpetsc.study import formatting
from msmpetsc.study.charts.cells import curves, file_name, sweeps, titled
from msmpetsc.study.charts.chart import Chart, Point, handle, legend_below, new_figure, repeats
from msmpetsc.study.charts.figure6 import line_styles
from msmpetsc.study.charts.style import BYTES, COUNT, SECONDS, Look, log_axes
from msmpetsc.study.rows import Row, failed, measured
from msmpetsc.study.spread import ends

KIND = "Growth with the number of cells"
CAPTION = (
    "A level curve means a cost in proportion to the cells; a rising one grows faster than the body. Memory is the "
    "peak of all ranks, the program itself and the surface mesh included. Whiskers reach from the least to the "
    "greatest of the repeats."
)


@dataclass(frozen=True)
class Quantity:
    """One panel."""

    title: str
    column: str
    value: Callable[[Row], float]
    tick: Formatter
    word: Callable[[float], str]


def a_cell(column: str) -> Callable[[Row], float]:
    return lambda row: row[column] / row["cells"]


QUANTITIES = (
    Quantity("time a frame and cell", "time_frame", a_cell("time_frame"), SECONDS, formatting.seconds),
    Quantity("memory a cell", "memory", a_cell("memory"), BYTES, formatting.size),
    Quantity("KSP iterations a step", "ksp_its", itemgetter("ksp_its"), COUNT, formatting.count),
)


def growth_charts(rows: list[Row], looks: dict[str, Look]) -> list[Chart]:
    """One chart for each scene that was swept over cells."""
    groups = sweeps(measured(rows, "cells"))
    charts = []
    for (scene, time_step), group in groups.items():
        chart = growth_chart(file_name("growth", scene, time_step, groups), scene, time_step, group, looks)
        if chart:
            chart.failed = failed(row for row in rows if row["scene"] == scene)
            charts.append(chart)
    return charts


def growth_chart(
    name: str, scene: str, time_step: float | None, rows: list[Row], looks: dict[str, Look]
) -> Chart | None:
    """The panels that have data; None where none has."""
    panels = [(quantity, measured(rows, quantity.column)) for quantity in QUANTITIES]
    panels = [(quantity, shown) for quantity, shown in panels if shown]
    if not panels:
        return None
    by_curve = curves(rows)
    lines = line_styles(by_curve)
    handles = {curve: handle(looks[group[0]["label"]], lines[curve]) for curve, group in by_curve.items()}
    figure, axes = new_figure(len(panels), list(handles))
    chart = Chart(name, KIND, titled("Growth with cells", scene, time_step), CAPTION, figure)
    for ax, (quantity, shown) in zip(axes, panels):
        ax.set_title(quantity.title, loc="left")
        ax.set_xlabel("valid cells (k: thousand, M: million)")
        values = [end for row in shown for end in ends(row, quantity.value)]
        log_axes(ax, [row["cells"] for row in shown], values, COUNT, quantity.tick)
        for curve, group in by_curve.items():
            known = measured(group, quantity.column)
            draw_curve(chart, ax, quantity, curve, known, looks[group[0]["label"]], lines[curve])
    legend_below(figure, handles)
    return chart


def draw_curve(
    chart: Chart, axes: Axes, quantity: Quantity, curve: str, rows: list[Row], look: Look, line: str
) -> None:
    """One curve of one panel."""
    cells, values = [row["cells"] for row in rows], [quantity.value(row) for row in rows]
    axes.plot(cells, values, line, color=look.color)
    if quantity.column == "time_frame":
        chart.whiskers(axes, cells, rows, quantity.value, look)
    chart.mark(axes, cells, values, [point(row, curve, quantity, value) for row, value in zip(rows, values)], look)


def point(row: Row, curve: str, quantity: Quantity, value: float) -> Point:
    """The numbers of one point."""
    numbers = {
        "valid cells": (formatting.count, row["cells"]),
        quantity.title: (quantity.word, value),
        "computing time a frame": (formatting.seconds, row["time_frame"]),
        **repeats(row, itemgetter("time_frame"), formatting.seconds),
        "memory": (formatting.size, row["memory"]),
        "KSP iterations a step": (formatting.count, row["ksp_its"]),
        "true step error": (formatting.error, row["true_error"]),
        "set-up": (formatting.seconds, row["time_setup"]),
        "factorisation": (formatting.seconds, row["time_factor"]),
        "ranks": (formatting.count, row["ranks"]),
    }
    return Point(curve, numbers, row["command"])
