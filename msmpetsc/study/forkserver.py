"""Fork server of ``msmpetsc`` processes, which need not import the program.

Imports take most of the time of a small case. A forked process shares its server's memory, so its
times and its memory do not represent a run on its own. Therefore only cases whose times are not
reported are run in this way.
"""

import ctypes
import multiprocessing
import os
import signal
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import NoReturn

PROGRAM = "msmpetsc.cli.main"
# first words of a command that starts the program in a new interpreter
COLD = [sys.executable, "-m", "msmpetsc"]
SERVER = multiprocessing.get_context("forkserver")
# the modules that a run imports, except PETSc
SERVER.set_forkserver_preload(
    [
        "msmpetsc.study.preloaded", PROGRAM, "msmpetsc.cli.commands.run", "msmpetsc.app.resume",
        "msmpetsc.build", "msmpetsc.geometry.readers",
    ]
)  # fmt: skip


class Forked:
    """A forked process, leader of its own session, that executes a command of ``msmpetsc``.

    It has the part of subprocess.Popen's interface that ends a process.

    arguments   : of the command, without the program's name
    environment : all environment variables of the process; it starts in the current folder
    log         : file to which standard output is appended
    errors      : file to which standard error is appended; ``log`` if None
    """

    def __init__(
        self,
        arguments: Sequence[str],
        environment: Mapping[str, str],
        log: Path,
        errors: Path | None = None,
    ):
        given = (list(arguments), os.getcwd(), dict(environment), (log, errors or log))
        self.process = SERVER.Process(target=_execute, args=given, daemon=True)
        self.process.start()
        self.pid = int(self.process.pid or 0)
        self.kill = self.process.kill

    def wait(self, timeout: float | None = None) -> int:
        """Return the exit status. Raises subprocess.TimeoutExpired."""
        self.process.join(timeout)
        if self.process.exitcode is None:
            raise subprocess.TimeoutExpired("msmpetsc", timeout or 0.0)
        return self.process.exitcode

    def poll(self) -> int | None:
        """Return the exit status, or None while the process runs."""
        return self.process.exitcode


def _execute(
    arguments: list[str], folder: str, environment: dict[str, str], files: tuple[Path, Path]
) -> None:
    enter(folder, environment)
    redirect_output(files)
    sys.argv = ["msmpetsc", *arguments]
    leave(import_module(PROGRAM).main())


def enter(folder: str, environment: Mapping[str, str]) -> None:
    """Make a forked process leader of its own session, with its own environment, and start MPI.

    environment : all environment variables of the process
    """
    os.setsid()
    # undo the handlers inherited from the fork server
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_DFL)
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    from mpi4py import MPI

    MPI.Init()


def redirect_output(files: Iterable[str | Path]) -> None:
    """Append standard output and standard error to two files."""
    for stream, path in enumerate(files, 1):
        file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(file, stream)
        os.close(file)


def leave(status: int) -> NoReturn:
    """Finalise PETSc and MPI, and exit with this status."""
    from mpi4py import MPI

    from msmpetsc.solve.petsc.initialise import finalise

    finalise()
    MPI.Finalize()
    # multiprocessing ends a forked process without C's own flush
    ctypes.CDLL(None).fflush(None)
    sys.exit(status)
