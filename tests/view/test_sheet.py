"""Contact sheets: the moments, the axes, and the content of a picture.

No test compares pictures pixel by pixel.
"""

import os

import h5py
import numpy as np
import pytest
import trimesh
from ball_result import BARE, EAST_HELD, HEIGHTS, LED, write_ball
from conftest import ROOT, python
from PIL import Image, ImageDraw

from msmpetsc.errors import InputError
from msmpetsc.results.reader import Result
from msmpetsc.scene.body import Region
from msmpetsc.scene.motion import Pin
from msmpetsc.scene.schema import OfBody
from msmpetsc.view import renderer, sheet
from msmpetsc.view.annotations import Entry, legend_picture
from msmpetsc.view.camera import YAW, camera_facing
from msmpetsc.view.composition import Still, Style, composition_of
from msmpetsc.view.drawable import BodiesAtRest, drawable_of_result


def test_moments_tell_the_story(falling_ball):
    with Result(falling_ball) as run:
        five = sheet.choose_moments(run, 5)
        assert five == {0: "start", 3: "fastest", 5: "most elastic energy", 8: "highest", 10: "end"}
        assert list(sheet.choose_moments(run, 3)) == [0, 5, 10]
        assert list(sheet.choose_moments(run, 1)) == [0]
        # the first of the longest gaps is halved
        assert list(sheet.choose_moments(run, 6)) == [0, 1, 3, 5, 8, 10]
        assert list(sheet.choose_moments(run, 99)) == list(range(11))


@pytest.fixture
def stills(tmp_path):
    """Return the function stills(scene tables, frames, eye) of a sheet that is not drawn."""

    def stills_of(tables: str, frames: list[int], **style) -> list[Still]:
        with Result(write_ball(tmp_path / "x.h5", scene=BARE + tables)) as run:
            return composition_of(drawable_of_result(run), frames, Style(**style)).stills(frames)

    return stills_of


def test_moments_of_the_scene(tmp_path):
    path = write_ball(tmp_path / "x.h5", scene=f"{BARE}picture.times = [0.72, 99.0, 0.26, 0.3]")
    sheet.contact_sheet(path, tmp_path / "x.png")
    sheet.contact_sheet(path, tmp_path / "y.png", frames=[0, 3, 7, 10])
    one, other = (np.array(Image.open(tmp_path / name)) for name in ("x.png", "y.png"))
    np.testing.assert_array_equal(one[: -sheet.CAPTION], other[: -sheet.CAPTION])


POINTS = np.random.default_rng(0).normal(size=(50, 3)) * [1, 9, 2]
EYES = [None, (1, -2, 0.6), (-3, 0.5, -1), (0, 0, 1), (0, -1, 0), (3, 0, 4)]


@pytest.mark.parametrize("gravity", [(0, 0, -9.81), (0, -9.81, 0), (3.0, 0, 4.0)])
@pytest.mark.parametrize("eye", EYES)
def test_camera_stands_upright_and_at_the_eye(gravity, eye):
    camera = camera_facing(POINTS, gravity, eye)
    axes = np.array([camera.right, camera.away, camera.up])
    assert axes @ axes.T == pytest.approx(np.eye(3)) and np.linalg.det(axes) == pytest.approx(1)
    assert axes @ gravity == pytest.approx([0, 0, -np.linalg.norm(gravity)])
    # the picture is not mirrored
    assert np.cross(camera.right, camera.upward) == pytest.approx(camera.to_eye)
    assert camera.upward @ camera.up > -1e-9
    if eye is not None:
        assert camera.to_eye @ eye == pytest.approx(np.linalg.norm(eye))


@pytest.mark.parametrize("scale", [1e-300, 1e300])
def test_a_camera_takes_directions_of_any_length(scale):
    one = camera_facing(POINTS, (0, 0, -1), (1, -2, 0.6))
    other = camera_facing(POINTS, (0, 0, -scale), (scale, -2 * scale, 0.6 * scale))
    assert other.to_eye == pytest.approx(one.to_eye) and other.up == pytest.approx(one.up)


def test_the_longer_side_lies_across():
    assert abs(camera_facing(POINTS, None).right @ [0, 1, 0]) == pytest.approx(np.cos(YAW))
    assert abs(camera_facing(POINTS, None, (0, 0, 2)).right @ [0, 1, 0]) == pytest.approx(1)


