"""Charts over the number of valid cells: the paper's Figure 6, and growth in time, memory and KSP iterations."""

import itertools
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from matplotlib.ticker import Formatter

from msmpetsc.study import formatting
from msmpetsc.study.charts.style import (
    BYTES,
    COUNT,
    REPEATS,
    SECONDS,
    Chart,
    Numbers,
    Styles,
    legend_below,
    log_axes,
    new_figure,
    title_axes,
)
from msmpetsc.study.table import Row, failed, grouped, measured, reach, records, succeeded

if TYPE_CHECKING:
    from pandas import DataFrame

FIGURE6 = "Frames a second over cells (the paper's Figure 6)"
FIGURE6_CAPTION = (
    "Higher is faster. A frame is one time step; set-up and factorisation, done once, are not counted. The legend says "
    "which true step error each curve reached: only curves of like error compare. Whiskers reach from the least to the "
    "greatest of the repeats."
)
GROWTH = "Growth with the number of cells"
GROWTH_CAPTION = (
    "A level curve means a cost in proportion to the cells; a rising one grows faster than the body. Memory is the "
    "peak of all ranks, the program itself and the surface mesh included. Whiskers reach from the least to the "
    "greatest of the repeats."
)
X_LABEL = "valid cells (k: thousand, M: million)"
VARIED = ("error", "max_iterations", "ranks")  # columns that may differ between curves of one method
CHOLESKY_PRESETS = ("fast-msm", "fast-msm-kronecker")
FACTORS = ("cholesky", "lu")
GPU_TYPES = ("cuda", "cusparse", "hip", "kokkos")  # parts of the names of PETSc's types
LINES = ("-", "--", ":", "-.")
SPEED: Numbers = {
    "valid cells": (formatting.count, "cells"),
    "frames a second": (formatting.plain, "fps"),
    "computing time a frame": (formatting.seconds, "time_frame"),
    **REPEATS,
    "true step error": (formatting.error, "true_error"),
    "iterations a step": (formatting.count, "iterations"),
    "KSP iterations a step": (formatting.count, "ksp_its"),
    "factorisation": (formatting.seconds, "time_factor"),
    "memory": (formatting.size, "memory"),
    "ranks": (formatting.count, "ranks"),
}
COSTS: Numbers = {
    "computing time a frame": (formatting.seconds, "time_frame"),
    **REPEATS,
    "memory": (formatting.size, "memory"),
    "KSP iterations a step": (formatting.count, "ksp_its"),
    "true step error": (formatting.error, "true_error"),
    "set-up": (formatting.seconds, "time_setup"),
    "factorisation": (formatting.seconds, "time_factor"),
    "ranks": (formatting.count, "ranks"),
}


class Quantity(NamedTuple):
    """A panel of the growth charts: a column, of which ``shown`` is a cell's part or the whole."""

    title: str
    column: str
    shown: str
    tick: Formatter
    word: Any

    @property
    def numbers(self) -> Numbers:
        """Numbers that a point tells of itself."""
        return {"valid cells": (formatting.count, "cells"), self.title: (self.word, self.shown)} | COSTS


QUANTITIES = (
    Quantity("time a frame and cell", "time_frame", "time_frame_a_cell", SECONDS, formatting.seconds),
    Quantity("memory a cell", "memory", "memory_a_cell", BYTES, formatting.size),
    Quantity("KSP iterations a step", "ksp_its", "ksp_its", COUNT, formatting.count),
)


# Which rows make one curve


def cell_sweeps(table: "DataFrame") -> dict[tuple[str, float], "DataFrame"]:
    """Return the rows by (scene, time step), where some curve has two cell counts or more."""
    groups = grouped(measured(succeeded(table), "cells"), "scene", "time_step")
    swept = {key: with_curves(group) for key, group in groups.items()}
    return {key: rows for key, rows in swept.items() if rows.groupby("curve")["cells"].nunique().max() > 1}


def with_curves(rows: "DataFrame") -> "DataFrame":
    """Return the rows with a column ``curve``: the method, and what else was varied within it."""
    varied = [name for name in VARIED if (rows.groupby("label")[name].nunique(dropna=False) > 1).any()]
    words = ([row["label"], *(formatting.setting(row, name) for name in varied)] for row in records(rows))
    return rows.assign(curve=[", ".join(filter(None, text)) for text in words])


