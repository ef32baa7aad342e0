"""The page of a run that goes on: what it says, how seldom it is written, and that it never ends the run."""

import json
import logging
import re
from pathlib import Path

import h5py
import numpy as np
import pytest
import trimesh
from block_scene import block_scene

from msmpetsc.geometry.surface import Surface
from msmpetsc.model.fields import Frame
from msmpetsc.output.drawing import live
from msmpetsc.scene.reading import load_scene

BALL = trimesh.creation.icosphere(subdivisions=1, radius=0.2)


def data_of(path: Path) -> dict:
    text = path.read_text(encoding="utf-8")
    return json.loads(re.search(r'<script id="data" type="application/json">(.*?)</script>', text, re.DOTALL)[1])


def frame(index: int) -> Frame:
    numbers = dict(step_error=2e-4, iterations=1, ksp_its=17, momentum=np.zeros(3), wall_time=0.0)
    energies = dict(kinetic=float(index), elastic=2.0, potential=3.0, contact=0.0)
    return Frame(index=index, time=index / 100, position=np.empty((0, 3)), surface=None, **numbers, **energies)


@pytest.fixture
def page(tmp_path, monkeypatch):
    """A page of ten steps of a ball, with a clock that the test sets: page.clock[0] = 7.0."""
    scene = load_scene(block_scene(tmp_path, time={"step": 0.01, "duration": 0.1}))
    clock = [0.0]
    monkeypatch.setattr(live, "perf_counter", lambda: clock[0])
    points = np.array(BALL.vertices)
    made = live.LivePage(tmp_path / "x.html", scene, Surface(points, np.array(BALL.faces)), lambda: points)
    made.clock = clock
    return made


def test_the_page_says_how_far_the_run_is(page, tmp_path):
    page.update(frame(0))
    page.clock[0] = 20.0
    page.update(frame(4))
    run = data_of(tmp_path / "x.html")["run"]
    assert run["rows"]["step"] == "4 of 10" and run["rows"]["left"] == "30 s"  # 5 s a step, six to go
    assert run["rows"]["kinetic"] == "4 J" and run["rows"]["its"] == "17" and run["rows"]["run"] == "running"
    assert run["refresh"] > 0 and [row[0] for row in run["curves"]] == [0, 0.04]
    page.end()
    assert data_of(tmp_path / "x.html")["run"]["rows"]["run"] == "ended"
    assert data_of(tmp_path / "x.html")["run"]["refresh"] == 0


def test_the_last_frame_finishes_it(page, tmp_path):
    page.update(frame(10))
    run = data_of(tmp_path / "x.html")["run"]
    assert run["rows"]["run"] == "finished" and run["refresh"] == 0 and "left" not in run["rows"]


def test_it_is_written_every_few_seconds_at_the_most(page, tmp_path):
    page.update(frame(0))
    written = (tmp_path / "x.html").stat().st_mtime_ns
    page.clock[0] = 2.9
    page.update(frame(1))
    assert (tmp_path / "x.html").stat().st_mtime_ns == written
    page.clock[0] = 3.1
    page.update(frame(2))
    assert data_of(tmp_path / "x.html")["run"]["rows"]["step"] == "2 of 10"
    assert list(tmp_path.glob("*.part")) == []


def test_long_runs_keep_short_curves(page):
    for index in range(3000):
        page.update(frame(index))
    times = [row[0] for row in page._series]
    assert len(times) <= live.MOST_POINTS + 1
    assert times[0] == 0 and np.ptp(np.diff(times)) < 1e-9  # evenly over the whole run
    assert times[-1] > 29


def test_what_fails_is_told_once_and_the_run_goes_on(page, tmp_path, caplog):
    page._newest = lambda: 1 / 0
    with caplog.at_level(logging.WARNING, logger="msmpetsc"):
        for index in range(3):
            page.clock[0] = 10.0 * index
            page.update(frame(index))
        page.end()
    assert [record.message for record in caplog.records] == [
        f"{tmp_path / 'x.html'} is not kept any further: division by zero"
    ]


@pytest.mark.parametrize("ranks", [1, 2])
def test_a_run_with_a_page_is_the_run_without(tmp_path, msmpetsc, ranks):
    scene = block_scene(
        tmp_path,
        time={"step": 0.01, "duration": 0.03},
        output={"surface": True},
        gravity={"acceleration": [0, 0, -9.8]},
    )
    for name, words in {"with": ["--watch", tmp_path / "x.html"], "without": []}.items():
        done = msmpetsc(ranks, "run", scene, "-o", tmp_path / f"{name}.h5", *words)
        assert done.returncode == 0, done.stderr
    with h5py.File(tmp_path / "with.h5") as a, h5py.File(tmp_path / "without.h5") as b:
        assert np.array_equal(a["frames/position"][:], b["frames/position"][:])
        surface = a["frames/surface"][-1]
    data = data_of(tmp_path / "x.html")
    assert data["run"]["rows"]["step"] == "3 of 3"
    assert data["points"] == 3 * len(surface)  # corners of a block, where three normals meet
    assert data["box"][0][2] == pytest.approx(surface[:, 2].min(), abs=1e-6)  # it fell, and that is drawn


def test_a_page_that_cannot_be_written_does_not_end_the_run(tmp_path, msmpetsc):
    scene = block_scene(tmp_path, time={"step": 0.01, "duration": 0.02}, output={"surface": True})
    done = msmpetsc(1, "run", scene, "-o", tmp_path / "x.h5", "--watch", "/proc/x.html")
    assert done.returncode == 0 and "warning: /proc/x.html is not kept any further" in done.stderr
