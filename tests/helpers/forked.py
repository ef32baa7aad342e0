"""Run programs in forks of a process that has already imported the package.

Each run and rank has its own fork. A small run takes 3 s of a core in a new process, 0.7 s in a
fork. Ranks are ranks of a real mpiexec: it starts a small program for each rank, which passes on
the environment of the rank. With this environment a forked child joins the other ranks. The small
program ends when the child ends.
"""

import ctypes
import multiprocessing
import os
import runpy
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib import import_module
from multiprocessing.connection import wait
from pathlib import Path
from typing import NoReturn
from unittest.mock import patch

PROGRAM = "msmpetsc.cli.main"
SERVER = multiprocessing.get_context("forkserver")
# modules that a run imports, except PETSc
SERVER.set_forkserver_preload(
    [
        "preloaded", PROGRAM, "msmpetsc.cli.commands.run", "msmpetsc.app.resume",
        "msmpetsc.build", "msmpetsc.geometry.readers",
    ]
)  # fmt: skip
STAND_IN = """cd "$0"; env -0 >$OMPI_COMM_WORLD_RANK.new
mv $OMPI_COMM_WORLD_RANK.new $OMPI_COMM_WORLD_RANK.env
read -r status <$OMPI_COMM_WORLD_RANK.status; exit $status"""


def started(target: Callable, *given) -> multiprocessing.Process:
    """Return a forked process; the server imports its modules from the paths of this process."""
    process = SERVER.Process(target=target, args=given, daemon=True)
    with patch.dict(os.environ, PYTHONPATH=os.pathsep.join(sys.path)):
        process.start()
    return process


def run_forked(
    arguments: Sequence[str], environment: Mapping[str, str], timeout: float
) -> subprocess.CompletedProcess:
    """Run ``msmpetsc`` with these arguments and return what subprocess.run returns.

    Raises subprocess.TimeoutExpired.
    """
    with tempfile.TemporaryDirectory() as folder:
        out, error = Path(folder, "out"), Path(folder, "error")
        child = started(_program, list(arguments), os.getcwd(), dict(environment), (out, error))
        child.join(timeout)
        if child.exitcode is None:
            # the session, with all processes that the child has started
            os.killpg(child.pid, signal.SIGKILL)
            raise subprocess.TimeoutExpired("msmpetsc", timeout)
        return subprocess.CompletedProcess(
            list(arguments), child.exitcode, out.read_text(), error.read_text()
        )


def run_ranks(
    ranks: int, arguments: Sequence[str], environment: Mapping[str, str], timeout: float
) -> subprocess.CompletedProcess:
    """Run Python with these arguments on so many ranks and return what subprocess.run returns.

    Raises subprocess.TimeoutExpired.
    """
    end = time.monotonic() + timeout
    with tempfile.TemporaryDirectory() as folder:
        streams = [Path(folder, name) for name in ("out", "error")]
        for rank in range(ranks):
            os.mkfifo(Path(folder, f"{rank}.status"))
        command = ["mpiexec", "--oversubscribe", "-n", str(ranks), "bash", "-c", STAND_IN, folder]
        out, error = (path.open("a") for path in streams)
        with (
            out,
            error,
            subprocess.Popen(command, env=environment, stdout=out, stderr=error) as mpiexec,
        ):
            children = []
            try:
                for rank in range(ranks):
                    own = _environment_of(Path(folder, f"{rank}.env"), mpiexec, end)
                    children.append(started(_rank, list(arguments), streams, own))
                _hand_on(children, mpiexec, folder, end)
                mpiexec.wait(max(0.1, end - time.monotonic()))
            finally:
                mpiexec.kill()
                for child in children:
                    # all ranks end if one fails
                    if child.is_alive():
                        os.killpg(child.pid, signal.SIGKILL)
        return subprocess.CompletedProcess(
            command, mpiexec.returncode, *(path.read_text() for path in streams)
        )


def _environment_of(path: Path, mpiexec: subprocess.Popen, end: float) -> dict[str, str]:
    while not path.exists() and mpiexec.poll() is None and time.monotonic() < end:
        time.sleep(0.01)
    words = path.read_text().split("\0")
    return dict(word.split("=", 1) for word in words if word) | {"PWD": os.getcwd()}


def _hand_on(children: list, mpiexec: subprocess.Popen, folder: str, end: float) -> None:
    """Pass each child's status to the program of its rank, until all or mpiexec have ended."""
    running = dict(enumerate(children))
    while running and mpiexec.poll() is None:
        if time.monotonic() > end:
            raise subprocess.TimeoutExpired("mpiexec", end)
        wait([child.sentinel for child in running.values()], 0.05)
        for rank in [rank for rank, child in running.items() if not child.is_alive()]:
            status = running.pop(rank).exitcode
            # opening for reading and writing never waits for a reader
            pipe = os.open(Path(folder, f"{rank}.status"), os.O_RDWR)
            os.write(pipe, b"%d\n" % (status if status >= 0 else 128 - status))


def _rank(arguments: list[str], streams: list[Path], environment: dict[str, str]) -> None:
    enter(environment["PWD"], environment)
    redirect_output(streams)
    status = 0
    try:
        _python(arguments)
    except SystemExit as ended:
        status = ended.code or 0
    leave(status)


def _python(arguments: list[str]) -> None:
    """Run Python's arguments: -c TEXT, -m MODULE or a file, and the rest."""
    kind, *rest = arguments
    if kind not in ("-c", "-m"):
        sys.argv, sys.path[0:0] = arguments, [str(Path(kind).parent)]
        runpy.run_path(kind, run_name="__main__")
        return
    sys.argv = ["-c", *rest[1:]]
    if kind == "-c":
        exec(compile(rest[0], "<string>", "exec"), {"__name__": "__main__"})
        return
    # the server has loaded the module, and runpy would warn of it
    sys.modules.pop(rest[0], None)
    runpy.run_module(rest[0], run_name="__main__", alter_sys=True)


def _program(
    arguments: list[str], folder: str, environment: dict[str, str], files: tuple[Path, Path]
) -> None:
    enter(folder, environment)
    redirect_output(files)
    sys.argv = ["msmpetsc", *arguments]
    leave(import_module(PROGRAM).main())


def enter(folder: str, environment: Mapping[str, str]) -> None:
    """Make a forked process the leader of its own session, set its environment, and start MPI."""
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
