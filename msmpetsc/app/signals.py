"""Signals that stop a run."""

import os
import signal
import sys
import threading
from collections.abc import Callable
from types import FrameType
from typing import Any

from mpi4py import MPI

from msmpetsc.comm import Stop

# exit status of a run that a signal stopped
STATUS: dict[int, int] = {signal.SIGUSR1: 0, signal.SIGTERM: 143, signal.SIGINT: 130}


class Signals:
    """Handlers of SIGUSR1, SIGTERM and SIGINT, which stop a run after its current iteration.

    A second SIGINT ends the run at once. Enter the context after PETSc has set its own handlers.
    Only the main thread can have handlers: a run in another thread ignores signals.
    """

    def __init__(self, comm: MPI.Comm):
        self.comm = comm
        # function called before a second SIGINT ends the run; None until the first step
        self._abandon: Callable[[], None] | None = None
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> "Signals":
        if threading.current_thread() is threading.main_thread():
            self._previous = {number: signal.signal(number, self._handle) for number in STATUS}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        Stop.signal = 0

    def begin(self, abandon: Callable[[], None]) -> None:
        """Let a SIGINT stop the run after its current iteration, from now on.

        A second SIGINT calls ``abandon`` and ends the process.
        """
        self._abandon = abandon

    def _handle(self, number: int, _: FrameType | None) -> None:
        """Record the signal; a SIGINT before the first step interrupts, a second SIGINT aborts."""
        if number == signal.SIGINT and self._abandon is None:
            raise KeyboardInterrupt
        if number == Stop.signal == signal.SIGINT and self._abandon:
            self._abandon()
            sys.stderr.write("msmpetsc: stopped at once\n")
            sys.stderr.flush()
            if self.comm.size > 1:
                self.comm.Abort(STATUS[number])
            # the file stays readable, as after a kill
            os._exit(STATUS[number])
        Stop.signal = max(Stop.signal, number) if number != signal.SIGINT else number
