"""Convergence in time: the error of the motion, and the energy that is left, over the time step."""

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from msmpetsc.study import formatting
from msmpetsc.study.charts.chart import Chart, Point, handle, legend_below, new_figure
from msmpetsc.study.charts.style import ERROR, FAINT, SECONDS, Look, around, log_axes, log_ticks
from msmpetsc.study.rows import Row, grouped, measured, succeeded

KIND = "Convergence in time"
CAPTION = (
    "The steps are solved to many digits, so that what is seen is the error of the time step alone. Of verlet the step "
    "is the substep. In the legend: the slope of the error, fitted to the shorter half of the steps; a start that is not "
    "smooth lowers it, for there are always vibrations that the steps are too long for. Energy left: where no load acts; "
    "overtones lose theirs sooner than the slowest vibration, whose closed form is dashed."
)
CLOSED = "(1 + ω²t²)^(−n), implicit Euler, slowest vibration"


def step_of(row: Row) -> float:
    """What an integrator steps by [s]."""
    return row["substep"] if row["integrator"] == "verlet" and row["substep"] else row["time_step"]


def order(rows: Sequence[Row]) -> float | None:
    """Slope of log error over log step, least squares over the shorter half of the steps, two at least."""
    rows = sorted(measured(rows, "trajectory_error"), key=step_of)
    kept = rows[: max(2, -(-len(rows) // 2))]
    if len({step_of(row) for row in kept}) < 2:
        return None
    logs = np.log([[step_of(row), row["trajectory_error"]] for row in kept])
    return float(np.polyfit(*logs.T, 1)[0])


def order_charts(rows: list[Row], looks: dict[str, Look], study: dict) -> list[Chart]:
    """One chart for each [[order]] of the study file whose scene has numbers."""
    charts = []
    for told in study.get("order", ()):
        group = [row for row in succeeded(rows) if row["scene"] == told.get("scene")]
        if measured(group, "trajectory_error"):
            charts.append(order_chart(told["scene"], group, looks, told.get("frequency")))
    return charts


def order_chart(scene: str, rows: list[Row], looks: dict[str, Look], frequency: float | None) -> Chart:
    """Left the error, right the energy, where it was measured."""
    by_label = {label: sorted(group, key=step_of) for label, group in grouped(rows, lambda row: row["label"]).items()}
    slopes = {label: order(group) for label, group in by_label.items()}
    handles = {named(label, slopes[label]): handle(looks[label]) for label in by_label}
    with_energy = measured(rows, "energy_left")
    if with_energy and frequency:
        handles[CLOSED] = Line2D([], [], color=FAINT, linestyle="--")
    figure, axes = new_figure(1 + bool(with_energy), list(handles))
    chart = Chart(f"order_{scene}", KIND, f"{KIND}: {scene}", CAPTION, figure)
    draw_error(chart, axes[0], by_label, looks)
    if with_energy:
        draw_energy(chart, axes[1], by_label, looks, frequency)
    legend_below(figure, handles)
    chart.findings["Order in the time step"] = [
        f"{label}: the error goes as the step to the power {slope:.2f}." for label, slope in slopes.items() if slope
    ]
    return chart


def named(label: str, slope: float | None) -> str:
    return label if slope is None else f"{label}: slope {slope:.2f}"


def draw_error(chart: Chart, axes: Axes, by_label: dict[str, list[Row]], looks: dict[str, Look]) -> None:
    axes.set_title("error of the motion", loc="left")
    axes.set_xlabel("time step")
    axes.set_ylabel("trajectory error")
    shown = {label: measured(group, "trajectory_error") for label, group in by_label.items()}
    rows = [row for group in shown.values() for row in group]
    log_axes(axes, [step_of(row) for row in rows], [row["trajectory_error"] for row in rows], SECONDS, ERROR)
    for label, group in shown.items():
        draw_curve(chart, axes, group, "trajectory_error", looks[label])


def draw_energy(
    chart: Chart, axes: Axes, by_label: dict[str, list[Row]], looks: dict[str, Look], frequency: float | None
) -> None:
    axes.set_title("energy left at the end", loc="left")
    axes.set_xlabel("time step")
    axes.set_ylabel("energy left / energy at the start")
    shown = {label: measured(group, "energy_left") for label, group in by_label.items()}
    rows = [row for group in shown.values() for row in group]
    axes.set_xscale("log")
    axes.set_xlim(around([step_of(row) for row in rows]))
    log_ticks(axes.xaxis, around([step_of(row) for row in rows]), SECONDS)
    axes.set_ylim(0, 1.15 * min(2, max(1, *(row["energy_left"] for row in rows))))
    for label, group in shown.items():
        draw_curve(chart, axes, group, "energy_left", looks[label])
    euler = [row for row in rows if row["integrator"] == "implicit-euler"]
    if frequency and euler:
        axes.plot(*closed_form(euler, frequency), "--", color=FAINT, zorder=2)


def closed_form(rows: list[Row], frequency: float) -> tuple[np.ndarray, np.ndarray]:
    """Steps t and the energy (1 + w^2 t^2)^(-n) that implicit Euler leaves of an oscillation after n = T / t steps."""
    steps = [step_of(row) for row in rows]
    t = np.geomspace(min(steps), max(steps), 100)
    end = max(row["steps"] * row["time_step"] for row in rows)
    return t, (1 + (2 * math.pi * frequency * t) ** 2) ** (-end / t)


def draw_curve(chart: Chart, axes: Axes, rows: list[Row], column: str, look: Look) -> None:
    x, y = [step_of(row) for row in rows], [row[column] for row in rows]
    axes.plot(x, y, color=look.color)
    chart.mark(axes, x, y, [point(row) for row in rows], look)


def point(row: Row) -> Point:
    numbers = {
        "time step": (formatting.seconds, step_of(row)),
        "steps": (formatting.count, row["steps"]),
        "trajectory error": (formatting.error, row["trajectory_error"]),
        "energy left": (formatting.plain, row["energy_left"]),
        "iterations a step": (formatting.count, row["iterations"]),
    }
    return Point(row["label"], numbers, row["command"])
