"""Measurements of a run: true errors, the iterates of one step, where the time went."""

from dataclasses import dataclass
from time import perf_counter
from typing import Any

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


class TrueErrors:
    """True errors of a run's steps, and of the iterates of one, against steps solved to rounding.

    What it takes is not timed with the run.

    trace : of the step that was followed, once it was taken
    """

    def __init__(self) -> None:
        self.stepper: Stepper | None = None  # whose steps the reference takes
        self.reference: Stepper | None = None
        # of a step that is followed: KSP iterations and seconds so far, positions (l, 3) [m]
        self.iterates: list[tuple[int, float, Positions]] = []
        self.trace: dict[str, Any] | None = None

    def follow(self, stepper: Stepper) -> None:
        """Trace the iterates of the step that begins now."""
        begin = perf_counter()
        before = stepper.work_so_far()

        def observe(q: Positions) -> None:
            nonlocal begin
            now = perf_counter()
            self.iterates.append(((stepper.work_so_far() - before).ksp_its, now - begin, q))
            begin += perf_counter() - now  # not of the step

        stepper.observer = observe

    def measure(self, index: int, stepper: Stepper, result: StepResult) -> Floats:
        """Position and energy error (2,) of step ``index``, which a stepper took last (collective)."""
        iterates = self.iterates
        self.iterates = []
        stepper.observer = None
        assert result.problem is not None, "no step was taken"
        errors = self.errors(stepper, result.problem, [*(q for *_, q in iterates), result.position])
        if iterates:
            names = ("ksp_its", "seconds", "position_error", "energy_error")
            rows = [(*of, *error) for (*of, _), error in zip(iterates, errors.tolist(), strict=False)]
            columns = dict(zip(names, map(list, zip(*rows, strict=True)), strict=True))
            self.trace = {"frame": index, "iteration": list(range(len(iterates))), **columns}
        last: Floats = errors[-1]
        return last

    def errors(self, stepper: Stepper, problem: StepProblem, positions: list[Positions]) -> Rows:
        """Return the errors (k, 2) of positions (l, 3) [m], NaN if the reference fails (collective).

        Relative position error |x - x*|_M / |y - x*|_M and energy error (g(x) - g*) / (g(y) - g*).
        """
        try:
            with begun(REFERENCE):
                return self._errors(self._reference(stepper), problem, positions)
        except StepFailed as failure:
            log.warning("the true error of a step is not known: its reference %s", failure)
            return np.full((len(positions), 2), np.nan)

    def _reference(self, stepper: Stepper) -> Stepper:
        if self.reference is None or self.stepper is not stepper:  # an anchor let go
            self.destroy()
            self.stepper = stepper
            self.reference = Stepper(
                stepper.comm,
                stepper.lattice,
                stepper.time_step,
                find_preset(REFERENCE_PRESET),
                REFERENCE_ERROR,
                touches=stepper.touches,
                prefix=REFERENCE_PREFIX,
                static=stepper.static,
            )
            self.reference.set_up()
        return self.reference

    def _errors(self, reference: Stepper, problem: StepProblem, positions: list[Positions]) -> Rows:
        reference.forget()  # what is measured does not depend on what was measured before
        exact = reference.step(problem, positions[-1]).position
        start, *distances = (_distances(reference, x, exact) for x in (problem.y, *positions))
        errors = np.divide(distances, start, out=np.zeros_like(distances), where=start > 0)
        errors[:, 0] = [reference.control.rounding.added_to(error, start[0]) for error in errors[:, 0]]
        return errors

    def destroy(self) -> None:
        """Collective."""
        if self.reference:
            self.reference.destroy()


def _distances(reference: Stepper, x: Positions, exact: Positions) -> Floats:
    """Return |x - x*|_M and g(x) - g*."""
    reference.unknowns.from_nodes(x - exact, reference.x)
    distance = reference.functional.norm(reference.x)
    reference.unknowns.from_nodes(x, reference.x)
    q = reference.functional.positions(reference.x)
    return np.array([distance, reference.functional.change(q, exact)[0]])


def times(comm: MPI.Comm) -> dict[str, float]:
    """Seconds in events of the run, those of its references left out, the greatest of all ranks (collective)."""
    return {name: comm.allreduce(sum(map(seconds, events)), MPI.MAX) for name, events in EVENTS.items()}
