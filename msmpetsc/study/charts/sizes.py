"""The error of the surface over what it costs: of a study's lattices and steps, and of the trials of a plan."""

from pathlib import Path
from typing import TYPE_CHECKING

from msmpetsc.study import formatting
from msmpetsc.study.charts.pareto import front
from msmpetsc.study.charts.plot import (
    DASH,
    ERROR,
    FAINT,
    SECONDS,
    Chart,
    CurveStyle,
    Numbers,
    Styles,
    curve_styles,
    log_axis,
    save_png,
)
from msmpetsc.study.table import grouped, measured, records, succeeded

if TYPE_CHECKING:
    from pandas import DataFrame

    from msmpetsc.study.sizing.answer import SizePlan

KIND = "Surface error over cost"
COST, SURFACE_ERROR = "computing time a simulated second", "surface error"
CAPTION = (
    "Lower is more exact, further left is cheaper. The surface error is how far the surface is from that of a run of "
    "many more cells and shorter steps, rms over the surface and time, of its largest displacement: cells, time step "
    "and unfinished steps together. A line joins the cells of one way to step, few at its left end."
)
COLUMNS = "time_second", "surface_error"
NUMBERS: Numbers = {
    SURFACE_ERROR: (formatting.error, "surface_error"),
    COST: (formatting.seconds, "time_second"),
    "cells": (formatting.count, "cells"),
    "time step": (formatting.seconds, "time_step"),
    "error asked for": (formatting.error, "error"),
}

NUMBERS_OF_TRIALS = {name: NUMBERS[name] for name in (SURFACE_ERROR, COST, "cells")}


def size_charts(table: "DataFrame", styles: Styles) -> list[Chart]:
    """Return one chart for each scene with surface errors."""
    charts = []
    for scene, rows in grouped(table, "scene").items():
        shown = measured(succeeded(rows), *COLUMNS)
        if len(shown):
            charts.append(size_chart(scene, shown, styles))
    return charts


def size_chart(scene: str, rows: "DataFrame", styles: Styles) -> Chart:
    """Return a curve a way to step, over its numbers of cells; what nothing else beats is ringed."""
    x, y = log_axis(COST, rows["time_second"], SECONDS), log_axis(SURFACE_ERROR, rows["surface_error"], ERROR)
    groups = grouped(rows, "label")
    chart = Chart(f"size_{scene}", KIND, f"{KIND}: {scene}", CAPTION, {label: styles[label] for label in groups})
    panel = chart.panel(scene, x, y)
    for group in groups.values():
        panel.curve(group.sort_values("cells", kind="stable"), COLUMNS, NUMBERS)
    panel.rings(rows.iloc[front(list(rows["time_second"]), list(rows["surface_error"]))], COLUMNS)
    least = {label: records(group.nsmallest(1, "surface_error"))[0] for label, group in groups.items()}
    chart.findings["The smallest surface error"] = [
        f"{label}: {formatting.error(row['surface_error'])} with {formatting.count(row['cells'])} cells."
        for label, row in least.items()
    ]
    return chart


def plan_picture(plan: "SizePlan", target: float, path: Path) -> None:
    """Write a PNG of the trials' expected errors over their costs, by integrator; the choice is ringed."""
    from pandas import DataFrame

    choice = plan.choice
    tried = [(trial.method, trial.cost, trial.error, trial.cells) for trial in plan.tried]
    rows = DataFrame(tried, columns=["label", *COLUMNS, "cells"]).assign(command="")
    chosen = DataFrame([(choice.cost, choice.budget.total)], columns=list(COLUMNS))
    x = log_axis(COST, [*rows["time_second"], choice.cost], SECONDS)
    y = log_axis(f"{SURFACE_ERROR}, estimated", [*rows["surface_error"], *chosen["surface_error"], target], ERROR)
    styles = curve_styles(sorted(set(rows["label"]))) | {"asked for": CurveStyle(FAINT, DASH)}
    chart = Chart(path.stem, KIND, f"{KIND}: the trials of a plan", "", styles)
    panel = chart.panel("tried, and ringed what is chosen", x, y)
    panel.line(x["scale"]["domain"], [target, target], strokeDash=[6, 4])
    panel.mark(rows, COLUMNS, NUMBERS_OF_TRIALS)
    panel.text(rows, COLUMNS, [formatting.count(cells) for cells in rows["cells"]])
    panel.rings(chosen, COLUMNS)
    save_png(chart, path.parent)
