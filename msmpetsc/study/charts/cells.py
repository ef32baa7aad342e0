"""Growth with the number of cells: frames a second, as in the paper's Figure 6, time, memory and KSP iterations."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

from msmpetsc.study import formatting
from msmpetsc.study.charts.plot import BYTES, COUNT, SECONDS, SHAPES, Chart, CurveStyle, Numbers, Styles, log_axis
from msmpetsc.study.table import grouped, measured, reach, records, succeeded

if TYPE_CHECKING:
    from pandas import DataFrame

KIND = "Growth with the number of cells"
CAPTION = (
    "Frames a second: higher is faster, and a frame is one time step; set-up and factorisation, done once, are not "
    "counted (the paper's Figure 6). The legend says which true step error each curve reached: only curves of like "
    "error compare. Per cell, a level curve means a cost in proportion to the cells. Memory is the peak of all ranks, "
    "the program itself and the surface mesh included. Whiskers reach from the least to the greatest of the repeats."
)
VARIED = ("error", "max_iterations", "ranks")  # columns that may differ between curves of one method
NUMBERS: Numbers = {
    "computing time a frame": (formatting.seconds, "time_frame"),
    "least of the repeats": (formatting.seconds, "time_frame_min"),
    "greatest of the repeats": (formatting.seconds, "time_frame_max"),
    "memory": (formatting.size, "memory"),
    "iterations a step": (formatting.count, "iterations"),
    "KSP iterations a step": (formatting.count, "ksp_its"),
    "true step error": (formatting.error, "true_error"),
    "set-up": (formatting.seconds, "time_setup"),
    "factorisation": (formatting.seconds, "time_factor"),
    "ranks": (formatting.count, "ranks"),
}


class Quantity(NamedTuple):
    """A panel: a column, of which ``shown`` is a cell's part or the whole; timed: whether it varies with the time."""

    title: str
    column: str
    shown: str
    tick: str
    word: Callable[[Any], str]
    timed: bool = False


QUANTITIES = (
    Quantity("frames a second", "fps", "fps", COUNT, formatting.plain, timed=True),
    Quantity("time a frame and cell", "time_frame", "time_frame_a_cell", SECONDS, formatting.seconds, timed=True),
    Quantity("memory a cell", "memory", "memory_a_cell", BYTES, formatting.size),
    Quantity("KSP iterations a step", "ksp_its", "ksp_its", COUNT, formatting.count),
)


def growth_charts(table: "DataFrame", styles: Styles) -> list[Chart]:
    """Return one chart for each scene and time step where some curve has two cell counts or more."""
    charts = []
    for (scene, time_step), rows in grouped(measured(succeeded(table), "cells"), "scene", "time_step").items():
        rows = with_curves(rows)
        if rows.groupby("curve")["cells"].nunique().max() > 1:
            step = f", time step {formatting.seconds(time_step)}" if time_step > 0 else ""
            charts.append(growth_chart(f"growth_{scene}_{formatting.plain(time_step)}", f"{scene}{step}", rows, styles))
    return [chart for chart in charts if chart.panels]


def with_curves(rows: "DataFrame") -> "DataFrame":
    """Return the rows with a column ``curve``: the method, what else was varied within it, and its true step error."""
    varied = [name for name in VARIED if (rows.groupby("label")[name].nunique(dropna=False) > 1).any()]
    words = ([row["label"], *(formatting.setting(row, name) for name in varied)] for row in records(rows))
    rows = rows.assign(curve=[", ".join(filter(None, text)) for text in words])
    reached = {curve: f"{curve}{errors(group)}" for curve, group in grouped(rows, "curve").items()}
    return rows.assign(curve=rows["curve"].map(reached))


def errors(rows: "DataFrame") -> str:
    """Return the true step errors that a curve reached, as a range; empty where none was measured."""
    reached = measured(rows, "true_error")["true_error"]
    ends = dict.fromkeys(formatting.error(end) for end in (reached.min(), reached.max()))
    return f" (step error {' to '.join(ends)})" if len(reached) else ""


def styles_of(curves: "DataFrame", styles: Styles) -> Styles:
    """Return the style of each curve: curves of one label share its colour and differ in their marker."""
    of_label: dict[str, int] = {}
    found = {}
    for curve, label in curves.itertuples(index=False):
        number = of_label[label] = of_label.get(label, -1) + 1
        shape = SHAPES[(SHAPES.index(styles[label].shape) + number) % len(SHAPES)]
        found[curve] = CurveStyle(styles[label].color, shape)
    return found


def growth_chart(name: str, title: str, rows: "DataFrame", styles: Styles) -> Chart:
    """Return the panels that have data."""
    rows = rows.assign(
        time_frame_a_cell=rows["time_frame"] / rows["cells"], memory_a_cell=rows["memory"] / rows["cells"]
    )
    own = styles_of(rows[["curve", "label"]].drop_duplicates(), styles)
    chart = Chart(name, KIND, f"Growth with cells: {title}", CAPTION, own, columns=2)
    for quantity in QUANTITIES:
        shown = measured(rows, quantity.column).sort_values("cells", kind="stable")
        if shown.empty:
            continue
        heights = reach(shown, quantity.shown).to_numpy().ravel() if quantity.timed else shown[quantity.shown]
        x = log_axis("valid cells (k: thousand, M: million)", shown["cells"], COUNT)
        panel = chart.panel(quantity.title, x, log_axis("", heights, quantity.tick))
        columns = "cells", quantity.shown
        numbers = {
            "valid cells": (formatting.count, "cells"),
            quantity.title: (quantity.word, quantity.shown),
        } | NUMBERS
        for curve, group in grouped(shown, "curve").items():
            if quantity.timed:
                panel.whiskers(group, columns, own[curve].color)
            panel.curve(group, columns, numbers, "curve")
    return chart
