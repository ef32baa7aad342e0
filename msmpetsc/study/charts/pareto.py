"""Speed against accuracy: computing time over the step error, and over the trajectory error, in two panels.

The two errors are never mixed. The step error says how far a step is from the exact minimiser of its energy: methods
can be compared by it where the time step is the same. The trajectory error says how far the run is from the true motion
of the lattice: explicit and implicit runs of any time step can be compared by it.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from operator import itemgetter

from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from msmpetsc.study import formatting
from msmpetsc.study.charts.chart import Chart, Point, handle, legend_below, new_figure, repeats
from msmpetsc.study.charts.style import ERROR, FAINT, INK, SECONDS, Look, log_axes
from msmpetsc.study.rows import Row, failed, grouped, measured, stepping, succeeded
from msmpetsc.study.spread import UNKNOWN, ends, is_known, spread, within_noise

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
class Measure:
    """One panel: which error, and what it costs."""

    error: str
    cost: str
    name: str
    x_label: str
    y_label: str
    unit: str


STEP = Measure(
    "true_error", "time_frame", "step error",
    "true step error |x − x*| / |y − x*|, rms over steps", "computing time a frame", "a frame",
)  # fmt: skip
TRAJECTORY = Measure(
    "trajectory_error", "time_second", "trajectory error",
    "trajectory error against a reference with a tiny step", "computing time a simulated second",
    "a simulated second",
)  # fmt: skip
MEASURES = {measure.name: measure for measure in (STEP, TRAJECTORY)}


def front(x: Sequence[float], y: Sequence[float]) -> list[int]:
    """Indices of the points that no other beats: none is at most as great in both and smaller in one. By rising x."""
    best, lowest = [], float("inf")
    for index in sorted(range(len(x)), key=lambda i: (x[i], y[i])):
        twin = bool(best) and (x[best[-1]], y[best[-1]]) == (x[index], y[index])
        if y[index] < lowest or twin:
            best.append(index)
            lowest = y[index]
    return best


def front_rows(rows: list[Row], measure: Measure) -> list[Row]:
    """The front of measured rows, by rising error. Errors that read alike, to two digits, count as equal: no step can
    better the trajectory error of its time step but in the last digits, and those are no reason to pay more."""
    errors, costs = columns(rows, measure)
    return [rows[i] for i in front([float(f"{error:.1e}") for error in errors], costs)]


def cheapest(rows: list[Row], measure: Measure, level: float) -> Row | None:
    """The row of least cost among those whose measured error is at most this level; nothing is interpolated."""
    reached = [row for row in measured(rows, measure.error, measure.cost) if row[measure.error] <= level]
    return min(reached, key=lambda row: row[measure.cost], default=None)


def winners(rows: list[Row], measure: Measure, level: float) -> list[Row]:
    """The cheapest, then those that its repeats do not tell from it, each method once; none where nothing reaches the
    level."""
    first = cheapest(rows, measure, level)
    if first is None:
        return []
    reached = [row for row in measured(rows, measure.error, measure.cost) if row[measure.error] <= level]
    return [first, *(within_noise(first, reached, itemgetter(measure.cost)) if is_known([first]) else [])]


def pareto_charts(rows: list[Row], looks: dict[str, Look]) -> list[Chart]:
    """One chart for each scene, and for each of its cell counts where a method was swept over errors or time steps."""
    charts = []
    for scene, here in grouped(rows, lambda row: row["scene"]).items():
        sizes = grouped(succeeded(here), lambda row: row["cells"])
        swept = {cells: group for cells, group in sizes.items() if len(sizes) == 1 or is_swept(group)}
        for cells, group in swept.items():
            name = f"pareto_{scene}" if len(swept) == 1 else f"pareto_{scene}_{formatting.plain(cells)}"
            chart = pareto_chart(name, scene, cells, group, looks)
            if chart:
                chart.failed = failed(here)
                charts.append(chart)
    return charts


def is_swept(rows: list[Row]) -> bool:
    """Some method was measured more than once."""
    return max(Counter(row["label"] for row in rows).values()) > 1


def pareto_chart(name: str, scene: str, cells: float | None, rows: list[Row], looks: dict[str, Look]) -> Chart | None:
    """The panels that have data; None where neither has."""
    step = common_time_step(measured(rows, STEP.error, STEP.cost))
    trajectory = measured(rows, TRAJECTORY.error, TRAJECTORY.cost)
    panels = [(measure, shown) for measure, shown in ((STEP, step), (TRAJECTORY, trajectory)) if shown]
    if not panels:
        return None
    labels = dict.fromkeys(row["label"] for _, shown in panels for row in shown)
    handles = {label: handle(looks[label]) for label in labels}
    handles[FRONT] = Line2D([], [], color=FAINT, marker="o", markersize=10, markerfacecolor="none", markeredgecolor=INK)
    figure, axes = new_figure(len(panels), list(handles))
    where = f"{scene}, {formatting.count(cells)} cells" if cells else scene
    chart = Chart(name, "Speed against accuracy", f"Speed against accuracy: {where}", CAPTION, figure)
    for ax, (measure, shown) in zip(axes, panels):
        draw(chart, ax, measure, shown, looks)
        chart.cheapest[measure.name] = [winners(shown, measure, level) for level in LEVELS]
        lines = [finding(measure, *pair) for pair in zip(LEVELS, chart.cheapest[measure.name])]
        chart.findings[f"The cheapest by {measure.name}"] = lines + ([] if is_known(shown) else [UNKNOWN])
    legend_below(figure, handles)
    return chart


def common_time_step(rows: list[Row]) -> list[Row]:
    """The rows of the time step with the most of them, the longer of two: only they compare by time a frame."""
    steps = grouped(rows, lambda row: row["time_step"])
    return max(steps.values(), key=lambda group: (len(group), group[0]["time_step"] or 0), default=[])


def draw(chart: Chart, axes: Axes, measure: Measure, rows: list[Row], looks: dict[str, Look]) -> None:
    """One panel: the front first, the methods over it."""
    step = formatting.seconds(rows[0]["time_step"])
    where = f", time step {step}" if measure is STEP and step else ""
    axes.set_title(f"over the {measure.name}{where}", loc="left")
    axes.set_xlabel(measure.x_label)
    axes.set_ylabel(measure.y_label)
    costs = [end for row in rows for end in ends(row, itemgetter(measure.cost))]
    log_axes(axes, [row[measure.error] for row in rows], costs, ERROR, SECONDS)
    draw_front(axes, front_rows(rows, measure), measure)
    for label, group in grouped(rows, lambda row: row["label"]).items():
        best = front_rows(group, measure)
        axes.plot(*columns(best, measure), color=looks[label].color, linewidth=1.6, zorder=3)
        chart.whiskers(axes, columns(group, measure)[0], group, itemgetter(measure.cost), looks[label])
        others = [row for row in group if not any(row is one for one in best)]
        hollow = {"markersize": 5, "markerfacecolor": "white", "markeredgecolor": looks[label].color}
        for chosen, style in ((best, {}), (others, hollow)):
            points = [point(row, measure) for row in chosen]
            chart.mark(axes, *columns(chosen, measure), points, looks[label], **style)


def columns(rows: list[Row], measure: Measure) -> tuple[list[float], list[float]]:
    return [row[measure.error] for row in rows], [row[measure.cost] for row in rows]


def draw_front(axes: Axes, rows: list[Row], measure: Measure) -> None:
    """A grey stair through the front, and a ring around each of its points."""
    x, y = columns(rows, measure)
    right, top = axes.get_xlim()[1], axes.get_ylim()[1]
    stair = {"drawstyle": "steps-post", "color": FAINT, "linewidth": 1.2, "zorder": 2}
    axes.plot([x[0], *x, right], [top, *y, y[-1]], **stair)
    ring = {"markersize": 12, "markerfacecolor": "none", "markeredgecolor": INK, "markeredgewidth": 1.1, "zorder": 5}
    axes.plot(x, y, "o", clip_on=False, **ring)


def point(row: Row, measure: Measure) -> Point:
    """The numbers of one point."""
    numbers = {
        measure.name: (formatting.error, row[measure.error]),
        measure.y_label: (formatting.seconds, row[measure.cost]),
        **repeats(row, itemgetter(measure.cost), formatting.seconds),
        "time step": (formatting.seconds, row["time_step"]),
        "substep": (formatting.seconds, row["substep"]),
        "error asked for": (formatting.error, row["error"]),
        "most iterations": (formatting.count, row["max_iterations"]),
        "iterations a step": (formatting.count, row["iterations"]),
        "ranks": (formatting.count, row["ranks"]),
    }
    return Point(row["label"], numbers, row["command"])


def finding(measure: Measure, level: float, best: list[Row]) -> str:
    """Which method is the cheapest that reached this level, and which may be just as cheap, in plain words."""
    start = f"{formatting.error(level)} or less:"
    if not best:
        return f"{start} nothing measured reaches it."
    row, *others = best
    reached = formatting.error(row[measure.error])
    step = f", {stepping(row)}" if measure is TRAJECTORY else ""
    asked = f"asked for {formatting.error(row['error'])}, " if row["error"] else ""
    sentence = f"{start} {row['label']}, {cost_of(row, measure)} {measure.unit} ({asked}reached {reached}{step})"
    if not others:
        return f"{sentence}."
    near = ", ".join(f"{other['label']} {cost_of(other, measure)}" for other in others)
    return f"{sentence}; within its noise: {near}."


def cost_of(row: Row, measure: Measure) -> str:
    """34 ms, or with the range of the repeats 34 ms [31 ms to 40 ms]."""
    cost, repeats_range = formatting.seconds(row[measure.cost]), spread(row, itemgetter(measure.cost))
    return f"{cost} [{' to '.join(map(formatting.seconds, repeats_range))}]" if repeats_range else cost
