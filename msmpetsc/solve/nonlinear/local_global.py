"""Methods with the constant matrix A = M + t^2 L as the Jacobian, by any of PETSc's SNES.

With A, Newton's method is the paper's local/global iteration x <- x - A^(-1) F(x) (Eq. 17). SNES
accelerates it (anderson, ngmres), searches along it, or begins L-BFGS with A.
"""

from dataclasses import dataclass, replace

import numpy as np
from petsc4py import PETSc

from msmpetsc.errors import InputError
from msmpetsc.solve.nonlinear.error_control import Outcome
from msmpetsc.solve.nonlinear.functional import Configuration, Iterate
from msmpetsc.solve.nonlinear.method import StepMethod
from msmpetsc.solve.petsc.events import LOCAL
from msmpetsc.solve.refused_options import BY_ERROR


@dataclass(eq=False)
class LocalGlobal(StepMethod):
    """A SNES with A as its Jacobian. All methods are collective.

    prefix  : prefix of the options
    has_npc : whether a plain iteration preconditions SNES
    base    : configuration to which changes of g are relative
    outcome : outcome of SNES's last iterate
    """

    prefix: str
    has_npc: bool

    def __post_init__(self) -> None:
        super().__post_init__()
        vectors = self.functional.vectors
        self.x, self.f, self.own = vectors.take(), vectors.take(), vectors.take()
        self.base = Configuration(self.functional.problem.q, None)
        self.outcome = Outcome()
        self.snes.setFunction(self._residual, self.f)
        self.snes.setJacobian(self._linearise, self.jacobian.operator)
        self.snes.setObjective(self._objective)
        self.snes.setConvergenceTest(self._converged)
        if self.preset.start_from_b:
            self.ksp.setInitialGuessNonzero(True)

    def begin(self) -> None:
        """Begin a step; this method keeps no data of steps."""

    def minimise(self, start: Iterate, outcome: Outcome) -> tuple[Iterate, Outcome]:
        self.base, self.outcome = start, replace(outcome, residual=np.inf)
        if self.has_npc:
            # The nonlinear preconditioner solves with A before SNES tests the start
            self.outcome = self._judge(start)
            if self.outcome.is_converged:
                return start, self.outcome
            self.adapt(self.outcome)
        if self.snes.getType() == PETSc.SNES.Type.QN:
            # QN keeps the secants of the last solve; setting the type again drops them
            self.snes.setType(PETSc.SNES.Type.KSPONLY)
            self.snes.setType(PETSc.SNES.Type.QN)
            self.snes.setFromOptions()
        start.x.copy(self.x)
        self.snes.solve(None, self.x)
        self.iterations += self.snes.its
        end = self.functional.vectors.take()
        self.snes.getSolution().copy(end)
        iterate = self.functional.iterate(end)
        self.outcome = self.finish(iterate, self.outcome)
        if not (self.outcome.is_converged or self.budget):
            ends = f"-{self.prefix}snes_type {self.snes.getType()} ends by a rule of its own"
            raise InputError(f"{ends}, {self.outcome.error:.2e} off: {BY_ERROR}")
        return iterate, self.outcome

    def _judge(self, iterate: Iterate) -> Outcome:
        """Return the outcome at SNES's next iterate, with an estimated error near the goal."""
        return self.control.estimated_if_near(iterate, self.control.judge(iterate, self.outcome))

    def _residual(self, _: PETSc.SNES, x: PETSc.Vec, f: PETSc.Vec) -> None:
        """Write F(x) to f (SNESFunction)."""
        with LOCAL:
            self.functional.evaluate(x, f)

    def _objective(self, _: PETSc.SNES, x: PETSc.Vec) -> float:
        """Return g(x) - g(base) (SNESObjective).

        If the difference has no digits left, return -1, so that the line search accepts x.
        """
        with LOCAL:
            configuration = self.functional.configuration(self.functional.positions(x))
            change, distance = self.functional.change(configuration, self.base)
        return -1.0 if self.outcome.is_flat and distance > 0 else change

    def _linearise(self, snes: PETSc.SNES, x: PETSc.Vec, _: PETSc.Mat, __: PETSc.Mat) -> None:
        """Linearise contact at x and set the initial guess of the linear solve (SNESJacobian)."""
        with LOCAL:
            self.base = self.functional.configuration(self.functional.positions(x))
            self.jacobian.linearise(self.base, False, None)
        if self.preset.start_from_b:
            # CG solves A z = F for z = x - x_new; x_new = b = A x - F: z = x - A x + F
            z = snes.getSolutionUpdate()
            self.jacobian.operator.mult(x, z)
            z.aypx(-1.0, x)
            z.axpy(1.0, self.f)

    def _converged(self, snes: PETSc.SNES, its: int, _: tuple[float, float, float]) -> int:
        """Return PETSc's reason to end, or 0 to go on (SNESConvergenceTest)."""
        if its > 0 or not self.has_npc:
            x = snes.getSolution()
            # With a nonlinear preconditioner, ``f`` belongs to another x
            configuration = self.functional.configuration(self.functional.positions(x))
            if self.has_npc:
                iterate = self.functional.evaluate(x, self.own, configuration)
            else:
                iterate = Iterate(configuration.q, configuration.contact, x, self.f)
            self.outcome = self._judge(iterate)
        reason = self.reason_to_end(its, self.outcome)
        if not reason:
            self.adapt(self.outcome)
        return reason
