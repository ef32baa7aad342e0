"""The processes of a study, under mpiexec, with more ranks than cores."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import AS_ROOT, ENVIRONMENT, run

from msmpetsc.cli.commands import doctor
from msmpetsc.study.process import Processes, environment


@pytest.fixture
def processes():
    found = Processes()
    yield found
    found.close()


def test_a_process_alone_takes_no_folder_from_others(
    tmp_path: Path, processes: Processes, monkeypatch
):
    """A process that ends must not remove a folder that a new process uses.

    A case in 300 failed in this way. Open MPI 5 leaves the folders.
    """
    (tmp_path / "shared").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "shared"))
    code = "import os; from mpi4py import MPI; print(*os.listdir(os.environ['TMPDIR']))"
    assert processes.run([sys.executable, "-c", code], tmp_path / "log", 30).status == 0
    assert (tmp_path / "log").read_text().split() == os.listdir(tmp_path / "shared")


RUNS_WITHIN_A_RUN = """
import subprocess, sys
from mpi4py import MPI
from msmpetsc.study.process import environment
for alone, launcher in ((True, []), (False, ["mpiexec", "-n", "2"])):
    program = "from mpi4py import MPI; print(MPI.COMM_WORLD.size)"
    command = [*launcher, sys.executable, "-c", program]
    subprocess.run(command, env=environment(alone), check=True)
"""


def test_a_study_may_be_one_rank_of_mpiexec():
    done = run(1, "-c", RUNS_WITHIN_A_RUN)
    assert done.returncode == 0 and "".join(done.stdout.split()) == "122", done.stderr


def test_a_case_may_have_more_ranks_than_cores(monkeypatch):
    for name, value in ENVIRONMENT.items():
        monkeypatch.setenv(name, value)
    command = ["mpiexec", "-n", str(os.cpu_count() + 1), "true"]
    done = subprocess.run(command, env=environment(), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.skipif(os.getuid() != 0, reason="Open MPI refuses root alone")
def test_what_root_must_set_for_mpiexec_is_said(
    tmp_path: Path, processes: Processes, monkeypatch: pytest.MonkeyPatch
):
    """Cases of a study, check --ranks and doctor say it, instead of Open MPI's last line."""
    for name in AS_ROOT:
        monkeypatch.delenv(name)
    words = ["OMPI_ALLOW_RUN_AS_ROOT=1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1"]
    ended = processes.run(["mpiexec", "-n", "2", "true"], tmp_path / "log", timeout=60)
    state, line = doctor.probed("", "mpiexec", "-n", "2")
    assert ended.word == "failed" and state == doctor.BROKEN
    assert all(word in text for word in words for text in (ended.reason, line)), (ended, line)
