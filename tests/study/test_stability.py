"""Maps of a study: their cases, the outcome of a run, and the charts. The runs are stand-ins."""

# ruff: noqa: F811 (fixtures are imported)
import re
from itertools import product
from pathlib import Path

import pytest
from one_process import input_error
from study_files import (
    Balance,
    all_cases,
    carry_out,
    row_of,
    stand_in,  # noqa: F401 (fixtures)
    study_file,
    svgs,
    tooltips,
    write_rows,
)

from msmpetsc.study.cases import shown_command
from msmpetsc.study.charts.stability import COLORS, SYMBOLS
from msmpetsc.study.outcomes import MEANING, OUTCOMES, counted, outcome
from msmpetsc.study.report import write_report
from msmpetsc.study.study_file import load_study

METHODS = """
[[method]]
label = "newton"
error = 1e-2
options = "-pc_type icc"

[[method]]
label = "explicit"
integrator = "verlet"
"""
X = 'x = { name = "time step", key = "time.step", unit = "s", values = [0.001, 5] }\n'
CHANGES = '["material.density={value}", "gravity.acceleration=[0, 0, -{value}]"]'
Y = f'y = {{ name = "density", template = {CHANGES}, values = [10, 20] }}\n'
GRID = '[[map]]\nname = "g"\nfile = "scene.toml"\nsteps = 4\n'
NAMED = '[[map]]\nname = "n"\n[[map.case]]\nname = "a"\nfile = "scene.toml"\nsteps = 4\n'


def test_a_map_is_each_method_at_each_place(tmp_path: Path):
    found = all_cases(tmp_path, METHODS + GRID + X + Y)
    places = [(one.point.y, one.point.x, one.label) for one in found]
    assert places == [*product((10.0, 20.0), (0.001, 5.0), ("newton", "explicit"))]
    assert len({one.id for one in found}) == 8
    # a time step longer than the scene
    long = shown_command(found[2])
    assert "material.density=10.0" in long and "gravity.acceleration=[0, 0, -10.0]" in long
    assert "step = 5.0, duration = 20.0" in long and 'preset = "newton", error = 0.01' in long
    assert long.endswith("-pc_type icc")
    explicit = shown_command(found[1])
    assert (
        'integrator = "verlet"' in explicit and "solver" not in explicit and "icc" not in explicit
    )


def test_a_method_may_change_every_scene(tmp_path: Path):
    solid = '[[method]]\nlabel = "solid"\nset = ["material.law=neo-hookean"]\n'
    (one,) = all_cases(tmp_path, solid + NAMED)
    assert one.set[0] == "material.law=neo-hookean" and one.point.x == "solid"


def test_named_cases_have_their_own_options_for_what_solves(tmp_path: Path):
    newton, explicit = all_cases(
        tmp_path, METHODS + NAMED + 'options = "-ksp_max_it 1"\nrecovers = true'
    )
    assert newton.options == "-pc_type icc -ksp_max_it 1" and explicit.options == ""
    assert (newton.point.x, newton.point.y, newton.point.recovers) == ("newton", "a", True)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (GRID + X + Y, ["method"]),
        (METHODS + GRID + X, ["map.0", "needs x and y"]),
        (METHODS + NAMED + '[[map.case]]\nname = "a"\nfile = "x"', ["map.0", "two cases", "'a'"]),
        (METHODS + GRID + 'methods = ["newtom"]\n' + X + Y, ["method", "'newtom'", "'newton'"]),
        (METHODS * 2 + GRID + X + Y, ["method", "two methods", "'newton'"]),
    ],
)
def test_a_mistake_in_a_map_is_told(tmp_path: Path, text: str, words: list[str]):
    path = study_file(tmp_path, text)
    assert all(word in input_error(lambda: load_study(path)) for word in words)


# How a run is judged

FINE = {"frames": 3, "shape_error": 0.0, "iterations": 30.0, "inverted": 0.0}


