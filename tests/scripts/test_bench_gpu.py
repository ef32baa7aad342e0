"""scripts/bench_gpu.py, which has no GPU here, on a pretended one: that it runs to its end, and counts what it says."""

import os
import sys
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path
from unittest.mock import patch

import pytest
from block_scene import block_scene
from conftest import ENVIRONMENT, ROOT
from mpi4py import MPI
from pretend_gpu import pretended

from msmpetsc.backend import cuda
from msmpetsc.model.build import build_model
from msmpetsc.scene.reading import load_scene

GPU_ALONE = {"A, by a kernel", "Hessian product in a graph"}
FALL = {"time": {"step": 0.01, "duration": 0.08}, "gravity": {"acceleration": [0, 0, -9.81]}}


@pytest.fixture(scope="module")
def bench():
    loader = SourceFileLoader("bench_gpu", str(ROOT / "scripts" / "bench_gpu.py"))
    module = module_from_spec(spec_from_loader(loader.name, loader))
    sys.modules[loader.name] = module
    loader.exec_module(module)
    return module


def test_parts_and_a_frame_are_measured(bench, tmp_path: Path, capsys: pytest.CaptureFixture):
    path = block_scene(tmp_path, **FALL, pin=[{"region": {"box": [[0, 0, 0], [0.1, 1, 1]], "relative": True}}])
    scene = load_scene(path)
    model = build_model(MPI.COMM_SELF, scene)
    quick = {"REPEATS": 2, "ITERATIONS": 3, "bandwidth": lambda like: 1e10}
    quick["in_a_graph"] = lambda function, times=1: function() or 1e-6
    with pretended(), patch.multiple(bench, **quick), patch.object(cuda, "wait", lambda: None):
        patched_load = {"load_scene": lambda *_: scene, "build_model": lambda *_: model}
        with patch.multiple(bench, **patched_load), patch.object(bench.device, "choose", lambda *_: None):
            args = type("Arguments", (), {"frames": 4})
            found = bench.dissected(32, args)
    frame = found["a frame"]
    assert min(found["GPU"].values()) > 0 and found["GPU"].keys() == found["CPU"].keys() | GPU_ALONE
    assert found["CPU"]["bound of one"] == bench.bound(model) / 1e10
    assert frame["bytes to the CPU"] == model.lattice.nodes.nbytes and frame["to the CPU"] == 1
    assert frame["to the GPU"] == 0 < frame["CG iterations"] < frame["launches"]
    bench.print_parts(found)
    assert "take" in capsys.readouterr().out


@pytest.mark.slow
def test_runs_are_compared(bench, tmp_path: Path, capsys: pytest.CaptureFixture):
    """Here none of them is on a GPU, and that one is told to have failed."""
    path = block_scene(tmp_path, **FALL)
    args = type("Arguments", (), {"scenes": ["scene"], "cells": [], "frames": 5, "error": 1e-3, "cores": 2})
    (tmp_path / "scenes").mkdir()
    for file in tmp_path.glob("scene.*"):
        file.rename(tmp_path / "scenes" / file.name)
    with patch.object(bench, "ROOT", tmp_path), patch.dict(os.environ, ENVIRONMENT):
        (row,) = bench.compared(args, tmp_path)
    assert row["cells"] == 32 and row["frames/s, GPU"] is None and row["error"] < 1e-3
    assert min(row["frames/s, one core"], row["frames/s, all cores"]) > 0 and path.name == "scene.toml"
    assert bench.device.what_is_missing() in capsys.readouterr().err


def test_without_a_gpu_it_says_so(bench, capsys: pytest.CaptureFixture):
    if bench.device.what_is_missing() is None:
        pytest.skip("there is one")
    with patch.object(sys, "argv", ["bench_gpu"]):
        assert bench.main() == 2
    assert capsys.readouterr().err.count("\n") == 1
