"""What is known of a step that could not be solved, in one line: the reason, the residual, where it is worst, what to try."""

from typing import TYPE_CHECKING

import numpy as np
from petsc4py import PETSc

from msmpetsc.errors import StepFailed
from msmpetsc.model.locate import describe_inverted, node_of_greatest

if TYPE_CHECKING:
    from msmpetsc.solve.nonlinear.step import Stepper

KINDS = {
    PETSc.SNES.ConvergedReason.DIVERGED_LINE_SEARCH: "line search",
    PETSc.SNES.ConvergedReason.DIVERGED_LINEAR_SOLVE: "linear solve",
    -4: "not finite",  # DIVERGED_FNORM_NAN; from PETSc 3.25 on DIVERGED_FUNCTION_NANORINF
    -14: "not finite",  # there too: DIVERGED_OBJECTIVE_NANORINF
}
REASON = {value: name for name, value in vars(PETSc.SNES.ConvergedReason).items() if isinstance(value, int)}
KSP_REASON = {value: name for name, value in vars(PETSc.KSP.ConvergedReason).items() if isinstance(value, int)}


def not_converged(stepper: "Stepper", iterations: int) -> StepFailed:
    """SNES gave up; ``stepper.work`` is F where it did (collective)."""
    snes, ksp = stepper.snes, stepper.ksp
    reason, kind = REASON.get(snes.reason, str(snes.reason)), KINDS.get(snes.reason, "iterations")
    other = "" if stepper.preset.true_hessian else "another preset (newton), "
    advice = f'a smaller time.step, {other}a looser solver.error, or safety.on_failure = "substep"'
    if kind == "linear solve":
        reason += f" (KSP {KSP_REASON.get(ksp.reason, str(ksp.reason))} after {ksp.its} its)"
        advice = "a looser -ksp_rtol, a larger -ksp_max_it, or another -pc_type"
    return StepFailed(
        f"did not converge: {reason} after {iterations} iterations, residual |F| = {stepper.residual:.2e}, "
        f"relative error {stepper.last_error:.2e}{_where_worst(stepper)}; try {advice}",
        kind,
    )


def no_minimum(stepper: "Stepper", error: float) -> StepFailed:
    """All that it came to was none, or farther from one than it seemed; ``stepper.work`` is F at the last (collective)."""
    seen = "a saddle or a fold" if np.isinf(error) else "a point farther from its solution than it seemed"
    return StepFailed(
        f"did not come to a minimum: it came to {seen} {stepper.doubts} times, residual |F| = {stepper.residual:.2e}"
        f"{_where_worst(stepper)}; try a smaller time.step, or another preset (newton)",
        "no minimum",
    )


def _where_worst(stepper: "Stepper") -> str:
    """Where ``stepper.work``, which is F, pulls farthest, and what is inside out (collective)."""
    worst = node_of_greatest(stepper.comm, stepper.lattice, *stepper.functional.pull(stepper.work))
    return f", worst at {worst}{describe_inverted(stepper.comm, stepper.lattice, stepper.functional.q)}"
