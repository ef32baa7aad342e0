"""The error of the surface over what it costs: of a study's lattices and steps, and of the trials of a plan."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib.style
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from msmpetsc.study import formatting
from msmpetsc.study.charts.pareto import front
from msmpetsc.study.charts.style import (
    ERROR,
    FAINT,
    INK,
    RC,
    SECONDS,
    Chart,
    Numbers,
    Styles,
    curve_styles,
    legend_below,
    log_axes,
    new_figure,
    save_png,
    title_axes,
)
from msmpetsc.study.table import failed, grouped, measured, records, succeeded

if TYPE_CHECKING:
    from pandas import DataFrame

    from msmpetsc.study.sizing.answer import SizePlan

KIND = "Surface error over cost"
COST, SURFACE_ERROR = "computing time a simulated second", "surface error"
CAPTION = (
    "Lower is more exact, further left is cheaper. The surface error is how far the surface is from that of a run of "
    "many more cells and shorter steps, rms over the surface and time, of its largest displacement: cells, time step "
    "and unfinished steps together. A line joins the cells of one way to step, few at its left end."
)
COLUMNS = "time_second", "surface_error"
NUMBERS: Numbers = {
    SURFACE_ERROR: (formatting.error, "surface_error"),
    COST: (formatting.seconds, "time_second"),
    "cells": (formatting.count, "cells"),
    "time step": (formatting.seconds, "time_step"),
    "error asked for": (formatting.error, "error"),
}
RING: dict[str, Any] = {"markersize": 13, "markerfacecolor": "none", "markeredgecolor": INK, "markeredgewidth": 1.2}


def size_charts(table: "DataFrame", styles: Styles) -> list[Chart]:
    """Return one chart for each scene with surface errors."""
    charts = []
    for scene, rows in grouped(table, "scene").items():
        shown = measured(succeeded(rows), *COLUMNS)
        if len(shown):
            chart = size_chart(scene, shown, styles)
            chart.failed = records(failed(rows))
            charts.append(chart)
    return charts


def size_chart(scene: str, rows: "DataFrame", styles: Styles) -> Chart:
    """Return a curve a way to step, over its numbers of cells; what nothing else beats is ringed."""
    labels = list(dict.fromkeys(rows["label"]))
    figure, (axes,) = new_figure(1, labels)
    chart = Chart(f"size_{scene}", KIND, f"{KIND}: {scene}", CAPTION, figure)
    title_axes(axes, scene, COST, SURFACE_ERROR)
    log_axes(axes, rows["time_second"], rows["surface_error"], (SECONDS, ERROR))
    for label, group in grouped(rows, "label").items():
        chart.curve(axes, group.sort_values("cells", kind="stable"), COLUMNS, styles[label], numbers=NUMBERS)
    best = rows.iloc[front(list(rows["time_second"]), list(rows["surface_error"]))]
    axes.plot(best["time_second"], best["surface_error"], "o", zorder=5, **RING)
    legend_below(figure, {label: styles[label].handle() for label in labels})
    least = {label: records(group.nsmallest(1, "surface_error"))[0] for label, group in grouped(rows, "label").items()}
    chart.findings["The smallest surface error"] = [
        f"{label}: {formatting.error(row['surface_error'])} with {formatting.count(row['cells'])} cells."
        for label, row in least.items()
    ]
    return chart


# A plan


def plan_picture(plan: "SizePlan", target: float, path: Path) -> None:
    """Write a PNG of the trials' expected errors over their costs, by integrator; the choice is ringed."""
    choice = plan.choice
    styles = curve_styles(sorted({trial.method for trial in plan.tried}))
    with matplotlib.style.context(["default", RC]):
        figure, (axes,) = new_figure(1, list(styles))
        chart = Chart(path.stem, KIND, f"{KIND}: the trials of a plan", "", figure)
        title_axes(axes, "tried, and ringed what is chosen", COST, f"{SURFACE_ERROR}, estimated")
        points = [(trial.cost, trial.error) for trial in plan.tried] + [(choice.cost, choice.budget.total)]
        costs, errors = zip(*points, strict=True)
        log_axes(axes, costs, [*errors, target], (SECONDS, ERROR))
        for trial in plan.tried:
            style = styles[trial.method]
            axes.plot(trial.cost, trial.error, style.marker, color=style.color, markersize=style.size, clip_on=False)
            _say(axes, f" {formatting.count(trial.cells)}", trial.cost, trial.error)
        axes.plot(choice.cost, choice.budget.total, "o", zorder=5, clip_on=False, **RING)
        axes.axhline(target, color=FAINT, linestyle="--", zorder=2)
        handles = {name: style.handle("none") for name, style in styles.items()}
        handles["asked for"] = Line2D([], [], color=FAINT, linestyle="--")
        legend_below(figure, handles)
        save_png(chart, path.parent)


def _say(axes: Axes, text: str, x: float, y: float) -> None:
    axes.annotate(text, (x, y), fontsize=7, color=FAINT, xytext=(3, 3), textcoords="offset points")
