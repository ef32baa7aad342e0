"""Write the checkpoints of a run, and its XDMF file, when they are due (results.writer)."""

from collections.abc import Iterator
from time import perf_counter
from typing import TYPE_CHECKING

from mpi4py import MPI

from msmpetsc.comm import Stop, on_root
from msmpetsc.errors import StepStopped
from msmpetsc.fields import Frame
from msmpetsc.results.writer import ResultFile
from msmpetsc.results.xdmf import write_xdmf

# for type checkers only: PETSc must get its options before it is imported
if TYPE_CHECKING:
    from msmpetsc.solve.simulate import TimeLoop

# fraction of the run time that checkpoints and XDMF may take [-]; hardly noticed
CHECKPOINT_TIME = 0.01


class Checkpoints:
    """Writer of checkpoints: at the first and last step, when due, and at a signal.

    The XDMF file is written with a checkpoint if this takes at most CHECKPOINT_TIME of the run.

    every  : frames between checkpoints; None for an interval that takes CHECKPOINT_TIME
    signal : number of the signal that ended the run before its last step; 0 if there was none
    """

    def __init__(self, comm: MPI.Comm, file: ResultFile, simulation: "TimeLoop", every: int | None):
        self.comm = comm
        self.file = file
        self.simulation = simulation
        self.every = every
        self.signal = 0
        # step of the last checkpoint, frames since it, and the time from which another
        # write takes no more than CHECKPOINT_TIME of the run [s]
        self._written = -1
        self._frames = 0
        self._due = 0.0

    def steps(self) -> Iterator[Frame | None]:
        """Yield the frame or None after each step, until a signal ends a step (collective)."""
        try:
            yield from self.simulation.advance()
        except StepStopped:
            self.after_step(is_stored=False)

    def after_step(self, is_stored: bool) -> bool:
        """Write a checkpoint if it is due; return whether the run must stop (collective).

        is_stored : whether the step gave a frame
        """
        simulation = self.simulation
        self._frames += is_stored
        due: bool = self.comm.bcast(perf_counter() >= self._due)
        with_xdmf = due
        if self.every is not None:
            due = self._frames >= self.every
        due = due or simulation.step in (0, simulation.steps)
        number = Stop.agreed(self.comm)
        if due or number:
            began = perf_counter()
            saved = simulation.saved
            if saved.step != self._written:
                self.file.write_checkpoint(saved)
                self._written = saved.step
            if simulation.step == simulation.steps != saved.step:
                self.file.write_checkpoint(simulation.end)
            self._frames = 0
            # the XDMF file is written whole, so its time grows with the frames
            if with_xdmf:
                on_root(self.comm, lambda: write_xdmf(self.file.path))
                ended = perf_counter()
                self._due = ended + (ended - began) / CHECKPOINT_TIME
        # a signal after the last step stops nothing
        if simulation.step < simulation.steps:
            self.signal = number
        return number != 0
