"""Convergence within one step: the error over the iterations, and over the seconds."""

from typing import TYPE_CHECKING

from msmpetsc.study import formatting
from msmpetsc.study.charts.plot import COUNT, ERROR, SECONDS, Chart, Numbers, Styles, axis_from_zero, log_axis
from msmpetsc.study.table import grouped

if TYPE_CHECKING:
    from pandas import DataFrame

KIND = "Convergence within one step"
CAPTION = (
    "One step, followed iterate by iterate. Both horizontal axes start at 0 and are logarithmic from their second "
    "number on. Of several cases of a method the one that went furthest is shown."
)
PANELS = (
    ("iteration", "iteration", "over the iterations", COUNT),
    ("seconds", "computing time within the step", "over the computing time", SECONDS),
)
ITERATE = ("iteration", "ksp_its", "seconds", "position_error", "energy_error")
NUMBERS: Numbers = {
    "iteration": (formatting.count, "iteration"),
    "computing time": (formatting.seconds, "seconds"),
    "step error": (formatting.error, "position_error"),
    "energy error": (formatting.error, "energy_error"),
    "KSP iterations": (formatting.count, "ksp_its"),
}


def iterates(entry: dict, commands: dict[str, str]) -> "DataFrame":
    """Return a trace as a row an iterate; those without a positive error are left out."""
    from pandas import DataFrame, to_numeric

    trace = entry["trace"]
    length = len(trace.get("position_error") or [])
    columns = {name: (trace.get(name) or [None] * length)[:length] for name in ITERATE}
    rows = DataFrame(columns, dtype=object).apply(to_numeric, errors="coerce").astype(float)
    rows = rows.assign(label=entry["label"], command=commands.get(entry.get("case", ""), ""))
    return rows[(rows["position_error"] > 0) & (rows["position_error"] < 1e300)]


def convergence_charts(traces: list[dict], styles: Styles, commands: dict[str, str]) -> list[Chart]:
    """Return one chart for each scene with traces; ``commands``: by case, for traces that name theirs."""
    charts = []
    for scene in dict.fromkeys(entry["scene"] for entry in traces):
        entries = [entry for entry in traces if entry["scene"] == scene]
        curves = furthest([iterates(entry, commands) for entry in entries])
        frames = {entry["trace"].get("frame") for entry in entries}
        if curves:
            charts.append(convergence_chart(scene, frames, curves, styles))
    return charts


def furthest(curves: list["DataFrame"]) -> dict[str, "DataFrame"]:
    """Return the trace of each method that ends with the least error: cases of looser targets are parts of it."""
    best: dict[str, DataFrame] = {}
    for curve in curves:
        for label, rows in grouped(curve, "label").items():
            if label not in best or rows["position_error"].iloc[-1] < best[label]["position_error"].iloc[-1]:
                best[label] = rows
    return best


def convergence_chart(scene: str, frames: set, curves: dict[str, "DataFrame"], styles: Styles) -> Chart:
    """Return two panels with one vertical scale."""
    step = f", step {frames.pop()}" if len(frames) == 1 else ""
    own = {label: styles[label] for label in curves}
    chart = Chart(f"convergence_{scene}", KIND, f"{KIND}: {scene}{step}", CAPTION, own)
    errors = [error for rows in curves.values() for error in rows["position_error"]]
    y = log_axis("true step error |x \N{MINUS SIGN} x*| / |y \N{MINUS SIGN} x*|", errors, ERROR)
    for column, name, title, words in PANELS:
        times = [value for rows in curves.values() for value in rows[column].dropna()]
        panel = chart.panel(title, axis_from_zero(name, times, words), y)
        for rows in curves.values():
            panel.curve(rows.dropna(subset=[column]), (column, "position_error"), NUMBERS)
    return chart
