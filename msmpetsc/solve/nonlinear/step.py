"""One implicit Euler step as one PETSc SNES (design: one step, many methods): it solves F(x) = grad g(x) = 0."""

import ctypes
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.backend.arrays import like
from msmpetsc.errors import InputError
from msmpetsc.model.checkpoint import Checkpoint
from msmpetsc.model.contact.penalty import Contact
from msmpetsc.model.elasticity import Elasticity
from msmpetsc.model.lattice import Lattice
from msmpetsc.solve.linear.operators import (
    ContactBlocks,
    Preconditioned,
    Preconditioner,
    ThreeColumns,
    TrueHessian,
    python_matrix,
)  # fmt: skip
from msmpetsc.solve.linear.system import ViewOfA, assemble
from msmpetsc.solve.linear.unknowns import Unknowns
from msmpetsc.solve.nonlinear.curvature import LowestCurvature
from msmpetsc.solve.nonlinear.estimate import ErrorEstimate
from msmpetsc.solve.nonlinear.failure import no_minimum, not_converged
from msmpetsc.solve.nonlinear.first_guess import FirstGuess
from msmpetsc.solve.nonlinear.functional import StepFunctional
from msmpetsc.solve.nonlinear.minimum import Minimum
from msmpetsc.solve.nonlinear.rounding import Rounding
from msmpetsc.solve.petsc.errors import refusal
from msmpetsc.solve.petsc.library import total_iterations
from msmpetsc.solve.presets import Preset, forget_defaults, set_defaults

DEFAULT_ERROR = 1e-3
FULL_STEP_ERROR = 1e-5  # below it g, quadratic in the error, has nothing left to tell
PROJECTED = 5  # iterations with the projected Hessian before the true one, which comes in faster, has another try
FIRST_RATIO = 5.0  # of the bound on the error to the error, before any was estimated
EARLY = 2.0  # a step is first looked at closely when its error is thought to be this many times what would do
LOOSEST = 0.3  # ksp_rtol
SHARE = 0.5  # of the error that would do, left to the linear solve
DOUBTS = 100  # about where a step has come to: saddles, and errors larger than they had seemed
CLOSER, CLOSEST = 0.1, 1e-3  # of the error that was enough to doubt: asked for next, and at the most
INDEFINITE = PETSc.KSP.ConvergedReason.DIVERGED_INDEFINITE_MAT
LOCAL_EVENT = "msmpetsc local"  # in -log_view and in measurements: all that is done spring by spring outside of KSP


@dataclass(frozen=True)
class StepResult:
    """position (l, 3) [m], ghosts included; previous (l, 3) [m]: so that the velocity is
    (position - previous) / t; error: estimate of the relative error of the step; iterations of SNES; ksp_its,
    the KSP iterations of all of them, and of what examines the result; work: of obstacles that struck this rank's
    nodes [J]; explicit: it was taken in substeps, and ``work`` has that of all that moved, pushed or came to be there;
    swing: by how much the energy of this rank's nodes changed that comes back (solve.energy_balance) [J]."""

    position: np.ndarray
    previous: np.ndarray
    error: float
    iterations: int
    ksp_its: int
    work: float = 0.0
    explicit: bool = False
    swing: float = 0.0


