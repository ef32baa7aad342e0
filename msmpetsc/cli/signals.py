"""What the outside asks of a run: to stop, by signals; and when a checkpoint is due. All ranks agree on it."""

import os
import re
import signal
import sys
from time import perf_counter
from types import FrameType

from mpi4py import MPI

from msmpetsc.errors import InputError

STATUS = {signal.SIGUSR1: 0, signal.SIGTERM: 143, signal.SIGINT: 130}
SHARE = 0.01  # of the time, that checkpoints may take
SECONDS = {"s": 1, "min": 60, "h": 3600}


class Interval:
    """Of checkpoints: so many frames, so many seconds, or as often as they take 1% of the time at the most."""

    def __init__(self, text: str | None):
        """text: "3", "5min", or None. Raises InputError."""
        found = re.fullmatch(r"(\d{1,18})(s|min|h)?", text or "0s", re.ASCII)
        if not found or (text and not int(found[1])):
            raise InputError(f"--checkpoint-every takes a number of frames, or 30s, 5min, 2h; not {text}")
        self.frames = None if found[2] else int(found[1])
        self.seconds = 0.0 if found[2] is None else float(found[1]) * SECONDS[found[2]]
        self.adapts = text is None
        self._frames, self._ended = 0, perf_counter()

    def due(self, stored: bool) -> bool:
        """After a step, and maybe a frame ``stored``."""
        self._frames += stored
        if self.frames is not None:
            return self._frames >= self.frames
        return perf_counter() - self._ended >= self.seconds

    def done(self, began: float) -> None:
        """A checkpoint is written, begun at that count of perf_counter."""
        self._frames, self._ended = 0, perf_counter()
        if self.adapts:
            self.seconds = (self._ended - began) / SHARE


class Signals:
    """SIGUSR1, SIGTERM and SIGINT ask a run to stop after its step; a second SIGINT ends it at once.

    To be used as a context, after PETSc has set its own handlers.
    """

    def __init__(self, comm: MPI.Comm):
        self.comm, self._asked, self._stepping = comm, 0, False

    def __enter__(self) -> "Signals":
        self._before = {number: signal.signal(number, self._note) for number in STATUS}
        return self

    def __exit__(self, *_) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def begin(self) -> None:
        """Steps are taken from here on: before, there is nothing that a SIGINT could keep."""
        self._stepping = True

    def agree(self, due: bool) -> tuple[bool, int]:
        """Whether any rank finds a checkpoint due, and the signal that any has got, or 0 (collective)."""
        mine = 2 * self._asked + due
        most = self.comm.allreduce(mine, MPI.MAX) if self.comm.size > 1 else mine
        return bool(most), most // 2

    def _note(self, number: int, _: FrameType | None) -> None:
        if number == signal.SIGINT and not self._stepping:
            raise KeyboardInterrupt
        if number == self._asked == signal.SIGINT:
            sys.stderr.write("msmpetsc: stopped at once\n")
            sys.stderr.flush()
            if self.comm.size > 1:
                self.comm.Abort(STATUS[number])
            os._exit(STATUS[number])  # the file is left as by a kill, which it is made for
        self._asked = max(self._asked, number) if number != signal.SIGINT else number
