"""One implicit Euler step as one PETSc SNES (design: one step, many methods).

A step minimises g(x) = 1/2 (x - y)^T M (x - y) + t^2 (E(x) - x^T f_ext), y = 2 q_n - q_(n-1)
(paper Eq. 10-12), so it solves F(x) = grad g(x) = M (x - y) + t^2 (grad E(x) - f_ext) = 0.
"""

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.errors import InputError, StepFailed
from msmpetsc.model.elasticity import Elasticity
from msmpetsc.model.lattice import Lattice
from msmpetsc.model.penalty import Contact
from msmpetsc.solve.operators import (
    ContactBlocks,
    ScalarPreconditioner,
    ThreeColumns,
    TrueHessian,
    python_matrix,
    scaled_sum,
)
from msmpetsc.solve.presets import Preset, forget_defaults, set_defaults
from msmpetsc.solve.system import assemble
from msmpetsc.solve.unknowns import Unknowns

DEFAULT_ERROR = 1e-3
FULL_STEP_ERROR = 1e-5  # below it g, quadratic in the error, has nothing left to tell
ROUNDINGS = 3  # of a row of F: in free fall one was passed now and then
PROJECTED = 5  # iterations with the projected Hessian before the true one, which comes in faster, has another try
REASON = {value: name for name, value in vars(PETSc.SNES.ConvergedReason).items() if isinstance(value, int)}
KSP_REASON = {value: name for name, value in vars(PETSc.KSP.ConvergedReason).items() if isinstance(value, int)}


@dataclass(frozen=True)
class StepResult:
    """position (l, 3) [m], ghosts included; previous (l, 3) [m]: q_(n-1) for the next step, so that the velocity
    is (position - previous) / t; error: bound on the relative error of the step; iterations of SNES; ksp_its, the
    KSP iterations of all of them."""

    position: np.ndarray
    previous: np.ndarray
    error: float
    iterations: int
    ksp_its: int


