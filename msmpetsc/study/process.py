"""Run child processes with time limits, and end them with all their descendants."""

import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Lock

import psutil

from msmpetsc.app.ranks import environment, last_error

# first words of a command that starts the program
PROGRAM = [sys.executable, "-m", "msmpetsc"]
# time [s] between SIGTERM and SIGKILL
GRACE = 3.0


@dataclass(frozen=True)
class Ended:
    """The end of a process.

    status : exit status; None after a timeout
    reason : why the process failed; "" for status 0
    """

    status: int | None
    reason: str

    @property
    def word(self) -> str:
        """The status column of table.csv: ok, failed or timeout."""
        if not self.reason:
            return "ok"
        return "timeout" if self.status is None else "failed"


class Processes:
    """The running child processes; after ``close`` no process starts."""

    def __init__(self) -> None:
        self._running: set[subprocess.Popen[bytes]] = set()
        self.stopped = False
        self._lock = Lock()

    def run(self, command: Sequence[str], log: Path, timeout: float) -> Ended:
        """Run a command to its end, or for ``timeout`` seconds, with all output in ``log``."""
        process = self._start(command, log)
        if process is None:
            return Ended(None, "stopped")
        status: int | None = None
        reason = ""
        try:
            if status := process.wait(timeout):
                reason = last_error(log.read_text(errors="replace")) or f"exit status {status}"
        except subprocess.TimeoutExpired:
            reason = too_long(timeout)
        finally:
            end(process)
            with self._lock:
                self._running.discard(process)
        return Ended(status, reason)

    def close(self) -> None:
        """End all running processes and start no more."""
        with self._lock:
            self.stopped = True
            running = list(self._running)
        for process in running:
            end(process)

    def _start(self, command: Sequence[str], log: Path) -> subprocess.Popen[bytes] | None:
        variables = environment(alone=command[0] != "mpiexec")
        with self._lock, open(log, "w") as out:
            if self.stopped:
                return None
            process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=out, stderr=out, env=variables,
                start_new_session=True,
            )  # fmt: skip
            self._running.add(process)
            return process


def too_long(timeout: float) -> str:
    """Return the reason of a run that reached its time limit."""
    return f"took longer than {timeout:g} s"


def end(process: subprocess.Popen[bytes]) -> None:
    """End a process and all processes of its session.

    A process group is not enough, because mpiexec gives each rank its own group.
    """
    if process.poll() is None:
        with suppress(ProcessLookupError):
            # mpiexec passes SIGTERM on to its ranks
            os.kill(process.pid, signal.SIGTERM)
        with suppress(subprocess.TimeoutExpired):
            process.wait(GRACE)
    for pid in session(process.pid):
        with suppress(ProcessLookupError, PermissionError):
            os.kill(pid, signal.SIGKILL)
    process.kill()
    process.wait()


def session(leader: int) -> list[int]:
    """Return the ids of the processes in the session of this leader."""
    members = []
    for pid in psutil.pids():
        with suppress(OSError):
            if os.getsid(pid) == leader:
                members.append(pid)
    return members
