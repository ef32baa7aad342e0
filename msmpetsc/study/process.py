"""Processes with all their children: run to the end or to a time limit, with the last error of their log."""

import os
import signal
import subprocess
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Lock

import psutil

from msmpetsc.app.ranks import environment, last_error
from msmpetsc.study.forkserver import COLD, Forked

GRACE = 3.0  # [s] between the request to end and the end


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


class Processes:
    """The running processes; once ``stopped``, no new one is started."""

    def __init__(self) -> None:
        self._running: set[subprocess.Popen[bytes] | Forked] = set()
        self._idle: list[Forked] = []  # that wait for another command
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
            reason = (
                ""
                if status == 0
                else last_error(log.read_text(errors="replace")) or f"exit status {status}"
            )
        except subprocess.TimeoutExpired:
            reason = too_long(timeout)
        finally:
            self._put_away(process, status)
        return Ended(status, reason)

    def close(self) -> None:
        """End all running processes."""
        with self._lock:
            self.stopped, running, idle = True, list(self._running), self._idle
            self._idle = []
        for process in running:
            end(process)
        for process in idle:
            process.close()

    def _start(
        self, command: Sequence[str], log: Path, warm: bool
    ) -> subprocess.Popen[bytes] | Forked | None:
        variables = environment(alone=command[0] != "mpiexec")
        with self._lock, open(log, "w") as out:
            if self.stopped:
                return None
            process: subprocess.Popen[bytes] | Forked
            if warm:
                process = self._idle.pop() if self._idle else Forked(variables)
                process.begin(command[3:], log)
            else:
                process = subprocess.Popen(
                    command,
                    stdin=subprocess.DEVNULL,
                    stdout=out,
                    stderr=out,
                    start_new_session=True,
                    env=variables,
                )
            self._running.add(process)
            return process

    def _put_away(self, process: subprocess.Popen[bytes] | Forked, status: int | None) -> None:
        """Keep a process whose command went well for another one; end any other, with what it may have left running."""
        serves = (
            isinstance(process, Forked)
            and status == 0
            and process.poll() is None
            and not self.stopped
        )
        if not serves:
            end(process)
        with self._lock:
            self._running.discard(process)
            if isinstance(process, Forked) and serves:
                self._idle.append(process)


def too_long(timeout: float) -> str:
    return f"took longer than {timeout:g} s"


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
