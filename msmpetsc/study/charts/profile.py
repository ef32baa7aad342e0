"""Performance profiles: the share of problems that a method solves within a factor of the best.

Source: Dolan and More 2002, Benchmarking optimization software with performance profiles, Math.
Program. 91, 201-213.
"""

from collections.abc import Iterator

import numpy as np
from pandas import DataFrame

from msmpetsc.solve.presets import PRESETS
from msmpetsc.study.charts.plot import Chart, Styles, channel
from msmpetsc.study.table import measured, succeeded

PROFILE = "Performance profile"
CAPTION = (
    "The share of problems that a method solves within a factor of the best method of each "
    "problem; higher is better. The left end shows how often a method is the best, the right end "
    "how often it solves a problem at all. A problem is a scene with its cells, time step and "
    "error asked for. Runs with a budget of iterations reach no such error and are left out."
)
# columns that define a problem; its rows differ in their label
PROBLEM = ["scene", "time_step", "error", "cells"]
# fewest problems of a profile
FEWEST = 3
# title of a panel by its column
COSTS = {"time_frame": "seconds", "products": "products with the Hessian"}
# presets whose solves with the constant matrix A are no products
WITHOUT_HESSIAN = [name for name, preset in PRESETS.items() if not preset.true_hessian]


def profile_charts(table: DataFrame, styles: Styles) -> list[Chart]:
    """Return a chart for each set of methods that were run on at least FEWEST common problems."""
    return [
        profile_chart(f"profile_{number}" if number > 1 else "profile", problems, styles)
        for number, problems in enumerate(comparable(table), 1)
    ]


def comparable(table: DataFrame) -> Iterator[list[DataFrame]]:
    """Yield, for each set of two or more methods, the rows of problems that all were run on."""
    rows = with_cells(table[~(table["max_iterations"] > 0)])
    by_methods: dict[frozenset[str], list[DataFrame]] = {}
    for _, group in rows.groupby(PROBLEM, sort=False, dropna=False):
        by_methods.setdefault(frozenset(group["label"]), []).append(group)
    for methods, problems in by_methods.items():
        if len(methods) > 1 and len(problems) >= FEWEST:
            yield problems


def with_cells(rows: DataFrame) -> DataFrame:
    """Return the rows, with the missing cell counts of killed runs filled in.

    A killed run gets a cell count that other methods have and its own method lacks.
    """
    rows = rows.copy()
    for _, group in rows.groupby(PROBLEM[:-1], sort=False, dropna=False):
        sizes = group["cells"].dropna().unique()
        for _, own in group.groupby("label", sort=False):
            lost = own.index[own["cells"].isna()]
            lacking = [cells for cells in sizes if cells not in set(own["cells"])]
            count = min(len(lost), len(lacking))
            rows.loc[lost[:count], "cells"] = lacking[:count]
    return rows


def ratios(problems: list[DataFrame], cost: str) -> DataFrame:
    """Return cost over the least cost of a problem: a row per problem, a column per method.

    An entry is infinite if the method did not solve the problem.
    """
    table = []
    for rows in problems:
        costs = measured(succeeded(rows), cost).groupby("label")[cost].min()
        table.append(costs / costs.min())
    labels = dict.fromkeys(label for rows in problems for label in rows["label"])
    return DataFrame(table, columns=list(labels)).fillna(np.inf).reset_index(drop=True)


def profile_chart(name: str, problems: list[DataFrame], styles: Styles) -> Chart:
    """Return the chart of problems, with a panel for each cost that was measured.

    Products are left out if a method solves with the constant matrix A, because they miss its work.
    """
    labels = dict.fromkeys(label for rows in problems for label in rows["label"])
    own = {label: styles[label] for label in labels}
    chart = Chart(name, PROFILE, f"{PROFILE}: {len(problems)} problems", CAPTION, own, columns=2)
    costs = dict(COSTS)
    if any(rows["preset"].isin(WITHOUT_HESSIAN).any() for rows in problems):
        del costs["products"]
    for cost, title in costs.items():
        factors = ratios(problems, cost)
        if np.isfinite(factors).any(axis=None):
            draw_profile(chart, title, factors)
    return chart


def draw_profile(chart: Chart, title: str, factors: DataFrame) -> None:
    """Draw the share of problems over the factor as a step function for each method."""
    known = factors.to_numpy(float)
    right = max(1.1 * float(known[np.isfinite(known)].max()), 2.0)
    x = channel("factor", "format(datum.value, '~g')", type="log", domain=[1, right])
    y = channel("problems", "format(datum.value, '.0%')", domain=[0, 1])
    panel = chart.panel(f"by {title}", x, y)
    values = []
    for label, column in zip(factors, known.T, strict=True):
        for end in np.unique([1.0, *column[np.isfinite(column)], right]).tolist():
            share = float((column <= end).mean())
            tip = f"{label}\n{share:.0%} within {end:.3g}"
            values.append({"x": end, "y": share, "curve": label, "tip": tip})
    panel.line(values, interpolate="step-after")
    panel.mark(values)
