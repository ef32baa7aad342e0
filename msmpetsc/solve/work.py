"""Work that steps took: what a clock would measure, where clocks do not agree."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Work:
    """Work of one step or of several; the sum of two is the work of both.

    step_error : the greatest estimated relative error of the steps, which does not add up
    """

    step_error: float = 0.0
    iterations: int = 0  # of SNES; substeps of an explicit integrator
    ksp_its: int = 0  # KSP iterations of all of them, and of what examines their results
    products: int = 0  # with the Hessian, those at multigrid's finest level included
    proof_products: int = 0  # of these, for estimates of errors and in searches for a negative curvature
    steps: int = 0  # that stand
    substeps: int = 0  # shorter steps taken in place of one that failed
    fallbacks: int = 0  # steps solved by the robust method
    wall_time: float = 0.0  # [s]

    def __add__(self, other: "Work") -> "Work":
        error = max(self.step_error, other.step_error)
        return Work(error, *(getattr(self, name) + getattr(other, name) for name in COUNTED))

    def __sub__(self, before: "Work") -> "Work":
        """Return the work since ``before``; the error is that of now."""
        return Work(self.step_error, *(getattr(self, name) - getattr(before, name) for name in COUNTED))


NO_WORK = Work()
COUNTED = [name for name in vars(NO_WORK) if name != "step_error"]  # what adds up