class Stepper:
    """The solver of one lattice and time step; all PETSc objects it makes are destroyed by ``destroy``.

    error          : relative error at which a step is done; None for the preset's own rule
    max_iterations : a budget instead of a promise: the step is taken as it is then
    touches        : whether steps may be given a ``contact``
    prefix         : of its PETSc options

    The error of x is |x - x*|_M / |x - y|_M, estimated (solve.nonlinear.estimate). |F(x)|_(M^-1) / |x - y|_M bounds it
    wherever E is convex between x and x*; where that will do already, or no estimate can be had, it is what is said.
    ``observer`` is called at each iterate, when its error is known.
    """

    observer: Callable[["Stepper"], None] | None = None

    def __init__(
        self,
        comm: MPI.Comm,
        lattice: Lattice,
        time_step: float,
        preset: Preset,
        error: float | None = None,
        max_iterations: int | None = None,
        touches: bool = False,
        prefix: str = "",
    ):
        self.comm, self.lattice, self.preset, self.prefix = comm, lattice, preset, prefix
        self.elasticity = Elasticity(comm, lattice)
        self.t2 = time_step**2
        published = preset.iterations if error is None else None
        self.budget = max_iterations or published
        self.error = error if error is not None or self.budget else DEFAULT_ERROR
        self.unknowns = Unknowns(comm, lattice)
        self.memory = self.unknowns.memory
        self.functional = StepFunctional(comm, self.unknowns, self.elasticity, time_step)
        self.base = np.empty_like(lattice.nodes)
        self.first_guess = FirstGuess(self.functional, preset.extrapolate)
        self.ratio = FIRST_RATIO
        self.local = PETSc.Log.Event(LOCAL_EVENT)
        self.owned_objects = [self.unknowns]
        self.defaults = set_defaults(preset, prefix, self.budget or 0)
        try:
            self._create_solver(time_step, touches)
        except InputError:
            self.destroy()
            raise

    @refusal("PETSc refuses its options")
    def _create_solver(self, time_step: float, touches: bool) -> None:
        self.matrix = self._keep(assemble(self.comm, self.unknowns, time_step, prefix=self.prefix))
        self._keep(ViewOfA(self.prefix))
        self.touches = touches
        self.hessian = TrueHessian(self.unknowns, self.elasticity, time_step, self._contact_blocks(time_step))
        self.projected = False  # whether newton's is, at the moment
        self.linear = self.hessian
        if not self.preset.true_hessian:
            self.linear = ThreeColumns(self.matrix, self.unknowns, self._contact_blocks(time_step))
        self.operator = self._keep(python_matrix(self.unknowns, self.linear, self.comm))
        self.x, self.f = map(self._keep, self.operator.createVecs())
        self.work = self._keep(self.f.duplicate())
        preconditioner = self._create_preconditioner(time_step)
        self.pmat = self._keep(python_matrix(self.unknowns, Preconditioned(self.preconditioned), self.comm))
        self.snes = self._keep(PETSc.SNES().create(self.comm))
        self.snes.setOptionsPrefix(self.prefix)
        self.inner = self.snes
        if f"{self.prefix}npc_snes_type" in PETSc.Options().getAll():
            self.inner = self._keep(self.snes.getNPC())
        self.ksp = self._keep(self.inner.getKSP())
        self.ksp.setOptionsPrefix(self.prefix)
        pc = self.ksp.getPC()
        pc.setOptionsPrefix(f"{self.prefix}three_columns_")  # leaves the bare -pc_ to the preconditioner of A
        pc.setType(PETSc.PC.Type.PYTHON)
        pc.setPythonContext(preconditioner)
        self.estimate = self._keep(ErrorEstimate(self.functional, self.hessian, preconditioner, self.prefix))
        self.curvature = self._keep(LowestCurvature(self.functional, self.hessian, preconditioner))
        self.minimum = self._keep(Minimum(self.functional, self.estimate, self.curvature))
        self.snes.setFunction(self._residual, self.f)
        self.snes.setJacobian(self._linearise, self.operator, self.pmat)
        self.snes.setObjective(self._objective)
        self.snes.setConvergenceTest(self._converged)
        if self.preset.start_from_b:
            self.ksp.setInitialGuessNonzero(True)
        self.snes.setFromOptions()
        # the user's own tolerance is left alone
        self.adapts = self.preset.inexact and f"{self.prefix}ksp_rtol" in self.defaults
        self.tightest = self.ksp.getTolerances()[0]

    def _contact_blocks(self, time_step: float) -> ContactBlocks | None:
        return ContactBlocks(self.unknowns, time_step) if self.touches else None

    def _create_preconditioner(self, time_step: float) -> Preconditioner:
        """Of A, or of A (x) I_3; contact changes what A is preconditioned with, but not A."""
        self.preconditioned, columns = self.matrix, 1
        if self.preset.kronecker:
            columns = 3
            self.preconditioned = self._keep(assemble(self.comm, self.unknowns, time_step, columns, self.prefix))
        elif self.touches:
            self.preconditioned = self._keep(self.matrix.copy())
        self.scalar = self._keep(self.preconditioned.createVecLeft())
        self.preconditioned.getDiagonal(self.scalar)
        self.diagonal = self.memory.read(self.scalar).copy()
        self.rounding = Rounding(self.functional, self.diagonal[: self.unknowns.size])
        self.added = np.zeros_like(self.diagonal)  # to the preconditioner's diagonal
        return Preconditioner(self.preconditioned, self.memory, 3 // columns, self.prefix)

    def _keep(self, owned: PETSc.Object) -> PETSc.Object:
        self.owned_objects.append(owned)
        return owned

    def set_up(self) -> None:
        """Build the preconditioner (a factorisation, for Cholesky) before the first step needs it.

        Raises InputError for a preconditioner that this PETSc or matrix does not have.
        """
        with refusal("PETSc cannot set up the solver", self._abandon):
            self.hessian.linearise(self.lattice.nodes, None)  # some solvers try it: Chebyshev's, for its eigenvalues
            self.ksp.setOperators(self.operator, self.pmat)
            self.ksp.setUp()

    def step(
        self,
        q: np.ndarray,
        y: np.ndarray,
        load: np.ndarray,
        contact: Contact | None = None,
        prescribed: np.ndarray | None = None,
        start: np.ndarray | None = None,
    ) -> StepResult:
        """q_(n+1) from q_n and y, where it would be without forces, (l, 3) [m] each, ghosts included.

        load    : force (owned, 3) [N]
        contact : what presses on the nodes in this step
        led     : q_n with the held nodes where they will be, (l, 3) [m]; q_n itself if they stay
        start   : a first guess (l, 3) [m]; the best of several if None

        Raises StepFailed on all ranks, and InputError where PETSc's options do not go together.
        """
        with refusal("PETSc cannot take a step with these options", self._abandon):
            return self._step(q, y, load, contact, prescribed, start)

    def _step(self, q, y, load, contact, prescribed, start) -> StepResult:
        its_before = self.all_its()
        self.functional.begin(q, y, load, contact, prescribed)
        self.base[:] = self.functional.q
        self.bound = self.last_error = self.residual = np.inf
        self.early, self.corrected, self.alarmed, self.at_rounding = EARLY, False, False, False
        self.doubts, self.goal = 0, self.error or 0.0
        self.unknowns.from_nodes(self.first_guess.best(q) if start is None else start, self.x)
        iterations = self._come_to_rest()
        while not self._is_minimum():
            iterations += self._come_to_rest()
        functional = self.functional
        self.unknowns.to_nodes(self.x, functional.q)
        self.first_guess.learn(functional.q)
        error = self.rounding.added_to(self.last_error, functional.away())
        return StepResult(functional.q.copy(), q, error, iterations, self.all_its() - its_before)

    def save(self, saved: Checkpoint) -> None:
        """What the next step depends on beside what it is given."""
        self.first_guess.save(saved)
        self.curvature.save(saved)
        saved.numbers["ratio"] = self.ratio
        if self.touches:
            bound = saved.rows["contact_bound"] = np.zeros(self.lattice.owned, like=self.added)
            bound[self.unknowns.free] = self.added[: self.unknowns.size]

    def restore(self, saved: Checkpoint) -> None:
        """Go on from there; from nothing saved as if no step had been taken (collective)."""
        self.first_guess.restore(saved)
        self.curvature.restore(saved)
        self.ratio = saved.number("ratio", FIRST_RATIO, 0)
        if self.touches:
            bound = saved.rows.get("contact_bound", np.zeros(self.lattice.owned))
            bound = like(self.added, bound)[self.unknowns.free]
            self._add_to_preconditioner(np.tile(bound, len(self.diagonal) // max(len(bound), 1)))

    def all_its(self) -> int:
        """KSP iterations of all steps so far, and of their estimates and searches for negative curvature."""
        return total_iterations(self.ksp) + total_iterations(self.estimate.ksp) + self.curvature.its

    def _come_to_rest(self) -> int:
        """Iterations that took x to where F is as small as it must be."""
        return 0 if self._is_solved() else self._solve()

    def _is_minimum(self) -> bool:
        """Whether x is one and its error what was said; x is moved on if not (collective). Raises StepFailed."""
        functional, enough = self.functional, self.error or 0.0
        self.unknowns.to_nodes(self.x, functional.q)
        compression = self.curvature.compression(functional.q)
        if compression.is_harmless:
            return True
        away = functional.away()
        finding = self.minimum.examine(
            self.x, self.corrected, compression, self.alarmed, enough * away if enough else np.inf
        )
        self.last_error = finding.error
        if self.budget or finding.error <= enough or (self.at_rounding and not np.isinf(finding.error)):  # x = y: 0 / 0
            return True
        self.doubts += 1
        if not self.minimum.go_on(self.x, finding):
            self.goal *= CLOSER
            if self.goal < CLOSEST * enough and np.isfinite(finding.error):
                return True  # g has no digits left to tell the two points apart: the step is as good as it says
        if self.doubts > DOUBTS:
            self._residual(self.snes, self.x, self.work)
            raise no_minimum(self, finding.error)
        self.bound, self.corrected = np.inf, False
        return False

    def _is_solved(self) -> bool:
        """Whether the first guess will do: an NPC would solve with A before SNES looks at its start."""
        if self.inner is self.snes:
            return False
        self._residual(self.snes, self.x, self.work)
        self.last_error = self._error_of(self.work)
        solved = self._will_do()
        if self.adapts and not solved:
            self._loosen()
        if solved and self.observer:
            self.observer(self)
        return solved

    def _solve(self) -> int:
        """SNES iterations that took x to the solution. Raises StepFailed.

        Under compression the true Hessian may be indefinite. CG then stops with the descent it has, but
        if its very first direction has negative curvature it climbs, and the line search says so: the
        projected Hessian takes over for some iterations (_linearise).
        """
        self.projected = self.preset.projected > 0
        self._begin_afresh()
        self.snes.solve(None, self.x)
        iterations, most = self.snes.its, self.snes.getTolerances()[3]
        while self._climbs() and iterations < most:
            self.projected = True
            self.snes.solve(None, self.x)
            iterations += self.snes.its
            if self.snes.its == 0:  # neither Hessian leads on
                break
        self.projected = False
        if self.snes.reason < 0:
            self._residual(self.snes, self.snes.getSolution(), self.work)
            raise not_converged(self, iterations)
        return iterations

    def _begin_afresh(self) -> None:
        """SNESQN alone keeps what it has learnt, its pairs of the last step; a type set anew has none."""
        if self.snes.getType() == PETSc.SNES.Type.QN:
            self.snes.setType(PETSc.SNES.Type.KSPONLY)
            self.snes.setType(PETSc.SNES.Type.QN)
            self.snes.setFromOptions()

    def _climbs(self) -> bool:
        return self.preset.true_hessian and self.snes.reason == PETSc.SNES.ConvergedReason.DIVERGED_LINE_SEARCH

    def _residual(self, _: PETSc.SNES, x: PETSc.Vec, f: PETSc.Vec) -> None:
        self.local.begin()
        self.functional.gradient_at(x, f)
        self.local.end()

    def _objective(self, _: PETSc.SNES, x: PETSc.Vec) -> float:
        """g(x) - g(base): a line search compares values, and their difference must keep its digits.

        Close to the solution g falls by less than the rounding of x changes it: then any move is called
        a fall, so that Newton's full step is taken.
        """
        self.local.begin()
        change, distance = self.functional.change(x, self.base)
        self.local.end()
        flat = self.bound < FULL_STEP_ERROR and distance > 0 and (self.corrected or not self.doubts)
        return -1.0 if flat else change

    def _linearise(self, snes: PETSc.SNES, x: PETSc.Vec, _: PETSc.Mat, __: PETSc.Mat) -> None:
        """Called before each linear solve: A is constant, only the true Hessian and contact depend on x."""
        self.local.begin()
        self.unknowns.to_nodes(x, self.base)
        contact = self.functional.contact
        if self.preset.true_hessian:
            self.projected = self.projected and snes.its < (self.preset.projected or PROJECTED)
            given = self.corrected and not self.projected  # the estimate has linearised at this very x
            if not given:
                self.hessian.linearise(self.base, contact, self.projected)
            self._start_from_estimate(snes, given)
        elif self.touches:
            self.linear.contact.linearise(contact, self.base, False)
        changed = self.touches and self._precondition_contact()
        if self.preset.true_hessian or changed:
            self.operator.assemble()
        if changed:
            self.pmat.assemble()
        self.local.end()
        if self.preset.start_from_b:
            self._start_from_b(snes, x)

    def _precondition_contact(self) -> bool:
        """Add to the preconditioner's diagonal what bounds the contact blocks; whether that changed it.

        A + t^2 bound is no less than A plus the blocks, so that a direct solve with it is a step downhill too.
        """
        contact = self.functional.contact
        bound = contact.bound(self.base) if contact else np.zeros(self.lattice.owned, like=self.base)
        bound = bound[self.unknowns.free]
        bound = np.tile(bound, len(self.diagonal) // max(len(bound), 1))
        changed = self.comm.allreduce(not bool(np.array_equal(bound, self.added)), MPI.LOR)
        if changed:
            self._add_to_preconditioner(bound)
        return changed

    def _add_to_preconditioner(self, bound: np.ndarray) -> None:
        self.added = bound
        self.memory.write(self.scalar)[:] = self.diagonal + self.t2 * bound
        self.preconditioned.setDiagonal(self.scalar)

    def _start_from_b(self, snes: PETSc.SNES, x: PETSc.Vec) -> None:
        """CG solves A z = F for z = x - x_new; x_new = b = A x - F (Algorithm 1) is z = x - A x + F."""
        z, f = snes.getSolutionUpdate(), snes.getFunction()[0]
        self.operator.mult(x, z)
        z.aypx(-1.0, x)
        z.axpy(1.0, f)

    def _start_from_estimate(self, snes: PETSc.SNES, given: bool) -> None:
        """CG goes on from what the estimate at this x, if it was ``given``, found of the same correction."""
        if f"{self.prefix}ksp_initial_guess_nonzero" in PETSc.Options().getAll():
            return
        given = given and self.ksp.getType() != PETSc.KSP.Type.PREONLY  # that starts from nothing
        if given:
            self.estimate.correction.copy(snes.getSolutionUpdate())
        self.ksp.setInitialGuessNonzero(given)

    def _error_of(self, f: PETSc.Vec) -> float:
        """Relative error at the positions functional.q, where F is f; the bound on it while that is far too much."""
        functional, enough = self.functional, self.goal
        self.corrected = False
        self.residual, away = functional.dual_norm(f), functional.away()
        self.at_rounding = self.rounding.is_all_of(f)
        if not away > 0 or not np.isfinite(self.residual):  # the start x = y tells nothing yet
            return 0.0 if self.at_rounding else np.inf
        self.bound = self.residual / away
        if self.bound > self.ratio * self.early * enough and not self.at_rounding:
            return self.bound
        if self.bound <= enough:
            lowest = self.curvature.compression(functional.q).least_curvature
            if self.bound <= enough * lowest:
                return self.bound / lowest
        return self._estimated(f, away, enough)

    def _will_do(self) -> bool:
        """Whether the error that was said last is below what was asked for, or nothing but rounding is left."""
        return self.at_rounding or self.last_error <= self.goal

    def _estimated(self, f: PETSc.Vec, away: float, enough: float) -> float:
        """The error against x less its correction: where x has not come far, |x - y|_M is not yet |x* - y|_M."""
        length = self.estimate(f, self.residual, EARLY * enough * away if enough else np.inf)
        if not np.isfinite(length):
            self.alarmed = True
            return self.bound
        self.ratio, self.early, self.corrected = max(self.bound * away / length, 1.0), 1.0, True
        return length / self.functional.away(self.estimate.correction)

    def _converged(self, snes: PETSc.SNES, its: int, _: tuple[float, float, float]) -> int | None:
        reasons = PETSc.SNES.ConvergedReason
        f = self.work
        if its == 0 and self.inner is not self.snes:  # known since _is_solved
            self.unknowns.to_nodes(snes.getSolution(), self.functional.q)
        else:
            f = self._function(snes)
            self.last_error = self._error_of(f)
        self.alarmed = self.alarmed or self.ksp.reason == INDEFINITE
        if self.observer:
            self.observer(self)
        if not np.isfinite(self.residual):
            return reasons.DIVERGED_FNORM_NAN
        if self._will_do():
            if self.at_rounding:
                return reasons.CONVERGED_FNORM_ABS
            return reasons.CONVERGED_SNORM_RELATIVE if self.corrected else reasons.CONVERGED_FNORM_RELATIVE
        if self.budget and its >= self.budget:
            if not self.corrected:
                self.last_error = self._estimated(f, self.functional.away(), 0.0)
            return reasons.CONVERGED_ITS
        if self.adapts:
            self._loosen()
        return reasons.ITERATING

    def _function(self, snes: PETSc.SNES) -> PETSc.Vec:
        """F at SNES's iterate, which functional.q then is."""
        if self.inner is self.snes:
            self.unknowns.to_nodes(snes.getSolution(), self.functional.q)
            return snes.getFunction()[0]
        self._residual(snes, snes.getSolution(), self.work)  # with an NPC SNES's own function may not be F
        return self.work

    def _loosen(self) -> None:
        """Let the next linear solve leave what the step can do with: it need not gain more digits than are missing."""
        missing = self.bound / self.ratio
        rtol = SHARE * self.goal / missing
        self.ksp.setTolerances(rtol=min(max(rtol, self.tightest), LOOSEST))

    def _abandon(self) -> None:
        """After an error within PETSc its objects may be in the middle of something, and crash when they are destroyed: they
        stay, even when the interpreter ends."""
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(self))
        self.owned_objects = [owned for owned in self.owned_objects if isinstance(owned, ViewOfA)]

    def destroy(self) -> None:
        """Collective, and in the same order on all ranks; the garbage collector's would differ."""
        for owned in reversed(self.owned_objects):
            owned.destroy()
        forget_defaults(self.defaults)
