"""The paper's Figure 6: frames a second over valid cells, for Cholesky factors and for CG."""

from operator import itemgetter

from msmpetsc.study import formatting
from msmpetsc.study.charts.cells import curves, file_name, sweeps, titled
from msmpetsc.study.charts.chart import Chart, Point, handle, legend_below, new_figure, repeats
from msmpetsc.study.charts.style import COUNT, Look, log_axes
from msmpetsc.study.rows import Row, failed, grouped, measured
from msmpetsc.study.spread import ends, is_below

KIND = "Frames a second over cells (the paper's Figure 6)"
CAPTION = (
    "Higher is faster. A frame is one time step; set-up and factorisation, done once, are not counted. The legend says "
    "which true step error each curve reached: only curves of like error compare. Whiskers reach from the least to the "
    "greatest of the repeats."
)
CHOLESKY_PRESETS = ("fast-msm", "fast-msm-kronecker")
FACTORS = ("cholesky", "lu")
GPU_TYPES = ("cuda", "cusparse", "hip", "kokkos")  # parts of the names of PETSc's types
FPS = itemgetter("fps")
LINES = ("-", "--", ":", "-.")


def is_cholesky(row: Row) -> bool:
    """Solves with a factor: so its preset has it, unless its own options say otherwise."""
    words = str(row["options"]).split()
    chosen = [value for name, value in zip(words, words[1:]) if name == "-pc_type"]
    return chosen[-1] in FACTORS if chosen else row["preset"] in CHOLESKY_PRESETS


def is_on_gpu(row: Row) -> bool:
    """PETSc's types name it."""
    return any(name in str(row["options"]) for name in GPU_TYPES)


def figure6_charts(rows: list[Row], looks: dict[str, Look]) -> list[Chart]:
    """One chart for each scene that was swept over cells with Cholesky among its methods."""
    groups = {key: group for key, group in sweeps(measured(rows, "fps")).items() if any(map(is_cholesky, group))}
    charts = []
    for (scene, time_step), group in groups.items():
        chart = figure6_chart(file_name("figure6", scene, time_step, groups), scene, time_step, group, looks)
        chart.failed = failed(row for row in rows if row["scene"] == scene)
        charts.append(chart)
    return charts


def figure6_chart(name: str, scene: str, time_step: float | None, rows: list[Row], looks: dict[str, Look]) -> Chart:
    """One panel, log-log."""
    by_curve = curves(rows)
    lines = line_styles(by_curve)
    look_of = {curve: looks[group[0]["label"]] for curve, group in by_curve.items()}
    handles = {f"{name} ({errors(group)})": handle(look_of[name], lines[name]) for name, group in by_curve.items()}
    figure, (axes,) = new_figure(1, list(handles))
    chart = Chart(name, KIND, titled("Frames a second over cells", scene, time_step), CAPTION, figure)
    axes.set_xlabel("valid cells (k: thousand, M: million)")
    axes.set_ylabel("frames a second")
    log_axes(axes, [row["cells"] for row in rows], [end for row in rows for end in ends(row, FPS)], COUNT, COUNT)
    for curve, group in by_curve.items():
        cells, fps = [row["cells"] for row in group], [row["fps"] for row in group]
        axes.plot(cells, fps, lines[curve], color=look_of[curve].color)
        chart.whiskers(axes, cells, group, FPS, look_of[curve])
        chart.mark(axes, cells, fps, [point(row, curve) for row in group], look_of[curve])
    legend_below(figure, handles)
    lines_found = overtaking(by_curve)
    if lines_found:
        chart.findings["Where CG overtakes Cholesky"] = lines_found
    return chart


def line_styles(by_curve: dict[str, list[Row]]) -> dict[str, str]:
    """Curves of one label share its colour and differ in their line."""
    seen: dict[str, int] = {}
    styles = {}
    for curve, group in by_curve.items():
        label = group[0]["label"]
        seen[label] = seen.get(label, -1) + 1
        styles[curve] = LINES[seen[label] % len(LINES)]
    return styles


def errors(rows: list[Row]) -> str:
    """The true step errors that a curve reached, as a range."""
    reached = [row["true_error"] for row in measured(rows, "true_error")]
    if not reached:
        return "step error not measured"
    low, high = formatting.error(min(reached)), formatting.error(max(reached))
    return f"step error {low}" if low == high else f"step error {low} to {high}"


def point(row: Row, curve: str) -> Point:
    """The numbers of one point."""
    numbers = {
        "valid cells": (formatting.count, row["cells"]),
        "frames a second": (formatting.plain, row["fps"]),
        "computing time a frame": (formatting.seconds, row["time_frame"]),
        **repeats(row, itemgetter("time_frame"), formatting.seconds),
        "true step error": (formatting.error, row["true_error"]),
        "iterations a step": (formatting.count, row["iterations"]),
        "KSP iterations a step": (formatting.count, row["ksp_its"]),
        "factorisation": (formatting.seconds, row["time_factor"]),
        "memory": (formatting.size, row["memory"]),
        "ranks": (formatting.count, row["ranks"]),
    }
    return Point(curve, numbers, row["command"])


def overtaking(by_curve: dict[str, list[Row]]) -> list[str]:
    """For each Cholesky curve, from which measured cell count on the fastest CG is faster; a GPU is no fair rival."""
    implicit = {curve: [row for row in group if row["integrator"] != "verlet"] for curve, group in by_curve.items()}
    named = [row | {"curve": curve} for curve, group in implicit.items() for row in group]
    factored = grouped(filter(is_cholesky, named), lambda row: row["curve"])
    rivals = grouped((row for row in named if not is_cholesky(row)), is_on_gpu)
    return [overtaken(curve, group, iterative) for iterative in rivals.values() for curve, group in factored.items()]


def overtaken(curve: str, group: list[Row], iterative: list[Row]) -> str:
    """Compared at the cell counts where both were measured."""
    rivals = {row["cells"]: fastest(iterative, row["cells"]) for row in group}
    pairs = [(row, rivals[row["cells"]]) for row in group if rivals[row["cells"]]]
    if not pairs:
        return f"{curve}: no iterative method was measured at the same cell counts."
    slower = [row["cells"] for row, rival in pairs if not is_below(row, rival, FPS)]
    won = [(row, rival) for row, rival in pairs if row["cells"] > max(slower, default=0)]
    if not won:
        row, rival = pairs[-1]
        cells = formatting.count(row["cells"])
        if not is_below(rival, row, FPS):
            both = f"{curve} and {rival['curve']} are as fast within their noise"
            return f"{both} at {cells} cells, the most measured ({duel(row, rival)})."
        return f"{curve} is still faster at {cells} cells, the most measured ({duel(row, rival)})."
    row, rival = won[0]
    start = f"{'' if slower else 'at every cell count measured, '}from {formatting.count(row['cells'])} cells on"
    return f"{rival['curve']} is faster than {curve} {start} ({duel(row, rival)})."


def fastest(rows: list[Row], cells: float) -> Row | None:
    return max((row for row in rows if row["cells"] == cells), key=lambda row: row["fps"], default=None)


def duel(row: Row, rival: Row) -> str:
    """Both speeds with their errors."""
    ours, theirs = (f"{side['fps']:.3g} frames a second at {error_of(side)}" for side in (rival, row))
    return f"there {ours} against {theirs}"


def error_of(row: Row) -> str:
    return f"a step error of {formatting.error(row['true_error'])}" if row["true_error"] else "an unmeasured step error"
