"""One implicit step as one PETSc SNES, which solves F(x) = grad g(x) = 0; a method is a set of
options (solve.presets)."""

import ctypes
from contextlib import ExitStack
from dataclasses import dataclass, replace

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.backend.arrays import Array, Positions, Rows
from msmpetsc.comm import Stop
from msmpetsc.elasticity.energy import Elasticity
from msmpetsc.errors import InputError, StepStopped
from msmpetsc.lattice.lattice import Lattice
from msmpetsc.solve.linear.unknowns import Unknowns
from msmpetsc.solve.nonlinear.curvature import Alarm, LowestCurvature
from msmpetsc.solve.nonlinear.error_control import (
    DEFAULT_ERROR,
    FULL_STEP_ERROR,
    NOT_FINITE,
    ErrorControl,
    Outcome,
    no_minimum,
    not_converged,
    where_worst,
)  # fmt: skip
from msmpetsc.solve.nonlinear.error_estimate import ErrorEstimate
from msmpetsc.solve.nonlinear.first_guess import FirstGuess
from msmpetsc.solve.nonlinear.functional import Iterate, Rounding, StepFunctional, StepProblem
from msmpetsc.solve.nonlinear.jacobian import FrictionDuals, Jacobian
from msmpetsc.solve.nonlinear.led_start import LedStart
from msmpetsc.solve.nonlinear.minimum import Minimum, Verdict
from msmpetsc.solve.nonlinear.preconditioning import LatticePreconditioner
from msmpetsc.solve.petsc.events import LOCAL
from msmpetsc.solve.petsc.library import petsc_errors, total_iterations
from msmpetsc.solve.presets import MOST_ITERATIONS, Preset, SolverOptions
from msmpetsc.solve.refused_options import BY_ERROR
from msmpetsc.solve.work import Work

PROJECTED = 5  # iterations with the projected Hessian before the true one, which comes in faster, has another try
SOFTER = 9.0  # how far |F| may rise at first; then lambda, from one solid that leads on to the next
DOUBTS = 100  # about where a step has come to: saddles, and errors larger than they had seemed
NEWTON = 10  # iterations of CG that the rest of an iteration of Newton's method costs
RAISED = 2.0  # times |F| before: friction and contact have kinks within what g has no digits for
INDEFINITE = PETSc.KSP.ConvergedReason.DIVERGED_INDEFINITE_MAT
CLIMBS = (  # PETSc takes it for a minimum where |H F| / |F| < 1e-4, as any is in small units
    PETSc.SNES.ConvergedReason.DIVERGED_LINE_SEARCH,
    PETSc.SNES.ConvergedReason.DIVERGED_LOCAL_MIN,
)


@dataclass(frozen=True)
class StepResult:
    """Result of one step.

    explicit   : taken in substeps; ``work`` then has that of all that moved, pushed or came to be there
    swing      : by how much the energy of this rank's nodes changed that comes back (solve.energy_balance) [J]
    time_error : estimated error of the trajectory so far; NaN where there is no estimate
    problem    : that was solved, of F = M (x - y) + tau^2 (grad E - f_ext); None of explicit steps. Statics have no M
    slack      : energy [J]: as far as g is convex, x is within the error asked for where g / tau^2 is no more above its
        least
    viscous    : forces of viscosity (owned, 3) [N]; its work is what it took in of this rank's cells [J]
    """

    position: Positions  # (l, 3) [m], ghosts included
    previous: Positions  # (l, 3) [m], such that the velocity is (position - previous) / t
    cost: Work  # of the step
    work: float = 0.0  # of obstacles that struck this rank's nodes [J]
    explicit: bool = False
    swing: float = 0.0
    static: bool = False  # a state of equilibrium, not a motion
    time_error: float = np.nan
    problem: StepProblem | None = None
    slack: float = 0.0
    tau: float = np.inf  # [s]
    viscous: Rows | None = None
    viscous_work: float = 0.0


