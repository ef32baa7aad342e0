"""Sizing: errors from runs of several sizes, and the integrator and cells that a plan chooses."""

# ruff: noqa: F811 (fixtures are imported)
import json
import math
import shutil
import tomllib
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest
from conftest import ROOT, python
from one_process import command_error, status_of
from study_files import SCENE, own_log  # noqa: F401 (fixtures)

from msmpetsc.cli.commands import plan as plan_command
from msmpetsc.errors import InputError
from msmpetsc.scene.reading import load_scene
from msmpetsc.study.cases import Case
from msmpetsc.study.metrics import surface_error
from msmpetsc.study.sizing import trials
from msmpetsc.study.sizing.choice import (
    Budget,
    Choice,
    PlannedMethod,
    SizePlan,
    overrides,
    put_into,
    tables,
)
from msmpetsc.study.sizing.orders import ORDERS, ErrorLaw, cosine_of, error_law
from msmpetsc.study.sizing.trials import Sizer, fewest_cells
from msmpetsc.study.table import Row

STATIC = 'integrator = "static"'


@pytest.mark.parametrize("order", [1.2, 1.6, 2.0])
@pytest.mark.parametrize("sizes", [(4, 2, 1), (4.3, 1.9, 1)])
def test_three_sizes_tell_order_and_error(order: float, sizes: tuple):
    """The error is 0.03 size^order exactly."""
    e = [0.03 * size**order for size in sizes]
    law = error_law(sizes, [e[0] - e[1], e[1] - e[2]], ORDERS)
    assert law.observed and law.order == pytest.approx(order)
    assert law.error(0.5) == pytest.approx(0.03 * 0.5**order)
    assert law.size(law.error(0.7)) == pytest.approx(0.7)


def test_an_order_that_cannot_be_is_not_believed():
    """If distances do not shrink, the least order is taken, which gives the greatest error."""
    stuck = error_law((4, 2, 1), [0.05, 0.05], ORDERS)
    assert not stuck.observed and stuck.order == 1 and stuck.error(1) == pytest.approx(0.05)
    steep = error_law((4, 2, 1), [0.5, 0.01], ORDERS)
    assert steep.order == 2.2 and steep.error(1) == pytest.approx(0.01 / (2**2.2 - 1))
    two = error_law((2, 1), [0.05], ORDERS)
    assert not two.observed and two.error(1) == pytest.approx(0.05)


def test_an_error_that_jumps_between_two_like_sizes_has_a_law():
    """Its order would be 618, and 0.2^618 underflows."""
    jump = ErrorLaw(1.0, 1.5).through((0.2, 0.5), (0.198, 0.001))
    assert jump.error(0.2) == pytest.approx(0.5) and jump.size(0.1) < 0.2


@pytest.mark.parametrize("error", [0.0, 1e-300, 5e-324])
def test_no_number_of_cells_is_enough_for_a_vanishing_error(error: float):
    assert fewest_cells(ErrorLaw(0.03, 1.0), error) == math.inf


@pytest.mark.parametrize(("order", "cosine"), [(1.0, 0.0), (1.5, 0.0), (1.5, 0.5), (2.0, 0.9)])
def test_lattices_that_err_by_chance(order: float, cosine: float):
    """The difference of two runs is at an angle to the error of the finer run.

    An angle of 0 would overestimate the error.
    """
    sizes, e = (4.0, 2.0, 1.0), [0.03 * size**order for size in (4, 2, 1)]
    first, second = (math.sqrt(a**2 - (1 - cosine**2) * b**2) - cosine * b for a, b in pairwise(e))
    across = math.sqrt(first**2 + second**2 + 2 * cosine * first * second)
    assert cosine_of(first, second, across) == pytest.approx(cosine, abs=1e-6)
    law = error_law(sizes, [first, second], ORDERS, cosine)
    assert law.order == pytest.approx(order, abs=1e-6) and law.error(1) == pytest.approx(0.03)
    assert law.measured(second, 1) == pytest.approx(e[1])
    assert error_law(sizes[1:], [second], (order, order)).error(1) > law.error(1)
    assert cosine_of(0, 1, 1) == 1


