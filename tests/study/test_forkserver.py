"""Runs that need not start the program: the same as those that do."""

from pathlib import Path

import h5py
import numpy as np
import pytest
from block_scene import block_scene
from study_files import alive

from msmpetsc.study import process
from msmpetsc.study.forkserver import COLD
from msmpetsc.study.process import Ended, Processes

TIME = {"step": 0.01, "duration": 0.1}


@pytest.fixture
def processes():
    found = Processes()
    yield found
    found.close()


def carry_out(
    processes: Processes, path: Path, *words: str, timeout: float = 60, warm: bool = True
) -> tuple[Ended, str]:
    """How it ended, and what it said."""
    log = path.with_suffix(".log")
    ended = processes.run([*COLD, "run", str(path), "-o", str(path.with_suffix(".h5")), *words], log, timeout, warm)
    return ended, log.read_text()


def test_a_forked_run_is_the_same_run(tmp_path: Path, processes: Processes):
    """Each begins anew: what one was given does not stay for the next."""
    path, frames = block_scene(tmp_path, time=TIME, gravity={"acceleration": [0, 0, -9.81]}), []
    for words, warm in (([], False), (["-snes_type", "ngmres"], True), ([], True)):
        ended, told = carry_out(processes, path, "--overwrite", *words, warm=warm)
        assert ended.status == 0, told
        with h5py.File(path.with_suffix(".h5")) as file:
            frames.append(file["frames/position"][:])
            assert file.attrs["petsc_options"] == " ".join(words) and str(path) in file.attrs["command"]
    np.testing.assert_array_equal(frames[2], frames[0])


def test_it_fails_as_the_program_does(tmp_path: Path, processes: Processes):
    path = block_scene(tmp_path, time=TIME)
    ended, told = carry_out(processes, path, "--set", "time.stp=1")
    assert ended.status == 2 and "time.stp: unknown key" in ended.reason and "Traceback" not in told
    hard = ["--set", "start.twist={axis=[1, 0, 0], degrees=90}", "-snes_max_it", "1"]
    ended, _ = carry_out(processes, path, "--error", "1e-12", *hard)
    assert ended.status == 3 and "DIVERGED_MAX_IT" in ended.reason


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="looks at Linux's processes")
def test_it_is_ended_when_it_takes_too_long(tmp_path: Path, processes: Processes, monkeypatch):
    began, end = [], process.end
    monkeypatch.setattr(process, "end", lambda one: (began.append(one.pid), end(one)))
    path = block_scene(tmp_path, time={"step": 0.01, "duration": 1000.0})
    ended, _ = carry_out(processes, path, timeout=3)
    assert ended.status is None and "longer than 3 s" in ended.reason
    assert began and not any(map(alive, began))
