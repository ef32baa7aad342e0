"""Convergence within one step, over iterations and seconds; and in time, over the time step."""

import numpy as np
from pandas import DataFrame, concat, to_numeric

from msmpetsc.study.charts.plot import COUNT, ERROR, SECONDS, Chart, Styles, axis_from_zero, log_axis
from msmpetsc.study.table import Row, grouped, measured, records, succeeded

KIND = "Convergence within one step"
CAPTION = (
    "One step, followed iterate by iterate. Both horizontal axes start at 0 and are logarithmic from their second "
    "number on. Of several cases of a method the one that went furthest is shown."
)
PANELS = (
    ("iteration", "iteration", "over the iterations", COUNT),
    ("seconds", "computing time within the step", "over the computing time", SECONDS),
)
ITERATE = ("iteration", "seconds", "position_error", "energy_error", "ksp_its")


def iterates(trace: dict, row: Row) -> DataFrame:
    """Return the trace of a case as a row an iterate; those without a positive error are out."""
    length = len(trace.get("position_error") or [])
    columns = {name: (trace.get(name) or [None] * length)[:length] for name in ITERATE}
    rows = DataFrame(columns, dtype=object).apply(to_numeric, errors="coerce").astype(float)
    rows = rows.assign(label=row["label"], command=row["command"])
    return rows[(rows["position_error"] > 0) & (rows["position_error"] < 1e300)]


def convergence_charts(table: DataFrame, styles: Styles, traces: dict[str, dict]) -> list[Chart]:
    """Return one chart for each scene with traces, which come by case."""
    charts = []
    for scene, rows in grouped(table[table["case"].isin(traces.keys())], "scene").items():
        curves = furthest([iterates(traces[row["case"]], row) for row in records(rows)])
        frames = {traces[case].get("frame") for case in rows["case"]}
        step = f", step {frames.pop()}" if len(frames) == 1 else ""
        if curves:
            charts.append(convergence_chart(f"convergence_{scene}", f"{KIND}: {scene}{step}", concat(curves), styles))
    return charts


def furthest(curves: list[DataFrame]) -> list[DataFrame]:
    """Return each method's trace that ends with the least error: looser targets are parts of it."""
    known = sorted((curve for curve in curves if len(curve)), key=lambda rows: -rows["position_error"].iloc[-1])
    best = {rows["label"].iloc[0]: rows for rows in known}
    return [best[label] for label in dict.fromkeys(rows["label"].iloc[0] for rows in curves if len(rows))]


def convergence_chart(name: str, title: str, rows: DataFrame, styles: Styles) -> Chart:
    """Return two panels with one vertical scale."""
    chart = Chart(name, KIND, title, CAPTION, {label: styles[label] for label in dict.fromkeys(rows["label"])})
    y = log_axis("true step error |x \N{MINUS SIGN} x*| / |y \N{MINUS SIGN} x*|", rows["position_error"], ERROR)
    for column, axis, title, words in PANELS:
        shown = rows.dropna(subset=[column])
        panel = chart.panel(title, axis_from_zero(axis, list(shown[column]), words), y)
        panel.curves(shown, (column, "position_error"), ITERATE)
    return chart


# In time

ORDER = "Convergence in time"
ORDER_CAPTION = (
    "The steps are solved to many digits, so that what is seen is the error of the time step alone. Of verlet the step "
    "is the substep. In the legend: the slope of the error, fitted to the shorter half of the steps; a start that is "
    "not smooth lowers it, for there are always vibrations that the steps are too long for."
)
TOLD = ("step", "steps", "trajectory_error", "energy_left", "iterations")


def with_step(rows: DataFrame) -> DataFrame:
    """Return the rows with a column ``step``, what the integrator steps by [s], sorted by it."""
    explicit = (rows["integrator"] == "verlet") & (rows["substep"] > 0)
    return rows.assign(step=rows["substep"].where(explicit, rows["time_step"])).sort_values("step", kind="stable")


def order(rows: DataFrame) -> float | None:
    """Return the slope of log error over log step, fitted to the shorter half of the steps."""
    rows = with_step(measured(rows, "trajectory_error"))
    kept = rows.head(max(2, -(-len(rows) // 2)))
    if kept["step"].nunique() < 2:
        return None
    return float(np.polyfit(np.log(kept["step"]), np.log(kept["trajectory_error"]), 1)[0])


def order_charts(table: DataFrame, styles: Styles, study: dict) -> list[Chart]:
    """Return one chart for each [[order]] of the study file whose scene has numbers."""
    charts, ok = [], succeeded(table)
    for entry in study.get("order", ()):
        rows = ok[ok["scene"] == entry.get("scene")]
        if len(measured(rows, "trajectory_error")):
            charts.append(order_chart(entry["scene"], rows, styles))
    return charts


def order_chart(scene: str, rows: DataFrame, styles: Styles) -> Chart:
    """Return the error over the time step."""
    slopes = {label: order(group) for label, group in grouped(rows, "label").items()}
    names = {label: f"{label}: slope {slope:.2f}" if slope else label for label, slope in slopes.items()}
    rows = with_step(rows.assign(curve=rows["label"].map(names)))
    own = {name: styles[label] for label, name in names.items()}
    chart = Chart(f"order_{scene}", ORDER, f"{ORDER}: {scene}", ORDER_CAPTION, own)
    shown = measured(rows, "trajectory_error")
    y = log_axis("trajectory error", shown["trajectory_error"], ERROR)
    panel = chart.panel("error of the motion", log_axis("time step", shown["step"], SECONDS), y)
    panel.curves(shown, ("step", "trajectory_error"), TOLD, "curve")
    return chart
