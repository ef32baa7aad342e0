"""Growth with the number of cells: frames a second (the paper's Figure 6), time, memory, iterations."""

from pandas import DataFrame

from msmpetsc.study import formatting
from msmpetsc.study.charts.plot import BYTES, COUNT, SECONDS, SHAPES, Chart, CurveStyle, Styles, log_axis
from msmpetsc.study.table import grouped, measured, reach, records, succeeded

KIND = "Growth with the number of cells"
CAPTION = (
    "Frames a second: higher is faster, and a frame is one time step; set-up and factorisation, done once, are not "
    "counted (the paper's Figure 6). The legend says which true step error each curve reached: only curves of like "
    "error compare. Per cell, a level curve means a cost in proportion to the cells. Memory is the peak of all ranks, "
    "the program itself and the surface mesh included. Whiskers reach from the least to the greatest of the repeats."
)
VARIED = ("error", "max_iterations", "ranks")  # may differ between curves of one method
TOLD = ("time_frame", "memory", "iterations", "ksp_its", "true_error", "time_setup", "time_factor", "ranks")
PANELS = (  # title, column, how its ticks are written, whether it varies with the time
    ("frames a second", "fps", COUNT, True),
    ("time a frame and cell", "time_frame_a_cell", SECONDS, True),
    ("memory a cell", "memory_a_cell", BYTES, False),
    ("KSP iterations a step", "ksp_its", COUNT, False),
)


def growth_charts(table: DataFrame, styles: Styles) -> list[Chart]:
    """Return a chart for each scene and time step where some curve has two cell counts or more."""
    charts = []
    for (scene, time_step), rows in grouped(measured(succeeded(table), "cells"), "scene", "time_step").items():
        rows = with_curves(rows)
        if rows.groupby("curve")["cells"].nunique().max() > 1:
            step = f", time step {formatting.seconds(time_step)}" if time_step > 0 else ""
            charts.append(growth_chart(f"growth_{scene}_{formatting.plain(time_step)}", f"{scene}{step}", rows, styles))
    return [chart for chart in charts if chart.panels]


def with_curves(rows: DataFrame) -> DataFrame:
    """Return the rows with a column ``curve``: method, what varied in it, and its step error."""
    varied = [name for name in VARIED if (rows.groupby("label")[name].nunique(dropna=False) > 1).any()]
    words = ([row["label"], *(formatting.entry(row, name) for name in varied)] for row in records(rows))
    rows = rows.assign(curve=[", ".join(filter(None, text)) for text in words])
    names = {curve: curve for curve in rows["curve"]}
    for curve, reached in grouped(measured(rows, "true_error"), "curve").items():
        ends = dict.fromkeys(map(formatting.error, (reached["true_error"].min(), reached["true_error"].max())))
        names[curve] += f" (step error {' to '.join(ends)})"
    return rows.assign(curve=rows["curve"].map(names))


def styles_of(curves: DataFrame, styles: Styles) -> Styles:
    """Return the style of each curve: those of one label share its colour, and have own markers."""
    found = {}
    number = curves.groupby("label").cumcount()
    for curve, label, more in zip(curves["curve"], curves["label"], number, strict=True):
        shape = SHAPES[(SHAPES.index(styles[label].shape) + more) % len(SHAPES)]
        found[curve] = CurveStyle(styles[label].color, shape)
    return found


def growth_chart(name: str, title: str, rows: DataFrame, styles: Styles) -> Chart:
    """Return the panels that have data."""
    rows = rows.assign(
        time_frame_a_cell=rows["time_frame"] / rows["cells"], memory_a_cell=rows["memory"] / rows["cells"]
    ).sort_values("cells", kind="stable")
    own = styles_of(rows[["curve", "label"]].drop_duplicates().sort_index(), styles)
    chart = Chart(name, KIND, f"Growth with cells: {title}", CAPTION, own, columns=2)
    for title, column, words, timed in PANELS:
        shown = measured(rows, column)
        if shown.empty:
            continue
        x = log_axis("valid cells (k: thousand, M: million)", shown["cells"], COUNT)
        heights = reach(shown, column).to_numpy().ravel() if timed else shown[column]
        panel = chart.panel(title, x, log_axis("", heights, words))
        if timed:
            panel.whiskers(shown, ("cells", column), "curve")
        panel.curves(shown, ("cells", column), ("cells", column, *TOLD), "curve")
    return chart
