"""Runs killed by SIGKILL at random moments, resumed, killed again: no frame is lost, and the end is the same."""

import os
import random
import re
import signal
import subprocess
import sys
import time
import xml.etree.ElementTree as ET
from pathlib import Path

import h5py
import numpy as np
import pytest
from conftest import ENVIRONMENT, run
from stopped_runs import assert_same, hanging, ranks_of

from msmpetsc.app.ranks import ALONE
from msmpetsc.fields import FRAME_FIELDS
from msmpetsc.results.reader import finished
from msmpetsc.solve.simulate import REMEMBERED
from msmpetsc.study.forkserver import Forked

pytestmark = pytest.mark.slow


def is_killed(ranks: int, arguments: list[str], wait: float, log: Path) -> bool:
    """Kill a run, or one of its ranks, after so many seconds; of two ranks after its first frame of this start."""
    if ranks == 1:
        child = Forked(ENVIRONMENT | ALONE)
        child.begin(arguments, log, last=True)
        try:
            assert child.wait(wait) == 0, log.read_text()
        except subprocess.TimeoutExpired:
            child.kill()
            child.process.join()
        return child.poll() is not None
    command = [
        "mpiexec",
        "--oversubscribe",
        "-n",
        str(ranks),
        sys.executable,
        "-m",
        "msmpetsc",
        *arguments,
    ]
    with subprocess.Popen(command, env=ENVIRONMENT, stderr=subprocess.PIPE, text=True) as process:
        next((line for line in process.stderr if line.startswith("frame ")), None)
        time.sleep(wait)
        processes = ranks_of(process)
        if len(processes) == ranks and process.poll() is None:
            os.kill(processes[0], signal.SIGKILL)
        said = process.stderr.read()
    assert process.returncode == 0 or len(processes) == ranks, said
    return process.returncode != 0


def frames_left(path: Path, whole: Path, least: int) -> int:
    """Return how many frames there are, which are those of a run that was never killed."""
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
    """While it is set up, runs, goes on, and makes room for more frames than were planned."""
    scene = hanging(tmp_path, steps, output={"surface": False})
    path, chance, at = tmp_path / "x.h5", random.Random(ranks), []
    longer = ["--force", "--set", f"time.duration={0.015 * steps}"]
    runs = {tmp_path / "whole.h5": [], tmp_path / "longer.h5": longer}
    for whole, more in runs.items():
        begin = time.monotonic()
        run(ranks, "-m", "msmpetsc", "run", scene, "-o", whole, *more[1:], status=0)
    seconds = (time.monotonic() - begin) / ranks  # of two ranks they count from the first frame
    while len(at) < kills:  # again and again from the start
        path.unlink(missing_ok=True)
        count = 0
        for whole, more in runs.items():
            often = chance.choice([[], ["--checkpoint-every", "1"]])
            command = ["run", str(scene), "--resume", str(path), *more, *often]
            while len(at) < kills and is_killed(
                ranks, command, chance.uniform(0, seconds), tmp_path / "log"
            ):
                # what comes after its checkpoint a run that goes on takes again
                kept = (count - 1) // REMEMBERED * REMEMBERED + 1 if count else 0
                count = frames_left(path, whole, kept)
                at.append(count)
            if len(at) == kills:
                run(ranks, "-m", "msmpetsc", *command, status=0)
            assert_same(path, whole)
    print(at)
    assert (
        ranks > 1 or len(set(at)) > 3
    )  # spread over the frames: fewer where other work holds up the start


def test_a_killed_run_leaves_its_xdmf_file(tmp_path: Path):
    path = tmp_path / "x.h5"
    command = [sys.executable, "-m", "msmpetsc", "run", hanging(tmp_path, 100_000), "-o", path]
    with subprocess.Popen(command, env=ENVIRONMENT, stderr=subprocess.PIPE, text=True) as process:
        assert any(re.match(r"frame [1-9]", line) for line in process.stderr)
        process.kill()
    with h5py.File(path) as file:
        grids = ET.parse(path.with_suffix(".xdmf")).findall(".//Time")
        assert 1 <= len(grids) / 2 <= finished(file) < 33_334
