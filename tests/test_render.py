"""Contact sheets: the moments, the axes, and a picture that shows what it should (never compared as an image)."""

import argparse
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI
from PIL import Image
from scipy.sparse import csr_array

from msmpetsc.cli import render as command
from msmpetsc.errors import InputError
from msmpetsc.model.frame import Frame
from msmpetsc.output import render
from msmpetsc.output.frames import ResultFile, open_result

trimesh = pytest.importorskip("trimesh")
pytestmark = pytest.mark.timeout(60)
SCENE = """
[[obstacle]]
shape = "plane"
point = [0, 0, 0]
normal = [0, 0, 2]
[gravity]
acceleration = [0, 0, -9.81]
"""
# A ball of radius 0.1 m falls, touches the ground, is squashed, leaps and comes to rest: height of its middle [m].
HEIGHTS = [0.5, 0.45, 0.3, 0.1, 0.07, 0.05, 0.08, 0.2, 0.35, 0.2, 0.1]
KINETIC = [0, 1, 4, 8, 4, 0, 5, 3, 0, 2, 0]
ELASTIC = [0, 0, 0, 0, 5, 9, 3, 0.1, 0.1, 0.1, 0]


@pytest.fixture
def result(tmp_path) -> Path:
    """The ball with its surface stored."""
    return write_ball(tmp_path / "ball.h5", surface=True)


