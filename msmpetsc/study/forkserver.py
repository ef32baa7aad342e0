"""Fork server of ``msmpetsc`` processes that execute several commands each, without start-up.

Start-up (imports, MPI, PETSc) takes most of the time of a small case. A forked process has executed
other commands before, so its times do not represent a run on its own. Therefore only cases whose
times are not reported are run in this way.
"""

import ctypes
import gc
import multiprocessing
import os
import signal
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from importlib import import_module
from multiprocessing.connection import Connection
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
    """A forked process, leader of its own session, that executes commands until a command fails.

    environment : all environment variables of the process; it starts in the current folder
    """

    def __init__(self, environment: Mapping[str, str]):
        self._commands, theirs = SERVER.Pipe()
        given = (theirs, os.getcwd(), dict(environment))
        self.process = SERVER.Process(target=_serve, args=given, daemon=True)
        self.process.start()
        theirs.close()
        self.pid = int(self.process.pid or 0)

    def begin(
        self, arguments: Sequence[str], log: Path, errors: Path | None = None, last: bool = False
    ) -> None:
        """Send a command of ``msmpetsc`` to the process and return at once.

        log    : file to which standard output is appended
        errors : file to which standard error is appended; ``log`` if None
        last   : no command will follow, so PETSc may read options at its start
        """
        self._commands.send((list(arguments), (str(log), str(errors or log)), last))

    def wait(self, timeout: float | None = None) -> int:
        """Return the exit status of the command begun last. Raises subprocess.TimeoutExpired."""
        if not self._commands.poll(timeout):
            raise subprocess.TimeoutExpired("msmpetsc", timeout or 0.0)
        try:
            return int(self._commands.recv())
        except EOFError:
            # the command has ended its process
            self.process.join()
            return int(self.process.exitcode or 0)

    def poll(self) -> int | None:
        """Return the exit status of the process, or None while it runs."""
        return self.process.exitcode

    def kill(self) -> None:
        """Kill the process."""
        self.process.kill()

    def close(self) -> None:
        """Close the connection and wait until the process ends."""
        self._commands.close()
        self.process.join()


def _serve(commands: Connection, folder: str, environment: dict[str, str]) -> None:
    enter(folder, environment)
    from mpi4py import MPI

    from msmpetsc.solve.petsc.initialise import start_for_runs

    # the collector then skips the objects of the imports
    gc.freeze()
    status = 0
    # EOFError: the parent has closed the connection
    with suppress(EOFError):
        while status == 0:
            arguments, files, last = commands.recv()
            redirect_output(files)
            _forget()
            if not last:
                # PETSc starts without options, so that each command gets only its own
                start_for_runs(MPI.COMM_WORLD, [])
            sys.argv = ["msmpetsc", *arguments]
            status = import_module(PROGRAM).main()
            sys.stdout.flush()
            ctypes.CDLL(None).fflush(None)
            commands.send(status)
    leave(status)


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
    sys.exit(status)


def _forget() -> None:
    """Collect the garbage of the previous command, and reset Linux's record of the peak memory."""
    gc.collect()
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
