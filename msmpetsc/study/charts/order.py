"""Convergence in time: the error of the motion, and the energy that is left, over the time step."""

import math
from typing import TYPE_CHECKING

import numpy as np

from msmpetsc.study import formatting
from msmpetsc.study.charts.plot import (
    DASH,
    ERROR,
    FAINT,
    PLAIN,
    SECONDS,
    Chart,
    CurveStyle,
    Numbers,
    Panel,
    Styles,
    channel,
    log_axis,
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
X_LABEL = "time step"
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
    names = {label: f"{label}: slope {slope:.2f}" if slope else label for label, slope in slopes.items()}
    rows = rows.assign(curve=rows["label"].map(names))
    shown, left = measured(rows, "trajectory_error"), measured(rows, "energy_left")
    own = {name: styles[label] for label, name in names.items()}
    if len(left) and frequency:
        own[CLOSED] = CurveStyle(FAINT, DASH)
    chart = Chart(f"order_{scene}", KIND, f"{KIND}: {scene}", CAPTION, own)
    x, y = log_axis(X_LABEL, shown["step"], SECONDS), log_axis("trajectory error", shown["trajectory_error"], ERROR)
    draw_methods(chart.panel("error of the motion", x, y), shown, "trajectory_error")
    if len(left):
        draw_energy(chart, left, frequency)
    return chart


def draw_energy(chart: Chart, rows: "DataFrame", frequency: float | None) -> None:
    """Draw the energy that is left over the step."""
    top = 1.15 * min(2, max(1, rows["energy_left"].max()))
    y = channel("energy left / energy at the start", PLAIN, np.arange(0, top, 0.2), domain=[0, top])
    panel = chart.panel("energy left at the end", log_axis(X_LABEL, rows["step"], SECONDS), y)
    euler = rows[rows["integrator"] == "implicit-euler"]
    if frequency and len(euler):
        panel.line(*closed_form(euler, frequency), strokeDash=[6, 4])
    draw_methods(panel, rows, "energy_left")


def closed_form(rows: "DataFrame", frequency: float) -> tuple[np.ndarray, np.ndarray]:
    """Return steps t [s] and the energy (1 + w^2 t^2)^(-n) that implicit Euler leaves of an oscillation.

    n = T / t steps; frequency [Hz].
    """
    steps = with_step(rows)["step"]
    t = np.geomspace(steps.min(), steps.max(), 100)
    end = (rows["steps"] * rows["time_step"]).max()
    return t, (1 + (2 * math.pi * frequency * t) ** 2) ** (-end / t)


def draw_methods(panel: Panel, rows: "DataFrame", column: str) -> None:
    """Draw a curve for each method."""
    for group in grouped(rows, "label").values():
        panel.curve(group.sort_values("step", kind="stable"), ("step", column), NUMBERS, "curve")
