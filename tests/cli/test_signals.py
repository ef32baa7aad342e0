"""Runs that signals stop continue exactly, also on two ranks of a real mpiexec."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import h5py
import pytest
from conftest import ENVIRONMENT, python
from one_process import status_of
from stopped_runs import (  # noqa: F401  # a fixture
    EVERY,
    STEPS,
    assert_same,
    every_step_forgets,
    hanging,
    ranks_of,
    stopped_after,
)  # fmt: skip

from msmpetsc.app import running
from msmpetsc.results.untrusted_file import finished

STATUS = {signal.SIGUSR1: 0, signal.SIGTERM: 143, signal.SIGINT: 130}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the result of a run that is never stopped."""
    folder = tmp_path_factory.mktemp("whole")
    assert status_of("run", hanging(folder), "-o", folder / "whole.h5") == 0
    return folder / "whole.h5"


@pytest.mark.parametrize("number", STATUS)
def test_a_signal_ends_the_step_and_the_run_goes_on_exactly(whole: Path, tmp_path, capsys, number):
    path, handler = tmp_path / "x.h5", signal.getsignal(number)
    # the signal comes between frames
    command = "run", whole.parent / "scene.toml", "-o", path
    assert stopped_after(10, *command, number=number) == STATUS[number]
    told = (
        f"stopped by {number.name} after step 10 of 40 (t = 0.1 s); to go on: msmpetsc run "
        f"--resume {path}\n"
    )
    assert told in capsys.readouterr().err
    assert signal.getsignal(number) == handler
    with h5py.File(path) as file:
        assert finished(file) == 4 and max(file["checkpoint/step"]) == 10
    assert status_of("run", "--resume", path) == 0
    assert_same(path, whole)
    assert sorted(os.listdir(tmp_path)) == ["x.h5", "x.xdmf"]


def test_stopped_again_and_again(whole: Path, tmp_path):
    path = tmp_path / "x.h5"
    # each command is the same
    arguments = "run", whole.parent / "scene.toml", "--resume", path
    for step in (0, 1, 7, 8, 27, 39):
        assert stopped_after(step, *arguments) == 0
        with h5py.File(path) as file:
            assert finished(file) == 1 + step // EVERY and max(file["checkpoint/step"]) == step
    assert status_of(*arguments) == 0
    assert_same(path, whole)


def test_a_signal_in_the_last_step_comes_too_late(whole: Path, tmp_path, capsys):
    path = tmp_path / "x.h5"
    command = "run", whole.parent / "scene.toml", "-o", path
    assert stopped_after(STEPS, *command, number=signal.SIGTERM) == 0
    assert "stopped" not in capsys.readouterr().err
    assert_same(path, whole)


@pytest.mark.parametrize("phase", ["prepare", "write_companions"])
def test_a_request_to_stop_kills_no_run_outside_its_steps(
    whole: Path, tmp_path, monkeypatch, phase: str
):
    """A signal before the first step stops the run at step 0; after the last it has no effect."""
    path, killed, of_phase = tmp_path / "x.h5", [], getattr(running, phase)

    def signalled(*given: object, **more: object) -> object:
        os.kill(os.getpid(), signal.SIGUSR1)
        return of_phase(*given, **more)

    monkeypatch.setattr(running, phase, signalled)
    before = signal.signal(signal.SIGUSR1, lambda *_: killed.append(phase))
    try:
        words = "-o", path, "--measure", path.with_suffix(".json")
        assert status_of("run", whole.parent / "scene.toml", *words) == 0
    finally:
        signal.signal(signal.SIGUSR1, before)
    assert not killed and path.with_suffix(".json").exists()
    with h5py.File(path) as file, h5py.File(whole) as other:
        assert finished(file) == (1 if phase == "prepare" else finished(other))


def start(*arguments: object, ranks: int = 1) -> subprocess.Popen:
    """Return a run in a new process that has reached its first frame."""
    launcher = ["mpiexec", "--oversubscribe", "-n", str(ranks)] if ranks > 1 else []
    command = [*launcher, sys.executable, "-m", "msmpetsc.cli.main", "run", *map(str, arguments)]
    process = subprocess.Popen(command, env=ENVIRONMENT, stderr=subprocess.PIPE, text=True)
    for line in process.stderr:
        if line.startswith("frame 0/"):
            return process
    raise AssertionError("it never began")


def wait_until(condition: Callable[[], object]) -> None:
    end = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


@pytest.mark.parametrize("ranks", [1, 2])
def test_a_signal_ends_a_step_of_minutes_between_its_iterations(tmp_path, ranks: int):
    """A step of 100,000 iterations ends at the signal.

    The rank that gets the signal stops the other rank too.
    """
    path = tmp_path / "x.h5"
    scene = hanging(
        tmp_path, 2, cages={"cell_size": 1 / 32}, material={"young_modulus": 1e9, "density": 1000.0}
    )
    seen = tmp_path / "iterations"
    endless = "--error 1e-13 --preset anderson -snes_type nrichardson -snes_linesearch_type basic "
    endless += f"-snes_max_it 100000 -snes_monitor ascii:{seen}"
    process = start(scene, "-o", path, *endless.split(), ranks=ranks)
    with process:
        wait_until(lambda: seen.exists() and seen.stat().st_size)
        pid = process.pid if ranks == 1 else ranks_of(process)[-1]
        os.kill(pid, signal.SIGTERM)
        began = time.perf_counter()
        told = process.stderr.read()
    assert process.returncode == 143 and time.perf_counter() - began < 20
    assert "stopped by SIGTERM after step 0 of 2 (t = 0 s); to go on: msmpetsc run --resume" in told
    with h5py.File(path) as file:
        assert finished(file) == 1 and max(file["checkpoint/step"]) == 0
    able = "--preset newton --error 1e-3 -snes_type newtonls -snes_linesearch_type bt"
    assert status_of("run", "--resume", path, "--force", *able.split()) == 0


def test_a_second_interrupt_stops_at_once(tmp_path):
    """Both signals come within a linear solve that would take minutes with these settings."""
    path = tmp_path / "x.h5"
    scene = hanging(
        tmp_path, 2, cages={"cell_size": 1 / 48}, solver={"preset": "paper", "error": 1e-9}
    )
    seen = tmp_path / "iterations"
    endless = f"-ksp_rtol 1e-99 -ksp_atol 0 -ksp_max_it 100000 -ksp_monitor ascii:{seen}"
    process = start(scene, "-o", path, *endless.split())
    with process:
        # an interrupt before the first monitored iteration would end the run
        wait_until(lambda: seen.exists() and seen.stat().st_size)
        # signals that arrive together count once, so send signals until the run has
        # ended
        wait_until(lambda: process.poll() is not None or process.send_signal(signal.SIGINT))
        told = process.stderr.read()
    assert process.returncode == 130 and "stopped at once" in told
    assert not list(tmp_path.glob("*x.h5.*"))
    with h5py.File(path) as file:
        assert finished(file) >= 1


INTERRUPTED_AT_THE_END = """
import atexit, os, signal
from msmpetsc.cli import main
main.main = lambda: 143
atexit.register(os.kill, os.getpid(), signal.{})
main.entry_point()
"""


@pytest.mark.parametrize("name", ["SIGINT", "SIGUSR1"])
def test_a_signal_after_the_end_changes_nothing(name: str):
    done = python("-c", INTERRUPTED_AT_THE_END.format(name))
    assert done.returncode == 143 and done.stderr == ""
