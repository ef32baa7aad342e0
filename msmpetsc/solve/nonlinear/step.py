"""Implicit step: minimise g by a method (solve.presets), then examine the result."""

from contextlib import ExitStack
from dataclasses import dataclass, replace

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.backend.arrays import Positions, Rows
from msmpetsc.comm import reduced
from msmpetsc.constraints.forces import ExternalForces
from msmpetsc.contact.step_contact import StepContactAt
from msmpetsc.elasticity.energy import Elasticity
from msmpetsc.elasticity.solid import NeoHookean
from msmpetsc.errors import InputError
from msmpetsc.lattice.lattice import Lattice
from msmpetsc.scene.schema import DEFAULT_STEP_ERROR
from msmpetsc.solve.linear.unknowns import Unknowns
from msmpetsc.solve.nonlinear.carried_start import CarriedStart
from msmpetsc.solve.nonlinear.curvature import LowestCurvature
from msmpetsc.solve.nonlinear.error_control import (
    ErrorControl,
    Outcome,
    no_minimum,
    where_worst,
)
from msmpetsc.solve.nonlinear.error_estimate import ErrorEstimate
from msmpetsc.solve.nonlinear.first_guess import FirstGuess
from msmpetsc.solve.nonlinear.functional import Iterate, Rounding, StepFunctional, StepProblem
from msmpetsc.solve.nonlinear.jacobian import Jacobian
from msmpetsc.solve.nonlinear.local_global import LocalGlobal
from msmpetsc.solve.nonlinear.newton import SOFTER, Newton
from msmpetsc.solve.nonlinear.optimality import Optimality, Verdict
from msmpetsc.solve.petsc.events import LOCAL
from msmpetsc.solve.petsc.library import petsc_errors, total_iterations
from msmpetsc.solve.presets import Preset, SolverOptions
from msmpetsc.solve.work import Work

# Greatest number of doubts in a step: saddles, and errors larger than estimated
DOUBTS = 100
# Options of SNES that the loop of Newton's method (nonlinear.newton) does not use
OF_SNES = ("snes_type", "snes_linesearch", "snes_ksp_ew", "npc_snes")
# Options of SNES that name this loop and are accepted
LOOP = {"snes_type": "newtonls", "snes_linesearch_type": "bt"}


@dataclass(frozen=True)
class StepResult:
    """Result of a step.

    position     : (l, 3) [m], ghosts included
    previous     : (l, 3) [m], for the velocity (position - previous) / t
    cost         : work of the step
    work         : work of obstacles that struck this rank's nodes [J]
    explicit     : whether the step was taken in explicit substeps; ``work`` then also includes
                   loads and anchors
    swing        : known oscillation of the energy of this rank's nodes over the step
                   (solve.energy_balance) [J]
    static       : whether the result is an equilibrium, not a motion
    time_error   : estimated error of the trajectory so far; NaN without an estimate
    contact      : contact at ``position``; None without contact, or if explicit
    problem      : F = M (x - y) + tau^2 (grad E - f_ext), without M in statics; None if explicit
    energy_tolerance : energy [J]; if g / tau^2 is this close to its minimum, x meets the error
    moved_by_rounding : greatest displacement by rounding, in the norm of M [m sqrt(kg)]
    load         : external forces of the problem; None if explicit or static
    tau          : tau of the problem [s]
    viscous      : gradient of the dissipation potential D (owned, 3) [N]; None without viscosity
    begun_error  : error of the history that a BDF2 step without history computes for itself
                   (solve.integrators.bdf2) [m sqrt(kg)]
    viscous_work : decrease of D from ``problem.fixed_positions`` to ``position``, this rank's part
                   [J]
    """

    position: Positions
    previous: Positions
    cost: Work
    work: float = 0.0
    explicit: bool = False
    swing: float = 0.0
    static: bool = False
    time_error: float = np.nan
    contact: StepContactAt | None = None
    problem: StepProblem | None = None
    load: ExternalForces | None = None
    energy_tolerance: float = 0.0
    moved_by_rounding: float = 0.0
    tau: float = np.inf
    viscous: Rows | None = None
    viscous_work: float = 0.0
    begun_error: float = 0.0


