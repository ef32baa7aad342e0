"""Work that steps took: what a clock would measure, where clocks do not agree."""

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class Work:
    """Work of one step or of several, which adds up; of their errors the greatest counts."""

    step_error: float = 0.0  # estimated, relative
    iterations: int = 0  # of SNES; substeps of an explicit integrator
    ksp_its: int = 0  # KSP iterations of all of them, and of what examines their results
    products: int = 0  # with the Hessian, those at multigrid's finest level included
    proof_products: int = (
        0  # of these, for estimates of errors and in searches for a negative curvature
    )
    steps: int = 0  # that stand
    substeps: int = 0  # shorter steps taken in place of one that failed
    fallbacks: int = 0  # steps solved by the robust method
    wall_time: float = 0.0  # [s]
    true_error: float = np.nan  # measured against steps solved to rounding; NaN where none was
    energy_error: float = np.nan  # the same of the energy

    def __add__(self, other: "Work") -> "Work":
        sums = {name: vars(self)[name] + vars(other)[name] for name in COUNTED}
        errors = {name: np.fmax(vars(self)[name], vars(other)[name]) for name in ERRORS}
        return Work(**sums, **errors)

    def __sub__(self, before: "Work") -> "Work":
        """Return the work since ``before``; errors are those of now."""
        return replace(self, **{name: vars(self)[name] - vars(before)[name] for name in COUNTED})


ERRORS = ("step_error", "true_error", "energy_error")
COUNTED = [name for name in vars(Work()) if name not in ERRORS]  # what adds up
