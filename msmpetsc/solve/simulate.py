"""The run: one implicit Euler step after another, each yielded as a frame."""

from collections.abc import Iterator
from dataclasses import dataclass
from time import perf_counter

import numpy as np
from mpi4py import MPI

from msmpetsc.errors import InputError, StepFailed
from msmpetsc.model.anchor import Anchor
from msmpetsc.model.build import Model
from msmpetsc.model.frame import Frame
from msmpetsc.model.penalty import Contact
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
        self.steps, self.solver = scene.time.steps, scene.solver
        self.held = self._held_at(self.time_step)
        self.stepper = self._new_stepper()
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
            before, time = self.state.q, index * self.time_step
            self._let_go(time)
            contact = self._contact(time)
            try:
                result = self.stepper.step(before, self.state.q_previous, self._load(time), contact, self._led(time))
            except StepFailed as failure:
                raise StepFailed(f"frame {index} (t = {time:.6g} s) {failure}") from None
            self.state = self._after_reflection(State(result.position, before), time)
            yield self._frame(index, result, before, perf_counter() - begin, contact)

    def _new_stepper(self) -> Stepper:
        """The solver while the same nodes are held: these are no unknowns."""
        lattice, solver = self.model.lattice, self.solver
        for anchor in self.held:
            lattice = lattice.pin(anchor.where)
        return Stepper(
            self.comm,
            lattice,
            self.time_step,
            find_preset(solver.preset),
            solver.error,
            solver.max_iterations,
            touches=bool(self.model.penalties),
        )

    def _held_at(self, time: float) -> list[Anchor]:
        return [anchor for anchor in self.model.anchors if anchor.holds_at(time)]

    def _let_go(self, time: float) -> None:
        """Another solver where an anchor's time has come (collective)."""
        held = self._held_at(time)
        if len(held) < len(self.held):
            self.held = held
            self.stepper.destroy()
            self.stepper = self._new_stepper()
            self.stepper.set_up()

    def _led(self, time: float) -> np.ndarray | None:
        """q_n with the anchored nodes where they will be at ``time``, (l, 3) [m]."""
        if not self.held:
            return None
        q = self.state.q.copy()
        for anchor in self.held:
            q[anchor.where] = self.model.lattice.nodes[anchor.where] + anchor.path.at(time)
        return q

    def _contact(self, time: float) -> Contact | None:
        """What presses in the step that ends at ``time``."""
        owned = self.model.lattice.owned
        q = self.state.q[:owned]
        presses = [p.during(q, time, self.time_step) for p in self.model.penalties if p.obstacle.acts_at(time)]
        return Contact(presses, owned) if presses else None

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

    def _after_reflection(self, state: State, time: float) -> State:
        q, q_previous = state.q, state.q_previous
        for reflection in self.model.reflections:
            q, q_previous = reflection.reflect(q, q_previous, time, self.time_step)
        if q is state.q:
            return state
        free = ~self.stepper.lattice.pinned[:, None]  # what is held does not give way
        return State(np.where(free, q, state.q), np.where(free, q_previous, state.q_previous))

    def _frame(
        self, index: int, result: StepResult, before: np.ndarray, wall_time: float, contact: Contact | None = None
    ) -> Frame:
        lattice, time = self.model.lattice, index * self.time_step
        owned = slice(lattice.owned)
        position = result.position[owned]
        velocity = (position - before[owned]) / self.time_step
        sums = self.comm.allreduce(
            np.array(
                [
                    0.5 * lattice.mass @ (velocity**2).sum(axis=1),
                    self.stepper.elasticity.energy(result.position),
                    -(self._load(time) * position).sum(),
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
            step_error=result.error,
            iterations=result.iterations,
            ksp_its=result.ksp_its,
            kinetic=sums[0],
            elastic=sums[1],
            potential=sums[2],
            contact=sums[3],
            momentum=sums[4:],
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