class Bodies:
    """A bench whose runs follow formulas.

    The error has parts of cells, of order 1.5, of time steps and of their solution.

    explicit   : whether verlet runs, at a third of the cost of BDF2
    cell_error : error of a single cell [-]; most: largest error of the cells [-]
    inverted   : function of the cells: number of cells inside out at the end
    """

    def __init__(
        self, *, explicit: bool = True, impacts: bool = False, cell_error: float = 1.0,
        most: float = math.inf, fails=lambda *_: False, inverted=lambda cells: 0.0,
    ):  # fmt: skip
        self.explicit, self.impacts, self.cell_error = explicit, impacts, cell_error
        self.most, self.fails, self.inverted = most, fails, inverted
        # errors by result file
        self.errors: dict[Path, float] = {}

    def result_of(self, case: Case) -> Path:
        return Path(case.id)

    def distance(self, a: float, b: float) -> float:
        """Return the distance of two results of these errors."""
        return abs(a - b)

    def error_of(self, method: PlannedMethod, cells: int) -> float:
        time = method.time_error or (1e-3 if method.integrator == "verlet" else 0.0)
        stuck = 0.3 * (len(self.errors) % 2) if self.impacts else 0.0
        of_cells = min(self.most, self.cell_error * cells**-0.5)
        return of_cells + time + 0.1 * (method.step_error or 0) + stuck

    def measure(self, case: Case, keep: bool) -> Row:
        assert keep and case.stores_surface
        tables = tomllib.loads("\n".join(case.set))
        time, cells = tables["time"], tables["cages"]["count"]
        assert time["step"] == case.time_step
        integrator, solver = time.get("integrator", "implicit-euler"), tables.get("solver", {})
        explicit = integrator == "verlet"
        if explicit and not self.explicit:
            return {"status": "timeout", "reason": "took longer than 1 s"}
        if self.fails(integrator, cells):
            return {"status": "failed", "reason": "planted"}
        method = PlannedMethod(integrator, time.get("error"), solver.get("error"))
        self.errors[self.result_of(case)] = self.error_of(method, cells)
        cost = 1e-6 * cells * (1 if explicit else 3) / case.time_step
        row = {"status": "ok", "reason": "", "cells": float(cells), "time_second": cost}
        return row | {"inverted": self.inverted(cells)}


def sized(
    tmp_path: Path, monkeypatch, target: float, cells: int = 6400, advised: float = 0.0, **bodies
) -> tuple[SizePlan, Bodies, list]:
    path = tmp_path / "scene.toml"
    if not path.exists():
        path.write_text(SCENE)
    bench, said = Bodies(**bodies), []

    def distance(a: Path, b: Path) -> float:
        return bench.distance(bench.errors[a], bench.errors[b])

    monkeypatch.setattr(trials, "surface_error", distance)
    asked = {"target": target, "frames": 10, "cells": cells, "advised": advised}
    return Sizer(path, bench, said.append, **asked).plan(), bench, said


@pytest.mark.parametrize("explicit", [True, False])
@pytest.mark.parametrize("target", [0.1, 0.03])
def test_the_plan_meets_the_error_and_wastes_little(
    tmp_path: Path, monkeypatch, explicit: bool, target: float
):
    """The choice's own error by the formula is slightly below the error asked for."""
    plan, bench, _ = sized(tmp_path, monkeypatch, target, explicit=explicit)
    method, cells = plan.choice.method, plan.choice.cells
    assert plan.met and not plan.bounds and (method.integrator == "verlet") == explicit
    # the plan extrapolates measured errors, which are slightly off
    assert 0.7 * target < bench.error_of(method, cells) <= 1.01 * target
    assert plan.choice.budget.total <= target and len(plan.tried) >= 4


@pytest.mark.parametrize("cell_error", [1.5, 3.7, 5.2])
def test_the_error_of_a_choice_is_what_is_said(tmp_path: Path, monkeypatch, cell_error: float):
    """The choice may have fewer cells than the finest lattice, nearly as many, or many more."""
    plan, bench, _ = sized(tmp_path, monkeypatch, 0.04, cell_error=cell_error, explicit=False)
    true = bench.error_of(plan.choice.method, plan.choice.cells)
    assert plan.met and plan.choice.budget.total == pytest.approx(true, rel=0.2)


@pytest.mark.parametrize("target", [0.1, 0.05])
def test_a_choice_is_little_better_than_asked_for_where_lattices_err_by_chance(
    tmp_path: Path, monkeypatch, target
):
    """The difference of two runs is at right angles to the error of the finer run, of order 1.

    The sum of both would be twice as much.
    """

    monkeypatch.setattr(Bodies, "error_of", lambda self, method, cells: 1.4 * cells ** (-1 / 3))
    monkeypatch.setattr(Bodies, "distance", lambda self, a, b: math.sqrt(abs(a**2 - b**2)))
    plan, *_ = sized(tmp_path, monkeypatch, target, 64_000, explicit=False)
    assert plan.met and 0.6 * target < 1.4 * plan.choice.cells ** (-1 / 3) < 1.1 * target


