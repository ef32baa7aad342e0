"""Progress on a terminal and in a batch log."""

import io
import logging

import numpy as np
import pytest
from study_stand_in import blank_frame

from msmpetsc.comm import log
from msmpetsc.fields import Frame
from msmpetsc.results import progress_bar
from msmpetsc.results.progress_bar import Progress


def frame(index: int) -> Frame:
    return blank_frame(index=index, time=index / 60, position=np.zeros((0, 3)), step_error=8.1e-4, ksp_its=45)


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def clock(monkeypatch):
    """Sets the time that progress sees [s]."""
    now = [1000.0]
    monkeypatch.setattr(progress_bar.time, "monotonic", lambda: now[0])
    return now


def run(clock, stream, steps, seconds_a_step, total):
    shown = Progress(total, stream=stream)
    for index in range(steps + 1):
        shown.update(frame(index))
        clock[0] += seconds_a_step
    shown.close()


def test_log_has_the_first_the_last_and_a_line_every_ten_seconds(clock):
    log = io.StringIO()
    run(clock, log, steps=100, seconds_a_step=0.25, total=100)  # 25 s
    lines = log.getvalue().splitlines()
    assert [line.split()[1] for line in lines] == ["0/100", "40/100", "80/100", "100/100"]
    assert lines[1] == "frame 40/100  t = 0.667 s  4 frames/s  15 s left  its 45  error 8.1e-04"
    log = io.StringIO()
    run(clock, log, steps=3, seconds_a_step=1, total=100)  # one that stops early
    assert [line.split()[1] for line in log.getvalue().splitlines()] == ["0/100", "3/100"]


def test_a_resumed_run_counts_its_own_frames_for_the_rate(clock):
    log = io.StringIO()
    shown = Progress(100, stream=log)
    shown.update(frame(50))
    clock[0] += 10
    shown.update(frame(60))
    assert "1 frames/s  40 s left" in log.getvalue()


@pytest.mark.parametrize("kind", [io.StringIO, Terminal])
def test_other_ranks_are_silent(kind):
    stream = kind()
    shown = Progress(10, enabled=False, stream=stream)
    shown.update(frame(0))
    shown.update(frame(10))
    shown.close()
    assert stream.getvalue() == ""


def test_log_lines_stand_above_the_bar_and_not_in_it(monkeypatch):
    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    handlers = [logging.StreamHandler(terminal)]
    monkeypatch.setattr(log, "handlers", handlers)
    bar = Progress(10)
    log.warning("a cell is inside out")
    bar.close()
    log.warning("afterwards")
    screen = terminal.getvalue().split("\n")
    assert screen[0].split("\r")[-1] == "a cell is inside out"  # the bar before it was wiped out
    assert "0/10" in screen[1] and "\r" in screen[1] and screen[-2] == "afterwards"
    assert log.handlers is handlers
