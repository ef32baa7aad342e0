"""Implicit Euler: a step of the scene is one step, solved by a solver that knows which nodes are free."""

from mpi4py import MPI

from msmpetsc import scene
from msmpetsc.model.build import Model
from msmpetsc.model.surroundings import Surroundings
from msmpetsc.solve.options import refuse_unused
from msmpetsc.solve.presets import find_preset
from msmpetsc.solve.state import State
from msmpetsc.solve.step import Stepper, StepResult


class ImplicitEuler:
    """The steps of one model; another solver takes over where an anchor lets go."""

    def __init__(
        self, comm: MPI.Comm, model: Model, surroundings: Surroundings, time: scene.Time, solver: scene.Solver
    ):
        self.comm, self.model, self.around = comm, model, surroundings
        self.time_step, self.solver = time.step, solver
        self.held = surroundings.held_at(self.time_step)
        self.stepper = self._new_stepper(self.time_step)

    def set_up(self) -> None:
        """Raises InputError for a preconditioner that this PETSc or matrix does not have (collective)."""
        self.stepper.set_up()

    def advance(self, state: State, time: float) -> tuple[StepResult, State]:
        """The step that ends at ``time``, and what the next one starts from (collective). Raises StepFailed."""
        self._let_go(time)
        around, q, q_previous = self.around, state.q, state.q_previous
        contact = around.contact(q, time, self.time_step)
        result = self.stepper.step(q, q_previous, around.load(time), contact, around.led(q, time))
        held = self.stepper.lattice.pinned
        return result, State(*around.reflect(result.position, result.previous, time, self.time_step, held))

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
            self.stepper.destroy()
            self.stepper = self._new_stepper(time)
            self.stepper.set_up()

    def refuse_unused_options(self, at_end: bool = False) -> None:
        """Raise InputError for PETSc options of the user that nothing has used (collective)."""
        refuse_unused(self.comm, self.stepper.defaults, at_end)

    def destroy(self) -> None:
        """Collective."""
        self.stepper.destroy()