def curves(rows: "DataFrame") -> dict[str, "DataFrame"]:
    """Return the rows by curve, each by rising cell count."""
    groups = grouped(rows if "curve" in rows else with_curves(rows), "curve")
    return {name: group.sort_values("cells", kind="stable") for name, group in groups.items()}


def label_of(curve: "DataFrame") -> str:
    """Return the label that all rows of a curve have."""
    return curve["label"].iloc[0]


def line_styles(by_curve: dict[str, "DataFrame"]) -> dict[str, str]:
    """Return the line of each curve: curves of one label share its colour and differ in their line."""
    seen: dict[str, int] = {}
    lines = {}
    for curve, group in by_curve.items():
        label = label_of(group)
        seen[label] = seen.get(label, -1) + 1
        lines[curve] = LINES[seen[label] % len(LINES)]
    return lines


def chart_title(kind: str, scene: str, time_step: float) -> str:
    """Return the title of a scene's chart, with its time step where there is one."""
    return f"{kind}: {scene}" + (f", time step {formatting.seconds(time_step)}" if time_step > 0 else "")


def file_name(kind: str, key: tuple[str, float], groups: dict) -> str:
    """Return the kind alone where there is one chart of it, else with what tells them apart."""
    if len(groups) == 1:
        return kind
    scene, time_step = key
    alone = sum(name == scene for name, _ in groups) == 1
    return f"{kind}_{scene}" if alone else f"{kind}_{scene}_{formatting.plain(time_step)}"


# Figure 6


def is_cholesky(row: Row) -> bool:
    """Return whether a case solves with a factor: so its preset has it, unless its own options say otherwise."""
    words = str(row["options"]).split()
    chosen = [value for name, value in itertools.pairwise(words) if name == "-pc_type"]
    return chosen[-1] in FACTORS if chosen else row["preset"] in CHOLESKY_PRESETS


def is_on_gpu(row: Row) -> bool:
    """Return whether PETSc's types name a GPU."""
    return any(name in str(row["options"]) for name in GPU_TYPES)


def figure6_charts(table: "DataFrame", styles: Styles) -> list[Chart]:
    """Return one chart for each scene that was swept over cells with Cholesky among its methods."""
    sweeps = cell_sweeps(measured(table, "fps"))
    groups = {key: rows for key, rows in sweeps.items() if any(map(is_cholesky, records(rows)))}
    charts = []
    for key, rows in groups.items():
        charts.append(figure6_chart(file_name("figure6", key, groups), key, rows, styles))
        charts[-1].failed = records(failed(table[table["scene"] == key[0]]))
    return charts


def figure6_chart(name: str, key: tuple[str, float], rows: "DataFrame", styles: Styles) -> Chart:
    """Return one panel, log-log; ``key``: scene and time step."""
    by_curve = curves(rows)
    lines = line_styles(by_curve)
    style_of = {curve: styles[label_of(group)] for curve, group in by_curve.items()}
    handles = {f"{name} ({errors(group)})": style_of[name].handle(lines[name]) for name, group in by_curve.items()}
    figure, (axes,) = new_figure(1, list(handles))
    chart = Chart(name, FIGURE6, chart_title("Frames a second over cells", *key), FIGURE6_CAPTION, figure)
    title_axes(axes, "", X_LABEL, "frames a second")
    log_axes(axes, rows["cells"], reach(rows, "fps").to_numpy().ravel(), (COUNT, COUNT))
    for curve, group in by_curve.items():
        columns = "cells", "fps"
        chart.curve(
            axes, group, columns, style_of[curve], numbers=SPEED, label="curve", line=lines[curve], whiskers=True
        )
    legend_below(figure, handles)
    overtaking = overtaking_lines(rows)
    if overtaking:
        chart.findings["Where CG overtakes Cholesky"] = overtaking
    return chart


def errors(rows: "DataFrame") -> str:
    """Return the true step errors that a curve reached, as a range."""
    reached = measured(rows, "true_error")["true_error"]
    if reached.empty:
        return "step error not measured"
    low, high = formatting.error(reached.min()), formatting.error(reached.max())
    return f"step error {low}" if low == high else f"step error {low} to {high}"


