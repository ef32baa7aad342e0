"""Implicit steps: a step of the scene is one minimisation, solved by a solver that knows which nodes are free.

Implicit Euler and BDF2 both look for the x where  M (x - y) + tau^2 (grad E(x) - f_ext) = 0;  they differ in y, what
x were without forces, and in tau, a share of the time step t.
"""

from dataclasses import replace

import numpy as np
from mpi4py import MPI

from msmpetsc.errors import StepFailed
from msmpetsc.model.build import Model
from msmpetsc.model.checkpoint import Checkpoint
from msmpetsc.model.environment import Environment
from msmpetsc.scene import schema as scene
from msmpetsc.solve.instrumentation import Measured, Trace
from msmpetsc.solve.integrators.state import State
from msmpetsc.solve.nonlinear.reference import PREFIX, Problem, Reference
from msmpetsc.solve.nonlinear.step import Stepper, StepResult
from msmpetsc.solve.options import refuse_unused
from msmpetsc.solve.presets import find_preset

MOST_SOLVES = 10  # of a step, for nodes that pass through a box


class ImplicitEuler:
    """The steps of one model; another solver takes over where an anchor lets go.

        v_(n+1) = v_n + t M^(-1) (f_ext - grad E(q_(n+1))),    q_(n+1) = q_n + t v_(n+1)

    so that y = q_n + t v_n = 2 q_n - q_(n-1) and tau = t (Eq. 10-12).

    prefix : of its PETSc options
    """

    SHARE = 1.0  # tau / t
    looks_back = False  # whether it has a use for State.history

    def __init__(
        self,
        comm: MPI.Comm,
        model: Model,
        environment: Environment,
        time: scene.Time,
        solver: scene.Solver,
        measured: Measured = Measured(),
        prefix: str = "",
    ):
        self.comm, self.model, self.around, self.prefix = comm, model, environment, prefix
        self.time_step, self.tau = time.step, self.SHARE * time.step
        self.solver, self.measured = solver, measured
        self.held = environment.anchors_at(self.time_step)
        self.stepper = self._new_stepper(self.time_step)
        self.reference, self.trace = None, None

    @property
    def unknowns(self) -> int:
        """Free nodes of this rank."""
        return self.stepper.unknowns.size

    def set_up(self) -> None:
        """Raises InputError for a preconditioner that this PETSc or matrix does not have (collective)."""
        self.stepper.set_up()

    def advance(self, state: State, time: float) -> tuple[StepResult, State]:
        """The step that ends at ``time``, and what the next one starts from (collective). Raises StepFailed."""
        self._let_go(time)
        result, sides = self._solve(state.q, 2 * state.q - state.q_previous, time, self.time_step, state.sides)
        after, before, work = self.around.reflect(
            result.position, result.previous, time, self.time_step, self.stepper.lattice.pinned, sides
        )
        return replace(result, work=work), State(after, before, sides=sides)

    def _solve(
        self, q: np.ndarray, y: np.ndarray, time: float, time_step: float, before: np.ndarray | None
    ) -> tuple[StepResult, np.ndarray]:
        """The x that belongs to y, as it will be at ``time``, and the sides that it was found with.

        Which face pushes a node out of a box is settled before the step is solved, by the way to y. Where the way to x
        tells otherwise the step is solved again; from then on a node that has a face keeps it, so that this ends.
        """
        around, iterations, ksp_its = self.around, 0, 0
        way = {"time": time, "time_step": time_step, "before": before, "held": self.stepper.lattice.pinned}
        sides = around.contact_faces(q, y, **way)
        for solves in range(MOST_SOLVES):
            contact = around.contact(q, time, time_step, sides)
            self.problem = Problem(q, y, around.load(time), contact, around.prescribed(q, time))
            result = self.stepper.step(**vars(self.problem))
            iterations, ksp_its = iterations + result.iterations, ksp_its + result.ksp_its
            met = around.contact_faces(q, result.position, **way)
            settled = np.where(sides > 0, sides, met) if solves else met
            if not self._passes(result.position, time, sides, settled):
                if around.penalties:  # what reflects goes by the way to x alone
                    met[around.pressing] = np.where(settled > 0, settled, sides)[around.pressing]
                return replace(result, iterations=iterations, ksp_its=ksp_its), met
            sides = settled
        raise StepFailed(
            f"has nodes that pass through an obstacle, solved {MOST_SOLVES} times with the face that each came in by; "
            'try a smaller time.step, or safety.on_failure = "substep"',
            "contact",
        )

    def _passes(self, x: np.ndarray, time: float, sides: np.ndarray, met: np.ndarray) -> bool:
        """Whether any node on its way to x has met what did not push it (collective)."""
        if not (self.around.has_sides and self.around.penalties):
            return False
        return self.comm.allreduce(not self.around.same_push(x, time, sides, met), MPI.LOR)

    def follow(self) -> None:
        """Trace the step that comes next."""
        self.trace = Trace()
        self.trace.follow(self.stepper)

    def true_errors(self, index: int, result: StepResult) -> tuple[np.ndarray, dict | None]:
        """Position and energy error of the step taken last, and its trace if that was asked for (collective)."""
        if self.reference is None:
            lattice = self.stepper.lattice
            self.reference = Reference(self.comm, lattice, self.tau, touches=bool(self.model.penalties))
        trace, self.trace, self.stepper.observer = self.trace, None, None
        positions = [*(trace.positions if trace else []), result.position]
        errors = self.reference.errors(self.problem, positions)
        return errors[-1], trace.told(index, errors[:-1]) if trace else None

    def _new_stepper(self, time: float) -> Stepper:
        """The solver while the same nodes are held as at ``time``: these are no unknowns."""
        solver = self.solver
        return Stepper(
            self.comm,
            self.model.lattice.pin(self.around.fixed_at(time)),
            self.tau,
            find_preset(solver.preset),
            solver.error,
            solver.max_iterations,
            touches=bool(self.model.penalties),
            prefix=self.prefix,
        )

    def _let_go(self, time: float) -> None:
        """Another solver where an anchor's time has come (collective)."""
        held = self.around.anchors_at(time)
        if len(held) < len(self.held):
            self.held = held
            self.destroy()
            self.stepper, self.reference = self._new_stepper(time), None
            self.stepper.set_up()

    def save(self, saved: Checkpoint, _: State) -> None:
        self.stepper.save(saved)

    def restore(self, saved: Checkpoint, _: State, time: float) -> None:
        """Go on after a step that ended at ``time`` (collective)."""
        self._let_go(time)
        self.stepper.restore(saved)

    def forget(self) -> None:
        """Let the steps so far leave no trace in the next (collective)."""
        self.stepper.restore(Checkpoint())

    def refuse_unused_options(self, at_end: bool = False, awaited: tuple[str, ...] = ()) -> None:
        """Raise InputError for PETSc options of the user that nothing has used (collective).

        awaited : prefixes of solvers that may still be made
        """
        reference = self.reference.stepper.defaults if self.reference else set()
        if self.measured != Measured() and not at_end:
            awaited = (*awaited, PREFIX)
        refuse_unused(self.comm, self.stepper.defaults | reference, at_end, awaited)

    def destroy(self) -> None:
        """Collective."""
        if self.reference:
            self.reference.destroy()
        self.stepper.destroy()


