"""Measurements beside a run's frames: true errors, the iterates of one step, where the time went."""

from dataclasses import dataclass, field
from time import perf_counter

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Floats, Positions, Rows
from msmpetsc.comm import log
from msmpetsc.errors import StepFailed
from msmpetsc.solve.nonlinear.functional import StepProblem
from msmpetsc.solve.nonlinear.step import Stepper, StepResult
from msmpetsc.solve.petsc.events import CYCLE, FINE, GRIDS, HIERARCHY, LOCAL, REFERENCE, begun, seconds
from msmpetsc.solve.presets import find_preset

REFERENCE_PRESET, REFERENCE_ERROR = "newton-multigrid", 1e-10
REFERENCE_PREFIX = "reference_"  # of its PETSc options
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


class TrueErrors:
    """True errors of a run's steps, and what the iterates of one had.

    trace : of the step that was followed, once it was taken
    """

    def __init__(self) -> None:
        self.reference: Reference | None = None
        self.followed: Trace | None = None
        self.trace: dict | None = None

    def follow(self, stepper: Stepper) -> None:
        """Trace the iterates of the step that comes next."""
        self.followed = Trace()
        self.followed.follow(stepper)

    def of(self, index: int, stepper: Stepper, result: StepResult) -> Floats:
        """Position and energy error (2,) of step ``index``, which a stepper took last (collective)."""
        if self.reference is None or self.reference.of is not stepper:  # an anchor let go
            self.destroy()
            self.reference = Reference(stepper)
        followed, self.followed, stepper.observer = self.followed, None, None
        assert result.problem is not None, "no step was taken"
        positions = [*(followed.positions if followed else []), result.position]
        errors = self.reference.errors(result.problem, positions)
        if followed:
            lists = {"iteration": followed.iteration, "ksp_its": followed.ksp_its, "seconds": followed.seconds}
            of_positions, of_energies = errors[:-1].T.tolist()
            self.trace = {"frame": index, **lists, "position_error": of_positions, "energy_error": of_energies}
        return errors[-1]

    def destroy(self) -> None:
        """Collective."""
        if self.reference:
            self.reference.destroy()


class Reference:
    """Steps of a stepper solved to rounding, which true errors are measured against; not timed with the run."""

    def __init__(self, of: Stepper):
        self.of = of
        with begun(REFERENCE):
            self.stepper = Stepper(
                of.comm,
                of.lattice,
                of.time_step,
                find_preset(REFERENCE_PRESET),
                REFERENCE_ERROR,
                touches=of.touches,
                prefix=REFERENCE_PREFIX,
                static=of.static,
            )
            self.stepper.set_up()

    def errors(self, problem: StepProblem, positions: list[Positions]) -> Rows:
        """(k, 2) of positions (l, 3) [m] that came near the step's solution x* (collective), NaN where x* is not found.

        Relative position error |x - x*|_M / |y - x*|_M and energy error (g(x) - g*) / (g(y) - g*).
        """
        try:
            with begun(REFERENCE):
                return self._errors(problem, positions)
        except StepFailed as failure:
            log.warning("the true error of a step is not known: its reference %s", failure)
            return np.full((len(positions), 2), np.nan)

    def _errors(self, problem: StepProblem, positions: list[Positions]) -> Rows:
        self.stepper.forget()  # what is measured does not depend on what was measured before
        exact = self.stepper.step(problem, positions[-1]).position
        start = self._distances(problem.y, exact)
        distances = np.array([self._distances(x, exact) for x in positions])
        errors = np.divide(distances, start, out=np.zeros_like(distances), where=start > 0)
        errors[:, 0] = [self.stepper.control.rounding.added_to(error, start[0]) for error in errors[:, 0]]
        return errors

    def _distances(self, x: Positions, exact: Positions) -> Floats:
        """|x - x*|_M and g(x) - g*."""
        stepper = self.stepper
        stepper.unknowns.from_nodes(x - exact, stepper.x)
        distance = stepper.functional.norm(stepper.x)
        stepper.unknowns.from_nodes(x, stepper.x)
        q = stepper.functional.positions(stepper.x)
        return np.array([distance, stepper.functional.change(q, exact)[0]])

    def destroy(self) -> None:
        """Collective."""
        self.stepper.destroy()


def times(comm: MPI.Comm) -> dict[str, float]:
    """Seconds in events of the run, those of its references left out, the greatest of all ranks (collective)."""
    return {name: comm.allreduce(sum(map(seconds, events)), MPI.MAX) for name, events in EVENTS.items()}
