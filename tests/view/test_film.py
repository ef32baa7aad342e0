"""Films: their playback, their pictures as read from the file, and refusals."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from ball_result import HEIGHTS
from one_process import input_error
from PIL import Image, ImageSequence
from surface_alone import drawable_of

from msmpetsc.cli.commands import render as command
from msmpetsc.cli.main import parsed
from msmpetsc.errors import InputError
from msmpetsc.view.annotations import CAPTION
from msmpetsc.view.composition import Style
from msmpetsc.view.film import playback_of, usual_speed, write_film

# times of the ball's frames [s]
TIMES = np.arange(11) / 10


def render(*words: object) -> None:
    assert command.run(parsed(["render", *map(str, words)])) == 0


def pictures_of(path: Path) -> list[np.ndarray]:
    """Return the pictures of a film as a player shows them."""
    if path.suffix != ".mp4":
        with Image.open(path) as film:
            pictures = [np.array(each.convert("RGB")) for each in ImageSequence.Iterator(film)]
    else:
        frames = pytest.importorskip("imageio_ffmpeg").read_frames(str(path))
        width, height = next(frames)["size"]
        pictures = [np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in frames]
    return [picture.astype(int) for picture in pictures]


def middle_of_body(picture: np.ndarray) -> float:
    """Return the row halfway between the first and the last row with clearly blue pixels."""
    rows = np.flatnonzero((picture[..., 2] - picture[..., 0] > 15).sum(axis=1) > 3)
    return (rows[0] + rows[-1]) / 2


def test_pace_leaves_frames_out_where_they_come_faster_than_pictures():
    # four seconds with 4,001 frames
    playback = playback_of(np.arange(4001) / 1000)
    assert playback.fps == 30 and len(playback.numbers) == 121
    assert playback.numbers[[0, 3, -1]].tolist() == [0, 100, 4000]


@pytest.mark.parametrize("span", [*np.geomspace(1e-6, 1e6, 50), 2.999, 3.0, 8.0, 8.001])
def test_a_film_lasts_three_to_eight_seconds_where_nothing_is_said(span: float):
    speed = usual_speed(span)
    assert span / speed * (1 + 1e-9) >= 3 and span / speed <= 8
    assert (speed == 1) == (3 <= span <= 8)


def test_the_film_of_a_third_of_a_second_says_how_much_slower_it_is():
    playback = playback_of(np.arange(41) / 120)
    assert 3 <= len(playback.numbers) / playback.fps <= 8
    assert playback.words == "10 times slower than real"
    assert playback_of(np.arange(61.0)).words == "10 times faster than real"


def test_a_film_fills_its_frame_and_says_its_speed(falling_ball, tmp_path, caplog):
    """The ball's path is four times as high as wide, and so is the film without its caption."""
    with caplog.at_level("INFO", logger="msmpetsc"):
        render(falling_ball, "-o", tmp_path / "x.gif")
    with Image.open(tmp_path / "x.gif") as film:
        seconds = sum(picture.info["duration"] for picture in ImageSequence.Iterator(film)) / 1000
    assert 3 <= seconds <= 8 and "5 times slower than real" in caplog.text
    pictures = np.array(pictures_of(tmp_path / "x.gif"))[:, :-CAPTION]
    assert pictures.shape[1] > 1.5 * pictures.shape[2]
    body = (pictures[..., 2] - pictures[..., 0] > 15).any(axis=0)
    rows = np.flatnonzero(body.any(axis=1))
    assert np.ptp(rows) > 0.75 * pictures.shape[1]


def test_slow_motion_shows_all_frames_for_longer(falling_ball, tmp_path):
    slow = playback_of(TIMES, speed=0.1)
    assert slow.fps == pytest.approx(1) and len(slow.numbers) == 11
    # at least a picture a second, so five pictures per frame
    slower = playback_of(TIMES, speed=0.02)
    assert len(slower.numbers) == 51 and (abs(np.bincount(slower.numbers)[1:-1] - 5) <= 1).all()
    render(falling_ball, "-o", tmp_path / "x.gif", "--frames", "0:3", "--speed", 0.05)
    with Image.open(tmp_path / "x.gif") as film:
        assert sum(picture.info["duration"] for picture in ImageSequence.Iterator(film)) == 5000


@pytest.mark.parametrize("frames", [[5, 2, 0], [3]])
def test_frames_out_of_order_make_no_film(frames):
    with pytest.raises(InputError, match="a film needs frames in order of time"):
        playback_of(TIMES[frames])


