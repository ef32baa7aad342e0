"""The run: one implicit Euler step after another, those that are stored yielded as frames."""

from collections.abc import Iterator
from dataclasses import dataclass
from time import perf_counter

import numpy as np
from mpi4py import MPI

from msmpetsc.errors import InputError, StepFailed
from msmpetsc.model.build import Model
from msmpetsc.model.frame import Frame
from msmpetsc.model.penalty import Contact
from msmpetsc.model.surroundings import Surroundings
from msmpetsc.scene import Scene
from msmpetsc.solve.options import refuse_unused
from msmpetsc.solve.presets import find_preset
from msmpetsc.solve.step import Stepper, StepResult
from msmpetsc.solve.surface import SurfaceMotion


@dataclass(frozen=True)
class State:
    """q_n and q_(n-1), (l, 3) [m], ghosts included: what the next step starts from. After contact they are
    not what the frame shows, which is the step as it was solved."""

    q: np.ndarray
    q_previous: np.ndarray


@dataclass
class Effort:
    """Of the steps since the frame stored before: the numbers of Frame of these names."""

    step_error: float = 0.0
    iterations: int = 0
    ksp_its: int = 0
    wall_time: float = 0.0  # [s]

    def add(self, result: StepResult, wall_time: float) -> None:
        self.step_error = max(self.step_error, result.error)
        self.iterations += result.iterations
        self.ksp_its += result.ksp_its
        self.wall_time += wall_time


class Simulation:
    """Steps a model from rest. Use as a context manager: its PETSc objects are destroyed on leaving."""

    def __init__(self, comm: MPI.Comm, scene: Scene, model: Model):
        self.comm, self.model, self.time_step = comm, model, scene.time.step
        self.steps, self.every, self.solver = scene.time.steps, scene.output.every, scene.solver
        self.surroundings = Surroundings(model)
        self.held = self.surroundings.held_at(self.time_step)
        self.stepper = self._new_stepper(self.time_step)
        self.surface = SurfaceMotion(comm, model.lattice, model.embedding) if model.embedding else None
        self.state = State(model.lattice.nodes.copy(), model.lattice.nodes.copy())

    @property
    def stored(self) -> int:
        """Number of frames, frame 0 included."""
        return 1 + -(-self.steps // self.every)

    def frames(self) -> Iterator[Frame]:
        """Frame 0, then one frame for every ``every``-th step and for the last (collective). ``state`` always goes
        with the last frame.

        Raises StepFailed on all ranks, naming the step.
        """
        start = StepResult(self.state.q, self.state.q_previous, 0.0, 0, 0)
        yield self._frame(0, start, Effort())
        effort = Effort()
        for index in range(1, self.steps + 1):
            begin = perf_counter()
            result, contact = self._step(index)
            effort.add(result, perf_counter() - begin)
            if index % self.every == 0 or index == self.steps:
                yield self._frame(index, result, effort, contact)
                effort = Effort()

    def _step(self, index: int) -> tuple[StepResult, Contact | None]:
        """The step that ends at index * t, and what pressed in it; ``state`` moves on (collective)."""
        around, state, time = self.surroundings, self.state, index * self.time_step
        self._let_go(time)
        contact = around.contact(state.q, time, self.time_step)
        try:
            result = self.stepper.step(
                state.q, state.q_previous, around.load(time), contact, around.led(state.q, time)
            )
        except StepFailed as failure:
            raise StepFailed(f"frame {index} (t = {time:.6g} s) {failure}") from None
        held = self.stepper.lattice.pinned
        self.state = State(*around.reflect(result.position, result.previous, time, self.time_step, held))
        return result, contact

    def _new_stepper(self, time: float) -> Stepper:
        """The solver while the same nodes are held as at ``time``: these are no unknowns."""
        solver = self.solver
        return Stepper(
            self.comm,
            self.model.lattice.pin(self.surroundings.pinned_at(time)),
            self.time_step,
            find_preset(solver.preset),
            solver.error,
            solver.max_iterations,
            touches=bool(self.model.penalties),
        )

    def _let_go(self, time: float) -> None:
        """Another solver where an anchor's time has come (collective)."""
        held = self.surroundings.held_at(time)
        if len(held) < len(self.held):
            self.held = held
            self.stepper.destroy()
            self.stepper = self._new_stepper(time)
            self.stepper.set_up()

    def refuse_unused_options(self, at_end: bool = False) -> None:
        """Raise InputError for PETSc options of the user that nothing has used (collective)."""
        refuse_unused(self.comm, self.stepper.defaults, at_end)

    def _frame(self, index: int, result: StepResult, effort: Effort, contact: Contact | None = None) -> Frame:
        lattice, time = self.model.lattice, index * self.time_step
        owned = slice(lattice.owned)
        position = result.position[owned]
        velocity = (position - result.previous[owned]) / self.time_step
        sums = self.comm.allreduce(
            np.array(
                [
                    0.5 * lattice.mass @ (velocity**2).sum(axis=1),
                    self.stepper.elasticity.energy(result.position),
                    -(self.surroundings.load(time) * position).sum(),
                    contact.energy(position) if contact else 0.0,
                    *(lattice.mass @ velocity),
                ]
            )
        )
        return Frame(
            index=index,
            time=time,
            position=position,
            surface=self.surface(position) if self.surface else None,
            kinetic=sums[0],
            elastic=sums[1],
            potential=sums[2],
            contact=sums[3],
            momentum=sums[4:],
            **vars(effort),
        )

    def __enter__(self) -> "Simulation":
        try:
            self.stepper.set_up()
        except InputError:
            self.destroy()
            raise
        return self

    def __exit__(self, *_) -> None:
        self.destroy()

    def destroy(self) -> None:
        self.stepper.destroy()
        if self.surface:
            self.surface.destroy()
