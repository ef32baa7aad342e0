"""Steps solved to rounding beside a run: what their true errors are measured against."""

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Floats, Positions, Rows
from msmpetsc.comm import log
from msmpetsc.errors import StepFailed
from msmpetsc.lattice.lattice import Lattice
from msmpetsc.solve.nonlinear.functional import StepProblem
from msmpetsc.solve.nonlinear.step import Stepper
from msmpetsc.solve.petsc.events import REFERENCE, begun
from msmpetsc.solve.presets import find_preset

PRESET, ERROR = "newton-multigrid", 1e-10
PREFIX = "reference_"  # of its PETSc options


class Reference:
    """The solver, its options under PREFIX; not timed with the run."""

    def __init__(self, comm: MPI.Comm, lattice: Lattice, time_step: float, touches: bool, static: bool = False):
        with begun(REFERENCE):
            self.stepper = Stepper(
                comm, lattice, time_step, find_preset(PRESET), ERROR, touches=touches, prefix=PREFIX, static=static
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
