"""Convergence in time: the error of the motion, and the energy that is left, over the time step."""

import math
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from msmpetsc.study import formatting
from msmpetsc.study.charts.style import (
    ERROR,
    FAINT,
    SECONDS,
    Chart,
    Numbers,
    Styles,
    around,
    legend_below,
    log_axes,
    log_ticks,
    new_figure,
    title_axes,
)
from msmpetsc.study.table import grouped, measured, succeeded

if TYPE_CHECKING:
    from pandas import DataFrame

KIND = "Convergence in time"
CAPTION = (
    "The steps are solved to many digits, so that what is seen is the error of the time step alone. Of verlet the step "
    "is the substep. In the legend: the slope of the error, fitted to the shorter half of the steps; a start that is "
    "not smooth lowers it, for there are always vibrations that the steps are too long for. Energy left: where no load "
    "acts; overtones lose theirs sooner than the slowest vibration, whose closed form is dashed."
)
CLOSED = "(1 + ω²t²)^(\N{MINUS SIGN}n), implicit Euler, slowest vibration"
NUMBERS: Numbers = {
    "time step": (formatting.seconds, "step"),
    "steps": (formatting.count, "steps"),
    "trajectory error": (formatting.error, "trajectory_error"),
    "energy left": (formatting.plain, "energy_left"),
    "iterations a step": (formatting.count, "iterations"),
}


def with_step(rows: "DataFrame") -> "DataFrame":
    """Return the rows with a column ``step``: what the integrator steps by [s]."""
    explicit = (rows["integrator"] == "verlet") & (rows["substep"] > 0)
    return rows.assign(step=rows["substep"].where(explicit, rows["time_step"]))


def order(rows: "DataFrame") -> float | None:
    """Return the slope of log error over log step, least squares over the shorter half of the steps, two at least."""
    rows = with_step(measured(rows, "trajectory_error")).sort_values("step", kind="stable")
    kept = rows.head(max(2, -(-len(rows) // 2)))
    if kept["step"].nunique() < 2:
        return None
    return float(np.polyfit(np.log(kept["step"]), np.log(kept["trajectory_error"]), 1)[0])


def order_charts(table: "DataFrame", styles: Styles, study: dict) -> list[Chart]:
    """Return one chart for each [[order]] of the study file whose scene has numbers."""
    charts = []
    for entry in study.get("order", ()):
        ok = succeeded(table)
        rows = with_step(ok[ok["scene"] == entry.get("scene")])
        if len(measured(rows, "trajectory_error")):
            charts.append(order_chart(entry["scene"], rows, styles, entry.get("frequency")))
    return charts


def order_chart(scene: str, rows: "DataFrame", styles: Styles, frequency: float | None) -> Chart:
    """Return the error in the left panel, the energy in the right one, where it was measured."""
    slopes = {label: order(group) for label, group in grouped(rows, "label").items()}
    handles = {_legend(label, slope): styles[label].handle() for label, slope in slopes.items()}
    with_energy = len(measured(rows, "energy_left")) > 0
    if with_energy and frequency:
        handles[CLOSED] = Line2D([], [], color=FAINT, linestyle="--")
    figure, axes = new_figure(1 + with_energy, list(handles))
    chart = Chart(f"order_{scene}", KIND, f"{KIND}: {scene}", CAPTION, figure)
    draw_error(chart, axes[0], measured(rows, "trajectory_error"), styles)
    if with_energy:
        draw_energy(chart, axes[1], measured(rows, "energy_left"), styles=styles, frequency=frequency)
    legend_below(figure, handles)
    chart.findings["Order in the time step"] = [
        f"{label}: the error goes as the step to the power {slope:.2f}." for label, slope in slopes.items() if slope
    ]
    return chart


def _legend(label: str, slope: float | None) -> str:
    return label if slope is None else f"{label}: slope {slope:.2f}"


def draw_error(chart: Chart, axes: Axes, rows: "DataFrame", styles: Styles) -> None:
    """Draw the error of the motion over the step."""
    title_axes(axes, "error of the motion", "time step", "trajectory error")
    log_axes(axes, rows["step"], rows["trajectory_error"], (SECONDS, ERROR))
    draw_methods(chart, axes, rows, column="trajectory_error", styles=styles)


def draw_energy(chart: Chart, axes: Axes, rows: "DataFrame", *, styles: Styles, frequency: float | None) -> None:
    """Draw the energy that is left over the step."""
    title_axes(axes, "energy left at the end", "time step", "energy left / energy at the start")
    axes.set_xscale("log")
    axes.set_xlim(around(rows["step"]))
    log_ticks(axes.xaxis, around(rows["step"]), SECONDS)
    axes.set_ylim(0, 1.15 * min(2, max(1, rows["energy_left"].max())))
    draw_methods(chart, axes, rows, column="energy_left", styles=styles)
    euler = rows[rows["integrator"] == "implicit-euler"]
    if frequency and len(euler):
        axes.plot(*closed_form(euler, frequency), "--", color=FAINT, zorder=2)


def closed_form(rows: "DataFrame", frequency: float) -> tuple[np.ndarray, np.ndarray]:
    """Return steps t [s] and the energy (1 + w^2 t^2)^(-n) that implicit Euler leaves of an oscillation.

    n = T / t steps; frequency [Hz].
    """
    steps = with_step(rows)["step"]
    t = np.geomspace(steps.min(), steps.max(), 100)
    end = (rows["steps"] * rows["time_step"]).max()
    return t, (1 + (2 * math.pi * frequency * t) ** 2) ** (-end / t)


def draw_methods(chart: Chart, axes: Axes, rows: "DataFrame", *, column: str, styles: Styles) -> None:
    """Draw a curve for each method."""
    for label, group in grouped(rows, "label").items():
        chart.curve(axes, group.sort_values("step", kind="stable"), ("step", column), styles[label], numbers=NUMBERS)
