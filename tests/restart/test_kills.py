"""Runs killed by SIGKILL at random moments and resumed lose no frame and end the same."""

import random
import re
import signal
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import h5py
import numpy as np
import pytest
from conftest import ENVIRONMENT, WORKERS, run
from stopped_runs import assert_same, hanging

from msmpetsc.fields import FRAME_FIELDS
from msmpetsc.results.untrusted_file import finished
from msmpetsc.solve.simulate import REMEMBERED

pytestmark = pytest.mark.slow


def run_killed(ranks: int, seconds: float, *arguments: object) -> subprocess.CompletedProcess:
    """Return a run whose rank 0 died after so many seconds of CPU time, or that ended before."""
    done = run(ranks, WORKERS / "killed_worker.py", seconds, *arguments)
    assert done.returncode in (0, 128 + signal.SIGPROF), done.stderr
    return done


def frames_left(path: Path, whole: Path, least: int) -> int:
    """Return the number of frames; check that they agree with a run that was never killed."""
    if not path.exists():
        assert least == 0
        return 0
    with h5py.File(path, locking=False) as file, h5py.File(whole) as other:
        count = finished(file)
        for name in (FRAME_FIELDS.keys() & file["frames"]) - {"wall_time"}:
            found, expected = (of["frames"][name][:count] for of in (file, other))
            assert np.array_equal(found, expected, equal_nan=True), name
    assert count >= least
    return count


@pytest.mark.parametrize(("ranks", "kills", "steps"), [(1, 24, 150), (2, 6, 40)])
def test_killed_at_any_moment(tmp_path: Path, ranks: int, kills: int, steps: int):
    """Kills come in the set-up, in steps, after a resume, and while the file is extended."""
    scene = hanging(tmp_path, steps, output={"surface": False})
    path, chance, at = tmp_path / "x.h5", random.Random(ranks), []
    longer = ["--force", "--set", f"time.duration={0.015 * steps}"]
    runs = {tmp_path / "whole.h5": [], tmp_path / "longer.h5": longer}
    for whole, more in runs.items():
        done = run_killed(ranks, 0, "run", scene, "-o", whole, *more[1:])
        seconds = float(done.stdout.split()[-1])
    # repeatedly from the start
    while len(at) < kills:
        path.unlink(missing_ok=True)
        count = 0
        for whole, more in runs.items():
            often = chance.choice([[], ["--checkpoint-every", "1"]])
            command = ["run", scene, "--resume", path, *more, *often]
            while len(at) < kills:
                done = run_killed(ranks, chance.uniform(0.01, seconds), *command)
                if done.returncode == 0:
                    break
                # frames after the last checkpoint are computed again
                kept = (count - 1) // REMEMBERED * REMEMBERED + 1 if count else 0
                count = frames_left(path, whole, kept)
                at.append(count)
            if len(at) == kills:
                run(ranks, "-m", "msmpetsc", *command, status=0)
            assert_same(path, whole)
    print(at)
    # moments are spread over the frames
    assert len(set(at)) > (3 if ranks == 1 else 1)


def test_a_killed_run_leaves_its_xdmf_file(tmp_path: Path):
    path = tmp_path / "x.h5"
    command = [sys.executable, "-m", "msmpetsc", "run", hanging(tmp_path, 100_000), "-o", path]
    with subprocess.Popen(command, env=ENVIRONMENT, stderr=subprocess.PIPE, text=True) as process:
        assert any(re.match(r"frame [1-9]", line) for line in process.stderr)
        process.kill()
    with h5py.File(path) as file:
        grids = ET.parse(path.with_suffix(".xdmf")).findall(".//Time")
        assert 1 <= len(grids) / 2 <= finished(file) < 33_334
