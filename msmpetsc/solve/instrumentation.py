"""Measurements of a run: true errors of its steps, and where the time went."""

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Floats, Positions
from msmpetsc.comm import log
from msmpetsc.errors import StepFailed
from msmpetsc.solve.nonlinear.functional import StepProblem
from msmpetsc.solve.nonlinear.step import Stepper
from msmpetsc.solve.petsc.events import CYCLE, FINE, GRIDS, HIERARCHY, LOCAL, REFERENCE, begun, seconds
from msmpetsc.solve.presets import find_preset

REFERENCE_PRESET, REFERENCE_ERROR = "newton-multigrid", 1e-10
REFERENCE_PREFIX = "reference_"  # of its PETSc options
EVENTS = {
    "factor": ["PCSetUp"], "local": [LOCAL.name], "ksp": ["KSPSolve"], "hierarchy": [GRIDS.name, HIERARCHY.name],
    "cycle": [CYCLE.name], "fine": [FINE.name],
}  # fmt: skip


class TrueErrors:
    """True errors of a run's steps, against steps solved to rounding. What it takes is not timed with the run."""

    def __init__(self) -> None:
        self.stepper: Stepper | None = None  # whose steps the reference takes
        self.reference: Stepper | None = None

    def errors(self, stepper: Stepper, problem: StepProblem, position: Positions) -> Floats:
        """Return the errors (2,) of a solution (l, 3) [m] of a step, NaN if the reference fails (collective).

        Relative position error |x - x*|_M / |y - x*|_M and energy error (g(x) - g*) / (g(y) - g*).
        """
        try:
            with begun(REFERENCE):
                return self._errors(self._reference(stepper), problem, position)
        except StepFailed as failure:
            log.warning("the true error of a step is not known: its reference %s", failure)
            return np.full(2, np.nan)

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

    def _errors(self, reference: Stepper, problem: StepProblem, position: Positions) -> Floats:
        reference.forget()  # what is measured does not depend on what was measured before
        exact = reference.step(problem, position).position
        start, distance = (_distances(reference, x, exact) for x in (problem.y, position))
        errors: Floats = np.divide(distance, start, out=np.zeros(2), where=start > 0)
        errors[0] = reference.control.rounding.added_to(errors[0], start[0])
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


def event_times() -> dict[str, float]:
    """Return the seconds of this rank in events of all runs of the process so far, those of references left out."""
    return {name: sum(map(seconds, events)) for name, events in EVENTS.items()}


def times(comm: MPI.Comm, before: dict[str, float]) -> dict[str, float]:
    """Return the seconds in events since there were so many ``before``, the greatest of all ranks (collective)."""
    return {name: comm.allreduce(now - before[name], MPI.MAX) for name, now in event_times().items()}