@dataclass(eq=False)
class Stepper:
    """Solver of the steps of one lattice and time step.

    ``destroy`` destroys all PETSc objects that the stepper has created.

    error          : greatest relative error of a step; None for the default, or for the budget
    max_iterations : budget of iterations; None for the preset's budget
    touches        : whether steps may have a ``contact``
    prefix         : prefix of the PETSc options
    static         : whether steps are equilibria; M then only weights errors
    solid          : solid of the lattice's cells, to share its memory; None to make it

    Raises InputError for options that contradict each other, on all ranks.
    """

    comm: MPI.Comm
    lattice: Lattice
    time_step: float
    preset: Preset
    error: float | None = None
    max_iterations: int | None = None
    touches: bool = False
    prefix: str = ""
    static: bool = False
    solid: NeoHookean | None = None

    def __post_init__(self) -> None:
        self.budget = self.max_iterations or 0
        if self.error is None and not self.budget:
            self.budget = self.preset.iterations or 0
        # Work of all steps before the present step
        self.before = Work()
        self.owned = ExitStack()
        self.unknowns = Unknowns(self.comm, self.lattice, self.static)
        self.owned.callback(self.unknowns.destroy)
        elasticity = Elasticity(self.lattice, self.solid)
        of_rank = elasticity.solid.stiffest if elasticity.solid else 0.0
        # Greatest lambda / mu of a cell
        self.stiffest = reduced(self.comm, of_rank, MPI.MAX)
        self.functional = StepFunctional(self.comm, self.unknowns, elasticity, self.time_step)
        self.owned.callback(self.functional.vectors.destroy)
        self.first_guess = FirstGuess(self.functional, self.preset.iterations is None)
        self.options = SolverOptions(self.preset, self.prefix, self.budget)
        try:
            with petsc_errors("PETSc refuses its options"):
                self.jacobian = Jacobian(
                    self.functional, self.preset, self.options, self.touches, self.owned
                )
                self.snes, self.ksp = self._create_solvers()
                self.control, self.optimality = self._create_control()
                self.method = self._create_method()
                self.carried_start = CarriedStart(self.functional, self.jacobian, self.ksp)
        except InputError:
            self.destroy()
            raise

    def _keep(self, owned: PETSc.Object) -> PETSc.Object:
        """Let ``destroy`` destroy an object; return the object."""
        self.owned.callback(owned.destroy)
        return owned

    def _create_solvers(self) -> tuple[PETSc.SNES, PETSc.KSP]:
        """Return a new SNES, and its KSP or the KSP of the SNES that preconditions it."""
        snes, prefix = self._keep(PETSc.SNES().create(self.comm)), self.prefix
        snes.setOptionsPrefix(prefix)
        # Whether a plain iteration preconditions SNES
        has_npc = self.options.is_given("npc_snes_type")
        if self.preset.true_hessian:
            self._refuse_of_snes()
        inner = self._keep(snes.getNPC()) if has_npc else snes
        ksp = self._keep(inner.getKSP())
        ksp.setOptionsPrefix(prefix)
        pc = self._keep(ksp.getPC())
        # The options -pc_ without a prefix are for the preconditioner of A or H inside
        pc.setOptionsPrefix(f"{prefix}three_columns_")
        pc.setType(PETSc.PC.Type.PYTHON)
        pc.setPythonContext(self.jacobian.preconditioner)
        snes.setFromOptions()
        if self.preset.true_hessian:
            snes.setType(PETSc.SNES.Type.PYTHON)
        return snes, ksp

    def _refuse_of_snes(self) -> None:
        """Raise InputError for options of SNES that Newton's method does not use."""
        for given, value in PETSc.Options().getAll().items():
            name = given.removeprefix(self.prefix)
            is_ours = given.startswith(self.prefix) and name.startswith(OF_SNES)
            if is_ours and LOOP.get(name) != value:
                raise InputError(
                    f"-{given}: newton's presets have a loop and a line search of "
                    "their own; presets anderson and lbfgs take it"
                )

    def _create_control(self) -> tuple[ErrorControl, Optimality]:
        functional, jacobian = self.functional, self.jacobian
        hessian, preconditioner = jacobian.hessian, jacobian.preconditioner
        estimate = self._keep(ErrorEstimate(functional, hessian, preconditioner, self.prefix))
        curvature = LowestCurvature(functional, hessian, preconditioner)
        rounding = Rounding(functional, jacobian.diagonal)
        optimality = Optimality(functional, estimate, curvature, rounding)
        error = self.error
        if error is None and not self.budget:
            error = DEFAULT_STEP_ERROR
        rtol = self.ksp.getTolerances()[0]
        control = ErrorControl(functional, estimate, curvature, rounding, error or 0.0, rtol)
        return control, optimality

    def _create_method(self) -> Newton | LocalGlobal:
        given = (
            self.functional, self.jacobian, self.snes, self.ksp, self.control, self.preset,
            self.options, self.budget, self.spent,
        )  # fmt: skip
        if self.preset.true_hessian:
            method: Newton | LocalGlobal = Newton(*given)
            self.snes.setPythonContext(method)
        else:
            method = LocalGlobal(*given, self.prefix, self.options.is_given("npc_snes_type"))
        return method

    def set_up(self) -> None:
        """Build the preconditioner before the first step; Cholesky factorises here.

        Raises InputError for a preconditioner that this PETSc lacks or the matrix does not support.
        """
        with petsc_errors("PETSc cannot set up the solver", self):
            # Chebyshev's method applies the operator for eigenvalue bounds
            self.jacobian.hessian.linearise(self.lattice.nodes, None)
            self.jacobian.preconditioner.prepare(self.lattice.nodes, None)
            self.ksp.setOperators(self.jacobian.operator)
            self.ksp.setUp()

    def step(self, problem: StepProblem, start: Rows | None = None) -> StepResult:
        """Return the result of a step.

        start : first guess (l, 3) [m]; None for the best of several guesses

        Raises StepFailed on all ranks, and StepStopped after a signal. Raises InputError if PETSc's
        options contradict each other, or if loads are too great (Rounding.refuse_loads).
        """
        with petsc_errors("PETSc cannot take a step with these options", self):
            self.before = self.work_so_far()
            now, outcome = self._first(self._begin(problem, start), Outcome(self.control.target))
            verdict = self.examine(now, outcome)
            while not verdict.is_minimum and (left := self._leave(now, verdict, outcome)):
                now, outcome = self.method.minimise(*left)
                verdict = self.examine(now, outcome)
            self.first_guess.learn(now.q)
            distance = outcome.distance
            error = self.control.rounding.step_error(verdict.error, distance, outcome.at_rounding)
            cost = replace(self.spent(), step_error=error)
            energy_tolerance = 0.5 * (self.control.target * distance) ** 2 / self.functional.t2
            return StepResult(
                now.q, problem.q, cost,
                contact=now.contact, problem=problem, energy_tolerance=energy_tolerance,
                moved_by_rounding=self.control.rounding.displacement,
            )  # fmt: skip

    def _begin(self, problem: StepProblem, start: Rows | None) -> Iterate:
        """Begin a step and return its first iterate."""
        self.functional.begin(problem)
        self.control.rounding.refuse_loads()
        self.method.begin()
        self.control.estimate.begin_step(problem.contact is not None)
        guess = self.first_guess.best() if start is None else start
        if start is None or self.static:
            guess = self.carried_start.find(
                self.first_guess.with_fixed(guess), self.first_guess.drift
            )
        with LOCAL:
            return self.functional.at(guess)

    def _first(self, start: Iterate, outcome: Outcome) -> tuple[Iterate, Outcome]:
        """Minimise g from the start of a step (collective).

        If the first iteration of a static state overshoots, minimise with smaller lambda first.

        Raises StepFailed, StepStopped and InputError.
        """
        newton = self.method
        may_soften = self.static and self.stiffest > 2 and not self.budget
        if not (isinstance(newton, Newton) and may_soften):
            return newton.minimise(start, outcome)
        newton.ends_on_overshoot = True
        try:
            now, reached = newton.minimise(start, outcome)
        finally:
            newton.ends_on_overshoot = False
        if newton.overshot:
            return newton.minimise(self._softened(newton, now), outcome)
        return now, reached

    def _softened(self, newton: Newton, now: Iterate) -> Iterate:
        """Return a start for the solid's own lambda: the last of several softer solutions.

        Lambda is mu at first, then grows by the factor SOFTER from solution to solution. A straight
        step changes volumes, which resist in proportion to lambda. Between these solutions volumes
        change little. The first Hessian of each solve keeps the slopes V U' of the last solution.
        The solve's own lambda would make the slopes far too large.

        Raises StepFailed and StepStopped.
        """
        solid = self.functional.elasticity.solid
        ratio = 1.0
        while solid and 2 * ratio < self.stiffest:
            with solid.softened(ratio):
                self.forget(modes=False)
                goal = Outcome(max(self.control.target, DEFAULT_STEP_ERROR))
                now, _ = newton.minimise(self.functional.at(now.q), goal)
                newton.slopes = solid.hessian_at(now.q, False).slopes
            ratio *= SOFTER
        self.forget(modes=False)
        return self.functional.at(now.q)

    def forget(self, modes: bool = True) -> None:
        """Forget data of earlier steps, so that the next step does not depend on them.

        modes : whether to forget the lowest mode, too
        """
        self.first_guess.forget()
        self.jacobian.preconditioner.forget()
        self.control.forget()
        if modes:
            self.optimality.curvature.forget()

    def work_so_far(self) -> Work:
        """Return the work of all steps so far, estimates and searches for modes included."""
        of_estimates = total_iterations(self.control.estimate.ksp)
        ksp_its = total_iterations(self.ksp) + of_estimates + self.optimality.curvature.search.its
        products = self.jacobian.hessian.products + self.jacobian.preconditioner.products
        proof = self.control.estimate.products + self.optimality.curvature.products
        its = self.method.iterations
        return Work(iterations=its, ksp_its=ksp_its, products=products, proof_products=proof)

    def spent(self) -> Work:
        """Return the work of the step in progress so far."""
        return self.work_so_far() - self.before

    def examine(self, now: Iterate, outcome: Outcome) -> Verdict:
        """Return the verdict whether an iterate is a minimum, with its error (collective)."""
        control = self.control
        outcome = control.with_compression(now, outcome)
        assert outcome.compression is not None
        # A budget may end far from the minimum
        if outcome.compression.least_curvature > 0 and not self.budget:
            return Verdict(outcome.error, now, is_minimum=True)
        enough = control.target * outcome.distance if control.target else np.inf
        verdict = self.optimality.examine(now, outcome, enough)
        is_good = verdict.error <= control.target or (
            outcome.at_rounding and not np.isinf(verdict.error)
        )
        return replace(verdict, is_minimum=bool(self.budget) or is_good)

    def _leave(
        self, now: Iterate, verdict: Verdict, outcome: Outcome
    ) -> tuple[Iterate, Outcome] | None:
        """Return the iterate and the outcome from which the step goes on (collective).

        Return None if the step can neither move nor become more accurate. Then the step ends with
        the error of the verdict.

        Raises StepFailed.
        """
        lower = self.optimality.lower_iterate(now, verdict)
        doubted = self.control.doubt(replace(outcome, error=verdict.error), lower is not None)
        if doubted and doubted.doubts > DOUBTS:
            raise no_minimum(doubted, where_worst(self.functional, lower or now))
        return (lower or now, doubted) if doubted else None

    def destroy(self) -> None:
        """Destroy all PETSc objects, in the same order on all ranks (collective)."""
        self.owned.close()
        self.options.withdraw()
