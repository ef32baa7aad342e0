"""scripts/bench.py: which frames count, how its figures are made, what a run of it leaves."""

import csv
import sys
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path

import numpy as np
import pytest
from conftest import ENVIRONMENT, ROOT
from mpi4py import MPI

from msmpetsc.model.build import build_model
from msmpetsc.scene.reading import load_scene

COST = {
    "cells": 1000,
    "nodes": 100_000,
    "memory": 2e8,
    "time": {"setup": 1.5},
    "hierarchy": {"bytes": 1e8, "builds": 2},
}


@pytest.fixture(scope="module")
def bench():
    sys.path.insert(0, str(ROOT / "scripts"))
    loader = SourceFileLoader("bench", str(ROOT / "scripts" / "bench.py"))
    module = module_from_spec(spec_from_loader(loader.name, loader))
    sys.modules[loader.name] = module
    loader.exec_module(module)
    yield module
    sys.path.remove(str(ROOT / "scripts"))


def one_run(bench, seconds: list[float], iterations: list[int], its: int = 30):
    iterations = np.array(iterations)
    frames = {"wall_time": np.array(seconds), "iterations": iterations, "ksp_its": its * iterations}
    return bench.Run(frames | {"products": 2 * its * iterations, "step_error": 1e-4 * iterations}, COST)


def test_frames_that_count_are_those_that_all_had_to_solve_but_the_first(bench):
    runs = [one_run(bench, [1.0] * 4, iterations) for iterations in ([1, 2, 0, 3], [1, 1, 1, 1])]
    assert bench.moving(runs).tolist() == [False, True, False, True]
    assert bench.moving([one_run(bench, [1.0] * 2, [2, 0])]).tolist() == [True, False]  # better than none
    falls = [one_run(bench, [1.0] * 2, [0, 0])]
    assert bench.moving(falls).tolist() == [True, True] and bench.figures(falls, bench.moving(falls))["KSP its"] == 0


def test_figures_are_of_the_frames_that_count(bench):
    """Frames of 9 s, which does not count, 0.1, 0.2 and 0.6 s; the other repeat takes twice as long."""
    runs = [one_run(bench, [9.0, *(k * s for s in (0.1, 0.2, 0.6))], [9, 1, 2, 3]) for k in (1, 2)]
    found = bench.figures(runs, bench.moving(runs))
    assert (found["ms"], found["ms least"], found["ms greatest"]) == pytest.approx((300, 200, 400))
    assert found["frames a second"] == pytest.approx(1 / 0.45) and found["us a cell"] == pytest.approx(300)
    assert (found["its an iteration"], found["KSP its"], found["products"]) == (30, 60, 120)
    assert found["error"] == pytest.approx(3e-4) and found["kB a node"] == 2 and found["set-up s"] == 1.5


def test_what_a_run_leaves(bench, tmp_path: Path, capsys, monkeypatch):
    """Four, two and one seconds a frame, and 0.6 on two ranks; one method of a row fails."""
    seconds = {"newton-jacobi": 4.0, "newton, gamg": 2.0, "newton": 1.0}
    calls = []

    def pretended(case, words, folder, ranks=1):
        name = next(name for name in bench.METHODS if bench.METHODS[name] == words)
        calls.append((name, ranks))
        failed = case.name == "heart_pull" and name == "newton, gamg"
        return None if failed else one_run(bench, [0.6 if ranks > 1 else seconds[name]] * 2, [1, 1])

    monkeypatch.setattr(bench, "run", pretended)
    words = ["bench.py", "--only", "1e5", "heart", "--repeats", "2", "--out", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", words)
    bench.main()
    heart, beam, ranks = csv.DictReader((tmp_path / "bench.csv").open())
    assert [float(row["times as fast"]) for row in (heart, beam, ranks)] == pytest.approx([4, 2, 1 / 0.6])
    assert heart["newton, gamg: ms"] == "" and float(heart["paper, GPU"]) == 53.4
    names = [name for name, _ in calls]
    assert names[:5] == ["newton-jacobi", "newton, gamg", "newton", "newton-jacobi", "newton"]  # it is not tried again
    assert calls[-4:] == [("newton", 1), ("newton", 2)] * 2
    table = capsys.readouterr().out.splitlines()
    assert (
        len(table) == 5 and "4000 | 2000 | 1000 | 2 (3)" in table[3] and len({line.count(" | ") for line in table}) == 1
    )
    assert (tmp_path / "bench.png").read_bytes()[:4] == b"\x89PNG"


def test_the_beam_is_the_one_of_the_table(bench, tmp_path: Path):
    model = build_model(MPI.COMM_SELF, load_scene(bench.beam("beam 1e4", tmp_path)))
    assert (len(model.lattice.cells), len(model.lattice.nodes)) == (40 * 15 * 15, 41 * 16 * 16)
    assert model.lattice.pinned.sum() == 16 * 16


def test_a_run_is_a_real_one(bench, tmp_path: Path, monkeypatch, capsys):
    monkeypatch.setattr(bench, "ENVIRONMENT", ENVIRONMENT)
    monkeypatch.setattr(bench, "BEAMS", {"beam 1e4": (8, 5e5, 2)})
    case = bench.Case("beam 1e4", bench.beam("beam 1e4", tmp_path), None)
    done = bench.run(case, bench.METHODS["newton, gamg"], tmp_path)
    assert len(done.frames["ksp_its"]) == 2 and done.frames["products"].min() > 0 and done.cost["cells"] == 8 * 3 * 3
    assert bench.run(case, ["-gone"], tmp_path) is None and "-gone" in capsys.readouterr().err
