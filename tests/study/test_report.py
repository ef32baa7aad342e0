"""The report of a study: charts and page from the table alone."""

import re
from html import unescape
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from study_files import Balance, row_of, spaced, svgs, tooltips, write_rows

from msmpetsc.study.charts.curves import (
    STEP,
    front,
    front_rows,
    growth_charts,
    pareto_charts,
    size_charts,
)  # fmt: skip
from msmpetsc.study.charts.plot import RING, Axes, Chart, curve_styles
from msmpetsc.study.charts.profile import comparable, profile_charts, ratios
from msmpetsc.study.report import write_report
from msmpetsc.study.table import as_table, read_table

# label, error asked for, seconds of a frame, true error of a step, error of the motion
MEASURED = (
    ("newton", 1e-2, 0.05, 4e-3, 0.2), ("newton", 1e-4, 0.08, 3e-5, 0.1),
    ("anderson", 1e-2, 0.03, 6e-3, 0.21), ("anderson", 1e-4, 0.11, 7e-5, 0.11),
)  # fmt: skip
ERRORS = [
    *(
        row_of(label, error=error, time_frame=time, true_error=true, trajectory_error=motion)
        for label, error, time, true, motion in MEASURED
    ),
    row_of("verlet", preset="", time_frame=0.02, trajectory_error=4e-4, substep=0.001),
    row_of(
        "paper", status="failed", reason="frame 3 did not converge", error=1e-4, time_frame=1e-3,
        true_error=1e-7,
    ),
]  # fmt: skip
SWEEP = [
    row_of(
        label, scene="bunny", cells=n, time_frame=time, true_error=5e-4, ksp_its=its, memory=1e6 * n
    )
    for label, times, its in (
        ("cholesky", (0.01, 0.1, 2.0), 10), ("cg", (0.02, 0.09, 0.5), 40),
    )
    for n, time in zip((1000, 10000, 100000), times, strict=True)
]  # fmt: skip


@pytest.fixture(scope="module")
def study(tmp_path_factory) -> Path:
    """Return a folder with a report that has two kinds of charts."""
    folder = write_rows(tmp_path_factory.mktemp("study"), ERRORS + SWEEP)
    (folder / "study.toml").write_text('title = "Fast & exact"\n')
    assert write_report(folder) == folder / "report.html"
    return folder


@pytest.fixture(scope="module")
def text(study: Path) -> str:
    return spaced((study / "report.html").read_text())


# The Pareto front

# few values, so that ties are common
COSTS = st.integers(0, 6).map(float)


@given(st.lists(st.tuples(COSTS, COSTS), max_size=12))
def test_the_front_is_what_nothing_beats(points: list[tuple[float, float]]):
    def beaten(a: tuple[float, float]) -> bool:
        return any(b[0] <= a[0] and b[1] <= a[1] and b != a for b in points)

    found = front([x for x, _ in points], [y for _, y in points])
    assert set(found) == {index for index, point in enumerate(points) if not beaten(point)}
    errors = [points[i][0] for i in found]
    assert len(set(found)) == len(found) and errors == sorted(errors)


def test_errors_that_read_alike_are_no_reason_to_pay_more():
    rows = as_table(
        [row_of("a", true_error=e, time_frame=t) for e, t in ((0.10001, 1), (0.1, 2), (0.02, 3))]
    )
    assert list(front_rows(rows, STEP)["time_frame"]) == [3, 1]


def repeated(label: str, low: float, time: float, high: float, **given) -> dict[str, str]:
    times = {"time_frame": time, "time_frame_min": low, "time_frame_max": high}
    return row_of(label, repeats=3, **times, **given)


NOISY = [
    repeated("newton", 0.009, 0.010, 0.021, true_error=4e-3, trajectory_error=0.05),
    repeated("pipecg", 0.009, 0.012, 0.022, true_error=4e-3, trajectory_error=0.05),
    repeated("anderson", 0.020, 0.028, 0.037, true_error=5e-3, trajectory_error=0.05),
    repeated("anderson", 0.014, 0.029, 0.037, error=1e-4, true_error=1e-4, trajectory_error=0.05),
    repeated("lbfgs", 0.022, 0.030, 0.031, true_error=1e-4, trajectory_error=0.05),
]


def test_twenty_options_are_told_apart_by_colour_and_mark():
    styles = curve_styles(f"option {number}" for number in range(20))
    drawn = list(styles.values())
    triangles = {"triangle-up", "triangle-down", "triangle-left", "triangle-right"}
    for one, other in zip(drawn, drawn[11:], strict=False):
        assert one.color == other.color and one.shape != other.shape
        assert not {one.shape, other.shape} <= triangles
    rows = as_table([
        row_of(label, cells=cells, error=error, time_frame=1, true_error=error)
        for label in styles for error in (1e-1, 1e-2, 1e-3, 1e-4) for cells in (1000, 2000)
    ])  # fmt: skip
    (chart,) = growth_charts(rows)
    assert len(set(chart.styles.values())) == 80
    # the options that vary name the curves of a label
    assert list(chart.styles)[1] == "option 0, error 1e-2 (step error 1e-2)"


