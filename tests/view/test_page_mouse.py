"""The page of a result in a browser by mouse and keys: it turns, zooms, plays, goes to a frame."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from ball_result import BARE, EAST_HELD, write_ball
from browser import Browser, in_browser
from test_film import render

pytestmark = in_browser


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the page of a ball that is dark on its east, seen from the east."""
    folder = tmp_path_factory.mktemp("page")
    result = write_ball(folder / "x.h5", scene=BARE + EAST_HELD)
    render(result, "-o", folder / "x.html", "--eye", "1,0,0")
    return folder / "x.html"


@pytest.fixture(scope="module")
def opened(path: Path) -> Iterator[Browser]:
    with Browser(path) as browser:
        yield browser


@pytest.fixture
def browser(opened: Browser) -> Browser:
    """Open the page in a browser in its first view."""
    opened.value("setPlaying(false), goTo(0)")
    opened.key("r")
    return opened


def seen(browser: Browser) -> np.ndarray:
    """Return rows and columns (k, 2) of the pixels of the body on a white page."""
    return np.argwhere(browser.picture().min(axis=2) < 200)


def dark(browser: Browser) -> int:
    """Return the number of pixels as dark as the held part."""
    return int((browser.picture()[..., 0] < 58).sum())


def test_dragging_turns_the_body(browser: Browser):
    """Half a turn is 450 pixels: the dark side is then behind, and back after the other half."""
    before = dark(browser)
    left, middle = np.array(browser.middle("#view")) - [225, 0], browser.middle("#view")
    browser.drag(tuple(left), (450, 0))
    assert abs(browser.value("view.yaw")) == pytest.approx(180) and before > 1000
    assert dark(browser) < 0.05 * before
    browser.drag((left[0] + 450, left[1]), (-450, 0))
    assert browser.value("view.yaw") == pytest.approx(0)
    assert dark(browser) == pytest.approx(before, rel=0.01)
    browser.drag(middle, (0, 100))
    # 0.4 degrees per pixel
    assert browser.value("view.pitch") == pytest.approx(40)


def test_the_wheel_comes_nearer_and_goes_away(browser: Browser):
    # the ball is in the middle of the picture
    browser.value("goTo(2)")
    first = np.ptp(seen(browser), axis=0)
    browser.wheel(browser.middle("#view"), -300)
    browser.until("view.zoom > 1")
    zoom = browser.value("view.zoom")
    assert zoom == pytest.approx(np.exp(0.3))
    assert np.ptp(seen(browser), axis=0) == pytest.approx(zoom * first, rel=0.03)
    browser.wheel(browser.middle("#view"), 600)
    browser.until("view.zoom < 1")
    assert np.ptp(seen(browser), axis=0) == pytest.approx(first * np.exp(-0.3), rel=0.03)


def test_dragging_with_shift_moves_the_body(browser: Browser):
    browser.value("goTo(2)")
    first = seen(browser).mean(axis=0)
    browser.drag(browser.middle("#view"), (60, -40), shift=True)
    # rows count downwards
    assert seen(browser).mean(axis=0) - first == pytest.approx([-40, 60], abs=2)
    assert browser.value("[view.yaw, view.pitch]") == [0, 0]


def test_play_plays_and_pauses(browser: Browser):
    assert browser.value("play.textContent") == "▶"
    start = seen(browser).mean(axis=0)
    browser.click("#play")
    browser.until("view.frame >= 3")
    assert browser.value("play.textContent") == "❚❚"
    browser.click("#play")
    frame = browser.value("view.frame")
    after = seen(browser).mean(axis=0)
    assert browser.value("[view.frame, view.playing, play.textContent]") == [frame, False, "▶"]
    # the ball has fallen, so frames 3 to 10 are lower than the first
    assert after[0] > start[0] + 20
    browser.key(" ")
    browser.until(f"view.frame !== {frame}")
    assert browser.value("view.playing")


def test_the_slider_goes_to_a_frame(browser: Browser):
    """The fourth of eleven frames is at 3/10 of the slider.

    The ball is then 0.4 m lower than at the start.
    """
    first = seen(browser)
    # pixels per metre; the ball is 0.2 m wide
    metre = np.ptp(first, axis=0)[0] / 0.2
    x, y = browser.middle("#slider")
    width = browser.value("slider.getBoundingClientRect().width")
    # the thumb is 16 pixels wide
    browser.click((x + (0.3 - 0.5) * (width - 16), y))
    assert browser.value("view.frame") == 3
    assert "0.300 s" in browser.value("byId('time').textContent")
    lower, _ = seen(browser).mean(axis=0) - first.mean(axis=0)
    assert lower == pytest.approx(0.4 * metre, rel=0.05)
