"""Scenes are drawn before they run."""

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
    """Return the picture that a command draws; the last word is its path."""
    render(*words[:-1], "-o", words[-1])
    return np.array(Image.open(words[-1]).convert("RGB")).astype(int)


def sized(folder: Path, sides: tuple[float, float, float]) -> Path:
    """Write a block whose west side is painted and pinned by a file, and whose east is pulled."""
    path = block_scene(folder, np.array(sides), **SCENE)
    # corners of a box are numbered along x, so these are its x = 0 face
    (folder / "spots.txt").write_text("0 1 2 3\n")
    return path


def test_a_scene_shows_pins_forces_and_cells(tmp_path):
    picture = drawn(sized(tmp_path, (0.5, 0.5, 0.5)), tmp_path / "x.png")
    left, right = np.array_split(picture, 2, axis=1)
    # nodes that the scene pins are dark
    assert (left[..., 0] < 58).sum() > 500
    # the arrow is orange
    assert (left[..., 0] - left[..., 2] > 90).sum() > 300
    # cells of the boundary are red and inner cells blue in the cut-open panel
    for less, more in ((2, 0), (0, 2)):
        counts = [(half[:-40, :, more] - half[:-40, :, less] > 75).sum() for half in (left, right)]
        assert counts[1] > 300 and counts[1] > 2 * counts[0]


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["-o", "x.mp4"], "no motion to film"),
        (["--frames", "1"], "--frames is for results"),
        (["--colour", "part"], "has no part"),
    ],
)
def test_what_a_scene_has_not_got(tmp_path, words, line):
    with pytest.raises(InputError, match=line):
        render(sized(tmp_path, (0.5, 0.5, 0.25)), *words)


def test_a_mesh_is_none_of_what_is_drawn(ball):
    with pytest.raises(InputError, match=r"must be named \*.h5 or \*.hdf5 or \*.toml"):
        render(ball)