@pytest.mark.parametrize(
    ("status", "kind", "figures", "recovers", "expected"),
    [
        (0, "", {}, True, "ok"),
        (0, "", {"iterations": 30.1}, False, "slow"),
        (0, "", {"iterations": 300.0, "integrator": "verlet"}, False, "ok"),
        (0, "", {"iterations": 31.0, "inverted": 1.0}, False, "inverted"),
        (0, "", {"shape_error": 0.021, "inverted": 1.0}, True, "not recovered"),
        (0, "", {"shape_error": 0.021}, False, "ok"),
        (0, "", {"shape_error": None}, False, "not finite"),
        (3, "line search", {}, False, "diverged"),
        (3, "energy", {}, False, "energy"),
        (3, "not finite", {"inverted": 1.0}, True, "not finite"),
        (3, "refused", {}, False, "refused"),
        (2, "", {}, False, "refused"),
        (None, "", {}, False, "timeout"),
        (1, "", {}, False, "crashed"),
        (-11, "energy", {}, False, "crashed"),
        (0, "", {"frames": None}, False, "crashed"),
    ],
)
def test_the_worst_that_befell_a_run_is_its_outcome(status, kind, figures, recovers, expected):
    assert outcome(status, kind, FINE | figures, recovers) == expected


def test_every_outcome_has_a_meaning_a_colour_and_a_mark():
    assert set(OUTCOMES) == set(MEANING) == set(COLORS) == {*SYMBOLS, "slow", "ok"}


def test_a_map_that_fails_is_an_answer(tmp_path: Path, stand_in):
    options = ("", "-ksp_exit 3 -ksp_kind energy", "-ksp_exit 2", "-ksp_fail")
    methods = (
        f'[[method]]\nlabel = "{label}"\noptions = "{words}"\n'
        for label, words in enumerate(options)
    )
    rows = carry_out(tmp_path, "".join(methods) + NAMED, jobs=2)
    assert [row["outcome"] for row in rows] == ["ok", "energy", "refused", "crashed"]
    assert [row["status"] for row in rows] == ["ok"] + 3 * ["failed"]
    assert rows[0]["shape_error"] < 1e-12 and rows[1]["frames"] == 5 and rows[0]["map"] == "n"
    assert counted(row["outcome"] for row in rows) == "1 ok, 1 energy, 1 refused, 1 crashed"
    page = write_report(tmp_path / "out").read_text()
    assert "Failed cases" not in page and "4: 1 ok, 1 energy, 1 refused, 1 crashed" in page


def place(label: str, x: float, y: float, outcome: str, **given) -> dict:
    at = {"map": "g", "x": float(x), "y": float(y), "scene": "g"}
    status = "ok" if outcome in OUTCOMES[-4:] else "failed"
    return row_of(label, outcome=outcome, status=status, **at, **given)


STUDY = """
[[map]]
name = "g"
title = "A map"
x = { name = "time step", key = "time.step", unit = "s", values = [1e-4, 1e-2, 1] }
y = { name = "modulus", key = "m", unit = "Pa", values = [1e3, 1e5] }
"""
PLACES = [
    place(label, x, y, "ok" if x < 1 else worst, **given)
    for label, worst, given in (
        ("newton", "slow", {"iterations": 4.2}), ("verlet", "diverged", {"reason": "ran away"}),
    )
    for y in (1e3, 1e5) for x in (1e-4, 1e-2, 1)
]  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = write_rows(tmp_path_factory.mktemp("atlas"), PLACES)
    (folder / "study.toml").write_text(STUDY)
    write_report(folder)
    return folder


def test_each_cell_has_its_mark_and_tells_its_numbers(folder: Path):
    text = (folder / "report.html").read_text().replace("\N{NO-BREAK SPACE}", " ")
    assert Balance(text).open == [] and len(svgs(text)) == 1
    tips = tooltips(text)
    assert len(tips) == 12
    assert any("time step 1 s\nmodulus 100 kPa\noutcome diverged\n" in tip for tip in tips)
    marks = re.findall(r"<text[^>]*>([^<]*)</text>", text)
    assert marks.count("D") == 2 and marks.count("4") == 6
    assert "Failed cases" not in text and "12: 8 ok, 2 slow, 2 diverged" in text
