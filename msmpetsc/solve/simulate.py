"""Time loop of a run: take its steps and yield the stored steps as frames."""

from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from functools import partial
from time import perf_counter
from typing import Any

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Indices, Positions, Rows, on_host, to_host
from msmpetsc.backend.machine import return_free_memory
from msmpetsc.build import Model, to_device
from msmpetsc.checkpoint import AT_END, Checkpoint
from msmpetsc.comm import reduced
from msmpetsc.constraints.holders import sums_by
from msmpetsc.contact.step_contact import StepContactAt
from msmpetsc.elasticity.energy import Elasticity
from msmpetsc.elasticity.stress import StressField
from msmpetsc.environment import Environment
from msmpetsc.errors import InputError, StepFailed
from msmpetsc.fields import FRAME_FIELDS, STRESS, Frame
from msmpetsc.lattice.embedded_surface import EmbeddedPoints
from msmpetsc.scene.reading import Scene
from msmpetsc.scene.schema import HOLDERS, Solver
from msmpetsc.scene.time import Time
from msmpetsc.solve.energy_balance import EnergyBalance
from msmpetsc.solve.instrumentation import REFERENCE_PREFIX, REFERENCE_PRESET, Monitors, true_errors
from msmpetsc.solve.integrators.adaptive import Adaptive
from msmpetsc.solve.integrators.bdf2 import Bdf2
from msmpetsc.solve.integrators.implicit import ImplicitEuler
from msmpetsc.solve.integrators.integrator import Integrator, State
from msmpetsc.solve.integrators.static import Static
from msmpetsc.solve.integrators.verlet import Verlet
from msmpetsc.solve.nonlinear.functional import Iterate
from msmpetsc.solve.nonlinear.jacobian import Jacobian
from msmpetsc.solve.nonlinear.step import StepResult
from msmpetsc.solve.petsc.device import sender
from msmpetsc.solve.petsc.events import STEPS
from msmpetsc.solve.presets import Preset, find_preset
from msmpetsc.solve.recovery import PREFIX as FALLBACK
from msmpetsc.solve.recovery import ROBUST, Recovery, TakeStep, take_step
from msmpetsc.solve.refused_options import refuse_unused
from msmpetsc.solve.work import Work

Integrators = dict[str, type[ImplicitEuler] | type[Verlet]]
INTEGRATORS: Integrators = {
    "implicit-euler": ImplicitEuler,
    "bdf2": Bdf2,
    "verlet": Verlet,
    "static": Static,
}
# number of steps between checkpoints; a checkpoint drops caches, so that a resumed run
# agrees
REMEMBERED = 20


def solvers_of(scene: Scene, true_error: int | None = None) -> dict[str, tuple[Preset, int]]:
    """Return the solvers of a run: prefix of the PETSc options -> preset, budget of iterations.

    true_error : number of steps between measurements of the true error; None without measurement
    """
    solvers = {}
    if scene.time.integrator != "verlet":
        solvers[""] = find_preset(scene.solver.preset), scene.solver.max_iterations or 0
    if scene.safety.on_failure == "fallback":
        solvers[FALLBACK] = find_preset(ROBUST), 0
    if true_error:
        solvers[REFERENCE_PREFIX] = find_preset(REFERENCE_PRESET), 0
    return solvers


def refuse_bad_options(
    scene: Scene, true_error: int | None = None, exported: Collection[int] = ()
) -> None:
    """Raise InputError if the scene cannot use the preset, measure true errors or export systems.

    exported : numbers of the steps whose linear systems are exported
    """
    solvers = solvers_of(scene, true_error)
    if scene.touching and not all(preset.true_hessian for preset, _ in solvers.values()):
        raise InputError(
            f"contact of surfaces needs one of newton's presets, not {scene.solver.preset}"
        )
    rolls = [table.key for table in scene.tables(*HOLDERS) if not all(table.table.fixed)]
    if rolls and not all(preset.true_hessian for preset, _ in solvers.values()):
        raise InputError(
            f"{rolls[0]}.fix: single components need one of newton's presets, not "
            f"{scene.solver.preset}: the matrix A of other presets holds whole nodes"
        )
    if scene.time.error and true_error:
        raise InputError("true errors need steps of constant length: leave out time.error")
    if "" not in solvers and true_error:
        raise InputError("true errors need steps that are solved: verlet has none")
    if exported and not ("" in solvers and solvers[""][0].true_hessian):
        method = scene.solver.preset if "" in solvers else "verlet"
        raise InputError(f"--export writes systems of newton's presets; {method} solves none")
    if exported and max(exported) > scene.time.steps:
        raise InputError(
            f"--export-steps {max(exported)}: the last step of the run is {scene.time.steps}"
        )


