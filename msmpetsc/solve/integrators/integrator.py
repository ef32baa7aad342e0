"""What all integrators are: takers of the steps of one model."""

from typing import Protocol

import numpy as np

from msmpetsc.backend.arrays import Floats
from msmpetsc.checkpoint import Checkpoint
from msmpetsc.solve.integrators.state import State
from msmpetsc.solve.nonlinear.step import StepResult


class Integrator(Protocol):
    """Takes steps of one length. All methods are collective.

    looks_back : it has a use for State.history
    """

    looks_back: bool = False

    @property
    def unknowns(self) -> int:
        """Number of free nodes of this rank."""

    def set_up(self) -> None:
        """Make ready for the first step. Raises InputError for options that cannot be."""
        return

    def advance(self, state: State, time: float) -> tuple[StepResult, State]:
        """Take the step that ends at ``time`` [s]: its result, and what the next one starts from. Raises StepFailed."""

    def follow(self) -> None:
        """Trace the iterates of the step that comes next, if it has any."""
        return

    def true_errors(self, index: int, result: StepResult) -> tuple[Floats, dict | None]:
        """Position and energy error (2,) of step ``index``, taken last, and its trace if it was followed.

        NaN where no single step was solved.
        """
        return np.full(2, np.nan), None

    def save(self, checkpoint: Checkpoint) -> None:
        """Store what the next step depends on beside its state, and forget all else."""

    def restore(self, checkpoint: Checkpoint, time: float) -> None:
        """Go on after a step that ended at ``time`` [s]."""

    def forget(self) -> None:
        """Forget what earlier steps showed, so that the next step does not depend on it."""

    def refuse_unused_options(self, at_end: bool = False, awaited: tuple[str, ...] = ()) -> None:
        """Raise InputError for PETSc options of the user that nothing has used.

        awaited : prefixes of solvers that may still be made
        """

    def destroy(self) -> None:
        """Destroy all PETSc objects."""