def test_statics_are_planned_by_their_cells_alone(tmp_path: Path, monkeypatch):
    """Static scenes need neither a step nor a duration."""
    static = SCENE.replace("step = 0.01, duration = 0.1", STATIC)
    (tmp_path / "scene.toml").write_text(static)
    plan, bench, _ = sized(tmp_path, monkeypatch, 0.1)
    assert plan.met and {each.method.integrator for each in plan.tried} == {"static"}
    assert 0.07 < bench.error_of(plan.choice.method, plan.choice.cells) <= 0.1
    monkeypatch.setattr(plan_command, "size_all", lambda *_: plan)
    assert status_of("plan", tmp_path / "scene.toml", "--surface-error", "0.1", "--write") == 0
    written = load_scene(tmp_path / "scene.toml")
    assert written.cages.count == plan.choice.cells
    assert "step" not in tomllib.loads(written.text)["time"]


def test_few_cells_are_tried_first(tmp_path: Path, monkeypatch):
    """An error of 0.1 needs 100 of 64,000 cells allowed, which trials of 1,000 show.

    An error of 0.01 needs trials of all 64,000.
    """
    for target, finest in ((0.1, 1000), (0.01, 64_000)):
        plan, bench, _ = sized(tmp_path, monkeypatch, target, 64_000)
        assert plan.met and max(each.cells for each in plan.tried) == finest
        assert bench.error_of(plan.choice.method, plan.choice.cells) > 0.7 * target


@pytest.mark.parametrize(("advised", "finest"), [(900, 1000), (3000, 8000), (1e6, 64_000)])
def test_thin_walls_are_tried_on_enough_cells(
    tmp_path: Path, monkeypatch, advised: float, finest: int
):
    """The plan says that the hundred cells for an error of 0.1 are too few for thin walls."""
    plan, *_ = sized(tmp_path, monkeypatch, 0.1, 64_000, advised)
    assert max(each.cells for each in plan.tried) == finest
    (told,) = plan.bounds
    assert plan.met and told.startswith(f"the cells: on {plan.choice.cells} cells a tenth")
    assert told.endswith(f"{advised:.0f} would do")


def test_where_the_error_jumps_the_fewest_cells_beyond_are_taken(tmp_path: Path, monkeypatch):
    """The error jumps at 300 cells, as if a foot folded differently.

    No lattice has the error asked for, or slightly less.
    """

    def error(self: Bodies, method: PlannedMethod, cells: int) -> float:
        return cells**-0.5 if cells > 300 else 2 * cells**-0.5

    monkeypatch.setattr(Bodies, "error_of", error)
    plan, *_ = sized(tmp_path, monkeypatch, 0.1)
    assert plan.met and 300 < plan.choice.cells < 330
    assert plan.choice.budget.total == pytest.approx(plan.choice.cells**-0.5, rel=0.2)


def test_a_coarsest_lattice_that_is_good_by_chance_takes_no_cells(tmp_path: Path, monkeypatch):
    """Errors of 0.1, 0.07 and 0.025 show no order. The usual order is assumed, and is right."""
    plan, bench, _ = sized(tmp_path, monkeypatch, 0.1, cell_error=2.0, most=0.1)
    assert plan.bounds == ["the cells: their distances show no order; order 1.5 is assumed"]
    assert max(each.cells for each in plan.tried) == 6400
    assert plan.met and bench.error_of(plan.choice.method, plan.choice.cells) > 0.75 * 0.1


def test_a_choice_that_fails_is_not_made(tmp_path: Path, monkeypatch):
    """Verlet fails on the chosen cells, but not on the cells tried before.

    The plan takes BDF2 and says so.
    """
    first, *_ = sized(tmp_path, monkeypatch, 0.1)
    runs_away = lambda integrator, cells: integrator == "verlet" and cells == first.choice.cells  # noqa: E731
    plan, _, said = sized(tmp_path, monkeypatch, 0.1, fails=runs_away)
    assert plan.met and "verlet" in plan.bounds[0]
    assert [each.choice.method.integrator for each in (first, plan)] == ["verlet", "bdf2"]
    assert any("planted" in text for text in said if isinstance(text, str))


def test_where_the_coarsest_lattice_fails_a_finer_one_stands_in(tmp_path: Path, monkeypatch):
    """The order is found although the coarsest lattice fails, as without a pinned node."""
    plan, *_ = sized(tmp_path, monkeypatch, 0.1, fails=lambda _, cells: cells == 100)
    assert plan.met and not plan.bounds and {each.cells for each in plan.tried} >= {200, 800, 6400}


