"""The run: one step after another, those that are stored yielded as frames."""

from collections.abc import Iterator
from dataclasses import dataclass
from time import perf_counter

import numpy as np
from mpi4py import MPI

from msmpetsc.errors import InputError, StepFailed
from msmpetsc.model.build import Model
from msmpetsc.model.elasticity import Elasticity
from msmpetsc.model.frame import Frame
from msmpetsc.model.surroundings import Surroundings
from msmpetsc.scene import Scene
from msmpetsc.solve.implicit_euler import ImplicitEuler
from msmpetsc.solve.measured import Measured
from msmpetsc.solve.state import State
from msmpetsc.solve.step import StepResult
from msmpetsc.solve.surface import SurfaceMotion
from msmpetsc.solve.verlet import Verlet

INTEGRATORS = {"implicit-euler": ImplicitEuler, "verlet": Verlet}


@dataclass
class Effort:
    """Of the steps since the frame stored before: the numbers of Frame of these names."""

    step_error: float = 0.0
    iterations: int = 0
    ksp_its: int = 0
    wall_time: float = 0.0  # [s]
    true_error: float = np.nan
    energy_error: float = np.nan

    def measure(self, errors: np.ndarray) -> None:
        """Of a step whose true errors were measured."""
        self.true_error, self.energy_error = np.fmax((self.true_error, self.energy_error), errors)

    def add(self, result: StepResult, wall_time: float) -> None:
        self.step_error = max(self.step_error, result.error)
        self.iterations += result.iterations
        self.ksp_its += result.ksp_its
        self.wall_time += wall_time


class Simulation:
    """Steps a model from rest. Use as a context manager: its PETSc objects are destroyed on leaving."""

    def __init__(self, comm: MPI.Comm, scene: Scene, model: Model, measured: Measured = Measured()):
        self.comm, self.model, self.time_step = comm, model, scene.time.step
        self.steps, self.every, self.measured, self.trace = scene.time.steps, scene.output.every, measured, None
        self.surroundings, self.elasticity = Surroundings(model), Elasticity(comm, model.lattice)
        integrator = INTEGRATORS[scene.time.integrator]
        self.integrator = integrator(comm, model, self.surroundings, scene.time, scene.solver, measured)
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
            if index == self.measured.trace:
                self.integrator.follow()
            begin = perf_counter()
            result = self._step(index)
            effort.add(result, perf_counter() - begin)
            if self.measured.asks(index):
                errors, trace = self.integrator.true_errors(index, result)
                effort.measure(errors)
                self.trace = trace or self.trace
            if index % self.every == 0 or index == self.steps:
                yield self._frame(index, result, effort)
                effort = Effort()

    def _step(self, index: int) -> StepResult:
        """The step that ends at index * t; ``state`` moves on (collective)."""
        time = index * self.time_step
        try:
            result, self.state = self.integrator.advance(self.state, time)
        except StepFailed as failure:
            raise StepFailed(f"frame {index} (t = {time:.6g} s) {failure}") from None
        return result

    def refuse_unused_options(self, at_end: bool = False) -> None:
        """Raise InputError for PETSc options of the user that nothing has used (collective)."""
        self.integrator.refuse_unused_options(at_end)

    def _frame(self, index: int, result: StepResult, effort: Effort) -> Frame:
        lattice, time = self.model.lattice, index * self.time_step
        owned, contact = slice(lattice.owned), self.surroundings.push(time)
        position = result.position[owned]
        velocity = (position - result.previous[owned]) / self.time_step
        sums = self.comm.allreduce(
            np.array(
                [
                    0.5 * lattice.mass @ (velocity**2).sum(axis=1),
                    self.elasticity.energy(result.position),
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
            self.integrator.set_up()
        except InputError:
            self.destroy()
            raise
        return self

    def __exit__(self, *_) -> None:
        self.destroy()

    def destroy(self) -> None:
        self.integrator.destroy()
        if self.surface:
            self.surface.destroy()
