"""The processes of a study, under mpiexec and with more ranks than cores."""

import os
import subprocess

from conftest import ENVIRONMENT

from msmpetsc.study.process import environment

RUNS_WITHIN_A_RUN = """
import subprocess, sys
from mpi4py import MPI
from msmpetsc.study.process import environment
for alone, launcher in ((True, []), (False, ["mpiexec", "-n", "2"])):
    command = [*launcher, sys.executable, "-c", "from mpi4py import MPI; print(MPI.COMM_WORLD.size)"]
    subprocess.run(command, env=environment(alone), check=True)
"""


def test_a_study_may_be_one_rank_of_mpiexec(on_ranks):
    done = on_ranks(1, "-c", RUNS_WITHIN_A_RUN, timeout=60)
    assert done.returncode == 0 and "".join(done.stdout.split()) == "122", done.stderr


def test_a_case_may_have_more_ranks_than_cores(monkeypatch):
    for name, value in ENVIRONMENT.items():
        monkeypatch.setenv(name, value)
    command = ["mpiexec", "-n", str(os.cpu_count() + 1), "true"]
    done = subprocess.run(command, env=environment(), capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