SPOTS = '[[pin]]\nregion.painted = "spots.txt"\n'


def test_held_parts(tmp_path):
    fixed = {}
    for name, tables in {"east": EAST_HELD, "led": LED + SPOTS}.items():
        with Result(write_ball(tmp_path / f"{name}.h5", scene=BARE + tables)) as run:
            subject = drawable_of_result(run)
            fixed[name] = [subject.fixed(index) for index in (0, 4, 5)]
            points = subject.surface(0)
    (east, *_), (first, before, after) = fixed["east"], fixed["led"]
    assert ((east == 1) == (points[:, 0] >= 0.02)).all() and 0 < east.mean() < 0.5
    assert ((first == 1) == (points[:, 2] <= 0.48)).all()
    assert (before == first).all() and not after.any()


def test_painted_points_mean_the_corners_of_their_cells():
    # three cells in a row along x
    x, y, z = np.mgrid[0:4, 0:2, 0:2].reshape(3, -1)
    nodes = np.stack([x, y, z], axis=1)
    cells = np.array([np.flatnonzero((x == i) | (x == i + 1)) for i in range(3)])
    points = np.array([(0.9, 0.1, 0.1), (2.9, 0.9, 0.9), (1.1, 0.1, 0.9)])
    rest = BodiesAtRest(nodes, cells, points, np.zeros(len(nodes), int), np.zeros(3, int))

    def find(painted: tuple[int, ...] | str) -> np.ndarray:
        return rest.find(OfBody(("pin", 0), None, Pin(region=Region(painted=painted))))

    assert (find((0,)) == (x <= 1)).all()
    assert (find((0, 2)) == (x <= 2)).all()
    assert not find("spots.txt").any()


FORCE = """
[[force]]
region = { box = [[0, -1, 0.5], [1, 1, 1]] }
total = [0, 0, -7.0]
start = 0.2
stop = 0.8
[[force]]
region.painted = "spots.txt"
total = [1, 0, 0]
"""


def test_an_arrow_for_each_force_while_it_acts(stills):
    before, first, last, after = stills(FORCE, frames=[1, 2, 7, 8])
    assert before.overlays.arrows == after.overlays.arrows == []
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.1).vertices
    pulled = ball[(ball[:, 0] >= 0) & (ball[:, 2] >= 0)].mean(axis=0)
    for still in (first, last):
        ((tail, tip),) = still.overlays.arrows
        assert tail == pytest.approx(pulled + np.array([0, 0, HEIGHTS[still.index]]), abs=1e-6)
        # a fifth of the ball's size
        assert tip - tail == pytest.approx([0, 0, -0.2 * 0.2])


PLATE = """
[[obstacle]]
shape = "box"
box = [[-0.125, -0.1, 0.62], [0.125, 0.1, 0.64]]
path = [{ time = 0.2, by = [0, 0, -0.2] }, { time = 0.6, by = [0.2, 0, -0.2] }]
stop = 0.8
"""


def test_obstacles_stand_where_they_are_at_the_time(stills):
    rest = np.array([(x, y, z) for x in (-0.125, 0.125) for y in (-0.1, 0.1) for z in (0.62, 0.64)])
    start, down, aside, gone = stills(PLATE, frames=[0, 1, 3, 8])
    for panel, by in (start, (0, 0, 0)), (down, (0, 0, -0.1)), (aside, (0.05, 0, -0.2)):
        assert panel.overlays.glass == [pytest.approx(rest + by)]
    assert gone.overlays.glass == []


def plane(height: float, normal: str) -> str:
    return f'[[obstacle]]\nshape = "plane"\npoint = [0, 0, {height}]\nnormal = {normal}\n'


def test_what_would_hide_the_body_is_glass(stills):
    above = stills(plane(0.7, "[0, 0, -1]"), frames=[0])[0].overlays
    # the face of the plate
    assert above.grounds == [] and above.glass[0][:4, 2] == pytest.approx(np.full(4, 0.7))
    # a plate lies behind the plane
    assert (above.glass[0][4:, 2] > 0.7).all()
    ground = plane(0.4, "[0, 0, 1]")
    below = stills(ground, frames=[0])[0].overlays
    assert below.glass == [] and below.grounds[0].corners[:, 2] == pytest.approx(np.full(4, 0.4))
    turned = stills(ground, frames=[0], eye=(3, -1, 2))[0].overlays
    # it belongs to the scene, not to the view
    assert turned.grounds[0].corners == pytest.approx(below.grounds[0].corners)
    # relative to a ball of 0.2 m
    assert np.ptp(below.grounds[0].corners, axis=0)[:2] == pytest.approx([0.64, 0.64])
    assert stills(ground, frames=[0], eye=(0, 1, -0.1))[0].overlays.grounds == []
    # more than half a ball away
    assert len(stills(plane(0.28, "[0, 0, 1]"), frames=[0])[0].overlays.grounds) == 0


