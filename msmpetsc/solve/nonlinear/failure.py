"""Messages of steps that could not be solved, one line each: the reason, the residual, where it is worst, what to
try."""

import numpy as np
from petsc4py import PETSc

from msmpetsc.elasticity.locate import describe_inverted, node_of_greatest
from msmpetsc.errors import StepFailed
from msmpetsc.solve.nonlinear.error_control import Outcome
from msmpetsc.solve.nonlinear.functional import Iterate, StepFunctional

NOT_FINITE = -4  # DIVERGED_FNORM_NAN; PETSc 3.25 has another name for it
KINDS = {
    PETSc.SNES.ConvergedReason.DIVERGED_LINE_SEARCH: "line search",
    PETSc.SNES.ConvergedReason.DIVERGED_LINEAR_SOLVE: "linear solve",
    NOT_FINITE: "not finite",
    -14: "not finite",  # from PETSc 3.25 on: DIVERGED_OBJECTIVE_NANORINF
}
REASON = {value: name for name, value in vars(PETSc.SNES.ConvergedReason).items() if isinstance(value, int)}
KSP_REASON = {value: name for name, value in vars(PETSc.KSP.ConvergedReason).items() if isinstance(value, int)}


def not_converged(
    snes: PETSc.SNES, ksp: PETSc.KSP, now: Outcome, iterations: int, worst: str, true_hessian: bool
) -> StepFailed:
    """SNES gave up after ``iterations``.

    worst        : words of where_worst
    true_hessian : newton's presets, which another one would not help
    """
    reason, kind = REASON.get(snes.reason, str(snes.reason)), KINDS.get(snes.reason, "iterations")
    preset = "" if true_hessian else "another preset (newton), "
    advice = f'a smaller time.step, {preset}a looser solver.error, or safety.on_failure = "substep"'
    if kind == "linear solve":
        reason += f" (KSP {KSP_REASON.get(ksp.reason, str(ksp.reason))} after {ksp.its} its)"
        advice = "a looser -ksp_rtol, a larger -ksp_max_it, or another -pc_type"
    return StepFailed(
        f"did not converge: {reason} after {iterations} iterations, residual |F| = {now.residual:.2e}, "
        f"relative error {now.error:.2e}{worst}; try {advice}",
        kind,
    )


def no_minimum(now: Outcome, worst: str) -> StepFailed:
    """All that the step came to was no minimum, or farther from one than it seemed."""
    seen = "a saddle or a fold" if np.isinf(now.error) else "a point farther from its solution than it seemed"
    return StepFailed(
        f"did not come to a minimum: it came to {seen} {now.doubts} times, residual |F| = {now.residual:.2e}{worst}; "
        "try a smaller time.step, or another preset (newton)",
        "no minimum",
    )


def where_worst(functional: StepFunctional, iterate: Iterate) -> str:
    """Words on where F pulls farthest, and on what is inside out (collective)."""
    comm, lattice = functional.comm, functional.lattice
    node = node_of_greatest(comm, lattice, *functional.pull(iterate.f))
    return f", worst at {node}{describe_inverted(comm, lattice, iterate.q)}"