class TimeLoop:
    """Take the steps of a run; as a context manager, destroy its PETSc objects on leaving.

    state  : state after the last step
    step   : number of steps taken, of ``steps``
    stored : number of frames of the whole run; ``stored_until(step)`` is the number of frames of
             its first steps
    system_monitor : called with the number of a step, the first iterate of a solve and its Jacobian
    saved  : last checkpoint, from which the run may resume; made after each ``REMEMBERED``-th step
    """

    def __init__(
        self,
        comm: MPI.Comm,
        scene: Scene,
        model: Model,
        true_error: int | None = None,
        system_monitor: Callable[[int, Iterate, Jacobian], None] | None = None,
    ):
        model = to_device(model, sender(comm))
        if model.collision and not on_host(model.lattice.nodes):
            raise InputError("contact of surfaces is computed on CPUs: --device cpu")
        if model.pressures and not on_host(model.lattice.nodes):
            raise InputError("pressure is computed on CPUs: --device cpu")
        self.comm, self.model = comm, model
        self.true_error, self.time_step = true_error, scene.time.step
        self.system_monitor = system_monitor
        self.steps, self.every = scene.time.steps, scene.output.every
        self.step = 0
        self.stored, self.stored_until = scene.stored, scene.stored_until
        self.environment = Environment(model)
        self.elasticity = self.environment.elasticity
        swings = scene.time.integrator != "implicit-euler"
        self.balance = EnergyBalance(self.environment, self.elasticity, swings)
        self.adaptive: Adaptive | None = None
        if scene.time.error:
            self.adaptive = Adaptive(scene.time, scene.solver, self._make, self.balance)
        self.integrator = self.adaptive or self._make(scene.time, scene.solver)
        take: TakeStep = partial(take_step, self.balance, self.integrator)
        # Adaptive passes each of its own steps through the energy balance.
        if self.adaptive:
            take = self.adaptive.advance
        self.recovery = Recovery(
            scene.time, scene.solver, scene.safety.on_failure, self._make, self.balance, take
        )
        self.monitors = Monitors(self.environment, self.time_step)
        w = model.embedding
        self.surface = None if w is None else EmbeddedPoints(comm, model.lattice, w)
        self.forces = Forces(model, self.environment, self.elasticity)
        solid = self.elasticity.solid if scene.output.stress else None
        self.stress = StressField(model.lattice, solid) if solid else None
        q, velocity = model.start
        sides = self.environment.obstacles.contact_faces(
            q, q, 0.0, 0.0, None, self.environment.anchors.fixed_at(0.0).all(axis=1)
        )
        self.state = State(q.copy(), q - self.time_step * velocity, sides=sides)
        # Whether options are checked again after the first solve, which reads more of
        # them than the set-up.
        self.awaits_solve = False
        self.saved = Checkpoint()

    def _make(self, time: Time, solver: Solver, prefix: str = "") -> Integrator:
        """Return the integrator of a scene's tables, with its prefix of options (collective)."""
        return INTEGRATORS[time.integrator](self.comm, self.environment, time, solver, prefix)

    def frames(self) -> Iterator[Frame]:
        """Yield frame 0, then the frames of each ``every``-th step and of the last (collective).

        Raises StepFailed, with the number of the step, on all ranks.
        """
        return (frame for frame in self.advance() if frame is not None)

    def advance(self) -> Iterator[Frame | None]:
        """Yield the frame of each step, or None if the step is not stored (collective).

        The run may be stopped or saved after each step.
        """
        if self.step == 0:
            self.monitors.overlaps(0, 0.0, self.state.q)
            self.balance.show(
                self.state.q, self.state.velocity(self.time_step), 0.0, self.state.sides
            )
            yield self._frame(0, self.state.q)
        while self.step < self.steps:
            with STEPS:
                frame = self._advance(self.step + 1)
            yield frame
        self.monitors.sum_up()
        self.recovery.sum_up()
        if self.adaptive:
            self.adaptive.sum_up()

    def _advance(self, index: int) -> Frame | None:
        """Take the next step; return its frame if it is stored (collective). Raises StepFailed."""
        time = index * self.time_step
        self.monitors.overlaps(index, time, self.state.q)
        if self.system_monitor:
            self.environment.system_monitor = partial(self.system_monitor, index)
        begin = perf_counter()
        try:
            result, self.state = self.recovery.step(self.state, time)
        except StepFailed as failure:
            raise StepFailed(
                f"frame {index} (t = {time:.6g} s) {failure}", failure.kind, index
            ) from None
        self.monitors.work += result.cost + Work(wall_time=perf_counter() - begin)
        is_recovered = result.cost.substeps + result.cost.fallbacks > 0
        if self.true_error and index % self.true_error == 0 and result.problem and not is_recovered:
            assert isinstance(self.integrator, ImplicitEuler)
            stepper = self.integrator.stepper
            # The solver of a viscous body's step without history is gone.
            if result.static or result.tau == stepper.time_step:
                true, energy = true_errors(stepper, result.problem, result.position)
                self.monitors.work += Work(true_error=true, energy_error=energy)
        self.monitors.gain(index, time, self.state.budget, self.balance.remedy(result.explicit))
        self.step = index
        if self.awaits_solve and (result.explicit or result.cost.ksp_its):
            self.refuse_unused_options()
        frame = (
            self._frame(index, result.position, result)
            if index % self.every == 0 or index == self.steps
            else None
        )
        if index % REMEMBERED == 0:
            self.saved = self._save()
        return frame

    def _save(self) -> Checkpoint:
        """Return a checkpoint, and drop all caches that it does not hold (collective).

        A resumed run starts without these caches and must agree to the last bit.
        """
        checkpoint = Checkpoint(self.step)
        self.state.save(
            checkpoint,
            self.model.lattice.owned,
            self.integrator.uses_history,
            self.environment.obstacles.has_sides,
        )
        self.integrator.save(checkpoint)
        self.environment.forget()
        for part in (self.recovery, self.monitors):
            checkpoint.keep_counts(part)
        checkpoint.rows = {name: to_host(rows) for name, rows in checkpoint.rows.items()}
        return checkpoint

    @property
    def end(self) -> Checkpoint:
        """Checkpoint with the positions at and before the last step, to start another run from."""
        owned = self.model.lattice.owned
        rows = {"q": self.state.q[:owned], "q_previous": self.state.q_previous[:owned]}
        step = AT_END - self.step
        return Checkpoint(step, {name: to_host(values) for name, values in rows.items()})

    def restore(self, checkpoint: Checkpoint) -> None:
        """Resume from a checkpoint before the first step (collective). Raises InputError."""
        checkpoint.refuse_rows_unlike(self.comm, self.saved)
        self.step = checkpoint.step
        self.state = State.restored(self.comm, self.model.lattice, checkpoint)
        for part in (self.recovery, self.monitors):
            checkpoint.restore_counts(part)
        if self.step:
            self.integrator.restore(checkpoint, self.step * self.time_step)
        self.saved = self._save()

    def refuse_unused_options(self, at_end: bool = False) -> None:
        """Raise InputError for the user's PETSc options that nothing has used (collective).

        After a call before the first step, the run repeats the check when a step has solved.
        """
        self.awaits_solve = self.step == 0 and not at_end
        awaited = {
            FALLBACK: self.recovery.on_failure == "fallback",
            REFERENCE_PREFIX: self.true_error and not at_end,
        }
        prefixes = tuple(prefix for prefix, may_come in awaited.items() if may_come)
        refuse_unused(self.comm, not self.awaits_solve, prefixes)

    def _frame(self, index: int, q: Positions, step: StepResult | None = None) -> Frame:
        """Return the frame at q (l, 3) [m], with the work since the last frame (collective)."""
        time = index * self.time_step
        energies = self.balance.energies
        work = self.monitors.work
        gained = self.state.budget.since_frame
        self.monitors.error(index, time)
        # An extra last frame starts no interval: a longer run would not store it.
        if index % self.every == 0:
            self.monitors.work = Work()
            self.state = replace(self.state, budget=replace(self.state.budget, since_frame=0.0))
        position = to_host(q[: self.model.lattice.owned])
        return Frame(
            index=index,
            time=time,
            position=position,
            surface=self.surface(position) if self.surface else None,
            **{
                name: getattr(energies, name)
                for name in ("kinetic", "elastic", "potential", "contact", "momentum")
            },
            inverted=self.monitors.inverted(index, time, q),
            energy_gained=max(gained, 0.0),
            self_contacts=energies.touch.contacts,
            self_distance=energies.touch.distance,
            self_contact=energies.touch.energy,
            time_error=step.time_error if step else np.nan,
            **vars(work),
            probe=self.model.probe(q) if self.model.probe else None,
            **self.forces(q, time, self.state.sides, step),
            **(self.stress(q) if self.stress else {}),
        )

    @property
    def rows(self) -> dict[str, int]:
        """Return the number of this rank's rows of each optional field of a frame."""
        lattice, rows = self.model.lattice, dict(self.forces.rows)
        if self.model.probe:
            rows["probe"] = len(self.model.probe)
        if self.surface:
            rows["surface"] = self.surface.weights.shape[0]
        if self.stress:
            rows |= {
                name: lattice.cells_owned if "c" in FRAME_FIELDS[name].shape else lattice.owned
                for name in STRESS
            }
        return rows

    def __enter__(self) -> "TimeLoop":
        try:
            self.integrator.set_up()
            self.saved = self._save()
            return_free_memory()
        except InputError:
            self.destroy()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.destroy()

    def destroy(self) -> None:
        """Destroy all PETSc objects (collective)."""
        self.recovery.destroy()
        self.integrator.destroy()


