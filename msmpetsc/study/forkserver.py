"""Commands of the program without its start: a process that has imported it carries out one after another.

A start takes 1.5 s of a core, which is most of a small case; a fork of the server 0.4 s, and a further command of the
same process none. What such a run costs says less of the program than a run of its own does, so only cases are run
like this of which no time is asked.
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
COLD = [sys.executable, "-m", "msmpetsc"]  # a command that starts it begins with this
SERVER = multiprocessing.get_context("forkserver")
SERVER.set_forkserver_preload(
    [
        "msmpetsc.study.preloaded", PROGRAM, "msmpetsc.cli.commands.run", "msmpetsc.app.resume", "msmpetsc.build",
        "msmpetsc.geometry.readers",
    ]
)  # fmt: skip  # all but PETSc


class Forked:
    """A process in a session of its own that carries out commands; one that fails is its last.

    environment : all that it has; its folder is the current one
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
        """Begin a command of ``msmpetsc``.

        log, errors : where its output goes, and its errors, if not there too
        last        : no other will follow; so it may have options that PETSc reads at its start
        """
        self._commands.send((list(arguments), (str(log), str(errors or log)), last))

    def wait(self, timeout: float | None = None) -> int:
        """Return the exit status of the command begun last. Raises subprocess.TimeoutExpired."""
        if not self._commands.poll(timeout):
            raise subprocess.TimeoutExpired("msmpetsc", timeout or 0.0)
        try:
            return int(self._commands.recv())
        except EOFError:  # the command has ended its process
            self.process.join()
            return int(self.process.exitcode or 0)

    def poll(self) -> int | None:
        """Return the exit status of the process; None while it lives."""
        return self.process.exitcode

    def kill(self) -> None:
        """End the process at once."""
        self.process.kill()

    def close(self) -> None:
        """Let the process end, which waits for a command."""
        self._commands.close()
        self.process.join()


def _serve(commands: Connection, folder: str, environment: dict[str, str]) -> None:
    enter(folder, environment)
    from mpi4py import MPI

    from msmpetsc.solve.petsc.initialise import start_for_runs

    gc.freeze()  # what was imported is not looked through again
    status = 0
    with suppress(EOFError):  # no more commands
        while status == 0:
            arguments, files, last = commands.recv()
            speak_into(files)
            _forget()
            if not last:
                start_for_runs(
                    MPI.COMM_WORLD, []
                )  # options are then lent to a run, and no later one has them
            sys.argv = ["msmpetsc", *arguments]
            status = import_module(PROGRAM).main()
            sys.stdout.flush()
            ctypes.CDLL(None).fflush(None)
            commands.send(status)
    leave(status)


def enter(folder: str, environment: Mapping[str, str]) -> None:
    """Make of a fork of the server a process in a session of its own, with MPI started.

    environment : all that it has
    """
    os.setsid()
    for number in (signal.SIGINT, signal.SIGTERM):  # the server's own are none of ours
        signal.signal(number, signal.SIG_DFL)
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    from mpi4py import MPI

    MPI.Init()


def speak_into(files: Iterable[str | Path]) -> None:
    """Let standard output and error go to two files."""
    for stream, path in enumerate(files, 1):
        file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(file, stream)
        os.close(file)


def leave(status: int) -> NoReturn:
    """End such a process, its PETSc and its MPI."""
    from mpi4py import MPI

    from msmpetsc.solve.petsc.initialise import finalise

    finalise()
    MPI.Finalize()
    sys.exit(status)


def _forget() -> None:
    """Collect the garbage of the command before, and let Linux count the most memory from now on."""
    gc.collect()
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