def values(panel: Axes, column: str) -> list:
    """Return the values of all layers of a panel that have this column."""
    return [value for layer in panel.layers for value in layer["data"]["values"] if column in value]


def curves_in(chart: Chart) -> dict[str, set[str]]:
    """Return the curves of each panel, by its title."""
    return {
        spaced(panel.title): {value["curve"] for value in values(panel, "curve")}
        for panel in chart.panels
    }


def test_whiskers_reach_from_the_least_to_the_greatest_of_the_repeats():
    growing = [
        repeated("cg", t / 2, t, 3 * t, cells=n, scene="s") for n, t in ((10, 0.1), (99, 1.0))
    ]
    rows = as_table([*NOISY, *growing])
    (pareto,), (growth,) = pareto_charts(rows, curve_styles(rows["label"])), growth_charts(rows)

    def ends(panel: Axes) -> list:
        return sorted({(value["y"], value["high"]) for value in values(panel, "high")})

    step, trajectory = map(ends, pareto.panels)
    assert step == [(0.009, 0.021), (0.009, 0.022), (0.014, 0.037), (0.02, 0.037), (0.022, 0.031)]
    assert trajectory[0] == pytest.approx((0.9, 2.1))
    speed, cost = map(ends, growth.panels)
    assert np.allclose(speed, [(1 / 3, 2), (1 / 0.3, 20)])
    assert np.allclose(cost, [(0.005, 0.03), (0.5 / 99, 3 / 99)])
    for panel in (*pareto.panels, *growth.panels):
        low, high = panel.y["scale"]["domain"]
        assert all(low <= a <= b <= high for a, b in ends(panel))
    once = pareto_charts(as_table(ERRORS), curve_styles(row["label"] for row in ERRORS))[0]
    assert not any(map(ends, once.panels))


def test_only_equal_time_steps_are_compared_by_the_step_error():
    longer = row_of("lbfgs", time_step=0.04, time_frame=0.01, true_error=1e-5, trajectory_error=0.5)
    rows = as_table([*ERRORS, longer])
    (chart,) = pareto_charts(rows, curve_styles(rows["label"]))
    shown = curves_in(chart)
    assert shown["over the step error, time step 10 ms"] == {"newton", "anderson"}
    assert shown["over the trajectory error"] == {"newton", "anderson", "verlet", "lbfgs"}


def test_the_page_is_well_formed_and_png_files_stand_beside_it(study: Path, text: str):
    assert Balance(text).open == [] and len(svgs(text)) == 3
    names = {"pareto_block_1000.png", "growth_bunny_0.01.png", "profile.png"}
    assert {path.name for path in study.glob("*.png")} == names
    assert all((study / name).read_bytes().startswith(b"\x89PNG") for name in names)
    ids = re.findall(r"""\sid=["']([^"']+)["']""", text)
    assert {"chart-pareto-block-1000", "chart-growth-bunny-0-01"} <= set(ids)
    assert len(set(ids)) == len(ids)
    assert "url(#" not in text and "xlink:href" not in text, "of another chart it may be"


def test_every_point_tells_its_numbers(text: str):
    tips = tooltips(text)
    # pareto's panels, growth's panels; the ends and jumps of two profiles
    assert len(tips) == (4 + 5) + 4 * 6 + (4 + 3)
    for row in (row for row in ERRORS + SWEEP if row["status"] == "ok"):
        assert any(row["label"] in tip and row["command"] in tip for tip in tips), row
    assert any("true error 3e-5\ntime frame 80 ms\ntime step 10 ms\n" in tip for tip in tips)


def test_the_report_needs_nothing_beside_itself(text: str):
    assert not re.search(r"(src|href)\s*=\s*.?\s*(https?:)?//", text)
    assert not re.search(r"@import|url\(\s*.?https?:|<link|<img|fetch\(|<script src", text)


def test_the_whole_table_and_every_command_are_in_it(text: str):
    assert all(row["command"] in text for row in ERRORS + SWEEP) and "<td>0.004</td>" in text
    assert "<h1>Fast &amp; exact</h1>" in text
    assert "frame 3 did not converge" in text.split("Failed cases")[1].split("All cases")[0]


def test_labels_are_escaped(tmp_path: Path):
    label = "a<b>&\"c'"
    rows = [row_of(label, true_error=1e-3, time_frame=0.1, reason="", scene=label, study=label)]
    rows.append(row_of(label, status="failed", reason=label, scene=label))
    text = write_report(write_rows(tmp_path, rows)).read_text()
    assert Balance(text).open == []
    assert "<b>" not in text and label in unescape(text)
    assert tooltips(text)[0].startswith(label)
    assert [path.name for path in tmp_path.glob("*.png")] == ["pareto_a_b_c__1000.png"]


BAD = ("nan", "inf", "0", "-1", "", "?")
LITTLE = {
    "no case": ([], 0),
    "one case": (ERRORS[:1], 1),
    "all failed": (ERRORS[-1:] * 3, 0),
    "no number": ([row_of("a", true_error=bad, time_frame=0.1) for bad in BAD], 0),
    "no cells": ([row_of("a", true_error=1e-3, time_frame=0.1, cells="")], 1),
}


