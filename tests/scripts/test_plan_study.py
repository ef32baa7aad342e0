"""The study of plans: what is run once, and what a choice is held against."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import plan_study
import pytest

from msmpetsc.study.cases import Case
from msmpetsc.study.process import Processes
from msmpetsc.study.runner import Bench, CaseResult
from msmpetsc.study.sizing.choice import Budget, Candidate, Choice

CASE = Case(scene="", file=Path(), content="", set=(), integrator="verlet", time_step=0.01, timeout=10.0)
NOTHING = Budget(0.0, 0.0, 0.0)


@pytest.mark.parametrize(("status", "runs"), [("ok", 1), ("failed", 1), ("timeout", 2)])
def test_a_run_is_made_once_unless_it_may_take_longer(tmp_path: Path, monkeypatch, status: str, runs: int):
    """A second bench of the folder knows it; one that ran out of time is made again when it has more."""
    made = []

    def measure(bench: Bench, case: Case, keep: bool) -> CaseResult:
        made.append(case)
        bench.result_of(case).parent.mkdir(exist_ok=True)
        bench.result_of(case).touch()
        return CaseResult({"status": status, "cells": 7.0}, None, 1.5)

    monkeypatch.setattr(Bench, "measure", measure)
    results = [
        plan_study.LastingBench(tmp_path, Processes()).measure(replace(CASE, timeout=limit)) for limit in (10, 5, 20)
    ]
    assert len(made) == runs and all(each == results[0] for each in results)
    plan_study.LastingBench(tmp_path, Processes()).result_of(CASE).unlink()
    plan_study.LastingBench(tmp_path, Processes()).measure(CASE)
    assert len(made) == runs + (status == "ok")


def trial(integrator: str, step: float, cells: float, cost: float) -> SimpleNamespace:
    return SimpleNamespace(method=Candidate(integrator, step), cells=cells, cost=cost)


@pytest.mark.parametrize(("cells", "finer"), [(100, 1250), (400, 3200)])
def test_the_finer_run_has_more_cells_than_any_trial_of_the_plan(cells: int, finer: int):
    sizer = SimpleNamespace(trials=[trial("verlet", 0.01, 1000.0, 1.0)])
    choice = Choice(Candidate("verlet", 0.01), cells, NOTHING, 1.0, NOTHING)
    assert plan_study.finer_cells(sizer, choice, 8) == finer


def test_a_finer_run_takes_the_cheaper_way():
    """Explicit substeps of their own length, or BDF2 in a quarter of the step, by what the trials cost."""
    choice = Choice(Candidate("implicit-euler", 0.02, "newton", 1e-2), 1000, NOTHING, 2.0, NOTHING)
    sizer = SimpleNamespace(trials=[trial("verlet", 0.01, 1000.0, 1.0)], step=0.01, duration=0.5)
    (seconds, explicit), (more, implicit) = plan_study.finer_methods(sizer, choice, 8000)
    assert explicit == Candidate("verlet", 0.01) and seconds == pytest.approx(0.5 * 16)
    assert implicit == Candidate("bdf2", 0.005, "newton", 1e-3) and more == pytest.approx(0.5 * 2 * 8 * 4)
    sizer.trials = [trial("verlet", 0.001, 1000.0, 1.0)]  # a trial of the step's error alone
    assert [method.integrator for _, method in plan_study.finer_methods(sizer, choice, 8000)] == ["bdf2"]


def test_the_finer_run_of_a_static_choice_is_static():
    choice = Choice(Candidate("static", 1.0, "newton", "", 1e-1), 100, NOTHING, 2.0, NOTHING)
    sizer = SimpleNamespace(trials=[trial("static", 1.0, 1000.0, 1.0)], step=1.0, duration=1.0)
    ((seconds, method),) = plan_study.finer_methods(sizer, choice, 3200)
    assert method == replace(choice.method, step_error=1e-3) and seconds == pytest.approx(2 * 32)