def overtaking_lines(rows: "DataFrame") -> list[str]:
    """Say for each Cholesky curve from which measured cell count on the fastest CG is faster.

    Rivals on a GPU are compared apart from those on a CPU.
    """
    ends = reach(rows, "fps")
    rows = rows.assign(slowest=ends["least"], fastest=ends["greatest"])
    rows = rows[rows["integrator"] != "verlet"]
    factored, gpu = (np.array([test(row) for row in records(rows)], bool) for test in (is_cholesky, is_on_gpu))
    rivals = grouped(rows.assign(gpu=gpu)[~factored], "gpu")
    return [
        overtaken(curve, records(group), iterative)
        for iterative in rivals.values()
        for curve, group in curves(rows[factored]).items()
    ]


def overtaken(curve: str, group: list[Row], iterative: "DataFrame") -> str:
    """Compare a Cholesky curve and its fastest rival at the cell counts where both were measured."""
    best = iterative.sort_values("fps", ascending=False, kind="stable").drop_duplicates("cells")
    rivals = {rival["cells"]: rival for rival in records(best)}
    pairs = [(row, rivals[row["cells"]]) for row in group if row["cells"] in rivals]
    if not pairs:
        return f"{curve}: no iterative method was measured at the same cell counts."
    slower = [row["cells"] for row, rival in pairs if not row["fastest"] < rival["slowest"]]
    won = [(row, rival) for row, rival in pairs if row["cells"] > max(slower, default=0)]
    if not won:
        row, rival = pairs[-1]
        most = f"at {formatting.count(row['cells'])} cells, the most measured ({duel(row, rival)})."
        if not rival["fastest"] < row["slowest"]:
            return f"{curve} and {rival['curve']} are as fast within their noise {most}"
        return f"{curve} is still faster {most}"
    row, rival = won[0]
    start = f"{'' if slower else 'at every cell count measured, '}from {formatting.count(row['cells'])} cells on"
    return f"{rival['curve']} is faster than {curve} {start} ({duel(row, rival)})."


def duel(row: Row, rival: Row) -> str:
    """Return both speeds with their errors."""
    theirs, ours = (f"{side['fps']:.3g} frames a second at {error_of(side)}" for side in (row, rival))
    return f"there {ours} against {theirs}"


def error_of(row: Row) -> str:
    """Return the step error of a row in words."""
    return f"a step error of {formatting.error(row['true_error'])}" if row["true_error"] else "an unmeasured step error"


# Growth


def growth_charts(table: "DataFrame", styles: Styles) -> list[Chart]:
    """Return one chart for each scene that was swept over cells."""
    groups = cell_sweeps(table)
    charts = []
    for key, rows in groups.items():
        chart = growth_chart(file_name("growth", key, groups), key, rows, styles)
        if chart:
            chart.failed = records(failed(table[table["scene"] == key[0]]))
            charts.append(chart)
    return charts


def growth_chart(name: str, key: tuple[str, float], rows: "DataFrame", styles: Styles) -> Chart | None:
    """Return the panels that have data; None where none has. ``key``: scene and time step."""
    rows = rows.assign(**{f"{name}_a_cell": rows[name] / rows["cells"] for name in ("time_frame", "memory")})
    panels = [quantity for quantity in QUANTITIES if len(measured(rows, quantity.column))]
    if not panels:
        return None
    by_curve = curves(rows)
    lines = line_styles(by_curve)
    handles = {curve: styles[label_of(group)].handle(lines[curve]) for curve, group in by_curve.items()}
    figure, all_axes = new_figure(len(panels), list(handles))
    chart = Chart(name, GROWTH, chart_title("Growth with cells", *key), GROWTH_CAPTION, figure)
    for axes, quantity in zip(all_axes, panels, strict=True):
        title_axes(axes, quantity.title, X_LABEL, "")
        shown = measured(rows, quantity.column)
        is_time = quantity.column == "time_frame"
        heights = reach(shown, quantity.shown).to_numpy().ravel() if is_time else shown[quantity.shown]
        log_axes(axes, shown["cells"], heights, (COUNT, quantity.tick))
        for curve, group in by_curve.items():
            chart.curve(
                axes, measured(group, quantity.column), ("cells", quantity.shown), styles[label_of(group)],
                numbers=quantity.numbers, label="curve", line=lines[curve], whiskers=is_time,
            )  # fmt: skip
    legend_below(figure, handles)
    return chart
