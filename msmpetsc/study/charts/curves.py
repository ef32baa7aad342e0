"""Charts of methods: cost over error, surface error over cost, growth with the number of cells.

There are two kinds of error. The step error is the distance of a step from the exact minimiser of
its energy: it compares methods with the same time step. The trajectory error is the distance of a
run from the true motion of the lattice: it compares all integrators and time steps.
"""

from collections.abc import Sequence

import numpy as np
from pandas import DataFrame, concat

from msmpetsc.study import formatting
from msmpetsc.study.charts.plot import (
    BYTES,
    COUNT,
    ERROR,
    INK,
    RING,
    SECONDS,
    Chart,
    Columns,
    CurveStyle,
    Styles,
    curve_styles,
    log_axis,
    points,
)
from msmpetsc.study.table import grouped, measured, records, spread, succeeded

SPEED_ACCURACY = "Speed against accuracy"
FRONT = "Pareto front"
CAPTION = (
    "Lower is faster, further left is more exact. A line joins the Pareto-optimal points of a "
    "method; its other points lie beside it. A point is the median of the repeats; whiskers "
    "reach from the least to the greatest, and points whose whiskers overlap may cost the same. "
    "Rings and the grey stair are the Pareto front: no measured case is both cheaper and more "
    "exact, with errors compared to two digits. The "
    "step error is that of solving a step; the trajectory error is that of the whole motion, time "
    "step included."
)
# columns of a point's tooltip
TIP = (
    "least", "greatest", "time_step", "substep", "error", "max_iterations", "iterations", "ranks",
)  # fmt: skip
# error and cost of a panel
STEP = ("true_error", "time_frame")
TRAJECTORY = ("trajectory_error", "time_second")
COST = "computing time a simulated second"
# titles of a panel, its x axis and its y axis
TITLES = {
    STEP: (
        "over the step error",
        "true step error |x \N{MINUS SIGN} x*| / |y \N{MINUS SIGN} x*|, rms over steps",
        "computing time a frame",
    ),
    TRAJECTORY: (
        "over the trajectory error", "trajectory error against a reference with a tiny step", COST,
    ),
}  # fmt: skip


def front(x: Sequence[float], y: Sequence[float]) -> list[int]:
    """Return the indices of the Pareto-optimal points (least x and least y) in the order of x."""
    # entry i, j: coordinate of point i less that of point j
    across = np.subtract.outer(x, x)
    down = np.subtract.outer(y, y)
    beaten = ((across >= 0) & (down >= 0) & ((across > 0) | (down > 0))).any(axis=1)
    return [int(index) for index in np.lexsort((y, x)) if not beaten[index]]


def front_rows(rows: DataFrame, columns: Columns) -> DataFrame:
    """Return the Pareto-optimal rows by error and cost, in the order of their error.

    Errors that agree to two digits count as equal. A smaller step error changes only later digits
    of the trajectory error, which are not worth a cost.
    """
    error, cost = columns
    return rows.iloc[front([float(f"{value:.1e}") for value in rows[error]], list(rows[cost]))]


def pareto_charts(table: DataFrame, styles: Styles) -> list[Chart]:
    """Return a chart for each scene and each number of cells at which a method was swept."""
    rows = succeeded(table)
    sizes = rows.groupby("scene")["cells"].nunique()
    charts = []
    for (scene, cells), group in grouped(rows, "scene", "cells").items():
        if sizes[scene] < 2 or group["label"].duplicated().any():
            words = [f"{formatting.count(cells)} cells"] if cells > 0 else []
            title = ", ".join([f"{SPEED_ACCURACY}: {scene}", *words])
            name = f"pareto_{scene}_{formatting.plain(cells)}"
            charts.append(pareto_chart(name, title, group, styles))
    return [chart for chart in charts if chart.panels]


def pareto_chart(name: str, title: str, rows: DataFrame, styles: Styles) -> Chart:
    """Return the chart of a scene, with a panel for each measure of error that has data."""
    step = measured(rows, *STEP)
    # step errors compare only at equal time steps: take the step with the most rows
    by_step = grouped(step, "time_step").values()
    step = max(
        by_step, key=lambda group: (len(group), group["time_step"].fillna(0).iloc[0]), default=step
    )
    panels = {STEP: step, TRAJECTORY: measured(rows, *TRAJECTORY)}
    labels = dict.fromkeys(label for shown in panels.values() for label in shown["label"])
    legend = {label: styles[label] for label in labels} | {FRONT: CurveStyle(INK, RING)}
    chart = Chart(name, SPEED_ACCURACY, title, CAPTION, legend)
    for columns, shown in panels.items():
        if len(shown):
            draw_panel(chart, shown, columns)
    return chart


def draw_panel(chart: Chart, rows: DataFrame, columns: Columns) -> None:
    """Draw the Pareto front, a line through the best points of each method, and all points."""
    title, x_title, y_title = TITLES[columns]
    if columns == STEP and (step := formatting.worded("time_step", rows["time_step"].iloc[0])):
        title += f", time step {step}"
    error, cost = columns
    rows = rows.join(spread(rows, cost))
    x = log_axis(x_title, rows[error], ERROR)
    y = log_axis(y_title, rows[["least", "greatest", cost]].to_numpy(), SECONDS)
    panel = chart.panel(title, x, y)
    front = front_rows(rows, columns)
    (_, right), (_, top) = x["scale"]["domain"], y["scale"]["domain"]
    errors, costs = list(front[error]), list(front[cost])
    panel.stair([errors[0], *errors, right], [top, *costs, costs[-1]])
    best = concat([front_rows(group, columns) for group in grouped(rows, "label").values()])
    panel.whiskers(rows, columns)
    panel.line(points(best, columns, ()))
    panel.mark(points(rows, columns, (*columns, *TIP)))
    panel.rings(front, columns)