class Bdf2(ImplicitEuler):
    """The backward differentiation formula of second order, of q and of v:

        q_(n+1) = (4 q_n - q_(n-1)) / 3 + tau v_(n+1),    v_(n+1) = (4 v_n - v_(n-1)) / 3 + tau a_(n+1),    tau = 2/3 t

    (Hairer and Wanner, Solving Ordinary Differential Equations II, III.1), so that
    y = (4 q_n - q_(n-1)) / 3 + tau (4 v_n - v_(n-1)) / 3.
    """

    SHARE = 2 / 3
    looks_back = True

    def advance(self, state: State, time: float) -> tuple[StepResult, State]:
        """As of implicit Euler, but a node that bounces off stays where it is, and its history becomes what leads there
        with its new velocity and the acceleration that it has: set back against its springs, as the paper has it, or
        without that acceleration, which its neighbours feel the other end of, a ball gained a fifth of its energy.
        """
        self._let_go(time)
        q, v, began = state.q, state.velocity(self.time_step), 0
        history = state.history
        if history is None:
            history, began = self._history(q, v, time, state.sides)
        q_0, v_0 = history
        y = (4 * q - q_0 + self.tau * (4 * v - v_0)) / 3
        result, sides = self._solve(q, y, time, self.time_step, state.sides)
        v_1 = (3 * result.position - 4 * q + q_0) / (2 * self.time_step)
        previous = result.position - self.time_step * v_1
        a = 0.5 * (3 * v_1 - 4 * v + v_0) * self.time_step  # times t^2
        before, work = self.around.turn(
            result.position, previous, a, time, self.time_step, self.stepper.lattice.pinned, sides
        )
        result = replace(result, previous=previous, ksp_its=result.ksp_its + began, work=work)
        if before is not previous:
            struck = (before != previous).any(axis=1)[:, None]
            v_after = (result.position - before - a) / self.time_step
            q, v = np.where(struck, before + 0.5 * a, q), np.where(struck, v_after, v)
        return result, State(result.position, before, (q, v), sides)

    def _history(
        self, q: np.ndarray, v: np.ndarray, time: float, sides: np.ndarray | None
    ) -> tuple[tuple[np.ndarray, np.ndarray], int]:
        """What would have led to q and v with the acceleration of an implicit Euler step of tau from there, which is
        the true one but for a part of first order; and the KSP iterations that this takes."""
        t, tau = self.time_step, self.tau
        result, _ = self._solve(q, q + tau * v, time - t + tau, tau, sides)
        a = ((result.position - q) / tau - v) / tau
        return (q - t * v + t**2 / 2 * a, v - t * a), result.ksp_its
