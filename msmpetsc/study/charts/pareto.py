"""Speed against accuracy: computing time over the errors of step, trajectory and surface.

The two errors are never mixed. The step error says how far a step is from the exact minimiser of its energy: methods
can be compared by it where the time step is the same. The trajectory error says how far the run is from the true motion
of the lattice: explicit and implicit runs of any time step can be compared by it.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from pandas import DataFrame, concat

from msmpetsc.study import formatting
from msmpetsc.study.charts.plot import (
    COUNT,
    ERROR,
    INK,
    RING,
    SECONDS,
    Chart,
    CurveStyle,
    Styles,
    log_axis,
    points,
)
from msmpetsc.study.table import ONCE_NOTE, Row, grouped, is_repeated, measured, reach, records, spread, succeeded

KIND = "Speed against accuracy"
LEVELS = (1e-1, 1e-2, 1e-3, 1e-6)
FRONT = "Pareto front"
CAPTION = (
    "Lower is faster, further left is more exact. A line joins a method's own best points; its other measurements are "
    "small and hollow. Whiskers reach from the least to the greatest of the repeats, whose median is the point. Ringed "
    "points on the grey stair are the Pareto front: nothing measured is both cheaper and more exact, errors taken to "
    "two digits. The step error is that of solving a step; the trajectory error is that of the "
    "whole motion, time step included."
)


STEPPING = ("time_step", "substep")
TOLD = ("least", "greatest", *STEPPING, "error", "max_iterations", "iterations", "ranks")


class ErrorMeasure(NamedTuple):
    """A panel: the columns of an error and of what it costs, and their words."""

    error: str
    cost: str
    name: str
    x_label: str
    y_label: str

    @property
    def columns(self) -> tuple[str, str]:
        return self.error, self.cost


STEP = ErrorMeasure(
    error="true_error",
    cost="time_frame",
    name="step error",
    x_label="true step error |x \N{MINUS SIGN} x*| / |y \N{MINUS SIGN} x*|, rms over steps",
    y_label="computing time a frame",
)
TRAJECTORY = ErrorMeasure(
    error="trajectory_error",
    cost="time_second",
    name="trajectory error",
    x_label="trajectory error against a reference with a tiny step",
    y_label="computing time a simulated second",
)


def front(x: Sequence[float], y: Sequence[float]) -> list[int]:
    """Return the points that no other beats: none is at most as great in both and smaller in one.

    They come by rising x.
    """
    across, down = np.subtract.outer(x, x), np.subtract.outer(y, y)  # of a row's point from a column's
    beaten = ((across >= 0) & (down >= 0) & ((across > 0) | (down > 0))).any(axis=1)
    return [int(index) for index in np.lexsort((y, x)) if not beaten[index]]


def front_rows(rows: DataFrame, measure: ErrorMeasure) -> DataFrame:
    """Return the front of measured rows, by rising error.

    Errors that read alike, to two digits, count as equal: no step can better the trajectory error
    of its time step but in the last digits, and those are no reason to pay more.
    """
    return rows.iloc[front([float(f"{error:.1e}") for error in rows[measure.error]], list(rows[measure.cost]))]


def cheapest(rows: DataFrame, measure: ErrorMeasure, level: float) -> Row | None:
    """Return the measured row of the least cost with an error of at most this level; None where nothing reaches it."""
    reached = measured(rows, *measure.columns)
    reached = reached[reached[measure.error] <= level]
    best = reached.assign(**spread(reached, measure.cost)).sort_values(measure.cost, kind="stable").head(1)
    return next(iter(records(best)), None)


def pareto_charts(table: DataFrame, styles: Styles) -> list[Chart]:
    """Return one chart for each scene, and for each of its cell counts where a method was swept."""
    charts = []
    for scene, rows in grouped(table, "scene").items():
        sizes = grouped(succeeded(rows), "cells")
        swept = {cells: group for cells, group in sizes.items() if len(sizes) == 1 or group["label"].duplicated().any()}
        for cells, group in swept.items():
            name = f"pareto_{scene}" if len(swept) == 1 else f"pareto_{scene}_{formatting.plain(cells)}"
            title = f"{KIND}: {scene}, {formatting.count(cells)} cells" if cells > 0 else f"{KIND}: {scene}"
            charts.append(pareto_chart(name, title, group, styles))
    return [chart for chart in charts if chart.panels]


def pareto_chart(name: str, title: str, rows: DataFrame, styles: Styles) -> Chart:
    """Return the panels that have data."""
    step = measured(rows, *STEP.columns)
    of_steps = grouped(step, "time_step").values()  # only those of one compare by time a frame
    step = max(of_steps, key=lambda group: (len(group), group["time_step"].fillna(0).iloc[0]), default=step)
    panels = [(STEP, step), (TRAJECTORY, measured(rows, *TRAJECTORY.columns))]
    panels = [(measure, shown) for measure, shown in panels if len(shown)]
    labels = dict.fromkeys(label for _, shown in panels for label in shown["label"])
    legend = {label: styles[label] for label in labels} | {FRONT: CurveStyle(INK, RING)}
    chart = Chart(name, KIND, title, CAPTION, legend)
    for measure, shown in panels:
        draw_panel(chart, shown, measure)
        lines = [cheapest_line(measure, level, cheapest(shown, measure, level)) for level in LEVELS]
        chart.findings[f"The cheapest by {measure.name}"] = lines + ([] if is_repeated(shown) else [ONCE_NOTE])
    return chart


def draw_panel(chart: Chart, rows: DataFrame, measure: ErrorMeasure) -> None:
    """Draw the front, over it a line through each method's best points, the others hollow."""
    step = formatting.worded("time_step", rows["time_step"].iloc[0])
    at_step = f", time step {step}" if measure is STEP and step else ""
    x = log_axis(measure.x_label, rows[measure.error], ERROR)
    y = log_axis(measure.y_label, reach(rows, measure.cost).to_numpy().ravel(), SECONDS)
    panel = chart.panel(f"over the {measure.name}{at_step}", x, y)
    front = front_rows(rows, measure)
    (_, right), (_, top) = x["scale"]["domain"], y["scale"]["domain"]
    errors, costs = list(front[measure.error]), list(front[measure.cost])
    panel.line([errors[0], *errors, right], [top, *costs, costs[-1]], interpolate="step-after", strokeWidth=1.2)
    rows = rows.join(spread(rows, measure.cost))
    best = concat([front_rows(group, measure) for group in grouped(rows, "label").values()])
    told = (*measure.columns, *TOLD)
    panel.whiskers(rows, measure.columns)
    panel.mark(points(rows.drop(best.index), measure.columns, told), hollow=True)
    panel.curves(best, measure.columns, told)
    panel.rings(front, measure.columns)


