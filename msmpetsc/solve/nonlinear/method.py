"""Base class of the methods that minimise g in a step."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from petsc4py import PETSc

from msmpetsc.comm import Stop
from msmpetsc.errors import StepStopped
from msmpetsc.solve.nonlinear.error_control import (
    NOT_FINITE,
    ErrorControl,
    Outcome,
    not_converged,
    where_worst,
)
from msmpetsc.solve.nonlinear.functional import Iterate, StepFunctional
from msmpetsc.solve.nonlinear.jacobian import Jacobian
from msmpetsc.solve.presets import MOST_ITERATIONS, Preset, SolverOptions
from msmpetsc.solve.work import Work

REASON = PETSc.SNES.ConvergedReason


@dataclass(eq=False)
class StepMethod(ABC):
    """Method that minimises g to the goal of an outcome. All methods are collective.

    snes, ksp : solvers with the user's options
    budget    : number of iterations after which the method ends; 0 for no budget
    spent     : returns the work of the step in progress so far
    """

    functional: StepFunctional
    jacobian: Jacobian
    snes: PETSc.SNES
    ksp: PETSc.KSP
    control: ErrorControl
    preset: Preset
    options: SolverOptions
    budget: int
    spent: Callable[[], Work]

    def __post_init__(self) -> None:
        # Iterations of all steps so far
        self.iterations = 0

    @abstractmethod
    def minimise(self, start: Iterate, outcome: Outcome) -> tuple[Iterate, Outcome]:
        """Return an iterate that meets the goal of ``outcome``, and the iterate's outcome.

        Raises StepFailed, StepStopped and InputError.
        """

    def reason_to_end(self, its: int, outcome: Outcome) -> int:
        """Return PETSc's reason to end after ``its`` iterations; 0 to go on."""
        if not np.isfinite(outcome.residual):
            return NOT_FINITE
        if outcome.at_rounding:
            return int(REASON.CONVERGED_FNORM_ABS)
        if outcome.is_converged:
            return int(
                REASON.CONVERGED_SNORM_RELATIVE
                if outcome.corrected
                else REASON.CONVERGED_FNORM_RELATIVE
            )
        if self.budget and its >= self.budget:
            return int(REASON.CONVERGED_ITS)
        if Stop.agreed(self.functional.comm):
            return int(REASON.DIVERGED_INNER)
        spent = self.spent()
        if spent.ksp_its + spent.iterations + its > MOST_ITERATIONS:
            return int(REASON.DIVERGED_MAX_IT)
        return int(REASON.ITERATING)

    def adapt(self, outcome: Outcome) -> None:
        """Set the tolerance of the next linear solve, unless the user has fixed it."""
        if self.preset.iterations is None and self.options.is_default("ksp_rtol"):
            self.ksp.setTolerances(rtol=self.control.tolerance(outcome))

    def finish(self, iterate: Iterate, outcome: Outcome) -> Outcome:
        """Return the final outcome, with an estimated error if SNES converged without an estimate.

        If SNES did not converge, raises StepStopped after a signal, and StepFailed otherwise.
        """
        reason = self.snes.reason
        if reason > 0 and not (outcome.corrected or outcome.error <= outcome.goal):
            goal = 0.0 if reason == REASON.CONVERGED_ITS else outcome.goal
            return self.control.estimated(iterate, outcome, goal)
        if reason < 0:
            if Stop.agreed(self.functional.comm):
                raise StepStopped("stopped by a signal")
            worst = where_worst(self.functional, iterate)
            raise not_converged(
                self.snes, self.ksp, outcome, self.snes.its, worst, self.preset.true_hessian
            )
        return outcome