# ---- surface error over cost

SIZES = "Surface error over cost"
SIZES_CAPTION = (
    "Lower is more exact, further left is cheaper. The surface error is the distance of the "
    "surface from that of a run with many more cells and shorter steps: rms over surface and time, "
    "relative to its largest displacement. It contains the errors of cells, time step and solver. "
    "A line joins runs of a method from few cells to many; rings mark the Pareto front."
)
SIZE = ("time_second", "surface_error")


def size_charts(table: DataFrame, styles: Styles) -> list[Chart]:
    """Return a chart of surface error over cost and over cells, with a curve for each method."""
    scenes = grouped(measured(succeeded(table), *SIZE), "scene")
    if not scenes:
        return []
    labels = dict.fromkeys(concat(scenes.values())["label"])
    own = {label: styles[label] for label in labels}
    chart = Chart("size", SIZES, SIZES, SIZES_CAPTION, own, columns=2, height=200)
    for scene, rows in scenes.items():
        draw_sizes(chart, scene, rows.sort_values("cells", kind="stable"))
    return [chart]


def draw_sizes(chart: Chart, scene: str, rows: DataFrame) -> None:
    """Draw the surface errors of a scene over cost and over cells."""
    y = log_axis("surface error", rows["surface_error"], ERROR)
    over_cost = chart.panel(scene, log_axis(COST, rows["time_second"], SECONDS), y)
    over_cost.rings(rows.iloc[front(list(rows["time_second"]), list(rows["surface_error"]))], SIZE)
    over_cells = chart.panel("", log_axis("valid cells", rows["cells"], COUNT), y)
    for panel, columns in ((over_cost, SIZE), (over_cells, ("cells", "surface_error"))):
        values = points(rows, columns, (*columns[::-1], "cells", "time_step", "error"))
        panel.line(values)
        panel.mark(values)


# ---- growth with the number of cells, as in the paper's Figure 6

GROWTH = "Growth with the number of cells"
GROWTH_CAPTION = (
    "Frames a second: higher is faster. A frame is one time step; set-up and factorisation, done "
    "once, are not counted (the paper's Figure 6). The legend gives the true step error of each "
    "curve: only curves of like error compare. A level curve of time a cell means cost "
    "proportional to the cells. Memory is the peak of all ranks, including the program itself and "
    "the surface mesh. Whiskers reach from the least to the greatest of the repeats."
)
# columns that distinguish the curves of a method, if they vary
VARIED = ("error", "max_iterations", "ranks")
GROWTH_TIP = (
    "time_frame", "memory", "iterations", "ksp_its", "true_error", "time_setup", "time_factor",
    "ranks",
)  # fmt: skip
# title, column, format of ticks, whether the column has a range over the repeats
GROWTH_PANELS = (
    ("frames a second", "fps", COUNT, True),
    ("time a frame and cell", "time_frame_a_cell", SECONDS, True),
    ("memory a cell", "memory_a_cell", BYTES, False),
    ("KSP iterations a step", "ksp_its", COUNT, False),
)


def growth_charts(table: DataFrame) -> list[Chart]:
    """Return a chart for each scene and time step if a curve has at least two cell counts."""
    charts = []
    rows = measured(succeeded(table), "cells")
    for (scene, time_step), group in grouped(rows, "scene", "time_step").items():
        curves = with_curves(group)
        if curves.groupby("label")["cells"].nunique().max() > 1:
            step = f", time step {formatting.seconds(time_step)}" if time_step > 0 else ""
            name = f"growth_{scene}_{formatting.plain(time_step)}"
            charts.append(growth_chart(name, f"{scene}{step}", curves))
    return [chart for chart in charts if chart.panels]


def with_curves(rows: DataFrame) -> DataFrame:
    """Return the rows with labels of curves: method, options that vary, and step error."""
    varied = [
        name for name in VARIED if (rows.groupby("label")[name].nunique(dropna=False) > 1).any()
    ]
    words = (
        [row["label"], *(formatting.entry(row, name) for name in varied)] for row in records(rows)
    )
    rows = rows.assign(label=[", ".join(filter(None, text)) for text in words])
    names = {label: label for label in rows["label"]}
    for label, reached in grouped(measured(rows, "true_error"), "label").items():
        ends = dict.fromkeys(
            map(formatting.error, (reached["true_error"].min(), reached["true_error"].max()))
        )
        names[label] += f" (step error {' to '.join(ends)})"
    return rows.assign(label=rows["label"].map(names))


def growth_chart(name: str, title: str, rows: DataFrame) -> Chart:
    """Return the chart of a scene and time step, with the panels that have data."""
    styles = curve_styles(rows["label"])
    rows = rows.assign(
        time_frame_a_cell=rows["time_frame"] / rows["cells"],
        memory_a_cell=rows["memory"] / rows["cells"],
    ).sort_values("cells", kind="stable")
    chart = Chart(name, GROWTH, f"Growth with cells: {title}", GROWTH_CAPTION, styles, columns=2)
    for title, column, words, timed in GROWTH_PANELS:
        shown = measured(rows, column)
        if shown.empty:
            continue
        x = log_axis("valid cells (k: thousand, M: million)", shown["cells"], COUNT)
        drawn = [column]
        if timed:
            shown = shown.join(spread(shown, column))
            drawn += ["least", "greatest"]
        panel = chart.panel(title, x, log_axis("", shown[drawn].to_numpy(), words))
        if timed:
            panel.whiskers(shown, ("cells", column))
        values = points(shown, ("cells", column), ("cells", column, *GROWTH_TIP))
        panel.line(values)
        panel.mark(values)
    return chart
