"""The run: one implicit Euler step after another, each yielded as a frame."""

from collections.abc import Iterator
from dataclasses import dataclass
from time import perf_counter

import numpy as np
from mpi4py import MPI

from msmpetsc.errors import InputError, StepFailed
from msmpetsc.model.build import Model
from msmpetsc.model.energy import elastic_energy
from msmpetsc.model.frame import Frame
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


class Simulation:
    """Steps a model from rest. Use as a context manager: its PETSc objects are destroyed on leaving."""

    def __init__(self, comm: MPI.Comm, scene: Scene, model: Model):
        self.comm, self.model, self.time_step = comm, model, scene.time.step
        self.steps = scene.time.steps
        solver = scene.solver
        self.stepper = Stepper(
            comm, model.lattice, scene.time.step, find_preset(solver.preset), solver.error, solver.max_iterations
        )
        self.surface = SurfaceMotion(comm, model.lattice, model.embedding) if model.embedding else None
        self.state = State(model.lattice.nodes.copy(), model.lattice.nodes.copy())

    def frames(self) -> Iterator[Frame]:
        """Frame 0, then one frame a step (collective). ``state`` always goes with the last frame.

        Raises StepFailed on all ranks, naming the frame.
        """
        start = StepResult(self.state.q, 0.0, 0, 0)
        yield self._frame(0, start, self.state.q, 0.0)
        for index in range(1, self.steps + 1):
            begin = perf_counter()
            before = self.state.q
            load = self._load(index * self.time_step)
            try:
                result = self.stepper.step(before, self.state.q_previous, load)
            except StepFailed as failure:
                raise StepFailed(f"frame {index} (t = {index * self.time_step:.6g} s) {failure}") from None
            self.state = self._after_contact(State(result.position, before))
            yield self._frame(index, result, before, perf_counter() - begin)

    def refuse_unused_options(self, at_end: bool = False) -> None:
        """Raise InputError for PETSc options of the user that nothing has used (collective)."""
        refuse_unused(self.comm, self.stepper.defaults, at_end)

    def _load(self, time: float) -> np.ndarray:
        """External force f_ext (owned, 3) [N]."""
        total = np.zeros((self.model.lattice.owned, 3))
        for load in self.model.loads:
            if load.acts_at(time):
                total += load.force
        return total

    def _after_contact(self, state: State) -> State:
        for plane in self.model.planes:
            state = State(*plane.reflect(state.q, state.q_previous))
        return state

    def _frame(self, index: int, result: StepResult, before: np.ndarray, wall_time: float) -> Frame:
        lattice, time = self.model.lattice, index * self.time_step
        owned = slice(lattice.owned)
        position = result.position[owned]
        velocity = (position - before[owned]) / self.time_step
        sums = self.comm.allreduce(
            np.array(
                [
                    0.5 * lattice.mass @ (velocity**2).sum(axis=1),
                    elastic_energy(result.position, *lattice.elastic_owned),
                    -(self._load(time) * position).sum(),
                    *(lattice.mass @ velocity),
                ]
            )
        )
        return Frame(
            index=index,
            time=time,
            position=position,
            surface=self.surface(position) if self.surface else None,
            step_error=result.error,
            iterations=result.iterations,
            ksp_its=result.ksp_its,
            kinetic=sums[0],
            elastic=sums[1],
            potential=sums[2],
            momentum=sums[3:],
            wall_time=wall_time,
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