class Stepper:
    """The solver of one lattice and time step; all PETSc objects it makes are destroyed by ``destroy``.

    error          : relative error at which a step is done; None for the preset's own rule
    max_iterations : a budget instead of a promise: the step is taken as it is then
    touches        : whether steps may be given a ``contact``

    The error of x is measured as |F(x)|_(M^-1) / |x - y|_M. It bounds the relative position error
    |x - x*|_M / |x - y|_M wherever E is convex between x and x*, for there the Hessian of g is at
    least M.
    """

    def __init__(
        self,
        comm: MPI.Comm,
        lattice: Lattice,
        time_step: float,
        preset: Preset,
        error: float | None = None,
        max_iterations: int | None = None,
        touches: bool = False,
    ):
        self.comm, self.lattice, self.preset = comm, lattice, preset
        self.elasticity = Elasticity(comm, lattice)
        self.t2 = time_step**2
        published = preset.iterations if error is None else None
        self.budget = max_iterations or published
        self.error = error if error is not None or self.budget else DEFAULT_ERROR
        self.unknowns = Unknowns(comm, lattice)
        self.q, self.y, self.base = (np.empty_like(lattice.nodes) for _ in range(3))
        self.gradient = np.empty_like(lattice.nodes)
        self.load = np.zeros((lattice.owned, 3))
        self.corrections = []  # x - y of the last steps, at most two, the newest first
        self.inverse_mass = np.tile(1 / lattice.mass[self.unknowns.free], 3)
        self.owned_objects = [self.unknowns]
        self.defaults = set_defaults(preset)
        try:
            self._create_solver(time_step, touches)
            self.rounding = self._rounding_of_residual()
        except PETSc.Error as error:
            self.destroy()
            raise InputError(f"PETSc refuses its options: {last_words(error)}") from None

    def _create_solver(self, time_step: float, touches: bool) -> None:
        self.matrix = self._keep(assemble(self.comm, self.unknowns, time_step))
        self.contact_blocks = ContactBlocks(self.unknowns, time_step) if touches else None
        # contact changes what A is preconditioned with, but not A
        self.preconditioner = self._keep(self.matrix.copy()) if touches else self.matrix
        self.scalar = self._keep(self.matrix.createVecLeft())
        self.matrix.getDiagonal(self.scalar)
        self.diagonal = self.scalar.array_r.copy()
        self.added = np.zeros(self.unknowns.size)  # to the preconditioner's diagonal
        if self.preset.true_hessian:
            context = self.hessian = TrueHessian(self.unknowns, self.elasticity, time_step, self.contact_blocks)
        else:
            context, self.hessian = ThreeColumns(self.matrix, self.contact_blocks), None
        self.operator = self._keep(python_matrix(self.unknowns, context, self.comm))
        self.x, self.f = map(self._keep, self.operator.createVecs())
        self.work = self._keep(self.f.duplicate())
        self.ksp = self._keep(PETSc.KSP().create(self.comm))
        pc = self.ksp.getPC()
        pc.setOptionsPrefix("three_columns_")  # leaves the bare -pc_ to the scalar preconditioner
        pc.setType(PETSc.PC.Type.PYTHON)
        pc.setPythonContext(ScalarPreconditioner(self.preconditioner))
        self.snes = self._keep(PETSc.SNES().create(self.comm))
        self.inner = self.snes
        if "npc_snes_type" in PETSc.Options().getAll():
            self.inner = self._keep(self.snes.getNPC())
        self.inner.setKSP(self.ksp)
        self.snes.setFunction(self._residual, self.f)
        self.snes.setJacobian(self._linearise, self.operator, self.operator)
        self.snes.setObjective(self._objective)
        self.snes.setConvergenceTest(self._converged)
        if self.preset.start_from_b:
            self.ksp.setInitialGuessNonzero(True)
        self.snes.setFromOptions()

    def _keep(self, owned: PETSc.Object) -> PETSc.Object:
        self.owned_objects.append(owned)
        return owned

    def set_up(self) -> None:
        """Build the preconditioner (a factorisation, for Cholesky) before the first step needs it.

        Raises InputError for a preconditioner that this PETSc or matrix does not have.
        """
        try:
            self.ksp.setOperators(self.operator, self.operator)
            self.ksp.setUp()
        except PETSc.Error as error:
            raise InputError(f"PETSc cannot set up the solver: {last_words(error)}") from None

    def step(
        self,
        q: np.ndarray,
        q_previous: np.ndarray,
        load: np.ndarray,
        contact: Contact | None = None,
        led: np.ndarray | None = None,
    ) -> StepResult:
        """q_(n+1) from q_n and q_(n-1), (l, 3) [m] each, ghosts included.

        load    : force (owned, 3) [N]
        contact : what presses on the nodes in this step
        led     : q_n with the held nodes where they will be, (l, 3) [m]; q_n itself if they stay

        Raises StepFailed on all ranks.
        """
        self.y = 2 * q - q_previous
        self.load, self.contact = load, contact
        self.q[:] = self.base[:] = q if led is None else led  # held nodes stay there
        self.reach = self.comm.allreduce(np.abs(q).max(initial=0), MPI.MAX)  # [m]
        self.last_error = self.residual = np.inf
        self._first_guess(q)
        iterations, ksp_its = (0, 0) if self._is_solved() else self._solve()
        self.unknowns.to_nodes(self.x, self.q)
        self.corrections = [self.q - self.y, *self.corrections[:1]]
        return StepResult(self.q.copy(), q, self.last_error, iterations, ksp_its)

    def _is_solved(self) -> bool:
        """Whether the first guess will do: an NPC would solve with A before SNES looks at its start."""
        if self.inner is self.snes:
            return False
        self._residual(self.snes, self.x, self.work)
        self.last_error = self._error_of(self.work)
        return self.last_error <= (self.error or 0.0)

    def _solve(self) -> tuple[int, int]:
        """SNES iterations and KSP iterations that took x to the solution. Raises StepFailed.

        Under compression the true Hessian may be indefinite. CG then stops with the descent it has, but
        if its very first direction has negative curvature it climbs, and the line search says so: the
        projected Hessian takes over for some iterations (_linearise).
        """
        its_before = 0 if self.inner is self.snes else self.inner.getLinearSolveIterations()
        self.snes.solve(None, self.x)
        # an NPC goes on counting
        iterations, ksp_its = self.snes.its, self.inner.getLinearSolveIterations() - its_before
        most = self.snes.getTolerances()[3]
        while self._climbs() and iterations < most:
            self.hessian.projected = True
            self.snes.solve(None, self.x)
            iterations, ksp_its = iterations + self.snes.its, ksp_its + self.inner.getLinearSolveIterations()
            if self.snes.its == 0:  # neither Hessian leads on
                break
        if self.hessian:
            self.hessian.projected = False
        if self.snes.reason < 0:
            raise StepFailed(self._failure())
        return iterations, ksp_its

    def _climbs(self) -> bool:
        return self.hessian is not None and self.snes.reason == PETSc.SNES.ConvergedReason.DIVERGED_LINE_SEARCH

    def _first_guess(self, q: np.ndarray) -> None:
        """Put the start of least g into x.

        Besides y, as published: the free flight y + t^2 M^(-1) f_ext, exact where no spring is stretched;
        y and the elastic corrections c = x - y of the last steps extrapolated, near in smooth motion; and
        q_n, which after an impact is not folded over as y may be, moved by what the free flight moves on average
        where nothing is held, so that a step that stops early keeps the momentum.
        """
        guesses = [self.y]
        if self.preset.extrapolate:
            flight = self.y.copy()
            flight[: self.lattice.owned] += self.t2 * self.load / self.lattice.mass[:, None]
            guesses += [flight, q + self._drift(flight - q)]
            if self.corrections:
                guesses.append(self.y + 2 * self.corrections[0] - self.corrections[-1])
        values = []
        for guess in guesses:
            self.unknowns.from_nodes(guess, self.x)
            values.append(self._objective(self.snes, self.x) if len(guesses) > 1 else 0.0)
        self.unknowns.from_nodes(guesses[int(np.argmin(values))], self.x)

    def _drift(self, moved: np.ndarray) -> np.ndarray | float:
        """Mean by mass (3,) of a free body's displacements (l, 3) [m]; 0 if some nodes are held."""
        if self.unknowns.total < self.lattice.table.total:
            return 0.0
        sums = np.append(self.lattice.mass @ moved[: self.lattice.owned], self.lattice.mass.sum())
        sums = self.comm.allreduce(sums)
        return sums[:3] / sums[3]

    def _residual(self, _: PETSc.SNES, x: PETSc.Vec, f: PETSc.Vec) -> None:
        """F(x) = M (x - y) + t^2 (grad E(x) - f_ext)."""
        self.unknowns.to_nodes(x, self.q)
        self.gradient[:] = 0
        self.elasticity.add_gradient(self.q, self.gradient)
        owned = self.lattice.owned
        self.gradient[:owned] -= self.load
        if self.contact:
            self.contact.add_gradient(self.q, self.gradient)
        scaled_sum(
            self.unknowns.free,
            self.lattice.mass,
            self.q[:owned] - self.y[:owned],
            self.t2,
            self.gradient,
            f.array.reshape(3, -1),
        )

    def _objective(self, _: PETSc.SNES, x: PETSc.Vec) -> float:
        """g(x) - g(base): a line search compares values, and their difference must keep its digits.

        Close to the solution g falls by less than the rounding of x changes it: then any move is called
        a fall, so that Newton's full step is taken.
        """
        self.unknowns.to_nodes(x, self.q)
        owned = slice(self.lattice.owned)
        moved = self.q[owned] - self.base[owned]
        inertia = 0.5 * self.lattice.mass @ (moved * (self.q[owned] + self.base[owned] - 2 * self.y[owned])).sum(axis=1)
        elastic = self.elasticity.change(self.q, self.base) - (moved * self.load).sum()
        if self.contact:
            elastic += self.contact.change(self.q, self.base)
        change, distance = self.comm.allreduce(np.array([inertia + self.t2 * elastic, (moved**2).sum()]))
        return -1.0 if self.last_error < FULL_STEP_ERROR and distance > 0 else change

    def _linearise(self, snes: PETSc.SNES, x: PETSc.Vec, _: PETSc.Mat, __: PETSc.Mat) -> None:
        """Called before each linear solve: A is constant, only the true Hessian and contact depend on x."""
        if self.preset.start_from_b:
            self._start_from_b(snes, x)
        changed = False
        if self.hessian or self.contact_blocks:
            self.unknowns.to_nodes(x, self.base)
        if self.contact_blocks:
            self.contact_blocks.linearise(self.contact, self.base, self.preset.true_hessian)
            changed = self._precondition_contact()
        if self.hessian:
            self.hessian.linearise(self.base)
            self.hessian.projected = self.hessian.projected and snes.its < PROJECTED
        if self.hessian or changed:
            self.operator.assemble()

    def _precondition_contact(self) -> bool:
        """Add to the preconditioner's diagonal what bounds the contact blocks; whether that changed it.

        A + t^2 bound is no less than A plus the blocks, so that a direct solve with it is a step downhill too.
        """
        bound = self.contact.bound(self.base)[self.unknowns.free] if self.contact else np.zeros(self.unknowns.size)
        changed = self.comm.allreduce(not np.array_equal(bound, self.added), MPI.LOR)
        if changed:
            self.added = bound
            self.scalar.array[:] = self.diagonal + self.t2 * bound
            self.preconditioner.setDiagonal(self.scalar)
        return changed

    def _start_from_b(self, snes: PETSc.SNES, x: PETSc.Vec) -> None:
        """CG solves A z = F for z = x - x_new; x_new = b = A x - F (Algorithm 1) is z = x - A x + F."""
        z, f = snes.getSolutionUpdate(), snes.getFunction()[0]
        self.operator.mult(x, z)
        z.aypx(-1.0, x)
        z.axpy(1.0, f)

    def _error_of(self, f: PETSc.Vec) -> float:
        """|F|_(M^-1) / |x - y|_M at the positions self.q; 0 where F is nothing but rounding."""
        f = f.array_r
        free = self.unknowns.free
        away = ((self.q[free] - self.y[free]) ** 2).sum(axis=1) @ self.lattice.mass[free]
        residual, away = np.sqrt(self.comm.allreduce(np.array([f * self.inverse_mass @ f, away])))
        self.residual = residual
        if residual <= self.rounding * self.reach:
            return 0.0
        return residual / away if away > 0 else np.inf  # the start x = y tells nothing yet

    def _rounding_of_residual(self) -> float:
        """|F|_(M^-1) that rounding alone leaves, for each metre of a coordinate: some eps of each row's diagonal."""
        rows = 3 * (ROUNDINGS * np.finfo(float).eps * self.diagonal) ** 2 @ self.inverse_mass[: self.unknowns.size]
        return np.sqrt(self.comm.allreduce(rows))

    def _converged(self, snes: PETSc.SNES, its: int, _: tuple[float, float, float]) -> int | None:
        reasons = PETSc.SNES.ConvergedReason
        # with an NPC on the left SNES's own function is not F
        self._residual(snes, snes.getSolution(), self.work)
        self.last_error = self._error_of(self.work)
        if not np.isfinite(self.residual):
            return reasons.DIVERGED_FNORM_NAN
        if self.last_error <= (self.error or 0.0):
            return reasons.CONVERGED_FNORM_RELATIVE
        if self.budget and its >= self.budget:
            return reasons.CONVERGED_ITS
        return reasons.ITERATING

    def _failure(self) -> str:
        advice = "a smaller time.step, another preset (newton), or a looser solver.error"
        reason = REASON.get(self.snes.reason, str(self.snes.reason))
        if self.snes.reason == PETSc.SNES.ConvergedReason.DIVERGED_LINEAR_SOLVE:
            ksp = KSP_REASON.get(self.ksp.reason, str(self.ksp.reason))
            reason += f" (KSP {ksp} after {self.ksp.its} its)"
            advice = "a looser -ksp_rtol, a larger -ksp_max_it, or another -pc_type"
        return (
            f"did not converge: {reason} after {self.snes.its} iterations, "
            f"residual |F| = {self.residual:.2e}, relative error {self.last_error:.2e}; try {advice}"
        )

    def destroy(self) -> None:
        """Collective, and in the same order on all ranks; the garbage collector's would differ."""
        for owned in reversed(self.owned_objects):
            owned.destroy()
        forget_defaults(self.defaults)


def last_words(error: PETSc.Error) -> str:
    """What a PETSc error says, without the calls it came through."""
    lines = str(error).splitlines()
    said = [line.partition("] ")[2] for line in lines if line.startswith("[") and "() at " not in line]
    return said[-1] if said else lines[0]