def write_ball(path: Path, surface: bool, scene: str = SCENE) -> Path:
    """Without surface: twice the ball as lattice, and an embedding that halves it."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    rows = len(ball.vertices)
    halve = csr_array(np.eye(rows) / 2)
    with ResultFile(path, MPI.COMM_SELF, {"scene": scene}) as file:
        file.write("surface/triangles", np.array(ball.faces))
        for name, part in (("weights", halve.data), ("indices", halve.indices), ("indptr", halve.indptr)):
            file.write(f"embedding/{name}", part)
        file.start_frames(len(HEIGHTS), rows, rows if surface else None)
        for index, height in enumerate(HEIGHTS):
            points = ball.vertices * [1, 1, min(1, height / 0.1)] + [0, 0, height]
            energies = dict(kinetic=KINETIC[index], elastic=ELASTIC[index], potential=height)
            numbers = dict(step_error=0.0, iterations=1, ksp_its=1, momentum=np.zeros(3), wall_time=0.0)
            drawn = points if surface else None
            file.append(Frame(index=index, time=index / 10, position=2 * points, surface=drawn, **energies, **numbers))
    return path


def test_moments_tell_the_story(result):
    with open_result(result) as file:
        five = render.choose_moments(file, 5)
        assert five == {0: "start", 3: "fastest", 5: "most elastic energy", 8: "highest", 10: "end"}
        assert list(render.choose_moments(file, 3)) == [0, 5, 10]
        assert list(render.choose_moments(file, 1)) == [0]
        assert list(render.choose_moments(file, 6)) == [0, 1, 3, 5, 8, 10]  # the first of the longest gaps is halved
        assert list(render.choose_moments(file, 99)) == list(range(11))


def test_surface_that_was_not_stored_is_computed(result, tmp_path):
    bare = write_ball(tmp_path / "bare.h5", surface=False)
    with open_result(result) as stored, open_result(bare) as file:
        assert render.surface_points(file, 4) == pytest.approx(render.surface_points(stored, 4), abs=1e-7)


@pytest.mark.parametrize("gravity", [(0, 0, -9.81), (0, -9.81, 0), (3.0, 0, 4.0)])
def test_axes_are_right_handed_with_gravity_down(gravity):
    points = np.random.default_rng(0).normal(size=(50, 3)) * [1, 9, 2]
    axes = render.camera_axes(points, {"gravity": {"acceleration": gravity}})
    assert axes @ axes.T == pytest.approx(np.eye(3)) and np.linalg.det(axes) == pytest.approx(1)
    assert axes @ gravity == pytest.approx([0, 0, -np.linalg.norm(gravity)])


def test_the_longer_side_lies_across(result):
    points = np.random.default_rng(0).normal(size=(50, 3)) * [1, 9, 2]
    assert abs(render.camera_axes(points, {})[0] @ [0, 1, 0]) == pytest.approx(np.cos(render.YAW))


def body_rows(picture: np.ndarray) -> tuple[int, int]:
    """First and last row of pixels that show the body: only it is clearly blue."""
    blue = picture[..., 2].astype(int) - picture[..., 0] > 25
    assert not blue[:, 0].any() and not blue[:, -1].any() and not blue[0].any() and not blue[-1].any()
    rows = np.flatnonzero(blue.any(axis=1))
    return rows[0], rows[-1]


def test_heights_sizes_and_captions_are_seen(result, tmp_path, capfd):
    render.contact_sheet(result, tmp_path / "new" / "x.png")
    assert capfd.readouterr().err == ""
    picture = np.array(Image.open(tmp_path / "new" / "x.png"))
    panels = np.split(picture, 5, axis=1)
    (top, bottom), fallen, squashed, leapt, _ = [body_rows(panel) for panel in panels]
    metre = (bottom - top) / 0.2  # the ball is 0.2 m high
    assert metre * 0.4 == pytest.approx(fallen[0] - top, rel=0.05)  # less the cosine of the elevation
    assert metre * 0.15 == pytest.approx(leapt[0] - top, rel=0.06)
    assert squashed[1] - squashed[0] < 0.75 * (bottom - top)
    ground = (abs(picture[..., :3].astype(int) - [239, 236, 230]).max(axis=2) < 3).any(axis=1)
    last_ground = np.flatnonzero(ground)[-1]
    ink = bottom + 9 + np.flatnonzero((panels[0][bottom + 9 :, :, :3] < 90).all(axis=2).any(axis=1))
    assert fallen[1] < last_ground < ink.min()  # whole ball, ground, then captions (below the ball, dark itself)


def test_no_ground_where_the_scene_has_none(tmp_path):
    path = write_ball(tmp_path / "x.h5", surface=True, scene="")
    picture = np.array(Image.open(render.contact_sheet(path, tmp_path / "x.png", frames=[3])))
    assert not (abs(picture[..., :3].astype(int) - [239, 236, 230]).max(axis=2) < 3).any()


def test_command_draws_beside_the_result(result, capsys):
    parser = argparse.ArgumentParser()
    command.add_parser(parser.add_subparsers())
    args = parser.parse_args(["render", str(result), "--frames", "2,0,4"])
    assert args.run(args) == 0
    assert capsys.readouterr().out.strip() == str(result.with_suffix(".png"))
    assert Image.open(result.with_suffix(".png")).size[0] % 3 == 0


@pytest.mark.parametrize(
    "options, told",
    [
        (["--frames", "0,11"], "has frames 0 to 10, not 11"),
        (["--frames", "first"], "--frames takes numbers"),
        (["--count", "0"], "--count must be at least 1"),
        (["-o", "/proc/x.png"], "/proc/x.png cannot be written"),
    ],
)
def test_what_cannot_be_drawn_is_told(result, options, told):
    parser = argparse.ArgumentParser()
    command.add_parser(parser.add_subparsers())
    args = parser.parse_args(["render", str(result), *options])
    with pytest.raises(InputError, match=told):
        args.run(args)


def test_without_opengl_one_line_names_the_package(result, tmp_path):
    """EGL is made to find no driver; VTK would crash."""
    draw = "import sys; from msmpetsc.output.render import contact_sheet; contact_sheet(*sys.argv[1:])"
    environment = {key: value for key, value in os.environ.items() if key != "DISPLAY"}
    environment |= {"__EGL_VENDOR_LIBRARY_DIRS": "/nonexistent", "PYTHONPATH": str(Path(__file__).parent.parent)}
    order = [sys.executable, "-c", draw, str(result), str(tmp_path / "x.png")]
    done = subprocess.run(order, env=environment, capture_output=True, text=True, timeout=40)
    assert done.returncode == 1
    assert done.stderr.strip().endswith("no OpenGL to draw with: apt install libegl1 libgl1-mesa-dri")
    assert "WARN" not in done.stderr