@pytest.mark.parametrize("little", LITTLE)
def test_tables_with_little_in_them(tmp_path: Path, little: str):
    rows, charts = LITTLE[little]
    text = write_report(write_rows(tmp_path, rows)).read_text()
    assert Balance(text).open == [] and len(svgs(text)) == charts


def test_surface_errors_are_drawn_over_cost_a_curve_a_way_to_step(tmp_path: Path):
    """Fill is both cheaper and more accurate than whole cells, except on the coarsest lattice."""
    rows = [
        row_of(label, scene="heart", cells=n, time_frame=time, surface_error=error)
        for label, errors in (("whole", (0.3, 0.2, 0.1)), ("fill", (0.2, 0.05, 0.01)))
        for n, time, error in zip((250, 700, 2000), (0.01, 0.02, 0.08), errors, strict=True)
    ]
    failed = {"status": "failed", "reason": "a pin holds no node", "time_frame": 1e-3}
    rows.append(row_of("fill", scene="heart", **failed))
    text = write_report(write_rows(tmp_path, rows)).read_text()
    assert ">heart<" in text and (tmp_path / "size.png").is_file()
    # a chart over cost and a chart over cells
    assert len([title for title in tooltips(text) if "surface error " in title]) == 2 * 6
    assert "a pin holds no node" in text
    table = read_table(tmp_path)
    (chart,) = size_charts(table, curve_styles(table["label"]))
    (rings,) = [layer for layer in chart.panels[0].layers if layer["mark"].get("shape") == RING]
    assert [value["y"] for value in rings["data"]["values"]] == [0.2, 0.05, 0.01]


def test_only_the_first_scenes_have_charts_of_their_own(tmp_path: Path):
    rows = [row_of("a", scene=name, true_error=1e-3, time_frame=0.1) for name in "xyz"]
    text = write_report(write_rows(tmp_path, rows), most_scenes=1).read_text()
    assert [path.name for path in tmp_path.glob("*.png")] == ["pareto_x_1000.png"]
    assert "none for the last 2 scenes, from y on" in text


# Performance profiles

# seconds of each method on five problems; None for a failure
PROFILED = {
    "newton": (1.0, 2.0, 3.0, 4.0, None),
    "anderson": (3.0, 1.0, 1.5, None, None),
}


def profiled() -> list[dict[str, str]]:
    rows = []
    for label, times in PROFILED.items():
        for n, time in enumerate(times):
            failed = {"status": "timeout", "cells": ""} if time is None else {}
            given = {"error": 1e-3, "cells": 1000 * (n + 1), "time_frame": time or ""} | failed
            rows.append(row_of(label, **given))
    # only a third method's budget solves the last problem, which is no comparison
    return [*rows, row_of("newton", max_iterations=1, time_frame=1e-9, cells=1000)]


def test_a_profile_is_the_share_within_each_factor():
    """Factors of newton are 1, 2, 2, 1; of anderson 3, 1, 1 and a failure.

    All methods fail on the fifth problem, whose cells are not counted.
    """
    table = as_table(profiled())
    (chart,) = profile_charts(table, curve_styles(table["label"]))
    (problems,) = comparable(table)
    found = ratios(problems, "time_frame")
    expected = {"newton": [1, 2, 2, 1, np.inf], "anderson": [3, 1, 1, np.inf, np.inf]}
    assert found.to_dict("list") == expected
    (panel,) = chart.panels
    assert panel.title == "by seconds", "no products were counted"
    line = panel.layers[0]["data"]["values"]
    steps = {label: [(p["x"], p["y"]) for p in line if p["curve"] == label] for label in PROFILED}
    right = pytest.approx(1.1 * 3)
    assert steps["newton"] == [(1, 0.4), (2, 0.8), (right, 0.8)]
    assert steps["anderson"] == [(1, 0.4), (3, 0.6), (right, 0.6)]


@pytest.mark.parametrize("other, titles", [
    ("newton-multigrid", ["by seconds", "by products with the Hessian"]),
    ("fast-msm", ["by seconds"]),
])  # fmt: skip
def test_a_profile_compares_products_of_methods_with_a_hessian_alone(other, titles):
    """The preset fast-msm solves with A: 300 solves a step count as a few products."""
    rows = [
        row_of(label, error=1e-3, cells=cells, time_frame=1.0, products=5)
        for label in ("newton", other)
        for cells in (1000, 2000, 3000)
    ]
    table = as_table(rows)
    (chart,) = profile_charts(table, curve_styles(table["label"]))
    assert [panel.title for panel in chart.panels] == titles


def test_a_profile_needs_three_problems_with_the_same_methods():
    table = as_table([row for row in profiled() if row["cells"] in ("1000", "2000")])
    assert not profile_charts(table, curve_styles(table["label"]))
    alone = as_table([row for row in profiled() if row["label"] == "newton"])
    assert not profile_charts(alone, curve_styles(alone["label"]))
