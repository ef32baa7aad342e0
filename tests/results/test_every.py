"""Storing every N-th step only: the same steps, fewer frames, and nothing computed for those left out."""

from pathlib import Path

import numpy as np
import pytest
from block_scene import block_scene, play

T = 0.02
SWING = {
    "time": {"step": T, "duration": 7 * T},
    "gravity": {"acceleration": [0, 0, -9.81]},
    "pin": [{"region": {"box": [[0, 0, 0], [0.01, 1, 1]]}}],
    "solver": {"preset": "anderson", "error": 1e-6},
}


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    return block_scene(tmp_path_factory.mktemp("every"), **SWING, output={"surface": True})


def test_frames_are_those_of_every_third_step_and_the_last(scene: Path):
    _, each = play(scene)
    _, few = play(scene, "output.every=3")
    assert [frame.index for frame in few] == [0, 3, 6, 7]
    for frame in few:
        same = each[frame.index]
        assert frame.time == same.time
        for name in ("position", "surface", "momentum", "kinetic", "elastic", "potential"):
            np.testing.assert_array_equal(getattr(frame, name), getattr(same, name))
    for frame, steps in zip(few[1:], (each[1:4], each[4:7], each[7:8]), strict=True):
        assert frame.iterations == sum(step.iterations for step in steps) > 0
        assert frame.ksp_its == sum(step.ksp_its for step in steps) > 0
        assert frame.products == sum(step.products for step in steps)
        assert frame.step_error == max(step.step_error for step in steps) > 0
