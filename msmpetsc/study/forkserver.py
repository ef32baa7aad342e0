"""Runs of the program without its start: a process that has imported it forks a child for each.

A start takes 2 s of a core, which is most of a small case; a fork 0.4 s. What such a run costs says less of the
program than a run of its own does, so only cases are run like this of which no time is asked.
"""

import multiprocessing
import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path

PROGRAM = "msmpetsc.cli.main"
COLD = [sys.executable, "-m", "msmpetsc"]  # a command that starts it begins with this
SERVER = multiprocessing.get_context("forkserver")
SERVER.set_forkserver_preload(
    [
        "msmpetsc.study.preloaded", PROGRAM, "msmpetsc.cli.commands.run", "msmpetsc.app.resume", "msmpetsc.build",
        "msmpetsc.geometry.readers",
    ]
)  # fmt: skip  # all but PETSc


class Forked:
    """A forked run of ``msmpetsc`` in a session of its own, with the interface of subprocess.Popen."""

    def __init__(self, arguments: Sequence[str], log: Path, environment: Mapping[str, str], errors: Path | None = None):
        """Start the run in the current folder; its output goes to ``log``, its errors to ``errors`` if given.

        environment : all that it has
        """
        where = (str(log), str(errors or log), os.getcwd())
        self.process = SERVER.Process(target=_run, args=(list(arguments), where, dict(environment)), daemon=True)
        self.process.start()
        self.pid = int(self.process.pid or 0)

    def poll(self) -> int | None:
        return self.process.exitcode

    def wait(self, timeout: float | None = None) -> int:
        self.process.join(timeout)
        if self.process.exitcode is None:
            raise subprocess.TimeoutExpired("msmpetsc", timeout or 0.0)
        return self.process.exitcode

    def kill(self) -> None:
        self.process.kill()


def _run(arguments: list[str], where: tuple[str, str, str], environment: Mapping[str, str]) -> None:
    *files, folder = where
    os.setsid()
    for number in (signal.SIGINT, signal.SIGTERM):  # the server's own are none of ours
        signal.signal(number, signal.SIG_DFL)
    for stream, path in enumerate(files, 1):  # standard output and error
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND), stream)
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