def cheapest_line(measure: ErrorMeasure, level: float, row: Row | None) -> str:
    """Say which case is the cheapest that reached this level."""
    start = f"{formatting.error(level)} or less:"
    if row is None:
        return f"{start} nothing measured reaches it."
    unit = measure.y_label.removeprefix("computing time ")
    told = ", ".join(filter(None, (formatting.entry(row, name) for name in (measure.error, "error", *STEPPING))))
    return f"{start} {row['label']}, {cost_of(row, measure)} {unit} ({told})."


def cost_of(row: Row, measure: ErrorMeasure) -> str:
    """Return 34 ms, or with the range of the repeats 34 ms [31 ms to 40 ms]."""
    cost = formatting.seconds(row[measure.cost])
    if row["least"] is None:
        return cost
    return f"{cost} [{formatting.seconds(row['least'])} to {formatting.seconds(row['greatest'])}]"


# The error of the surface over what it costs

SIZES = "Surface error over cost"
SIZES_CAPTION = (
    "Lower is more exact, further left is cheaper. The surface error is how far the surface is from that of a run of "
    "many more cells and shorter steps, rms over the surface and time, of its largest displacement: cells, time step "
    "and unfinished steps together. A line joins the cells of one way to step, few at its left end; ringed is the "
    "Pareto front. What an error takes is read off these lines, between two points by their logarithms."
)
SIZE = ("time_second", "surface_error")


def size_charts(table: DataFrame, styles: Styles) -> list[Chart]:
    """Return a chart of all scenes with surface errors: a curve a way to step, over cost and over cells."""
    scenes = grouped(measured(succeeded(table), *SIZE), "scene")
    if not scenes:
        return []
    own = {label: styles[label] for label in dict.fromkeys(concat(scenes.values())["label"])}
    chart = Chart("size", SIZES, SIZES, SIZES_CAPTION, own, columns=2, height=200)
    if len(scenes) == 1:
        chart.name += f"_{next(iter(scenes))}"
        chart.title += f": {next(iter(scenes))}"
    for scene, rows in scenes.items():
        draw_sizes(chart, scene, rows.sort_values("cells", kind="stable"))
        lines = [what_takes(rows, level) for level in (0.1, 0.03, 0.01)]
        chart.findings[f"What an error of the surface takes: {scene}"] = lines
    return [chart]


def draw_sizes(chart: Chart, scene: str, rows: DataFrame) -> None:
    """Draw a scene's two panels."""
    y = log_axis("surface error", rows["surface_error"], ERROR)
    over_cost = chart.panel(scene, log_axis(TRAJECTORY.y_label, rows["time_second"], SECONDS), y)
    over_cost.rings(rows.iloc[front(list(rows["time_second"]), list(rows["surface_error"]))], SIZE)
    over_cells = chart.panel("", log_axis("valid cells", rows["cells"], COUNT), y)
    for panel, columns in ((over_cost, SIZE), (over_cells, ("cells", "surface_error"))):
        panel.curves(rows, columns, (*columns[::-1], "cells", "time_step", "error"))


def what_takes(rows: DataFrame, level: float) -> str:
    """Say how many cells and what time each way to step takes for an error."""
    curves = ", ".join(f"{label} {reached(of, level)}" for label, of in grouped(rows, "label").items())
    return f"{100 * level:g}%: {curves}."


def reached(rows: DataFrame, level: float) -> str:
    """Return the cells and the cost from which on a curve, by rising cells, is below a level."""
    above = np.flatnonzero(rows["surface_error"] > level)
    if len(above) == 0:
        cells, seconds = rows.iloc[0][["cells", "time_second"]]
        return f"{formatting.count(cells)} cells or fewer ({formatting.seconds(seconds)})"
    if above[-1] + 1 == len(rows):
        return f"more than {formatting.count(rows['cells'].iloc[-1])} cells"
    between = rows.iloc[[above[-1] + 1, above[-1]]][["surface_error", "cells", "time_second"]]
    logs = np.log(between.to_numpy(float)).T
    cells, seconds = (float(np.exp(np.interp(np.log(level), logs[0], column))) for column in logs[1:])
    return f"{formatting.count(round(cells))} cells ({formatting.seconds(seconds)})"
