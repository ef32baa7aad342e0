"""Speed against accuracy: computing time over the step error, and over the trajectory error, in two panels.

The two errors are never mixed. The step error says how far a step is from the exact minimiser of its energy: methods
can be compared by it where the time step is the same. The trajectory error says how far the run is from the true motion
of the lattice: explicit and implicit runs of any time step can be compared by it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from msmpetsc.study import formatting
from msmpetsc.study.charts.plot import ERROR, INK, RING, SECONDS, Chart, CurveStyle, Numbers, Panel, Styles, log_axis
from msmpetsc.study.table import (
    ONCE_NOTE,
    Row,
    grouped,
    is_repeated,
    measured,
    reach,
    records,
    spread,
    succeeded,
    within_noise,
)

if TYPE_CHECKING:
    from pandas import DataFrame

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


@dataclass(frozen=True)
class ErrorMeasure:
    """A panel: the columns of an error and of what it costs, and their words."""

    error: str
    cost: str
    name: str
    x_label: str
    y_label: str
    unit: str

    @property
    def columns(self) -> tuple[str, str]:
        """The columns of both axes."""
        return self.error, self.cost

    @property
    def numbers(self) -> Numbers:
        """Numbers that a point tells of itself; its rows have the spread of their cost."""
        return {
            self.name: (formatting.error, self.error),
            self.y_label: (formatting.seconds, self.cost),
            "least of the repeats": (formatting.seconds, "least"),
            "greatest of the repeats": (formatting.seconds, "greatest"),
            "time step": (formatting.seconds, "time_step"),
            "substep": (formatting.seconds, "substep"),
            "error asked for": (formatting.error, "error"),
            "most iterations": (formatting.count, "max_iterations"),
            "iterations a step": (formatting.count, "iterations"),
            "ranks": (formatting.count, "ranks"),
        }


STEP = ErrorMeasure(
    error="true_error",
    cost="time_frame",
    name="step error",
    x_label="true step error |x \N{MINUS SIGN} x*| / |y \N{MINUS SIGN} x*|, rms over steps",
    y_label="computing time a frame",
    unit="a frame",
)
TRAJECTORY = ErrorMeasure(
    error="trajectory_error",
    cost="time_second",
    name="trajectory error",
    x_label="trajectory error against a reference with a tiny step",
    y_label="computing time a simulated second",
    unit="a simulated second",
)


# What is best


def front(x: Sequence[float], y: Sequence[float]) -> list[int]:
    """Return indices of the points that no other beats: none is at most as great in both and smaller in one.

    They come by rising x.
    """
    best: list[int] = []
    lowest = float("inf")
    for index in sorted(range(len(x)), key=lambda i: (x[i], y[i])):
        twin = bool(best) and (x[best[-1]], y[best[-1]]) == (x[index], y[index])
        if y[index] < lowest or twin:
            best.append(index)
            lowest = y[index]
    return best


def front_rows(rows: "DataFrame", measure: ErrorMeasure) -> "DataFrame":
    """Return the front of measured rows, by rising error.

    Errors that read alike, to two digits, count as equal: no step can better the trajectory error of its time step but
    in the last digits, and those are no reason to pay more.
    """
    return rows.iloc[front([float(f"{error:.1e}") for error in rows[measure.error]], list(rows[measure.cost]))]


def winners(rows: "DataFrame", measure: ErrorMeasure, level: float) -> list[Row]:
    """Return the cheapest row with an error of at most this level, then those that its repeats do not tell from it.

    Nothing is interpolated; each method comes once; nothing comes where nothing reaches the level.
    """
    reached = measured(rows, *measure.columns)
    reached = reached[reached[measure.error] <= level]
    if reached.empty:
        return []
    reached = reached.assign(**spread(reached, measure.cost))
    first = reached[measure.cost].idxmin()
    best = records(reached.loc[[first]])
    if is_repeated(reached.loc[[first]]):
        best += records(within_noise(reached, first, measure.cost))
    return best


# The charts


def pareto_charts(table: "DataFrame", styles: Styles) -> list[Chart]:
    """Return one chart for each scene, and for each of its cell counts where a method was swept."""
    charts = []
    for scene, rows in grouped(table, "scene").items():
        sizes = grouped(succeeded(rows), "cells")
        swept = {cells: group for cells, group in sizes.items() if len(sizes) == 1 or group["label"].duplicated().any()}
        for cells, group in swept.items():
            name = f"pareto_{scene}" if len(swept) == 1 else f"pareto_{scene}_{formatting.plain(cells)}"
            title = f"{KIND}: {scene}, {formatting.count(cells)} cells" if cells > 0 else f"{KIND}: {scene}"
            chart = pareto_chart(name, title, group, styles)
            charts += [chart] if chart else []
    return charts


def pareto_chart(name: str, title: str, rows: "DataFrame", styles: Styles) -> Chart | None:
    """Return the panels that have data; None where neither has."""
    step, trajectory = common_time_step(measured(rows, *STEP.columns)), measured(rows, *TRAJECTORY.columns)
    panels = [(measure, shown) for measure, shown in ((STEP, step), (TRAJECTORY, trajectory)) if len(shown)]
    if not panels:
        return None
    labels = dict.fromkeys(label for _, shown in panels for label in shown["label"])
    legend = {label: styles[label] for label in labels} | {FRONT: CurveStyle(INK, RING)}
    chart = Chart(name, KIND, title, CAPTION, legend)
    for measure, shown in panels:
        draw_panel(chart, shown, measure)
        lines = [cheapest_line(measure, level, winners(shown, measure, level)) for level in LEVELS]
        chart.findings[f"The cheapest by {measure.name}"] = lines + ([] if is_repeated(shown) else [ONCE_NOTE])
    return chart


def common_time_step(rows: "DataFrame") -> "DataFrame":
    """Return the rows of the time step with the most of them, the longer of two: only they compare by time a frame."""
    groups = grouped(rows, "time_step")
    return max(groups.values(), key=lambda group: (len(group), group["time_step"].fillna(0).iloc[0]), default=rows)


def draw_panel(chart: Chart, rows: "DataFrame", measure: ErrorMeasure) -> None:
    """Draw a panel: the front first, the methods over it."""
    step = formatting.seconds(rows["time_step"].iloc[0])
    at_step = f", time step {step}" if measure is STEP and step else ""
    x = log_axis(measure.x_label, rows[measure.error], ERROR)
    y = log_axis(measure.y_label, reach(rows, measure.cost).to_numpy().ravel(), SECONDS)
    panel = chart.panel(f"over the {measure.name}{at_step}", x, y)
    front = front_rows(rows, measure)
    (_, right), (_, top) = x["scale"]["domain"], y["scale"]["domain"]
    errors, costs = list(front[measure.error]), list(front[measure.cost])
    panel.line([errors[0], *errors, right], [top, *costs, costs[-1]], interpolate="step-after", strokeWidth=1.2)
    for group in grouped(rows.join(spread(rows, measure.cost)), "label").values():
        draw_method(panel, group, measure)
    panel.rings(front, measure.columns)


def draw_method(panel: Panel, rows: "DataFrame", measure: ErrorMeasure) -> None:
    """Draw a line through a method's own best points, and its other ones small and hollow."""
    best = front_rows(rows, measure)
    color = panel.styles[rows["label"].iloc[0]].color
    panel.whiskers(rows, measure.columns, color)
    panel.curve(best, measure.columns, measure.numbers)
    panel.mark(rows.drop(best.index), measure.columns, measure.numbers, fill="white", stroke=color, size=35)


# In words


def cheapest_line(measure: ErrorMeasure, level: float, best: list[Row]) -> str:
    """Say which method is the cheapest that reached this level, and which may be just as cheap."""
    start = f"{formatting.error(level)} or less:"
    if not best:
        return f"{start} nothing measured reaches it."
    row, *near = best
    reached = formatting.error(row[measure.error])
    step = f", {formatting.stepping(row)}" if measure is TRAJECTORY else ""
    asked = f"asked for {formatting.error(row['error'])}, " if row["error"] else ""
    sentence = f"{start} {row['label']}, {cost_of(row, measure)} {measure.unit} ({asked}reached {reached}{step})"
    if not near:
        return f"{sentence}."
    rivals = ", ".join(f"{rival['label']} {cost_of(rival, measure)}" for rival in near)
    return f"{sentence}; within its noise: {rivals}."


def cost_of(row: Row, measure: ErrorMeasure) -> str:
    """Return 34 ms, or with the range of the repeats 34 ms [31 ms to 40 ms]."""
    cost = formatting.seconds(row[measure.cost])
    if row["least"] is None:
        return cost
    return f"{cost} [{formatting.seconds(row['least'])} to {formatting.seconds(row['greatest'])}]"
