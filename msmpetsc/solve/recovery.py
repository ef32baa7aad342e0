"""What is done about a step that fails, so that a hard moment costs time instead of the run."""

from collections.abc import Callable
from dataclasses import dataclass, replace

from mpi4py import MPI

from msmpetsc.comm import log
from msmpetsc.errors import StepFailed
from msmpetsc.model.build import Model
from msmpetsc.model.checkpoint import Checkpoint
from msmpetsc.model.environment import Environment
from msmpetsc.scene import schema as scene
from msmpetsc.solve.integrators.implicit import ImplicitEuler
from msmpetsc.solve.integrators.state import State
from msmpetsc.solve.integrators.verlet import Verlet
from msmpetsc.solve.nonlinear.step import StepResult

DEEPEST = 10  # halvings: 1024 pieces of a step
ROBUST = "newton-projected"
PREFIX = "fallback_"  # of the PETSc options of that
WORDS = {"substep": "taken in shorter ones", "fallback": f"solved by {ROBUST}"}

Attempt = Callable[[ImplicitEuler | Verlet, State, float, float], tuple[StepResult, State]]


@dataclass
class Done:
    """About one step: shorter steps taken in its place, whether the robust method solved it, and what it all cost."""

    substeps: int = 0
    fallbacks: int = 0
    error: float = 0.0
    iterations: int = 0
    ksp_its: int = 0

    def add(self, result: StepResult) -> None:
        self.error = max(self.error, result.error)
        self.iterations += result.iterations
        self.ksp_its += result.ksp_its


class Rescue:
    """Of one run. Solvers are made when they are needed, and kept while they are.

    attempt : (integrator, state, time, time step) -> result and state of a step that ends at ``time``, or StepFailed
    """

    def __init__(self, comm: MPI.Comm, model: Model, environment: Environment, wanted: scene.Scene, attempt: Attempt):
        self.comm, self.model, self.around, self.scene, self.attempt = comm, model, environment, wanted, attempt
        self.on_failure, self.time_step = wanted.safety.on_failure, wanted.time.step
        self.spare: dict[int, ImplicitEuler | Verlet] = {}  # by how often the step is halved
        self.rescued = 0  # steps
        self.level = 0  # that the next step begins with: a hard moment is seldom over at once

    @property
    def is_on(self) -> bool:
        """Whether steps are under its care before they have failed."""
        return self.level > 0

    @property
    def awaited(self) -> tuple[str, ...]:
        """Prefixes of PETSc options that may still be used."""
        return (PREFIX,) if self.on_failure == "fallback" else ()

    def step(self, state: State, time: float, failure: StepFailed | None) -> tuple[StepResult, State, Done]:
        """The step that ends at ``time``, after a ``failure`` of it if it was tried (collective). Raises StepFailed."""
        if self.on_failure == "stop":
            raise failure
        if not self.rescued:
            told = str(failure).split("; try ")[0]
            log.warning("t = %.6g s: the step %s: it is %s", time, told, WORDS[self.on_failure])
        self.rescued += 1
        for integrator in self.spare.values():
            integrator.forget()  # so that a checkpoint need not remember them
        done = Done()
        if self.on_failure == "fallback":
            result, after = self._take(0, state, time, done)
            done.fallbacks = 1
        else:
            result, after = self._in_pieces(state, time, max(self.level, 1) if failure else self.level, done)
        result = replace(result, error=done.error, iterations=done.iterations, ksp_its=done.ksp_its)
        return result, after, done

    def save(self, saved: Checkpoint) -> None:
        saved.numbers |= {"level": self.level, "rescued": self.rescued}

    def restore(self, saved: Checkpoint) -> None:
        if self.on_failure == "substep":
            self.level = saved.count("level", DEEPEST)
        if self.on_failure != "stop":  # else it was another scene that asked for it
            self.rescued = saved.count("rescued")

    def sum_up(self) -> None:
        """At the end of a run: how often it was."""
        if self.rescued:
            log.warning("%d step%s %s", self.rescued, "s were" if self.rescued > 1 else " was", WORDS[self.on_failure])

    def _in_pieces(self, state: State, time: float, level: int, done: Done) -> tuple[StepResult, State]:
        """All of a step in 2^level pieces, and again halved where that fails; then one level up for the next."""
        self.deepest = level
        pieces, start = 2**level, time - self.time_step
        for piece in range(1, pieces + 1):
            result, state = self._piece(state, start + piece * self.time_step / pieces, level, done)
        self.level = self.deepest if self.deepest > level else level - 1
        if self.level == 0:
            self._forget()
        return result, state

    def _piece(self, state: State, time: float, level: int, done: Done) -> tuple[StepResult, State]:
        self.deepest = max(self.deepest, level)
        try:
            result, after = self._take(level, state, time, done)
            done.substeps += 1
            return result, after
        except StepFailed as failure:
            if level == DEEPEST:
                raise StepFailed(f"{failure} (and failed in {2**level} pieces)", failure.kind) from None
        half = self.time_step / 2 ** (level + 1)
        _, state = self._piece(state, time - half, level + 1, done)
        return self._piece(state, time, level + 1, done)

    def _take(self, level: int, state: State, time: float, done: Done) -> tuple[StepResult, State]:
        """One step of t / 2^level; states outside are of steps of t."""
        short = self.time_step / 2**level
        if level not in self.spare:
            self.spare[level] = self._new(short)
            self.spare[level].set_up()
        result, after = self.attempt(self.spare[level], state.over(self.time_step, short), time, short)
        done.add(result)
        result = replace(
            result, previous=State(result.position, result.previous).over(short, self.time_step).q_previous
        )
        return result, after.over(short, self.time_step)

    def _new(self, short: float) -> ImplicitEuler | Verlet:
        time, solver = self.scene.time.model_copy(update={"step": short}), self.scene.solver
        if self.on_failure == "fallback":
            solver = scene.Solver(preset=ROBUST, error=solver.error)
            return ImplicitEuler(self.comm, self.model, self.around, time, solver, prefix=PREFIX)
        kind = Verlet if time.integrator == "verlet" else ImplicitEuler
        return kind(self.comm, self.model, self.around, time, solver)

    def _forget(self) -> None:
        for integrator in self.spare.values():
            integrator.destroy()
        self.spare.clear()

    destroy = _forget  # collective
