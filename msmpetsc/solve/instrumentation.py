"""Measurements of a run beside its frames: true errors, the iterates of one step, where the time went."""

from dataclasses import dataclass, field
from time import perf_counter

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.solve.multigrid.memory import stored_bytes
from msmpetsc.solve.nonlinear.step import Stepper
from msmpetsc.solve.petsc.events import GRIDS, HIERARCHY, LOCAL, count, seconds

EVENTS = {
    "factor": ["PCSetUp"], "local": [LOCAL.name], "ksp": ["KSPSolve"], "hierarchy": [GRIDS.name, HIERARCHY.name]
}  # fmt: skip


@dataclass(frozen=True)
class Probes:
    """Probes of a run's steps.

    true_error : every so many steps the true error is measured; None for never
    trace      : the step whose iterates are followed; None for none
    """

    true_error: int | None = None
    trace: int | None = None

    def asks(self, index: int) -> bool:
        """Whether the true error of a step is to be measured."""
        return index == self.trace or (self.true_error is not None and index % self.true_error == 0)


@dataclass
class Trace:
    """Iterates of a step: at each its number, the KSP iterations and seconds so far, positions (l, 3) [m]."""

    iteration: list[int] = field(default_factory=list)
    ksp_its: list[int] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    positions: list[np.ndarray] = field(default_factory=list)

    def follow(self, stepper: Stepper) -> None:
        """Take the iterates from now on, which is when the step begins."""
        begin, before = perf_counter(), stepper.work_so_far()

        def observe(q: np.ndarray) -> None:
            nonlocal begin
            now = perf_counter()
            self.iteration.append(len(self.iteration))
            self.ksp_its.append((stepper.work_so_far() - before).ksp_its)
            self.seconds.append(now - begin)
            self.positions.append(q)
            begin += perf_counter() - now  # not of the step

        stepper.observer = observe

    def as_lists(self, index: int, errors: np.ndarray) -> dict:
        """The trace as plain lists, with the errors (k, 2) of the iterates."""
        lists = {"iteration": self.iteration, "ksp_its": self.ksp_its, "seconds": self.seconds}
        return {"frame": index, **lists, "position_error": errors[:, 0].tolist(), "energy_error": errors[:, 1].tolist()}


def begin_timing() -> None:
    """Have PETSc time its events from here on."""
    PETSc.Log.begin()


def times(comm: MPI.Comm) -> dict[str, float]:
    """Seconds in events of the run, those of its references left out, the greatest of all ranks (collective)."""
    return {name: comm.allreduce(sum(map(seconds, events)), MPI.MAX) for name, events in EVENTS.items()}


def hierarchies(comm: MPI.Comm, stepper: Stepper | None) -> dict[str, int]:
    """How many hierarchies of multigrid were built, and bytes of all ranks that the last one holds (collective)."""
    multigrid = stepper.jacobian.preconditioner.multigrid if stepper else None
    own = stored_bytes(multigrid.multigrid) if multigrid else 0
    return {"builds": count(HIERARCHY.name), "bytes": comm.allreduce(own)}
