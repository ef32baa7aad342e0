"""Processes with all their children: run to the end or to a time limit, with the last error of their log.

A run of the program may be forked from a process that has imported it, which spares it 2 s of a core, most of a small
case. What that costs says less of the program, so only cases are forked of which no time is asked.
"""

import multiprocessing
import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from threading import Lock

import psutil

GRACE = 3.0  # [s] between the request to end and the end
VARIABLES_OF_MPI = (  # of a launcher around us: not for our children
    "PMIX_", "PMI_", "OMPI_COMM_WORLD_", "OMPI_UNIVERSE_", "OMPI_MCA_ess", "OMPI_MCA_orte_ess_",
    "OMPI_MCA_orte_hnp_uri",
    "OMPI_MCA_orte_local_daemon_uri", "OMPI_MCA_orte_jobfam_", "OMPI_MCA_pmix",
)  # fmt: skip
# A process alone needs neither Open MPI's daemon nor its search for a network, a third of a second at its start; nor
# folders that all share: one that ends may take them from under one that begins, which then fails (1 of 300).
ALONE = {
    "OMPI_MCA_ess_singleton_isolated": "1", "OMPI_MCA_pml": "ob1", "OMPI_MCA_orte_create_session_dirs": "0",
}  # fmt: skip
# more ranks than cores are the user's to ask for: as Open MPI 4 calls it, and as 5 does
OVERSUBSCRIBED = {"OMPI_MCA_rmaps_base_oversubscribe": "1", "PRTE_MCA_rmaps_default_mapping_policy": ":oversubscribe"}
PROGRAM = "msmpetsc.cli.main"
COLD = [sys.executable, "-m", "msmpetsc"]  # a command that starts it begins with this
SERVER = multiprocessing.get_context("forkserver")
SERVER.set_forkserver_preload(
    [
        "msmpetsc.study.preloaded", PROGRAM, "msmpetsc.cli.commands.run", "msmpetsc.app.resume", "msmpetsc.build",
        "msmpetsc.geometry.readers",
    ]
)  # fmt: skip  # all but PETSc


@dataclass(frozen=True)
class Ended:
    """The end of a process."""

    status: int | None  # exit status, None where time ran out
    reason: str  # the last line of trouble, "" if status is 0

    @property
    def word(self) -> str:
        """Whether it ended well: ok, failed or timeout."""
        if not self.reason:
            return "ok"
        return "timeout" if self.status is None else "failed"


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


class Processes:
    """The running processes; once ``stopped``, no new one is started."""

    def __init__(self) -> None:
        self._running: set[subprocess.Popen[bytes] | Forked] = set()
        self.stopped = False
        self._lock = Lock()

    def run(self, command: Sequence[str], log: Path, timeout: float, warm: bool = False) -> Ended:
        """Run to the end, or for ``timeout`` seconds; ``log`` gets what it says.

        warm : spare it the start of the program, if it is one
        """
        process = self._start(command, log, warm and list(command[:3]) == COLD)
        if process is None:
            return Ended(None, "stopped")
        status: int | None = None
        try:
            status = process.wait(timeout)
            reason = "" if status == 0 else last_error(log.read_text(errors="replace")) or f"exit status {status}"
        except subprocess.TimeoutExpired:
            reason = too_long(timeout)
        finally:
            end(process)  # what it may have left running, too
            with self._lock:
                self._running.discard(process)
        return Ended(status, reason)

    def close(self) -> None:
        """End all running processes."""
        with self._lock:
            self.stopped, running = True, list(self._running)
        for process in running:
            end(process)

    def _start(self, command: Sequence[str], log: Path, warm: bool) -> subprocess.Popen[bytes] | Forked | None:
        variables = environment(alone=command[0] != "mpiexec")
        with self._lock, open(log, "w") as out:
            if self.stopped:
                return None
            process: subprocess.Popen[bytes] | Forked
            if warm:
                process = Forked(command[3:], log, variables)
            else:
                process = subprocess.Popen(
                    command, stdin=subprocess.DEVNULL, stdout=out, stderr=out, start_new_session=True, env=variables
                )
            self._running.add(process)
            return process


def environment(alone: bool = False) -> dict[str, str]:
    """Return the environment for a child, without the variables of the MPI of this process."""
    ours = {name: value for name, value in os.environ.items() if not name.startswith(VARIABLES_OF_MPI)}
    # one thread a rank, or ranks and threads would fight for the cores
    return {"OMP_NUM_THREADS": "1"} | OVERSUBSCRIBED | (ALONE if alone else {}) | ours


def too_long(timeout: float) -> str:
    return f"took longer than {timeout:g} s"


def last_error(log: str) -> str:
    """Return the last line of a log that is an error, or else the last line."""
    lines = [line.strip() for line in log.splitlines() if line.strip()]
    errors = [line for line in lines if "msmpetsc: error:" in line]
    return (errors or lines or [""])[-1].removeprefix("msmpetsc: error: ")[:500]


def end(process: subprocess.Popen[bytes] | Forked) -> None:
    """End a process and all of its session: mpiexec gives each rank a process group of its own."""
    if process.poll() is None:
        with suppress(ProcessLookupError):
            os.kill(process.pid, signal.SIGTERM)  # mpiexec tells its ranks
        with suppress(subprocess.TimeoutExpired):
            process.wait(GRACE)
    for pid in session(process.pid):
        with suppress(ProcessLookupError, PermissionError):
            os.kill(pid, signal.SIGKILL)
    process.kill()
    process.wait()


def session(leader: int) -> list[int]:
    members = []
    for pid in psutil.pids():
        with suppress(OSError):
            if os.getsid(pid) == leader:
                members.append(pid)
    return members
