"""Obstacles that are meshes are drawn at their positions, from the data of the result."""

from pathlib import Path

import h5py
import numpy as np
import pytest
import trimesh
from ball_result import BARE, write_ball
from browser import Browser, in_browser
from PIL import Image
from test_film import render
from test_page import data_of

from msmpetsc.errors import InputError
from msmpetsc.results.reader import Result
from msmpetsc.view.composition import Style, composition_of
from msmpetsc.view.drawable import drawable_of_result, solids_of
from msmpetsc.view.sheet import contact_sheet

STATUE = """
picture.eye = [0, -1, 0]
[[obstacle]]
shape = "plane"
point = [0, 0, -9]
normal = [0, 0, 1]
[[obstacle]]
shape = "mesh"
mesh.source = "statue.ply"
path = [{ time = 1.0, by = [0, 0, -0.4] }]
stop = 0.95
"""
# box to the right of the ball [m]
LOW, HIGH = np.array([0.15, -0.05, 0.45]), np.array([0.25, 0.05, 0.55])


BAR = np.array([[0.15, -0.05, 0.49], [0.25, 0.05, 0.51]])
TURNING = """
[[obstacle]]
path = [{ time = 1.0, turn = [0, 90, 0] }]
center = [0.2, 0, 0.5]
response = "barrier"
"""
TWO_BARS = f'''{TURNING}shape = "box"\nbox = {BAR.tolist()}
{TURNING}shape = "mesh"\nmesh.source = "bar.ply"'''


@pytest.fixture
def result(tmp_path: Path) -> Path:
    """Return the result of a ball, and beside it a cube that sinks with it, but more slowly."""
    return with_mesh(write_ball(tmp_path / "x.h5", scene=BARE + STATUE), [LOW, HIGH])


def with_mesh(path: Path, bounds) -> Path:
    """Return a result whose obstacle 1 is a mesh, a box between two corners."""
    cube = trimesh.creation.box(bounds=bounds)
    with h5py.File(path, "r+", libver="earliest") as file:
        file["obstacle/points"], file["obstacle/triangles"] = cube.vertices, cube.faces
        file["obstacle/number"] = np.ones(len(cube.faces), "i4")
    return path


def right_of_the_ball(picture: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Return rows and columns drawn at least a diameter right of the ball, and the diameter."""
    rows, columns = np.nonzero(picture.min(axis=2) < 230)
    left = columns.min()
    # ball from 0 to 0.2 m, cube from 0.25 to 0.35 m
    metre = (columns.max() - left) / 0.35
    cube = columns > left + 0.225 * metre
    return rows[cube], columns[cube], metre


def test_a_sheet_has_it_where_it_is_and_none_when_it_is_gone(result: Path):
    with Result(result) as run:
        stills = composition_of(drawable_of_result(run), [0, 5, 10], Style()).stills([0, 5, 10])
    first, middle, last = (still.overlays.meshes for still in stills)
    assert [meshes[0].number for meshes in (first, middle)] == [1, 1] and last == []
    np.testing.assert_allclose(middle[0].by, [0, 0, -0.2])
    np.testing.assert_allclose(middle[0].seen[[0, 7]], np.array([LOW, HIGH]) - [0, 0, 0.2])
    contact_sheet(result, result.with_suffix(".png"), frames=[0, 5, 10])
    picture = np.array(Image.open(result.with_suffix(".png")).convert("RGB")).astype(int)
    # without the captions
    bodies = np.array_split(picture[: picture.shape[0] * 3 // 4], 3, axis=1)
    wide = [np.ptp(np.nonzero(body.min(axis=2) < 230)[1]) for body in bodies]
    # 0.35 m wide; the ball alone is 0.2 m wide
    assert wide[0] == pytest.approx(1.75 * wide[2], rel=0.05)


@in_browser
def test_a_page_has_it_once_and_moves_it(result: Path):
    path = result.with_suffix(".html")
    render(result, "-o", path, "--eye", "0,-1,0")
    data = data_of(path)
    assert len(data["solids"]["1"]["corners"]) == 9 * 12
    assert [len(state["meshes"]) for state in data["overlays"]] == [1] * 10 + [0]
    with Browser(path) as browser:
        pictures = [browser.picture() for frame in (0, 5) if not browser.value(f"goTo({frame})")]
    rows, columns, metre = right_of_the_ball(pictures[0])
    assert [np.ptp(rows), np.ptp(columns)] == pytest.approx([0.1 * metre] * 2, rel=0.1)
    sunk = right_of_the_ball(pictures[1])[0]
    assert sunk.mean() - rows.mean() == pytest.approx(0.2 * metre, rel=0.1)


@in_browser
def test_a_bar_that_turns_is_drawn_as_it_has_turned(tmp_path: Path):
    """A box and a mesh, lying at first, are upright at the end."""
    scene = f"{BARE}picture.eye = [0, -1, 0]{TWO_BARS}"
    path = with_mesh(write_ball(tmp_path / "x.h5", scene=scene), BAR)
    with Result(path) as run:
        (still,) = composition_of(drawable_of_result(run), [0, 10], Style()).stills([10])
        solid = solids_of(run)[1]
    ((mesh,), (box,)) = still.overlays.meshes, still.overlays.glass
    upright = [[0.19, -0.05, 0.45], [0.21, 0.05, 0.55]]
    for drawn in (box, mesh.seen, mesh.moved(solid.points)):
        np.testing.assert_allclose([drawn.min(axis=0), drawn.max(axis=0)], upright, atol=1e-12)
    render(path, "-o", path.with_suffix(".html"), "--eye", "0,-1,0")
    with Browser(path.with_suffix(".html")) as browser:
        pictures = [browser.picture() for frame in (0, 10) if not browser.value(f"goTo({frame})")]
    rows, columns, metre = right_of_the_ball(pictures[0])
    assert np.ptp(columns) == pytest.approx(0.1 * metre, rel=0.1) and np.ptp(rows) < 0.03 * metre
    right = pictures[1][:, columns.min() : columns.max() + 1]
    tall, wide = np.nonzero(right.min(axis=2) < 230)
    assert np.ptp(tall) == pytest.approx(0.1 * metre, rel=0.1) and np.ptp(wide) < 0.03 * metre


DAMAGE = {
    "obstacle/triangles has numbers outside its 8 points": ("triangles", lambda old: old + 1),
    "the points of its obstacles are not finite": ("points", lambda old: old * np.inf),
}


@pytest.mark.parametrize("said", DAMAGE)
def test_a_damaged_one_is_refused(result: Path, said: str):
    name, change = DAMAGE[said]
    with h5py.File(result, "r+", libver="earliest") as file, np.errstate(all="ignore"):
        file[f"obstacle/{name}"][...] = change(file[f"obstacle/{name}"][...])
    with Result(result) as run, pytest.raises(InputError, match="is damaged") as refused:
        solids_of(run)
    assert said in str(refused.value)