def test_an_enormous_box_is_cut_and_a_far_one_left_out(stills):
    box = '[[obstacle]]\nshape = "box"\nbox = [[-50, -50, {}], [50, 50, {}]]\n'
    (glass,) = stills(box.format(-50, 0.39), frames=[0])[0].overlays.glass
    assert np.ptp(glass, axis=0)[:2] == pytest.approx(1.3 * np.array([0.2, 0.2]))
    assert glass[:, 2].max() == 0.39 and glass[:, 2].min() == pytest.approx(0.4 - 0.15 * 0.2)
    assert stills(box.format(1.0, 1.01), frames=[0])[0].overlays.glass == []


def test_spheres_are_shown_where_they_are_and_large_ones_cut(stills):
    ball = '[[obstacle]]\nshape = "sphere"\ncenter = [0, 0, {}]\nradius = {}\n'
    path = "path = [{ time = 1.0, by = [0, 0, -0.1] }]\n"
    moving = stills(ball.format(0.8, 0.05) + path, frames=[0, 10])
    start, end = (still.overlays.balls[0] for still in moving)
    assert start.center == pytest.approx([0, 0, 0.8]) and start.radius == 0.05
    assert end.center == pytest.approx([0, 0, 0.7])
    (large,) = stills(ball.format(-49.61, 50), frames=[0])[0].overlays.balls
    assert large.radius == 50 and np.ptp(large.seen, axis=0)[:2] == pytest.approx([0.26, 0.26])
    assert stills(ball.format(3, 0.1), frames=[0])[0].overlays.balls == []


def test_glass_is_seen_at_its_place_and_through(tmp_path):
    level = "picture.eye = [0, -1, 0]"
    path = write_ball(tmp_path / "x.h5", scene=BARE + level + PLATE)
    sheet.contact_sheet(path, tmp_path / "x.png", frames=[0, 1, 8])
    picture = np.array(Image.open(tmp_path / "x.png"))
    panels = np.split(picture[: -sheet.CAPTION], 3, axis=1)
    across = np.flatnonzero(is_body(panels[2]).any(axis=0))
    left, ball = across[0] - 2, slice(across[0], across[-1] + 1)
    _, through, alone = [is_body(panel[:, ball]).sum() for panel in panels]
    # at 0.1 s the plate stands before a thirteenth of the ball
    assert through == pytest.approx(alone, rel=0.03)
    drawn = ((panel[:, :left] < 250).any(axis=(1, 2)) for panel in panels)
    above, before, gone = map(np.flatnonzero, drawn)
    metre = np.ptp(across) / 0.2
    assert before[0] - above[0] == pytest.approx(0.1 * metre, abs=3)
    assert np.ptp(before) == pytest.approx(0.02 * metre, abs=3)
    assert len(gone) == 0


def is_body(picture: np.ndarray) -> np.ndarray:
    """Return which pixels show the body: only the body is clearly blue."""
    return picture[..., 2].astype(int) - picture[..., 0] > 25


def body_rows(picture: np.ndarray) -> tuple[int, int]:
    """Return the body's first and last row of pixels; it must not reach the picture's edges."""
    blue = is_body(picture)
    assert not blue[:, [0, -1]].any() and not blue[[0, -1]].any()
    rows = np.flatnonzero(blue.any(axis=1))
    return rows[0], rows[-1]