@pytest.mark.parametrize("ending", ["mp4", "gif", "webp"])
def test_the_ball_falls_and_leaps_in_the_film(falling_ball, tmp_path, ending, capsys):
    if ending == "mp4":
        pytest.importorskip("imageio_ffmpeg")
    path = tmp_path / "new" / f"x.{ending}"
    words = "--size 320x480 --eye 0,-1,0 --speed 0.5 --frames 0:11"
    render(falling_ball, "-o", path, *words.split())
    assert capsys.readouterr().out.strip() == str(path)
    pictures = pictures_of(path)
    assert len(pictures) == len(HEIGHTS) and pictures[0].shape == (480, 320, 3)
    # the underside of the squashed ball is too dark to be blue
    whole = np.array(HEIGHTS) >= 0.1
    # without the caption
    rows = np.array([middle_of_body(picture[:-CAPTION]) for picture in pictures])[whole]
    centres = np.array(HEIGHTS)[whole]
    # pixels per metre, downwards
    scale = (rows[0] - rows[2]) / (centres[0] - centres[2])
    assert scale < 0 and rows - rows[0] == pytest.approx(scale * (centres - centres[0]), abs=6)
    # no temporary file is left
    assert [path.name for path in path.parent.iterdir()] == [path.name]


def test_the_legend_names_what_is_drawn(falling_ball, tmp_path):
    """The legend goes from neutral grey to the darkest colour; without colours there is none."""
    pictures = []
    for words in ([], ["--colour", "displacement"]):
        render(falling_ball, "-o", tmp_path / "x.png", "--frames", "0,5", *words)
        pictures.append(np.array(Image.open(tmp_path / "x.png")).astype(int))
    plain, coloured = pictures
    assert len(coloured) == len(plain) + 34
    for end in ([0xDC, 0xDC, 0xDC], [8, 0x1D, 0x58]):
        assert (abs(coloured[-24] - end).max(axis=1) < 12).any()


@pytest.mark.parametrize(
    "words, line",
    [
        (["--frames", "0,11"], "has frames 0 to 10, not 11"),
        (["--count", "0"], "--count must be at least 1"),
        (["--eye", "0,0,0"], "--eye takes three numbers"),
        (["--eye", "north"], "--eye takes numbers"),
        (["--frames", "0:x"], "--frames takes numbers like 0,10,20 or slices"),
        (["--frames", "20:"], "of which --frames names none"),
        (["--colour", "sped"], "did you mean 'speed'"),
        (["--colour", "part"], "has no part"),
        (["--size", "101x100"], "--size takes two even numbers"),
        (["--speed", "10"], r"--speed is for \*.mp4"),
        (["--set", "cages.count=3"], "--set is for scenes"),
        (["-o", "x.mp4", "--speed", "0"], "--speed must be above 0"),
        (["-o", "x.mp4", "--speed", "nan"], "--speed must be above 0"),
        (["-o", "x.gif", "--speed", "1e-300"], "--speed 1e-300: the film would last"),
        (["-o", "x.mp4", "--count", "3"], r"--count is for \*.png"),
        (["-o", "x.html", "--size", "100x100"], r"--size is for \*.png"),
        (["-o", "x.html", "--cells"], r"--cells is for \*.png"),
        (["-o", "x.gif", "--size", "64x64"], "too small for caption and legend"),
    ],
)
def test_what_cannot_be_drawn_ends_in_one_line(falling_ball, words, line):
    assert re.search(line, input_error(lambda: render(falling_ball, *words)))


@pytest.mark.parametrize(
    "sides", [(1.0, 0.1, 0.1), (0.1, 0.1, 1.0), (0.3, 0.3, 0.3)], ids=["long", "high", "cube"]
)
def test_no_third_of_a_film_is_empty(sides, tmp_path):
    """A box that sways by a tenth of its longest side reaches each third of the picture."""
    box = trimesh.creation.box(sides).subdivide().subdivide()
    sway = 0.1 * max(sides) * np.array([1.0, 0, 0])
    points = np.array(box.vertices)
    subject = drawable_of(points, np.array(box.faces))
    swaying = replace(subject, times=np.arange(3.0), nodes=lambda index: points + index % 2 * sway)
    style, playback = Style(eye=(0, -1, 0)), playback_of(swaying.times)
    write_film(swaying, tmp_path / "x.gif", [0, 1, 2], style, playback)
    pictures = np.array(pictures_of(tmp_path / "x.gif"))
    body = (pictures[..., 2] - pictures[..., 0] > 15).any(axis=0)
    # the part without the caption
    rows = np.flatnonzero(body.any(axis=1))
    body = body[: rows[0] + rows[-1]]
    assert all(third.any() for axis in (0, 1) for third in np.array_split(body, 3, axis=axis))
    assert body.mean() > 0.25
