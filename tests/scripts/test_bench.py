"""scripts/bench.py: how figures follow from runs, and a real run."""

import sys
from pathlib import Path

import lab

import bench
import numpy as np
import pytest

from msmpetsc.solve.petsc import device

COST = {
    "device": "cpu", "cells": 1000, "nodes": 100_000, "memory": 2e8,
    "time": {"setup": 1.5, "cycle": 4.0, "fine": 3.0}
}  # fmt: skip


def sample(seconds: list[float]) -> bench.Sample:
    """Return a run's measurements: seconds per frame, 1 iteration, 30 KSP its, 60 products."""
    frames = {"wall_time": np.array(seconds), "step_error": np.linspace(0, 1e-4, len(seconds))}
    counts = {"iterations": 1, "ksp_its": 30, "products": 60, "proof_products": 6}
    return bench.Sample(
        frames | {name: np.full(len(seconds), count) for name, count in counts.items()}, COST
    )


def test_figures_are_of_all_frames_but_the_first_and_of_the_median_repeat():
    repeats = [sample([9.0, *(k * s for s in (0.1, 0.2, 0.6))]) for k in (1, 2, 4)]
    row = bench.row("heart_pull", {"old": [sample([9.0, 1.8])], "failed": [], "new": repeats})
    assert row["new [ms]"] == "600 (300 to 1,200)" and row["failed [ms]"] is None
    assert row["times as fast"] == pytest.approx(3) and row["products"] == "60 / - / 60"
    assert row["slowest tenth [ms]"] == pytest.approx(1200)
    assert row["frames/s (paper's CPU, GPU)"] == "1.67 (19.9, 53.4)"
    assert (row["proof"], row["coarse"]) == ("10.0%", "25.0%")
    assert (row["us a cell"], row["kB a node"], row["error"]) == pytest.approx((600, 2, 1e-4))


def test_a_run_is_a_real_one(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(lab, "OUT", tmp_path)
    monkeypatch.setattr(bench, "BEAMS", {"beam 1e4": (8, 5e5, 2)})
    done = bench.measured("beam 1e4", bench.METHODS["newton, gamg"], None)
    assert len(done.frames["ksp_its"]) == 2 and done.frames["products"].min() > 0
    assert done.cost["cells"] == 8 * 3 * 3
    assert bench.measured("beam 1e4", bench.Method(("-gone",)), None) is None


def test_without_a_gpu_it_says_so(capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch):
    if device.what_is_missing() is None:
        pytest.skip("there is one")
    monkeypatch.setattr(sys, "argv", ["bench.py", "--gpu"])
    assert bench.main() == 2
    assert capsys.readouterr().err.count("\n") == 1
