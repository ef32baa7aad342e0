"""Rows are sent, keys numbered and errors shared in the same way on any number of ranks."""

import pytest
from conftest import WORKERS, run

WORKER = WORKERS / "comm_worker.py"


@pytest.mark.parametrize("ranks", [1, 3])
def test_against_plain_arrays(ranks):
    # with -m mpi4py a failure on any rank ends all ranks
    done = run(ranks, "-m", "mpi4py", WORKER)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("passed") == ranks
