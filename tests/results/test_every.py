"""Storing every N-th step only: the same steps, fewer frames, and nothing computed for those left out."""

from pathlib import Path

import h5py
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


def test_the_file_and_the_log_hold_every_third_step(scene: Path, msmpetsc):
    path = scene.with_suffix(".h5")
    done = msmpetsc(1, "run", scene, "-o", path, "--set", "output.every=3")
    assert done.returncode == 0, done.stderr
    assert "frame 7/7" in done.stderr
    with h5py.File(path) as file:
        np.testing.assert_allclose(file["frames/time"], T * np.array([0, 3, 6, 7]))
        assert file["frames/surface"].shape[0] == 4
        step = file["checkpoint/step"][:]
        assert max(step) == 0  # the next would be that of the twentieth
        np.testing.assert_array_equal(file["checkpoint/q"][int(np.argmax(step))], file["frames/position"][0])


def test_more_than_all_steps_leaves_the_last(scene: Path):
    assert [frame.index for frame in play(scene, "output.every=100")[1]] == [0, 7]
