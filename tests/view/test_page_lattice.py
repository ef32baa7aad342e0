"""Cells and springs on a page: what is packed comes out again, and a browser shows it, moves it and hides it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from block_scene import CELL, block_scene
from browser import Browser, in_browser
from test_page import data_of, restored, stream

from msmpetsc.cli.commands.render import drawable_of_file
from msmpetsc.view.camera import camera_facing
from msmpetsc.view.composition import Style
from msmpetsc.view.drawable import Drawable
from msmpetsc.view.mesh import BOUNDARY, INTERIOR, cut_open
from msmpetsc.view.page import write_page

FALL, EYE = 0.2, (0.0, -1.0, 0.0)  # [m] a frame
TABLES = {"output": {"surface": True}, "time": {"step": 0.01, "duration": 0.1}}


@pytest.fixture
def falling(tmp_path: Path) -> Drawable:
    """A cube of four cells along each side, which falls for three frames beside a ball that is drawn as a mesh."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.05)
    ball.apply_translation([0.6, 0.25, 0.25])
    ball.export(tmp_path / "ball.ply")
    obstacle = {"shape": "mesh", "mesh": {"source": "ball.ply"}}
    subject, _ = drawable_of_file(block_scene(tmp_path, np.array([0.5, 0.5, 0.5]), obstacle=[obstacle], **TABLES), [])

    def fallen(points: np.ndarray, index: int) -> np.ndarray:
        return points - np.array([0, 0, FALL * index])

    nodes, surface = subject.nodes(0), subject.surface(0)
    return replace(
        subject, times=np.arange(3) / 10,
        nodes=lambda index: fallen(nodes, index), surface=lambda index: fallen(surface, index),
    )  # fmt: skip


def written(folder: Path, subject: Drawable, *shown: str) -> Path:
    write_page(subject, folder / "x.html", [0, 1, 2], Style(eye=EYE, shown=shown))
    return folder / "x.html"


def test_the_page_holds_the_half_of_the_lattice_behind_the_middle(tmp_path: Path, falling: Drawable):
    data = data_of(written(tmp_path, falling, "cells", "springs"))
    about = data["lattice"]
    low, high = np.array(about["box"])
    numbers = restored(stream(data, "nodes"), 3).reshape(3, -1, 3)
    cells = stream(data, "cells").view("<u2").reshape(-1, 8)
    springs = stream(data, "springs").view("<u2").reshape(-1, 2)
    cut = cut_open(falling, camera_facing(falling.surface(0), None, EYE), ("cells", "springs"))
    assert [kind["cells"] for kind in about["kinds"]] == [len(cut.cells[BOUNDARY]), len(cut.cells[INTERIOR])]
    assert about["kinds"][1]["cells"] >= 4 and len(cells) == 32  # of 64, of which 2 x 2 x 2 are within
    every = np.concatenate([cut.cells[BOUNDARY], cut.cells[INTERIOR]])
    for index, frame in enumerate(numbers):
        nodes = low + frame / 65535 * (high - low)
        assert nodes[cells] == pytest.approx(falling.nodes(index)[every], abs=1e-5)
        assert nodes[springs] == pytest.approx(falling.nodes(index)[cut.springs], abs=1e-5)
    assert nodes[cells][..., 1].min() >= 0.25 - 1e-5  # seen from the south, the north is left
    assert [entry["text"] for entry in data["legend"][:3]] == ["boundary cell", "interior cell", "spring"]


def test_what_is_not_asked_for_is_not_there(tmp_path: Path, falling: Drawable):
    data = data_of(written(tmp_path, falling))
    assert data["lattice"] is None and "nodes" not in data["streams"]
    data = data_of(written(tmp_path, falling, "springs"))
    assert not len(stream(data, "cells")) and data["lattice"]["kinds"] == [] and len(stream(data, "springs")) > 100


def red_rows(browser: Browser) -> np.ndarray:
    """The rows of the pixels that are as red as boundary cells are in any light, also behind the body."""
    picture = browser.picture()
    return np.nonzero(picture[..., 0] - picture[..., 2] > 60)[0]


@in_browser
@pytest.mark.timeout(120)
def test_cells_and_springs_are_switched_and_move_with_the_frames(tmp_path: Path, falling: Drawable):
    path = written(tmp_path, falling, "cells", "springs")
    with Browser(path) as browser:
        first = red_rows(browser)
        metre = browser.value("perMetre()")
        assert len(first) > 1000 and np.ptp(first) == pytest.approx((0.5 - (1 - 0.86) * CELL) * metre, abs=3)
        browser.value("goTo(2)")
        assert red_rows(browser).mean() - first.mean() == pytest.approx(2 * FALL * metre, abs=2)
        both = browser.picture()
        assert browser.value("gl.getError()") == 0 and browser.value("data.overlays.states[0].meshes.length") == 1
        browser.click("#show-cells")
        assert browser.value("[...shown]") == ["springs"] and not len(red_rows(browser))
        lines = browser.picture()
        browser.key("s")
        assert browser.value("[...shown]") == [] and "show=none" in browser.value("location.hash")
        bare = browser.picture()
        assert (abs(lines - bare).max(axis=2) > 30).sum() > 500  # the springs were seen through the body
        browser.click("#show-cells")
        browser.click("#show-springs")
        assert (browser.picture() == both).mean() > 0.999
    with Browser(path, address="frame=1&show=cells") as browser:
        assert browser.value("[[...shown], view.frame]") == [["cells"], 1] and len(red_rows(browser)) > 1000
