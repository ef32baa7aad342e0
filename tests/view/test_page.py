"""The page of a result: its packed data are read back, and a browser shows the body in place."""

import base64
import json
import logging
import re
import zlib
from pathlib import Path

import numpy as np
import pytest
from ball_result import BARE, HEIGHTS, LED, write_ball
from test_film import render

from msmpetsc.results.reader import Result
from msmpetsc.view import page


def written_page(folder: Path, *words: str, scene: str | None = None) -> Path:
    result = write_ball(folder / "x.h5", **({} if scene is None else {"scene": scene}))
    render(result, "-o", folder / "x.html", *words)
    return folder / "x.html"


def data_of(path: Path) -> dict:
    script = re.compile(r'<script id="data" type="application/json">(.*?)</script>', re.DOTALL)
    return json.loads(script.search(path.read_text(encoding="utf-8"))[1])


def stream(data: dict, name: str) -> np.ndarray:
    return np.frombuffer(zlib.decompress(base64.b64decode(data["streams"][name])), np.uint8)


def restored(raw: np.ndarray, frames: int) -> np.ndarray:
    """Return the frames (f, n) of 16 bits as page.js restores them."""
    return np.cumsum(raw.view("<u2").reshape(frames, -1), axis=0, dtype=np.uint16)


def test_the_page_holds_every_frame_to_its_levels(tmp_path):
    path = written_page(tmp_path)
    data = data_of(path)
    low, high = np.array(data["box"])
    numbers = restored(stream(data, "positions"), len(HEIGHTS)).reshape(len(HEIGHTS), -1, 3)
    with Result(tmp_path / "x.h5") as run:
        for index, frame in enumerate(numbers):
            # the points of the nodes
            error = abs(low + frame / 65535 * (high - low) - run.frames.position[index])
            assert (error <= 0.5001 * (high - low) / 65535).all()
        triangles = stream(data, "triangles").view("<u2").reshape(-1, 3)
        assert (triangles == run.surface.triangles[:]).all()
    assert data["times"] == pytest.approx([index / 10 for index in range(11)])


def test_the_page_loads_nothing(tmp_path):
    text = written_page(tmp_path).read_text(encoding="utf-8")
    assert not re.search(r"(src|href)\s*=|@import|https?://(?!www\.w3\.org/2000/svg)|\{\{", text)


def test_a_title_cannot_end_the_script(tmp_path):
    evil = "</script><script>document.title = 1</script>"
    path = written_page(tmp_path, scene=f'title = "{evil}"\n{BARE}')
    text = path.read_text(encoding="utf-8")
    assert evil not in text and data_of(path)["title"] == evil


def test_colours_come_out_as_shares_of_the_scale(tmp_path):
    data = data_of(written_page(tmp_path, "--colour", "displacement"))
    shares = np.cumsum(stream(data, "colours").reshape(len(HEIGHTS), -1).astype(int), axis=0) % 256
    assert (shares[0] == 0).all() and shares.max() == 255
    bar = data["legend"][0]
    assert bar["kind"] == "bar" and bar["text"] == "displacement [mm]"
    assert [number for _, number in bar["ticks"]] == ["0", "100", "200", "300", "400", "500"]


def test_a_page_too_large_has_fewer_frames_and_says_so(tmp_path, monkeypatch, caplog):
    points = data_of(written_page(tmp_path))["points"]
    monkeypatch.setattr(page, "MAX_BYTES", 8 * 10 * points)
    with caplog.at_level(logging.INFO, logger="msmpetsc"):
        data = data_of(written_page(tmp_path))
    assert data["times"][0] == 0 and data["times"][-1] == 1 and 2 < len(data["times"]) < 11
    assert f"has {len(data['times'])} of the 11 frames" in caplog.text


def test_anchored_points_are_free_after_their_stop(tmp_path):
    data = data_of(written_page(tmp_path, scene=BARE + LED))
    fixed = np.cumsum(stream(data, "fixed").reshape(len(HEIGHTS), -1), axis=0, dtype=np.uint8)
    assert (fixed[:5] == fixed[0]).all() and set(fixed[0]) == {0, 255} and not fixed[5:].any()
