"""Implicit Euler: a step of the scene is one step, solved by a solver that knows which nodes are free."""

import numpy as np
from mpi4py import MPI

from msmpetsc import scene
from msmpetsc.model.build import Model
from msmpetsc.model.surroundings import Surroundings
from msmpetsc.solve.measured import Measured, Trace
from msmpetsc.solve.options import refuse_unused
from msmpetsc.solve.presets import find_preset
from msmpetsc.solve.reference import PREFIX, Problem, Reference
from msmpetsc.solve.state import State
from msmpetsc.solve.step import Stepper, StepResult


class ImplicitEuler:
    """The steps of one model; another solver takes over where an anchor lets go."""

    def __init__(
        self,
        comm: MPI.Comm,
        model: Model,
        surroundings: Surroundings,
        time: scene.Time,
        solver: scene.Solver,
        measured: Measured = Measured(),
    ):
        self.comm, self.model, self.around = comm, model, surroundings
        self.time_step, self.solver, self.measured = time.step, solver, measured
        self.held = surroundings.held_at(self.time_step)
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
        around, q = self.around, state.q
        contact = around.contact(q, time, self.time_step)
        self.problem = Problem(q, state.q_previous, around.load(time), contact, around.led(q, time))
        result = self.stepper.step(**vars(self.problem))
        held = self.stepper.lattice.pinned
        return result, State(*around.reflect(result.position, result.previous, time, self.time_step, held))

    def follow(self) -> None:
        """Trace the step that comes next."""
        self.trace = Trace()
        self.trace.follow(self.stepper)

    def true_errors(self, index: int, result: StepResult) -> tuple[np.ndarray, dict | None]:
        """Position and energy error of the step taken last, and its trace if that was asked for (collective)."""
        if self.reference is None:
            lattice = self.stepper.lattice
            self.reference = Reference(self.comm, lattice, self.time_step, touches=bool(self.model.penalties))
        trace, self.trace, self.stepper.observer = self.trace, None, None
        positions = [*(trace.positions if trace else []), result.position]
        errors = self.reference.errors(self.problem, positions)
        return errors[-1], trace.told(index, errors[:-1]) if trace else None

    def _new_stepper(self, time: float) -> Stepper:
        """The solver while the same nodes are held as at ``time``: these are no unknowns."""
        solver = self.solver
        return Stepper(
            self.comm,
            self.model.lattice.pin(self.around.pinned_at(time)),
            self.time_step,
            find_preset(solver.preset),
            solver.error,
            solver.max_iterations,
            touches=bool(self.model.penalties),
        )

    def _let_go(self, time: float) -> None:
        """Another solver where an anchor's time has come (collective)."""
        held = self.around.held_at(time)
        if len(held) < len(self.held):
            self.held = held
            self.destroy()
            self.stepper, self.reference = self._new_stepper(time), None
            self.stepper.set_up()

    def refuse_unused_options(self, at_end: bool = False) -> None:
        """Raise InputError for PETSc options of the user that nothing has used (collective)."""
        reference = self.reference.stepper.defaults if self.reference else set()
        awaited = PREFIX if self.measured != Measured() else None
        refuse_unused(self.comm, self.stepper.defaults | reference, at_end, awaited)

    def destroy(self) -> None:
        """Collective."""
        if self.reference:
            self.reference.destroy()
        self.stepper.destroy()
