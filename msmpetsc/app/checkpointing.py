"""When a run writes a checkpoint, and when a signal stops it."""

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from time import perf_counter
from types import FrameType
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

from msmpetsc.comm import Stop
from msmpetsc.errors import StepStopped
from msmpetsc.fields import Frame
from msmpetsc.results.writer import ResultFile

if TYPE_CHECKING:  # PETSc must first be given its options
    from msmpetsc.solve.simulate import TimeLoop

STATUS: dict[int, int] = {signal.SIGUSR1: 0, signal.SIGTERM: 143, signal.SIGINT: 130}
CHECKPOINT_TIME = 0.01  # part of the time that checkpoints may take


class Checkpoints:
    """Write a checkpoint when it is due, at the first and the last step, and when a signal asks the run to stop.

    every  : number of frames after which one is due; None: as takes 1% of the time
    signal : the one that ended the run before its last step; 0 for none
    """

    def __init__(self, comm: MPI.Comm, file: ResultFile, simulation: "TimeLoop", every: int | None):
        self.comm, self.file, self.simulation, self.every = comm, file, simulation, every
        self.signal = 0
        self._written = -1  # step of the last checkpoint
        self._frames = 0
        self._seconds = 0.0  # until the next one
        self._ended = perf_counter()

    def steps(self) -> Iterator[Frame | None]:
        """Yield the frames of the steps, and None after those that give none, until a signal ends one (collective)."""
        try:
            yield from self.simulation.advance()
        except StepStopped:
            self.after_step(is_stored=False)

    def after_step(self, is_stored: bool) -> bool:
        """Write a checkpoint if one is due; return whether the run is to stop (collective).

        is_stored : whether the step gave a frame
        """
        simulation = self.simulation
        self._frames += is_stored
        due = perf_counter() - self._ended >= self._seconds
        if self.every is not None:
            due = self._frames >= self.every
        due = self.comm.bcast(due) or simulation.step in (0, simulation.steps)
        number = Stop.agreed(self.comm)
        if due or number:
            began = perf_counter()
            saved = simulation.saved
            if saved.step != self._written:
                self.file.write_checkpoint(saved)
                self._written = saved.step
            self._frames, self._ended = 0, perf_counter()
            self._seconds = (self._ended - began) / CHECKPOINT_TIME
        if simulation.step < simulation.steps:  # after the last step there is nothing to stop
            self.signal = number
        return number != 0


class Signals:
    """Note SIGUSR1, SIGTERM and SIGINT, which ask a run to stop after the iteration or the explicit step under way.

    A second SIGINT ends it at once.

    Used as a context, after PETSc has set its own handlers. Python lets the main thread alone have
    handlers: a run in another thread hears no signals.
    """

    def __init__(self, comm: MPI.Comm):
        self.comm = comm
        self._abandon: Callable[[], None] | None = None  # once steps are taken
        self._before: dict[int, Any] = {}

    def __enter__(self) -> "Signals":
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.signal(number, self._note) for number in STATUS}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        Stop.signal = 0

    def begin(self, abandon: Callable[[], None]) -> None:
        """Keep the run's result from now on at a SIGINT; a second SIGINT calls ``abandon`` and ends the run."""
        self._abandon = abandon

    def _note(self, number: int, _: FrameType | None) -> None:
        if number == signal.SIGINT and self._abandon is None:
            raise KeyboardInterrupt
        if number == Stop.signal == signal.SIGINT and self._abandon:
            self._abandon()
            sys.stderr.write("msmpetsc: stopped at once\n")
            sys.stderr.flush()
            if self.comm.size > 1:
                self.comm.Abort(STATUS[number])
            os._exit(STATUS[number])  # the file is left as by a kill, which it is made for
        Stop.signal = max(Stop.signal, number) if number != signal.SIGINT else number
