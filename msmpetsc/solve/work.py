"""Work of steps: counts that do not depend on the machine, wall time and errors."""

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class Work:
    """Work and errors of some steps. A sum adds counts and keeps the largest errors.

    step_error     : estimated relative error of a step
    iterations     : SNES iterations, or substeps of an explicit integrator
    ksp_its        : KSP iterations of the solves and of the error estimates
    products       : products with the Hessian, multigrid's finest level included
    proof_products : the products among them of error estimates and searches for negative curvature
    steps          : accepted steps
    substeps       : shorter steps that replace failed steps
    fallbacks      : steps solved by the robust method
    wall_time      : time of the steps [s]
    true_error     : relative position error against a step solved to rounding, or NaN
    energy_error   : relative energy error against a step solved to rounding, or NaN
    """

    step_error: float = 0.0
    iterations: int = 0
    ksp_its: int = 0
    products: int = 0
    proof_products: int = 0
    steps: int = 0
    substeps: int = 0
    fallbacks: int = 0
    wall_time: float = 0.0
    true_error: float = np.nan
    energy_error: float = np.nan

    def __add__(self, other: "Work") -> "Work":
        sums = {name: vars(self)[name] + vars(other)[name] for name in COUNTED}
        errors = {name: np.fmax(vars(self)[name], vars(other)[name]) for name in ERRORS}
        return Work(**sums, **errors)

    def __sub__(self, before: "Work") -> "Work":
        """Return the work since ``before``, with the present errors."""
        return replace(self, **{name: vars(self)[name] - vars(before)[name] for name in COUNTED})


ERRORS = ("step_error", "true_error", "energy_error")
COUNTED = [name for name in vars(Work()) if name not in ERRORS]