def test_lattices_alike_are_one_lattice(tmp_path: Path, monkeypatch):
    """A lattice of a single cell has no coarser lattice."""
    with pytest.raises(InputError, match=r"only one lattice could be run.*--cells N"):
        sized(tmp_path, monkeypatch, 0.1, cells=1)


# by the words of the limit: the target, and properties of the bodies
BOUNDS = {
    # at most 8 times the cells are allowed, which leaves 1.8e-2
    "the mesh's cells": (1e-2, {"cell_error": 4.0}),
    # two integrators do not agree
    "the step": (0.1, {"impacts": True}),
    # the trials differ by 0.4, so the usual order is assumed
    "the cells: their distances show no order": (0.2, {"cell_error": 5.0, "most": 0.45}),
}


@pytest.mark.parametrize("bound", BOUNDS)
def test_a_plan_says_what_bounds_the_error(tmp_path: Path, monkeypatch, bound: str):
    target, bodies = BOUNDS[bound]
    plan, bench, _ = sized(tmp_path, monkeypatch, target, **bodies)
    assert any(said.startswith(bound) for said in plan.bounds) and plan.met == ("order" in bound)
    if plan.met:
        assert 0.14 < bench.error_of(plan.choice.method, plan.choice.cells) <= 0.2
    if bound == "the mesh's cells":
        assert plan.choice.cells == 8 * 6400
        # a finer lattice was tried before the refusal
        assert max(each.cells for each in plan.tried) == round(6400 * 2**1.5)


def test_a_plan_says_that_cells_end_inside_out(tmp_path: Path, monkeypatch):
    """Cells of the finest lattice count, so order 1 is assumed. Coarser lattices do not matter."""
    finest, coarser = (lambda n: 7.0 * (n == 6400)), (lambda n: 7.0 * (n < 6400))
    plan, *_ = sized(tmp_path, monkeypatch, 0.1, inverted=finest)
    order, motion = plan.bounds
    assert "order 1 is assumed" in order and motion.endswith("fewer --frames may help")
    without, *_ = sized(tmp_path, monkeypatch, 0.1, inverted=coarser)
    assert without.bounds == [] and plan.choice.cells >= without.choice.cells


def test_runs_that_fail_are_told_and_end_the_plan_in_a_line(tmp_path: Path, monkeypatch):
    said: list = []
    bench = Bodies(explicit=False, fails=lambda *_: True)
    (tmp_path / "scene.toml").write_text(SCENE)
    sizer = Sizer(tmp_path / "scene.toml", bench, said.append, target=0.1, frames=10)
    with pytest.raises(InputError, match="the trials failed"):
        sizer.plan()
    assert all("planted" in text for text in said) and len(said) == 2
    (tmp_path / "scene.toml").write_text(SCENE.replace("count = 10", "cell_size = 0.1"))
    with pytest.raises(InputError, match="--cells N says how many"):
        Sizer(tmp_path / "scene.toml", bench, print, target=0.1, frames=10)


def true_error(scene: Path, *, choice: list[str], finer: list[str]) -> float:
    """Return the error of a plan's choice against a finer run of 32 times the cells."""
    fine = [f"cages.count={32 * load_scene(scene).cages.count}", *finer]
    results = [scene.with_name("choice.h5"), scene.with_name("finer.h5")]
    for result, changes in zip(results, (choice, fine), strict=True):
        own = [word for change in ("output.surface=true", *changes) for word in ("--set", change)]
        python("-m", "msmpetsc", "run", scene, "-o", result, *own, check=True)
    return surface_error(*results)


@pytest.fixture
def soft_beam(tmp_path: Path) -> Path:
    for name in ("beam_soft.toml", "beam.obj"):
        shutil.copy(ROOT / "scenes" / "studies" / name, tmp_path)
    return tmp_path / "beam_soft.toml"


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_true_error_of_a_plan_is_what_was_asked_for(soft_beam: Path):
    """The plan of a soft beam meets a run in explicit substeps, whose own error is small."""
    words = ["--surface-error", "0.1", "--cells", "1000", "--frames", "20", "--write"]
    assert status_of("plan", soft_beam, *words) == 0
    every = max(1, round(1 / 60 / load_scene(soft_beam).time.step))
    # simulated time of the trials [s]
    tried = 20 / 60
    choice = [f"output.every={every}", f"time.duration={tried}"]
    fine = [f"time={{step = 0.016666666666666666, duration = {tried}, integrator = 'verlet'}}"]
    error = true_error(soft_beam, choice=choice, finer=fine)
    assert 0.6 * 0.1 < error < 1.1 * 0.1


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_true_error_of_a_plan_of_statics_is_what_was_asked_for(soft_beam: Path):
    """The plan of a soft beam at rest under its weight meets an error of 0.05."""
    text = soft_beam.read_text()
    time = text[text.index("[time]") : text.index("[gravity]")]
    soft_beam.write_text(text.replace(time, f"[time]\n{STATIC}\n\n"))
    words = ["--surface-error", "0.05", "--cells", "1000", "--write"]
    assert status_of("plan", soft_beam, *words) == 0
    assert 0.6 * 0.05 < true_error(soft_beam, choice=[], finer=[]) < 1.1 * 0.05