class Forces:
    """Compute the force fields of a frame (fields.Frame) that the scene needs.

    The fields are loads, reactions of pins and anchors, and contact forces of obstacles and of the
    surface. The last implicit step gives loads, inertia and friction. At the start and in explicit
    steps loads are those of the time, reactions leave out inertia, and contact forces leave out
    friction.

    rows : name of a field -> number of its rows
    """

    def __init__(self, model: Model, environment: Environment, elasticity: Elasticity):
        self.comm, self.model, self.environment = model.lattice.table.comm, model, environment
        self.elasticity = elasticity
        self.keys = [obstacle.key for obstacle in model.obstacles]
        bodies = len(model.lattice.first_of_body) if model.collision else 0
        holders = len(model.holders.keys)
        self.tractions = model.loads[len(model.loads) - model.tractions :]
        rows = {
            "reaction": holders,
            "torque": holders,
            "push": len(model.obstacles),
            "contact_push": bodies,
            "surface_load": model.tractions + len(model.pressures),
        }
        self.rows = {name: count for name, count in rows.items() if count}

    def __call__(
        self, q: Positions, time: float, sides: Indices | None, step: StepResult | None
    ) -> dict[str, Any]:
        """Return the force fields at q (l, 3) [m] (collective).

        time  : end time [s] of the last step
        sides : (o, l) contact faces of the nodes
        step  : result of the last step; None at the start
        """
        environment, owned = self.environment, self.model.lattice.owned
        contact = step.contact if step else None
        if contact is None:
            contact = environment.push(q, time, sides)
        # A step takes means of loads, so they balance its reactions.
        loads = step.load if step and step.load else environment.forces.at(time)
        load = loads.at(q)
        sums = {"load": to_host(load.sum(axis=0)), **self._pushes(q, contact)}
        if "surface_load" in self.rows:
            totals = loads.totals[len(loads.totals) - len(self.tractions) :]
            dead = [
                float(load.share.sum()) * total
                for load, total in zip(self.tractions, totals, strict=True)
            ]
            sums["surface_load"] = np.array([*dead, *loads.pressures.resultants(q)])
        if "reaction" in self.rows:
            fixed = environment.anchors.fixed_at(time)[:owned]
            reaction = (self._holding_forces(q, contact, step) - load) * fixed
            sums["reaction"] = self.model.holders.totals(reaction)
            sums["torque"] = self.model.holders.torques(
                q[:owned], reaction, self._torque_points(time)
            )
        return {
            name: reduced(self.comm, sums[name])
            for name in sums
            if name == "load" or name in self.rows
        }

    def _torque_points(self, time: float) -> Positions:
        """Return the reference points (a, 3) [m] of the torques of pins and anchors."""
        points, anchors = self.model.holders.centers.copy(), self.model.anchors
        for row, anchor in enumerate(anchors, len(points) - len(anchors)):
            points[row] = anchor.path.center + anchor.path.value_at(time)[:3]
        return points

    def _holding_forces(
        self, q: Positions, contact: StepContactAt | None, step: StepResult | None
    ) -> Rows:
        """Return the sums (owned, 3) [N] of reaction and load on the nodes."""
        forces, owned = np.zeros_like(q), self.model.lattice.owned
        self.elasticity.add_gradient(q, forces)
        if contact:
            contact.add_gradient(forces)
        forces = forces[:owned]
        if step and step.viscous is not None:
            forces += step.viscous
        if step and step.problem:
            accelerated = (q[:owned] - step.problem.y[:owned]) / step.tau**2
            forces += self.model.lattice.mass[:, None] * accelerated
        return forces

    def _pushes(self, q: Positions, contact: StepContactAt | None) -> dict[str, Any]:
        """Return this rank's contact forces [N]: of obstacles (o, 3), and on bodies (b, 3)."""
        lattice, owned = self.model.lattice, self.model.lattice.owned
        push = np.zeros((len(self.keys), 3))
        for state, pressed in contact.of_obstacles if contact else ():
            gradient = np.zeros_like(q[:owned])
            state.add_gradient(q[:owned], pressed, gradient)
            push[self.keys.index(state.penalty.obstacle.key)] -= to_host(gradient.sum(axis=0))
        bodies = len(lattice.first_of_body)
        touching = np.zeros((bodies, 3))
        if contact and contact.surface:
            obstacles, _ = contact.surface.of_obstacles()
            push[contact.surface.contacts.obstacles.numbers] += obstacles / self.comm.size
            own = np.zeros_like(q[:owned])
            contact.surface.add_gradient(own)
            touching -= sums_by(lattice.body[:owned, None], own, bodies)
        return {"push": push, "contact_push": touching}