def test_heights_sizes_and_captions_are_seen(falling_ball, tmp_path, capfd):
    sheet.contact_sheet(falling_ball, tmp_path / "new" / "x.png")
    assert capfd.readouterr().err == ""
    picture = np.array(Image.open(tmp_path / "new" / "x.png"))
    panels = np.split(picture, 5, axis=1)
    (top, bottom), fallen, squashed, leapt, _ = [body_rows(panel) for panel in panels]
    # the ball is 0.2 m high
    metre = (bottom - top) / 0.2
    # the cosine of the elevation shortens it
    assert metre * 0.4 == pytest.approx(fallen[0] - top, rel=0.05)
    assert metre * 0.15 == pytest.approx(leapt[0] - top, rel=0.06)
    assert squashed[1] - squashed[0] < 0.75 * (bottom - top)
    ground = (abs(picture[..., :3].astype(int) - [239, 236, 230]).max(axis=2) < 3).any(axis=1)
    last_ground = np.flatnonzero(ground)[-1]
    ink = bottom + 9 + np.flatnonzero((panels[0][bottom + 9 :, :, :3] < 90).all(axis=2).any(axis=1))
    # the ball above the ground above the captions, and the dark underside of the ball
    assert fallen[1] < last_ground < ink.min()


def test_a_result_without_surface_or_with_a_strange_scene_is_told(tmp_path):
    path = write_ball(tmp_path / "x.h5")
    for key, told in ("embedding", "no surface to draw"), ("scene", "another version"):
        with h5py.File(path, "r+") as file:
            del (file.attrs if key == "scene" else file)[key]
        with pytest.raises(InputError, match=told):
            sheet.contact_sheet(path, tmp_path / "x.png")


def test_without_opengl_one_line_names_the_package(falling_ball, tmp_path):
    """Without an EGL driver VTK would crash."""
    draw = "import sys; from msmpetsc.view.sheet import contact_sheet; contact_sheet(*sys.argv[1:])"
    environment = {key: value for key, value in os.environ.items() if key != "DISPLAY"}
    environment |= {"__EGL_VENDOR_LIBRARY_DIRS": "/nonexistent", "PYTHONPATH": str(ROOT)}
    done = python("-c", draw, falling_ball, tmp_path / "x.png", env=environment)
    told = "no OpenGL to draw with: apt install libegl1 libgl1-mesa-dri\n"
    assert done.returncode == 1 and done.stderr.endswith(told) and "WARN" not in done.stderr


def test_many_panels_stand_in_rows_and_each_is_shown(falling_ball, tmp_path):
    """Eleven panels are in two rows of six, in a sheet that fits a screen."""
    sheet.contact_sheet(falling_ball, tmp_path / "x.png", frames=range(11))
    drawn = np.array(Image.open(tmp_path / "x.png"))
    assert 1000 < drawn.shape[1] <= 2000
    each = [part for row in np.split(drawn, 2) for part in np.split(row, 6, axis=1)]
    assert all(is_body(panel).any() for panel in each[:11]) and (each[11] == 255).all()
    assert body_rows(each[3])[0] > body_rows(each[2])[0] > body_rows(each[0])[0] > 0


def test_all_that_is_written_is_in_one_typeface(falling_ball, tmp_path, monkeypatch):
    """Captions and the legend use the same typeface."""
    written, draw = {}, ImageDraw.ImageDraw.text

    def recorded(self, at, text, fill=None, font=None, **options):
        written[text] = font.getname()[0]
        draw(self, at, text, fill, font, **options)

    monkeypatch.setattr(ImageDraw.ImageDraw, "text", recorded)
    style = Style(colour="displacement")
    sheet.contact_sheet(falling_ball, tmp_path / "x.png", frames=[0], style=style)
    assert set(written.values()) == {"DejaVu Sans"}
    assert {"displacement", "t"} <= {text.partition(" ")[0] for text in written}


def test_a_black_picture_is_no_picture(falling_ball, tmp_path, monkeypatch):
    black = np.zeros((2, 2, 3), np.uint8)
    monkeypatch.setattr(renderer.pv.Plotter, "screenshot", lambda self, **_: black)
    with pytest.raises(InputError, match="black picture"):
        sheet.contact_sheet(falling_ball, tmp_path / "y.png", frames=[0])
    assert not (tmp_path / "y.png").exists()


@pytest.mark.parametrize("width", [240, 400, 900])
def test_a_legend_ends_inside_its_picture(width: int):
    ticks = tuple((0.25 * i, f"{5 * i}") for i in range(5))
    bar = Entry("bar", "von Mises' stress [Pa], clipped at 21, most 26.4", ticks=ticks)
    picture = legend_picture([bar, Entry("swatch", "pinned")], width)
    assert picture.shape[1] == width and (picture < 128).any()
    assert (picture[:, [0, 1, -2, -1]] > 240).all()