PLAN = SizePlan(
    Choice(PlannedMethod("bdf2", 0.005, 1e-2), 4321, Budget(0.05, 0.031), 7.5),
    met=True, bounds=["the step: planted"],
)  # fmt: skip


def test_the_command_tells_the_answer_and_writes_it(tmp_path: Path, monkeypatch, capsys, own_log):
    monkeypatch.setattr(plan_command, "size_all", lambda *_: print("what was tried") or PLAN)
    path = tmp_path / "scene.toml"
    path.write_text(SCENE.replace("count = 10", "cell_size = 0.1"))
    assert status_of("plan", path, "--surface-error", "0.1", "--write") == 0
    out, written = capsys.readouterr().out, load_scene(path)
    assert "7.5 computing seconds a simulated second" in out and "the step: planted" in out
    assert written.cages.count == 4321 and written.cages.cell_size is None
    assert (written.time.integrator, written.time.error) == ("bdf2", 0.005)
    assert written.solver.error == 0.01
    assert status_of("plan", path, "--json") == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["met"] and answer["choice"]["cells"] == 4321
    assert answer["error"] == pytest.approx(0.081)


COMMENTED = """# A scene of mine
title = "x"      # for the reader

[time]
step = 0.02      # [s]
duration = 1.0

[solver]         # how
preset = "anderson"
max_iterations = 5
"""


def test_what_is_written_into_a_scene_keeps_its_comments(tmp_path: Path):
    path = tmp_path / "scene.toml"
    path.write_bytes(COMMENTED.replace("\n", "\r\n").encode())
    put_into(path, tables(PlannedMethod("implicit-euler", 0.005, 1e-2)))
    time = 'integrator = "implicit-euler"\nerror = 0.005\n'
    expected = COMMENTED.replace("= 1.0\n", f"= 1.0\n{time}").replace("anderson", "newton")
    expected = expected.replace("max_iterations = 5", "error = 0.01").replace("\n", "\r\n")
    assert path.read_bytes().decode() == expected
    put_into(path, tables(PlannedMethod("verlet")))
    assert 'integrator = "verlet"' in path.read_text() and "# how" in path.read_text()


BEFORE = {
    "bare": "time = { step = 0.02, duration = 1.0 }",
    "implicit": "time = { step = 0.02, duration = 1.0, integrator = 'implicit-euler' }\n"
    "solver = { preset = 'anderson', max_iterations = 5 }",
    "verlet": "time = { step = 0.02, duration = 1.0, integrator = 'verlet', substep = 1e-4 }\n"
    "solver.error = 0.1",
}


@pytest.mark.parametrize(
    "method", [PlannedMethod("verlet"), PlannedMethod("implicit-euler", 0.005, 1e-5)], ids=str
)
@pytest.mark.parametrize("given", BEFORE)
def test_the_command_of_a_plan_says_what_its_lines_say(
    tmp_path: Path, given: str, method: PlannedMethod
):
    """With the printed changes the scene is the same as with the choice written into it."""
    path = tmp_path / "scene.toml"
    path.write_text(SCENE[: SCENE.index("time =")] + BEFORE[given])
    changed = load_scene(path, overrides(path, tables(method)))
    put_into(path, tables(method))
    written = load_scene(path)
    assert (changed.time, changed.solver) == (written.time, written.solver)
    assert changed.time.error == method.time_error and changed.time.integrator == method.integrator


def test_what_cannot_be_met_is_told_with_status_3_and_not_written(
    tmp_path: Path, monkeypatch, capsys, own_log
):
    monkeypatch.setattr(plan_command, "size_all", lambda *_: replace(PLAN, met=False))
    path = tmp_path / "scene.toml"
    path.write_text(SCENE)
    assert status_of("plan", path, "--surface-error", "0.01", "--write") == 3
    assert path.read_text() == SCENE and "nothing meets 0.01" in capsys.readouterr().out


def test_an_error_that_makes_no_sense_is_refused_in_one_line(tmp_path: Path, own_log):
    told = command_error("plan", tmp_path / "scene.toml", "--surface-error", 2)
    assert "between 0 and 1" in told
