"""The program on one rank without its start: a process that has imported it forks a child for each run.

A start takes 2 s of a core, a fork 0.4 s. What several ranks do, and what starts by itself, has a real mpiexec.
"""

import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path

from msmpetsc.study.forkserver import PROGRAM, SERVER


def run_forked(arguments: Sequence[str], environment: Mapping[str, str], timeout: float) -> subprocess.CompletedProcess:
    """``msmpetsc`` with these arguments, as subprocess.run gives it. Raises subprocess.TimeoutExpired."""
    with tempfile.TemporaryDirectory() as folder:
        out, error = Path(folder, "out"), Path(folder, "error")
        where = (str(out), str(error), os.getcwd())
        child = SERVER.Process(target=_run, args=(list(arguments), where, dict(environment)), daemon=True)
        child.start()
        child.join(timeout)
        if child.exitcode is None:
            os.killpg(child.pid or 0, signal.SIGKILL)
            raise subprocess.TimeoutExpired(list(arguments), timeout)
        return subprocess.CompletedProcess(list(arguments), child.exitcode, out.read_text(), error.read_text())


def _run(arguments: list[str], where: tuple[str, str, str], environment: dict[str, str]) -> None:
    os.setsid()
    for number in (signal.SIGINT, signal.SIGTERM):  # the server's own are none of ours
        signal.signal(number, signal.SIG_DFL)
    *files, folder = where
    for number, path in enumerate(files, 1):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND), number)
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    from mpi4py import MPI

    MPI.Init()
    sys.argv = ["msmpetsc", *arguments]
    status = import_module(PROGRAM).main()
    if "petsc4py.PETSc" in sys.modules:
        sys.modules["petsc4py.PETSc"]._finalize()
    MPI.Finalize()
    sys.exit(status)
