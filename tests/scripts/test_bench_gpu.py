"""scripts/bench_gpu.py where there is no GPU."""

import sys

import bench_gpu
import pytest

from msmpetsc.solve.petsc import device


def test_without_a_gpu_it_says_so(capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch):
    if device.what_is_missing() is None:
        pytest.skip("there is one")
    monkeypatch.setattr(sys, "argv", ["bench_gpu"])
    assert bench_gpu.main() == 2
    assert capsys.readouterr().err.count("\n") == 1