@dataclass(eq=False)
class Stepper:
    """Solver of the steps of one lattice and time step; all PETSc objects it makes are destroyed by ``destroy``.

    error          : relative error at which a step is done; None for the preset's own rule
    max_iterations : a budget instead of a promise: the step is taken as it is then

    Raises InputError for PETSc options that do not go together (collective).
    """

    comm: MPI.Comm
    lattice: Lattice
    time_step: float
    preset: Preset
    error: float | None = None
    max_iterations: int | None = None
    touches: bool = False  # whether steps may have a ``contact``
    prefix: str = ""  # of its PETSc options
    static: bool = False  # what is looked for is an equilibrium: M weighs errors and nothing else

    def __post_init__(self) -> None:
        self.budget = self.max_iterations or 0
        if self.error is None and not self.budget:
            self.budget = self.preset.iterations or 0
        self.projected = False  # whether newton's Hessian is, at the moment
        self.is_detour = False  # the way to the last iterate is not what the linear solve has led to
        self.outcome = Outcome()  # of the solve in progress, as its last iterate has it
        self.is_first, self.begun = False, np.inf  # iteration, of which softer solids may follow; |F| before it
        self.overshoots = False  # it has, and ends its solve
        self.slopes: Array | None = None  # V U' of a softer solid, for the next Hessian
        self.iterations = 0  # of all steps so far
        self.before = Work()  # of the steps before the present one
        self.is_forced = False  # the last move was a full one, whatever g said of it
        self.is_bent = False  # such a move has raised |F|: g is to be asked all the same
        self.base = np.empty_like(self.lattice.nodes)  # positions that g is compared with
        self.friction, self.owned = FrictionDuals(), ExitStack()
        self.unknowns = Unknowns(self.comm, self.lattice, self.static)
        self.owned.callback(self.unknowns.destroy)
        elasticity = Elasticity(self.lattice)
        of_rank = elasticity.solid.stiffest if elasticity.solid else 0.0
        self.stiffest = self.comm.allreduce(of_rank, MPI.MAX)  # lambda of a cell, in mu
        self.functional = StepFunctional(self.comm, self.unknowns, elasticity, self.time_step)
        self.first_guess = FirstGuess(self.functional, self.preset.iterations is None)
        self.options = SolverOptions(self.preset, self.prefix, self.budget)
        try:
            with petsc_errors("PETSc refuses its options"):
                self.jacobian = Jacobian(self.functional, self.preset, self.options, self.touches, self.owned)
                self.x, self.f, self.work = (self._keep(self.jacobian.operator.createVecRight()) for _ in range(3))
                self.has_npc = self.options.is_given("npc_snes_type")  # a plain iteration that preconditions SNES
                self.snes, self.ksp = self._create_solvers()
                self.control, self.minimum = self._create_control()
                self.led_start = LedStart(self.functional, self.jacobian, self.ksp, (self.x, self.f, self.work))
        except InputError:
            self.destroy()
            raise

    def _keep(self, owned: PETSc.Object) -> PETSc.Object:
        self.owned.callback(owned.destroy)
        return owned

    def _create_solvers(self) -> tuple[PETSc.SNES, PETSc.KSP]:
        """Create SNES, and the KSP of its own or of the SNES that preconditions it."""
        snes, prefix = self._keep(PETSc.SNES().create(self.comm)), self.prefix
        snes.setOptionsPrefix(prefix)
        inner = self._keep(snes.getNPC()) if self.has_npc else snes
        ksp = self._keep(inner.getKSP())
        ksp.setOptionsPrefix(prefix)
        pc = self._keep(ksp.getPC())
        pc.setOptionsPrefix(f"{prefix}three_columns_")  # leaves the bare -pc_ to the preconditioner of A
        pc.setType(PETSc.PC.Type.PYTHON)
        pc.setPythonContext(self.jacobian.preconditioner)
        snes.setFunction(self._residual, self.f)
        snes.setJacobian(self._linearise, self.jacobian.operator)
        snes.setObjective(self._objective)
        if self.touches:
            snes.setLineSearchPreCheck(self._change_way)
        snes.setConvergenceTest(self._converged)
        if self.preset.start_from_b:
            ksp.setInitialGuessNonzero(True)
        snes.setFromOptions()
        ksp.setComputeEigenvalues(ksp.getType() == PETSc.KSP.Type.CG)
        return snes, ksp

    def _create_control(self) -> tuple[ErrorControl, Minimum]:
        functional, jacobian = self.functional, self.jacobian
        hessian, preconditioner = jacobian.hessian, jacobian.preconditioner
        estimate = self._keep(ErrorEstimate(functional, hessian, preconditioner, self.prefix))
        curvature = self._keep(LowestCurvature(functional, hessian, preconditioner))
        rounding = Rounding(functional, jacobian.diagonal)
        minimum = self._keep(Minimum(functional, estimate, curvature, rounding))
        error = self.error
        if error is None and not self.budget:
            error = DEFAULT_ERROR
        tightest, _, _, self.most_its = self.ksp.getTolerances()
        control = ErrorControl(functional, estimate, curvature, rounding, error or 0.0, tightest)
        if self.preset.true_hessian:
            self.ksp.setMonitor(control.solve_bound.watch)
        return control, minimum

    def set_up(self) -> None:
        """Build the preconditioner (a factorisation, for Cholesky) before the first step needs it.

        Raises InputError for a preconditioner that this PETSc or matrix does not have.
        """
        with petsc_errors("PETSc cannot set up the solver", self._abandon):
            self.jacobian.hessian.linearise(self.lattice.nodes, None)  # Chebyshev's method tries it, for eigenvalues
            self.jacobian.preconditioner.in_use.prepare(self.lattice.nodes, None)
            self.ksp.setOperators(self.jacobian.operator)
            self.ksp.setUp()

    def step(self, problem: StepProblem, start: Rows | None = None) -> StepResult:
        """Solve one step.

        start : a first guess (l, 3) [m]; the best of several if None

        Raises StepFailed on all ranks, StepStopped where a signal asks for it, and InputError where PETSc's options do
        not go together.
        """
        with petsc_errors("PETSc cannot take a step with these options", self._abandon):
            self.before = self.work_so_far()
            self._begin(problem, start)
            self.is_first = self.static and self.stiffest > 2 and self.preset.true_hessian and not self.budget
            self.slopes = None
            outcome = self.solve_once(Outcome(self.control.target))
            verdict = self.examine(outcome)
            while not verdict.is_minimum and (doubted := self._leave(verdict, outcome)):
                outcome = self.solve_once(doubted)
                verdict = self.examine(outcome)
            q = self.functional.positions(self.x)
            self.first_guess.learn(q)
            distance = self.functional.distance(q)
            error = self.control.rounding.added_to(verdict.error, distance, outcome.at_rounding)
            cost = replace(self.work_so_far() - self.before, step_error=error)
            slack = 0.5 * (self.control.target * distance) ** 2 / self.functional.t2
            return StepResult(q, problem.q, cost, problem=problem, slack=slack)

    def _begin(self, problem: StepProblem, start: Rows | None) -> None:
        self.functional.begin(problem)
        self.control.rounding.refuse_loads()
        self.base[:] = problem.fixed
        self.friction.begin(problem.contact)
        self.control.estimate.convexity = 1.0
        self.is_forced = self.is_bent = False
        guess = self.first_guess.best() if start is None else start
        if start is None or self.static:
            guess = self.led_start.reach(self.first_guess.held(guess), self.first_guess.drift)
        self.unknowns.from_nodes(guess, self.x)
        multigrid = self.jacobian.preconditioner.to_balance
        if start is None and multigrid:
            self._balance(multigrid)

    def _balance(self, multigrid: LatticePreconditioner) -> None:
        """Move bodies as wholes to where their forces balance, as far as they do not meet."""
        iterate = self._evaluate(self.x)
        multigrid.balance(iterate.q, self.functional.problem.contact, iterate.f, self.x)
        if self.functional.surface is None:
            return
        balanced = self.functional.positions(self.x)
        share = self.functional.free_share(iterate.q, balanced)
        if share < 1.0:
            self.unknowns.from_nodes(iterate.q + share * (balanced - iterate.q), self.x)

    def forget(self, modes: bool = True) -> None:
        """Forget what earlier steps showed, so that the next step does not depend on it; modes: the lowest mode too."""
        self.first_guess.forget()
        self.jacobian.preconditioner.forget()
        self.control.forget(modes)
        self.minimum.curvature.forget(modes)

    def work_so_far(self) -> Work:
        """Work of all steps so far, of their estimates and searches for negative curvature."""
        of_estimates = total_iterations(self.control.estimate.ksp)
        ksp_its = total_iterations(self.ksp) + of_estimates + self.minimum.curvature.its
        products = self.jacobian.hessian.products + self.jacobian.preconditioner.products
        proof = self.control.estimate.products + self.minimum.curvature.products
        return Work(iterations=self.iterations, ksp_its=ksp_its, products=products, proof_products=proof)

    def solve_once(self, outcome: Outcome) -> Outcome:
        """Bring F at x down to the goal of an outcome so far (collective). Raises StepFailed and InputError.

        If the first iteration overshoots, solids of a smaller lambda lead on to the solution.
        """
        solved = self._solve(outcome)
        if not self.overshoots:
            return solved
        self._solve_softened()
        return self._solve(outcome)

    def _solve(self, outcome: Outcome) -> Outcome:
        """Bring F at x down to the goal by SNES (collective). Raises StepFailed and InputError.

        Under compression the true Hessian may be indefinite. CG then stops with the descent it has,
        but if its very first direction has negative curvature it climbs, as the line search says:
        the projected Hessian takes over for some iterations (_linearise).
        """
        self.outcome, self.overshoots = outcome, False
        if self._is_solved():
            return self.outcome
        self.projected = self.preset.projected > 0
        if self.snes.getType() == PETSc.SNES.Type.QN:  # alone it keeps what it has learnt; set anew it has nothing
            self.snes.setType(PETSc.SNES.Type.KSPONLY)
            self.snes.setType(PETSc.SNES.Type.QN)
            self.snes.setFromOptions()
        iterations, most = self._run_snes(), self.snes.getTolerances()[3]
        while self.preset.true_hessian and self.snes.reason in CLIMBS and iterations < most:
            self.projected = True
            its = self._run_snes()
            iterations += its
            if its == 0:  # neither Hessian leads on
                break
        self.projected = False
        if self.snes.reason < 0:
            worst = where_worst(self.functional, self._evaluate(self.snes.getSolution()))
            raise not_converged(self.snes, self.ksp, self.outcome, iterations, worst, self.preset.true_hessian)
        if not (self.outcome.is_enough or self.overshoots or self.budget):
            ends = f"-{self.prefix}snes_type {self.snes.getType()} ends by a rule of its own"
            raise InputError(f"{ends}, {self.outcome.error:.2e} off: {BY_ERROR}")
        return self.outcome

    def _solve_softened(self) -> None:
        """Solve for solids whose lambda is mu, then more and more of it. Raises StepFailed and InputError.

        The greater lambda, the shorter a straight way until it has changed volumes; from solution to solution they
        change little. The first Hessian of each has the pressure of the one before: with its own lambda, what lacks of
        volume would bend everything.
        """
        solid = self.functional.elasticity.solid
        ratio = 1.0
        while solid and 2 * ratio < self.stiffest:
            with solid.softened(ratio):
                self.forget(modes=False)
                self._solve(Outcome(max(self.control.target, DEFAULT_ERROR)))
                self.slopes = solid.hessian_at(self.functional.positions(self.x), False).slopes
            ratio *= SOFTER
        self.forget(modes=False)

    def _run_snes(self) -> int:
        self.snes.solve(None, self.x)
        self.iterations += self.snes.its
        if self.snes.reason < 0 and Stop.agreed(self.comm):
            raise StepStopped("stopped by a signal")
        return int(self.snes.its)

    def examine(self, outcome: Outcome) -> Verdict:
        """Whether x is a minimum, and how far from it (collective)."""
        control, functional, q = self.control, self.functional, self.functional.positions(self.x)
        compression = self.minimum.curvature.compression(q)
        if compression.least_curvature > 0 and not self.budget:  # a budget may end where g is no parabola yet
            return Verdict(outcome.error, is_minimum=True)
        enough = control.target * functional.distance(q) if control.target else np.inf
        verdict = self.minimum.examine(self.x, outcome, compression, enough)
        will_do = verdict.error <= control.target or (outcome.at_rounding and not np.isinf(verdict.error))
        return replace(verdict, is_minimum=bool(self.budget) or will_do)

    def _leave(self, verdict: Verdict, outcome: Outcome) -> Outcome | None:
        """Move x from where it is no minimum to where g is lower; what is then known (collective). Raises StepFailed.

        None where g has no digits left to tell the two apart: the step is as good as the verdict says.
        """
        doubted = self.control.doubt(replace(outcome, error=verdict.error), self.minimum.go_on(self.x, verdict))
        if doubted and doubted.doubts > DOUBTS:
            worst = where_worst(self.functional, self.functional.evaluate(self.x, self.work))
            raise no_minimum(doubted, worst)
        return doubted

    def _is_solved(self) -> bool:
        """Whether the first guess will do: an NPC solves with A before SNES looks at its start."""
        if not self.has_npc:
            return False
        iterate = self._evaluate(self.x)
        self.outcome = self.control.judge(iterate, self.outcome)
        if not self.outcome.is_enough:
            self._adapt()
        return self.outcome.is_enough

    def _evaluate(self, x: PETSc.Vec) -> Iterate:
        with LOCAL:
            return self.functional.evaluate(x, self.work)

    def _residual(self, _: PETSc.SNES, x: PETSc.Vec, f: PETSc.Vec) -> None:
        with LOCAL:
            self.functional.evaluate(x, f)

    def _objective(self, snes: PETSc.SNES, x: PETSc.Vec) -> float:
        """g(x) - g(base): a line search compares values, and their difference must keep its digits.

        Close to the solution g falls by less than the rounding of x changes it: then any move is
        called a fall, so that Newton's full step is taken.
        """
        if self.preset.true_hessian and x.handle == snes.getSolution().handle:
            return 0.0  # the start of a line search, which is where it was linearised
        with LOCAL:
            q = self.functional.positions(x)
            self.friction.see(q, self.base)
            change, distance = self.functional.change(q, self.base)
        outcome = self.outcome
        is_flat = outcome.bound < FULL_STEP_ERROR and (outcome.corrected or not outcome.doubts)
        self.is_forced = is_flat and distance > 0 and not self.is_bent
        return -1.0 if self.is_forced else change

    def _change_way(self, x: PETSc.Vec, y: PETSc.Vec) -> bool:
        """Change the way from x to x - y, which a line search is to try, where it leads into obstacles or the surface
        meets itself on it; whether it was."""
        self.is_detour = False
        if self.functional.problem.contact is None:
            return False
        end = x.copy()
        end.axpy(-1.0, y)
        with LOCAL:
            before, after = self.functional.positions(x), self.functional.positions(end)
            stopped = self._stop_at_obstacles(before, after, end) if self.preset.true_hessian else None
            if stopped is not None:
                x.copy(y)
                y.axpy(-1.0, end)
            share = self.functional.free_share(before, after if stopped is None else stopped)
        end.destroy()
        if share < 1.0:
            y.scale(share)
        self.is_detour = stopped is not None or share < 1.0
        return self.is_detour

    def _stop_at_obstacles(self, before: Positions, after: Positions, end: PETSc.Vec) -> Positions | None:
        """Return where nodes that come into an obstacle on a way (l, 3) end at its surface, and write it into ``end``;
        None where g is no less there.

        H at x knows nothing of obstacles that are not touched yet: nodes run deep into them, and a line search that
        shortens the whole way for it would let them come in one by one.
        """
        functional, contact = self.functional, self.functional.problem.contact
        stopped = contact.stopped(after, before) if contact else None
        if not self.comm.allreduce(stopped is not None, MPI.LOR):
            return None
        self.unknowns.from_nodes(after if stopped is None else stopped, end)
        free = functional.positions(end)  # nodes that are led stay where they are led to
        if functional.value(free) >= functional.value(after):  # without self-contact, which costs most
            return None
        return free if functional.change(free, before)[0] < 0 else None

    def _linearise(self, snes: PETSc.SNES, x: PETSc.Vec, _: PETSc.Mat, __: PETSc.Mat) -> None:
        """Take the Jacobian at x, and the start of the linear solve (SNES calls it before each)."""
        with LOCAL:
            if snes.its > 0 and self.friction.is_awaited:
                self.friction.see(self.functional.positions(x), self.base)  # where no objective was asked for
            self.unknowns.to_nodes(x, self.base)
            self.projected = self.projected and snes.its < (self.preset.projected or PROJECTED)
            known = self.outcome.corrected and not self.projected  # the estimate has linearised at this very x
            self.jacobian.linearise(
                self.base, self.functional.problem.contact, self.projected, self.friction.duals, known
            )
            if self.slopes is not None and not (known or self.projected):
                self.jacobian.hessian.take_slopes(self.slopes)
            self.slopes = None
            self.friction.is_awaited = True
            if self.preset.true_hessian:
                self._start_from_estimate(snes, known)
            if self.preset.iterations is None and not self.options.is_given("ksp_max_it"):
                most = self.jacobian.preconditioner.most_iterations(self.ksp.getTolerances()[0])
                self.ksp.setTolerances(max_it=most or self.most_its)
        if self.preset.start_from_b:  # CG solves A z = F for z = x - x_new; x_new = b = A x - F: z = x - A x + F
            z = snes.getSolutionUpdate()
            self.jacobian.operator.mult(x, z)
            z.aypx(-1.0, x)
            z.axpy(1.0, self.f)

    def _start_from_estimate(self, snes: PETSc.SNES, known: bool) -> None:
        """Start CG from the correction that an estimate at this x found, if there is any."""
        if self.options.is_given("ksp_initial_guess_nonzero"):
            return
        known = known and self.ksp.getType() != PETSc.KSP.Type.PREONLY  # that starts from nothing
        if known:
            self.control.estimate.correction.copy(snes.getSolutionUpdate())
        self.ksp.setInitialGuessNonzero(known)

    def _converged(self, snes: PETSc.SNES, its: int, _: tuple[float, float, float]) -> PETSc.SNES.ConvergedReason:
        """Whether SNES is done (its convergence test), by its iterate's error or by the budget."""
        reasons, iterate = PETSc.SNES.ConvergedReason, self._iterate(snes)
        if its > 0:
            self.jacobian.preconditioner.learn(
                self.ksp.its, self.ksp.getTolerances()[0], self.control.solve_bound.reduction
            )
            if self.is_detour or self.projected:  # of another x, or another Hessian
                self.outcome = replace(self.outcome, left=np.inf, solved=np.inf)
            elif self.preset.true_hessian:
                self.outcome = self.control.led_by(self.ksp, self.outcome)
        before = self.outcome.residual
        if its > 0 or not self.has_npc:  # else known since _is_solved
            known = self.outcome if its > 0 else replace(self.outcome, residual=np.inf)  # from where SNES begins again
            self.outcome = self.control.judge(iterate, known)
        self.is_bent |= self.is_forced and self.outcome.residual > RAISED * before
        self.is_forced = False
        outcome = self.outcome
        if self.ksp.reason == INDEFINITE:
            self.outcome = outcome = replace(outcome, alarm=max(outcome.alarm, Alarm.ON_THE_WAY))
        if not np.isfinite(outcome.residual):
            return NOT_FINITE
        self.overshoots = self.is_first and self._overshoots(its)
        if self.overshoots:
            return reasons.CONVERGED_ITS
        if outcome.is_enough:
            if outcome.at_rounding:
                return reasons.CONVERGED_FNORM_ABS
            return reasons.CONVERGED_SNORM_RELATIVE if outcome.corrected else reasons.CONVERGED_FNORM_RELATIVE
        if self.budget and its >= self.budget:
            if not outcome.corrected:
                self.outcome = self.control.estimated(iterate, outcome, 0.0)
            return reasons.CONVERGED_ITS
        if Stop.agreed(self.comm):
            return reasons.DIVERGED_INNER  # _run_snes says so
        spent = self.work_so_far() - self.before
        if spent.ksp_its + NEWTON * (spent.iterations + its) > MOST_ITERATIONS:
            return reasons.DIVERGED_MAX_IT
        self._adapt()
        return reasons.ITERATING

    def _overshoots(self, its: int) -> bool:
        """Whether the first iteration has raised |F| so much that softer solids are to lead on."""
        self.is_first = its == 0
        if self.is_first:
            self.begun = self.outcome.residual
        return self.outcome.residual > SOFTER * self.begun

    def _iterate(self, snes: PETSc.SNES) -> Iterate:
        """Return SNES's iterate, and F there."""
        x = snes.getSolution()
        if self.has_npc:
            return self._evaluate(x)
        return Iterate(self.functional.positions(x), self.f)

    def _adapt(self) -> None:
        """Let the next linear solve leave what the step can do with; a tolerance of the user's own is left alone."""
        if self.preset.iterations is None and self.options.is_default("ksp_rtol"):
            rtol, atol = self.control.tolerances(self.outcome)
            self.ksp.setTolerances(rtol=rtol, atol=None if self.options.is_given("ksp_atol") else atol)

    def _abandon(self) -> None:
        """Keep PETSc's objects for ever: after an error they may crash when they are destroyed."""
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(self))
        self.owned = ExitStack()

    def destroy(self) -> None:
        """Collective, and in the same order on all ranks; the garbage collector's would differ."""
        self.owned.close()
        self.options.withdraw()
