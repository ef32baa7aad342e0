"""The run: one step after another, those that are stored yielded as frames."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import to_host
from msmpetsc.comm import on_root
from msmpetsc.errors import InputError, StepFailed
from msmpetsc.model.build import Model, to_device
from msmpetsc.model.checkpoint import Checkpoint
from msmpetsc.model.elasticity import Elasticity
from msmpetsc.model.environment import Environment
from msmpetsc.model.frame import Frame
from msmpetsc.scene.schema import Scene
from msmpetsc.solve.energy_balance import EnergyBalance
from msmpetsc.solve.instrumentation import Measured
from msmpetsc.solve.integrators.implicit import Bdf2, ImplicitEuler
from msmpetsc.solve.integrators.state import State
from msmpetsc.solve.integrators.verlet import Verlet
from msmpetsc.solve.linear.surface import SurfaceMotion
from msmpetsc.solve.monitors import Watch
from msmpetsc.solve.nonlinear.reference import PREFIX as REFERENCE
from msmpetsc.solve.nonlinear.reference import PRESET
from msmpetsc.solve.nonlinear.step import StepResult
from msmpetsc.solve.options import refuse_bad_values, refuse_unused
from msmpetsc.solve.petsc.device import sender
from msmpetsc.solve.presets import Preset, find_preset
from msmpetsc.solve.recovery import PREFIX as FALLBACK
from msmpetsc.solve.recovery import ROBUST, Done, Rescue

INTEGRATORS = {"implicit-euler": ImplicitEuler, "bdf2": Bdf2, "verlet": Verlet}


def solvers_of(scene: Scene, measured: Measured) -> dict[str, tuple[Preset, int]]:
    """The solvers of a run: prefix of their PETSc options -> preset and budget of iterations."""
    solvers = {}
    if INTEGRATORS[scene.time.integrator] is not Verlet:
        solvers[""] = find_preset(scene.solver.preset), scene.solver.max_iterations or 0
    if scene.safety.on_failure == "fallback":
        solvers[FALLBACK] = find_preset(ROBUST), 0
    if measured != Measured():
        solvers[REFERENCE] = find_preset(PRESET), 0
    return solvers


def refuse_bad_options(comm: MPI.Comm, scene: Scene, measured: Measured) -> None:
    """Raise InputError for PETSc options that the solvers of this scene refuse, before there is anything to solve."""
    solvers = solvers_of(scene, measured)
    if "" not in solvers:
        refuse_unused(comm, set(), at_end=True, awaited=tuple(solvers))
    on_root(comm, lambda: refuse_bad_values(solvers))


WHOLE = Done()  # a step that needed no rescue


@dataclass
class Effort:
    """Of the steps since the frame stored before: the numbers of Frame of these names."""

    step_error: float = 0.0
    iterations: int = 0
    ksp_its: int = 0
    wall_time: float = 0.0  # [s]
    true_error: float = np.nan
    energy_error: float = np.nan
    substeps: int = 0
    fallbacks: int = 0
    energy_gained: float = 0.0  # [J]

    def measure(self, errors: np.ndarray) -> None:
        """Of a step whose true errors were measured."""
        self.true_error, self.energy_error = np.fmax((self.true_error, self.energy_error), errors)

    def add(self, result: StepResult, done: Done, wall_time: float) -> None:
        self.step_error = max(self.step_error, result.error)
        self.substeps += done.substeps
        self.fallbacks += done.fallbacks
        self.iterations += result.iterations
        self.ksp_its += result.ksp_its
        self.wall_time += wall_time


class Simulation:
    """Steps a model from its start. Use as a context manager: its PETSc objects are destroyed on leaving."""

    def __init__(self, comm: MPI.Comm, scene: Scene, model: Model, measured: Measured = Measured()):
        model = to_device(model, sender(comm))
        self.comm, self.model, self.time_step = comm, model, scene.time.step
        self.steps, self.every, self.measured, self.trace = scene.time.steps, scene.output.every, measured, None
        self.environment, self.elasticity = Environment(model), Elasticity(comm, model.lattice)
        integrator = INTEGRATORS[scene.time.integrator]
        self.integrator = integrator(comm, model, self.environment, scene.time, scene.solver, measured)
        swings = scene.time.integrator != "implicit-euler"
        self.balance = EnergyBalance(comm, model.lattice, self.environment, self.elasticity, swings)
        self.rescue = Rescue(comm, model, self.environment, scene, self._attempt)
        self.watch = Watch(comm, model.lattice)
        self.surface = SurfaceMotion(comm, model.lattice, model.embedding) if model.embedding else None
        q, velocity = model.start
        sides = self.environment.contact_faces(q, q, 0.0, 0.0, None, self.environment.fixed_at(0.0))
        self.state, self.effort = State(q.copy(), q - self.time_step * velocity, sides=sides), Effort()
        self.step = 0  # steps taken
        self.stored, self.stored_until = scene.stored, scene.stored_until  # numbers of frames

    def frames(self) -> Iterator[Frame]:
        """Frame 0, then one frame for every ``every``-th step and for the last (collective). ``state`` always goes
        with the last frame.

        Raises StepFailed on all ranks, naming the step.
        """
        return (frame for frame in self.advance() if frame is not None)

    def advance(self) -> Iterator[Frame | None]:
        """The same, with None after the steps between: after each the run may stop, or be saved (collective)."""
        if self.step == 0:
            state = self.state
            self.watch.overlaps(0, self.environment, state.q, 0.0, self.time_step)
            self.energies = self.balance.energies(state.q, state.velocity(self.time_step), 0.0, state.sides)
            yield self._frame(0, self.state.q)
        for index in range(self.step + 1, self.steps + 1):
            if index == self.measured.trace:
                self.integrator.follow()
            self.watch.overlaps(index, self.environment, self.state.q, index * self.time_step, self.time_step)
            begin = perf_counter()
            result, done = self._step(index)
            self.effort.add(result, done, perf_counter() - begin)
            if self.measured.asks(index) and done == WHOLE:
                errors, trace = self.integrator.true_errors(index, result)
                self.effort.measure(errors)
                self.trace = trace or self.trace
            self.watch.gain(index, index * self.time_step, self.balance.ledger)
            self.step = index
            yield self._frame(index, result.position) if index % self.every == 0 or index == self.steps else None
        self.watch.sum_up()
        self.rescue.sum_up()

    def saved(self) -> Checkpoint:
        """All that the next step depends on; to be stored or copied before that is taken."""
        saved = Checkpoint(self.step)
        self.state.save(saved, self.model.lattice.owned, self.integrator.looks_back, self.environment.has_sides)
        self.integrator.save(saved, self.state)
        for part in (self.balance, self.rescue, self.watch):
            part.save(saved)
        saved.numbers |= vars(self.effort)
        saved.rows = {name: to_host(rows) for name, rows in saved.rows.items()}
        return saved

    def restore(self, saved: Checkpoint) -> None:
        """Go on from there (collective)."""
        saved.refuse_rows_unlike(self.comm, self.saved())
        self.step, time = saved.step, saved.step * self.time_step
        self.state = State.restored(self.comm, self.model.lattice, saved)
        self.integrator.restore(saved, self.state, time)
        for part in (self.balance, self.rescue, self.watch):
            part.restore(saved)
        known = {name: value for name, value in vars(Effort()).items() if name in saved.numbers}
        self.effort = Effort(
            **{
                name: saved.count(name) if isinstance(value, int) else saved.numbers[name]
                for name, value in known.items()
            }
        )

    def _step(self, index: int) -> tuple[StepResult, Done]:
        """The step that ends at index * t; ``state`` moves on (collective)."""
        time, rescue = index * self.time_step, self.rescue
        try:
            if rescue.is_on:
                result, self.state, done = rescue.step(self.state, time, None)
                return result, done
            try:
                result, self.state = self._attempt(self.integrator, self.state, time, self.time_step)
                return result, WHOLE
            except StepFailed as failure:
                result, self.state, done = rescue.step(self.state, time, failure)
                return result, done
        except StepFailed as failure:
            raise StepFailed(f"frame {index} (t = {time:.6g} s) {failure}", failure.kind, index) from None

    def _attempt(self, integrator, state: State, time: float, time_step: float) -> tuple[StepResult, State]:
        """A step that passes its examination (collective). Raises StepFailed."""
        result, after = integrator.advance(state, time)
        self.energies, ended, ledger = self.balance.check(state, result, after, time, time_step)
        self.balance.keep(ended, ledger, after)
        self.effort.energy_gained += ledger.last
        return result, after

    def refuse_unused_options(self, at_end: bool = False) -> None:
        """Raise InputError for PETSc options of the user that nothing has used (collective)."""
        self.integrator.refuse_unused_options(at_end, self.rescue.awaited)

    def _frame(self, index: int, q: np.ndarray) -> Frame:
        """What is stored of positions q (l, 3) and of the steps since the frame before (collective)."""
        time, energies = index * self.time_step, self.energies
        effort = replace(self.effort, energy_gained=max(self.effort.energy_gained, 0.0))
        if index % self.every == 0:  # the last frame may come between: of a longer run it is none
            self.effort = Effort()
        self.watch.error(index, time, effort.step_error)
        position = to_host(q[: self.model.lattice.owned])
        return Frame(
            index=index,
            time=time,
            position=position,
            surface=self.surface(position) if self.surface else None,
            kinetic=energies.kinetic,
            elastic=energies.elastic,
            potential=energies.potential,
            contact=energies.contact,
            momentum=energies.momentum,
            inverted=self.watch.inverted(index, time, q),
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
        self.rescue.destroy()
        self.integrator.destroy()
        if self.surface:
            self.surface.destroy()
