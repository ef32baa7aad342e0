"""Progress on a terminal and in a batch log."""

import io
import logging
import re
from itertools import count

import numpy as np
import pytest

from msmpetsc.comm import log
from msmpetsc.fields import Frame
from msmpetsc.results import progress_bar
from msmpetsc.results.progress_bar import Progress


def frame(index: int) -> Frame:
    place = dict(index=index, time=index / 60, position=np.zeros((0, 3)))
    return Frame(step_error=8.1e-4, ksp_its=45, **place)


class Terminal(io.StringIO):
    def isatty(self):
        return True


def shown(monkeypatch, stream: io.StringIO, indices: range, **options) -> str:
    """Return the output of a progress bar after some frames of 100."""
    monkeypatch.setattr("sys.stderr", stream)
    bar = Progress(100, **options)
    for index in indices:
        bar.update(frame(index))
    bar.close()
    return stream.getvalue()


def test_a_log_has_a_line_now_and_then(monkeypatch):
    lines = shown(monkeypatch, io.StringIO(), range(101)).splitlines()
    assert [line.split()[1] for line in lines] == ["0/100", "100/100"]
    monkeypatch.setattr(progress_bar, "LINE_EVERY", 0.0)
    lines = shown(monkeypatch, io.StringIO(), range(101)).splitlines()
    assert [line.split()[1] for line in lines] == [f"{index}/100" for index in range(101)]
    assert "frame/s" in lines[40] and lines[40].endswith("its 45  error 8.1e-04")


def test_a_resumed_run_counts_its_own_frames_for_the_rate(monkeypatch):
    monkeypatch.setattr(progress_bar, "LINE_EVERY", 0.0)
    # time passes whenever tqdm asks for it
    monkeypatch.setattr("tqdm.std.time", count(0.0, 0.1).__next__)
    lines = shown(monkeypatch, io.StringIO(), range(50, 60)).splitlines()
    assert lines[0].startswith("frame 50/100")
    assert 0 < float(re.search(r"([\d.]+)frame/s", lines[-1])[1]) <= 10


@pytest.mark.parametrize("kind", [io.StringIO, Terminal])
def test_other_ranks_are_silent(monkeypatch, kind):
    assert shown(monkeypatch, kind(), range(0, 11, 10), enabled=False) == ""


def test_log_lines_stand_above_the_bar_and_not_in_it(monkeypatch):
    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    handlers = [logging.StreamHandler(terminal)]
    monkeypatch.setattr(log, "handlers", handlers)
    bar = Progress(10)
    bar.update(frame(0))
    log.warning("a cell is inside out")
    bar.close()
    log.warning("afterwards")
    screen = terminal.getvalue().split("\n")
    # the bar was erased before the warning
    assert screen[0].split("\r")[-1] == "a cell is inside out"
    assert "0/10" in screen[1] and "\r" in screen[1] and screen[-2] == "afterwards"
    assert log.handlers is handlers
