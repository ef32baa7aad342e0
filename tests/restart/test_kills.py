"""Runs killed by SIGKILL at random moments, resumed, killed again: no frame is lost, and the end is the same."""

import json
import os
import random
import signal
import subprocess
import sys
import time

import h5py
import pytest
from conftest import ENVIRONMENT, WORKERS, run
from stopped_runs import assert_same, hanging, ranks_of

from msmpetsc.results.reader import finished

ALONE, ON_TWO = 24, 6  # kills
pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]


def test_killed_at_any_moment_on_one_rank(tmp_path):
    """While it is set up, runs, goes on, and makes room for more frames than were planned."""
    worker = WORKERS / "kill_worker.py"
    command = [sys.executable, worker, hanging(tmp_path, 150), tmp_path, ALONE, 1]
    done = subprocess.run([*map(str, command)], env=ENVIRONMENT, capture_output=True, text=True, timeout=220)
    assert done.returncode == 0, done.stderr
    seen = json.loads(done.stdout.splitlines()[-1])
    print(seen)
    assert seen["kills"] == ALONE and seen["faults"] == []
    assert len(set(seen["at frame"])) > 3  # spread over the frames: fewer where other work holds up the start


def test_killed_at_any_moment_on_two_ranks(tmp_path):
    """One rank, which ends the other."""
    scene, path, chance = hanging(tmp_path, 40, output={"surface": False}), tmp_path / "x.h5", random.Random(2)
    whole = tmp_path / "whole.h5"
    assert run(2, "-m", "msmpetsc.cli.main", "run", scene, "-o", whole).returncode == 0
    kills, known, at = 0, 0, []
    while kills < ON_TWO:
        killed = kill_soon(["run", str(scene), "--resume", str(path), "--checkpoint-every", "1"], chance)
        kills += killed
        with h5py.File(path, locking=False) as file:
            assert finished(file) >= known
            known = finished(file)
            at.append(known)
        if not killed:
            assert_same(path, whole)
            path.unlink()
            known = 0
    print(at)
    if path.exists():
        assert run(2, "-m", "msmpetsc.cli.main", "run", "--resume", path).returncode == 0
        assert_same(path, whole)


def kill_soon(arguments: list[str], chance: random.Random) -> bool:
    """Start on two ranks and kill one of them; False if it was at its end before."""
    command = ["mpiexec", "--oversubscribe", "-n", "2", sys.executable, "-m", "msmpetsc.cli.main", *arguments]
    with subprocess.Popen(command, env=ENVIRONMENT, stderr=subprocess.PIPE, text=True) as process:
        for line in process.stderr:
            if line.startswith("frame "):
                break
        time.sleep(chance.uniform(0, 0.2))
        ranks = ranks_of(process)
        if len(ranks) == 2 and process.poll() is None:
            os.kill(chance.choice(ranks), signal.SIGKILL)
        process.stderr.read()
    return process.returncode != 0
