"""Measurements beside a run's frames: true errors, the iterates of one step, where the time went."""

from dataclasses import dataclass, field
from time import perf_counter

from mpi4py import MPI

from msmpetsc.backend.arrays import Positions
from msmpetsc.solve.nonlinear.step import Stepper
from msmpetsc.solve.petsc.events import CYCLE, FINE, GRIDS, HIERARCHY, LOCAL, seconds

EVENTS = {
    "factor": ["PCSetUp"], "local": [LOCAL.name], "ksp": ["KSPSolve"], "hierarchy": [GRIDS.name, HIERARCHY.name],
    "cycle": [CYCLE.name], "fine": [FINE.name],
}  # fmt: skip


@dataclass(frozen=True)
class Probes:
    """Probes of a run's steps."""

    true_error: int | None = None  # every so many steps the true error is measured; None for never
    trace: int | None = None  # the step whose iterates are followed; None for none

    def asks(self, index: int) -> bool:
        """Whether the true error of a step is to be measured."""
        return index == self.trace or (self.true_error is not None and index % self.true_error == 0)


@dataclass
class Trace:
    """Iterates of a step: at each its number, the KSP iterations and seconds so far, positions (l, 3) [m]."""

    iteration: list[int] = field(default_factory=list)
    ksp_its: list[int] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    positions: list[Positions] = field(default_factory=list)

    def follow(self, stepper: Stepper) -> None:
        """Take the iterates from now on, which is when the step begins."""
        begin, before = perf_counter(), stepper.work_so_far()

        def observe(q: Positions) -> None:
            nonlocal begin
            now = perf_counter()
            self.iteration.append(len(self.iteration))
            self.ksp_its.append((stepper.work_so_far() - before).ksp_its)
            self.seconds.append(now - begin)
            self.positions.append(q)
            begin += perf_counter() - now  # not of the step

        stepper.observer = observe


def times(comm: MPI.Comm) -> dict[str, float]:
    """Seconds in events of the run, those of its references left out, the greatest of all ranks (collective)."""
    return {name: comm.allreduce(sum(map(seconds, events)), MPI.MAX) for name, events in EVENTS.items()}
