"""Scenes and meshes drawn before anything is run."""

from pathlib import Path

import numpy as np
import pytest
from block_scene import block_scene
from PIL import Image
from test_film import render

from msmpetsc.errors import InputError

SCENE = {
    "output": {"surface": True},
    "time": {"step": 0.01, "duration": 0.1},
    "pin": [{"region": {"painted": "spots.txt"}}],
    "force": [{"region": {"box": [[0.3, 0, 0], [0.5, 0.5, 0.25]]}, "total": [1.0, 0, 0]}],
}


def drawn(*words: object) -> np.ndarray:
    """The picture that a command draws; its path is the last word."""
    render(*words[:-1], "-o", words[-1])
    return np.array(Image.open(words[-1]).convert("RGB")).astype(int)


def sized(folder: Path, sides: tuple[float, float, float]) -> Path:
    """A block with the points of its west side painted, pinned by a file, and pulled at its east."""
    path = block_scene(folder, np.array(sides), **SCENE)
    (folder / "spots.txt").write_text("0 1 2 3\n")  # box: corners are numbered along x, so these are its west
    return path


def test_a_scene_shows_pins_forces_and_cells(tmp_path):
    picture = drawn(sized(tmp_path, (0.5, 0.5, 0.5)), tmp_path / "x.png")
    left, right = np.array_split(picture, 2, axis=1)
    assert (left[..., 0] < 58).sum() > 500  # pinned by the file: dark
    assert (left[..., 0] - left[..., 2] > 90).sum() > 300  # the arrow
    for less, more in ((2, 0), (0, 2)):  # red cells of the boundary, blue ones inside, in the panel cut open
        counts = [(half[:-40, :, more] - half[:-40, :, less] > 75).sum() for half in (left, right)]
        assert counts[1] > 300 and counts[1] > 2 * counts[0]


def test_a_mesh_alone_shows_its_box(tmp_path, ball):
    picture = drawn(ball, tmp_path / "x.png")
    grey = abs(picture - (0x8A, 0x92, 0x9B)).max(axis=2) <= 40
    assert len(picture) > 400 and grey.sum() > 500


@pytest.mark.parametrize(
    ("kind", "words", "line"),
    [
        ("scene", ["-o", "x.mp4"], "no motion to film"),
        ("scene", ["--frames", "1"], "--frames is for results"),
        ("scene", ["--colour", "part"], "has no part"),
        ("mesh", ["--show", "cells"], "is a mesh without cells"),
        ("mesh", ["--colour", "speed"], "is a mesh alone"),
        ("mesh", ["--set", "cages.count=3"], "--set changes a scene"),
    ],
)
def test_what_a_scene_or_a_mesh_has_not_got(tmp_path, ball, kind, words, line):
    path = ball if kind == "mesh" else sized(tmp_path, (0.5, 0.5, 0.25))
    with pytest.raises(InputError, match=line):
        render(path, *words)
