"""The observers of a run's steps: frames and checkpoints are written, progress is shown, signals are heard."""

import logging
import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from time import perf_counter
from types import FrameType
from typing import TYPE_CHECKING, Any, Protocol

from mpi4py import MPI

from msmpetsc.comm import log
from msmpetsc.errors import InputError
from msmpetsc.fields import Frame
from msmpetsc.results.progress_bar import Progress
from msmpetsc.results.writer import ResultFile

if TYPE_CHECKING:  # PETSc must first be given its options
    from msmpetsc.solve.simulate import Simulation

STATUS: dict[int, int] = {signal.SIGUSR1: 0, signal.SIGTERM: 143, signal.SIGINT: 130}
CHECKPOINT_TIME = 0.01  # part of the time that checkpoints may take
SECONDS = {"s": 1, "min": 60, "h": 3600}


class Observer(Protocol):
    """What is called after each step."""

    def after_step(self, frame: Frame | None) -> bool:
        """See the frame of the step just taken, if it is stored; return whether the run is to stop (collective)."""
        ...


class FrameWriter:
    """Write each frame that the file does not have yet."""

    def __init__(self, file: ResultFile, frames: int):
        """frames: number of those that the steps taken before gave."""
        self.file, self.frames = file, frames

    def after_step(self, frame: Frame | None) -> bool:
        if frame is not None:
            if self.frames >= self.file.finished:
                self.file.append(frame)
            self.frames += 1
        return False


class Callback:
    """Call a function of the user's with each frame, once that is written."""

    def __init__(self, function: Callable[[Frame], object]):
        self.function = function

    def after_step(self, frame: Frame | None) -> bool:
        if frame is not None:
            self.function(frame)
        return False


class ProgressLine:
    """Show how far the run is, on rank 0, where notes are wanted."""

    def __init__(self, progress: Progress):
        self.progress = progress

    @classmethod
    @contextmanager
    def shown(cls, comm: MPI.Comm, steps: int) -> Iterator["ProgressLine"]:
        """Show it in the block, and end the line after it."""
        progress = Progress(steps, enabled=comm.rank == 0 and log.isEnabledFor(logging.INFO))
        try:
            yield cls(progress)
        finally:
            progress.close()

    def after_step(self, frame: Frame | None) -> bool:
        if frame is not None:
            self.progress.update(frame)
        return False


@dataclass(frozen=True)
class Interval:
    """How often a checkpoint is due: after so many frames, so many seconds, or as takes 1% of the time at the most.

    frames  : None where seconds count
    adapts  : whether the seconds follow from how long a checkpoint takes
    """

    frames: int | None
    seconds: float
    adapts: bool

    @classmethod
    def parsed(cls, given: int | str | None) -> "Interval":
        """Parse 3, "3", "5min", or None. Raises InputError."""
        text = None if given is None else str(given)
        match = re.fullmatch(r"(\d{1,18})(s|min|h)?", text or "0s", re.ASCII)
        if not match or (text and not int(match[1])):
            raise InputError(f"--checkpoint-every takes a number of frames, or 30s, 5min, 2h; not {text}")
        if match[2] is None:
            return cls(int(match[1]), 0.0, False)
        return cls(None, float(match[1]) * SECONDS[match[2]], text is None)


class Checkpoints:
    """Write a checkpoint when it is due, at the first and the last step, and when a signal asks the run to stop.

    signal : the one that ended the run before its last step; 0 for none
    """

    def __init__(self, file: ResultFile, simulation: "Simulation", interval: Interval, signals: "Signals"):
        self.file, self.simulation, self.interval, self.signals = file, simulation, interval, signals
        self.signal, self._written = 0, -1
        self._seconds, self._frames, self._ended = interval.seconds, 0, perf_counter()

    def after_step(self, frame: Frame | None) -> bool:
        simulation = self.simulation
        self._frames += frame is not None
        due = (self.signals.comm.rank == 0 and self._is_due()) or simulation.step in (0, simulation.steps)
        due, number = self.signals.agree(due)
        if due:
            began = perf_counter()
            saved = simulation.saved()
            if saved.step != self._written:
                self.file.write_checkpoint(saved)
                self._written = saved.step
            self._frames, self._ended = 0, perf_counter()
            if self.interval.adapts:
                self._seconds = (self._ended - began) / CHECKPOINT_TIME
        if simulation.step < simulation.steps:  # after the last step there is nothing to stop
            self.signal = number
        return number != 0

    def _is_due(self) -> bool:
        if self.interval.frames is not None:
            return self._frames >= self.interval.frames
        return perf_counter() - self._ended >= self._seconds


class Signals:
    """Note SIGUSR1, SIGTERM and SIGINT, which ask a run to stop after its step; a second SIGINT ends it at once.

    Used as a context, after PETSc has set its own handlers. Python lets the main thread alone have handlers: a run in
    another thread hears no signals.
    """

    def __init__(self, comm: MPI.Comm):
        self.comm, self._asked, self._stepping = comm, 0, False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> "Signals":
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.signal(number, self._note) for number in STATUS}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def begin(self) -> None:
        """Say that steps are taken from now on: before, there is nothing that a SIGINT could keep."""
        self._stepping = True

    def agree(self, due: bool) -> tuple[bool, int]:
        """Return whether any rank has a checkpoint due, and the signal that any has got, or 0 (collective)."""
        own = 2 * self._asked + due
        greatest = self.comm.allreduce(own, MPI.MAX) if self.comm.size > 1 else own
        return bool(greatest), greatest // 2

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
