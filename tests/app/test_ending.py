"""Failures of some ranks alone, under a real mpiexec: no other rank waits for them."""

import pytest
from block_scene import block_scene
from conftest import WORKERS, run

CASES = [  # ranks that fail, where, and how
    ("1", "step", "input"),
    ("0", "model", "memory"),
    ("1,2", "model", "input"),
]


@pytest.mark.timeout(100)
@pytest.mark.parametrize(("ranks", "where", "what"), CASES)
def test_a_failure_of_some_ranks_ends_all_with_its_line_and_status(tmp_path, ranks, where, what):
    scene = block_scene(tmp_path, time={"step": 0.01, "duration": 0.1})
    worker = WORKERS / "alone_worker.py"
    done = run(3, worker, ranks, where, what, "run", scene, "-o", tmp_path / "x.h5", timeout=40)
    told = [line for line in done.stderr.splitlines() if line.startswith("msmpetsc: error:")]
    assert done.returncode == 2 and len(told) == 1 and "Traceback" not in done.stderr, done.stderr
    said = {"input": "it fails", "memory": "there is not enough memory (Unable"}[what]
    assert told[0].startswith(f"msmpetsc: error: {said}")
