"""Recovery from a step that fails, so that a hard moment costs time instead of the run."""

from collections.abc import Callable
from dataclasses import replace
from typing import ClassVar

from msmpetsc.checkpoint import COUNT, Range
from msmpetsc.comm import log
from msmpetsc.errors import StepFailed
from msmpetsc.scene.reading import Scene
from msmpetsc.scene.schema import Solver
from msmpetsc.scene.time import Time
from msmpetsc.solve.energy_balance import EnergyBalance
from msmpetsc.solve.integrators.integrator import Integrator, State
from msmpetsc.solve.nonlinear.step import StepResult
from msmpetsc.solve.work import Work

DEEPEST = 10  # halvings: 1024 pieces of a step
ROBUST = "newton-projected"
PREFIX = "fallback_"  # of the PETSc options of that
WORDS = {"substep": "taken in shorter ones", "fallback": f"solved by {ROBUST}"}

MakeIntegrator = Callable[[Time, Solver, str], Integrator]  # str: prefix of its PETSc options
TakeStep = Callable[[State, float], tuple[StepResult, State]]  # float: time of its end [s]


class Recovery:
    """Takes the steps of one run, failed ones another way: by integrators kept while they are needed.

    make    : makes an integrator
    balance : examines each step that one takes
    take    : takes a step as the scene has it
    """

    state: ClassVar[dict[str, Range]] = {"level": (0, DEEPEST), "recovered": COUNT}

    def __init__(self, scene: Scene, make: MakeIntegrator, balance: EnergyBalance, take: TakeStep):
        self.time, self.solver, self.make, self.balance, self.take = (
            scene.time,
            scene.solver,
            make,
            balance,
            take,
        )
        self.on_failure, self.time_step = scene.safety.on_failure, scene.time.step
        self.spare: dict[int, Integrator] = {}  # by how often the step is halved
        self.recovered = 0  # steps
        self.level = 0  # that the next step begins with: a hard moment is seldom over at once
        self.deepest = 0  # level of the step in progress

    def step(self, state: State, time: float) -> tuple[StepResult, State]:
        """Take the step that ends at ``time``. Raises StepFailed."""
        if not self.level or self.on_failure != "substep":  # a level may be of another scene
            try:
                return self.take(state, time)
            except StepFailed as failure:
                if self.on_failure == "stop":
                    raise
                if not self.recovered:
                    reason = str(failure).split("; try ")[0]
                    log.warning(
                        "t = %.6g s: the step %s: it is %s", time, reason, WORDS[self.on_failure]
                    )
        self.recovered += 1
        for integrator in self.spare.values():
            integrator.forget()  # so that a checkpoint need not remember them
        if self.on_failure == "fallback":
            result, after = self._take(0, state, time)
            return replace(result, cost=result.cost + Work(fallbacks=1)), after
        return self._in_pieces(state, time, self.level or 1)

    def sum_up(self) -> None:
        """Say at the end of a run how many steps were recovered."""
        if self.recovered and self.on_failure != "stop":
            were = "s were" if self.recovered > 1 else " was"
            log.warning("%d step%s %s", self.recovered, were, WORDS[self.on_failure])

    def _in_pieces(self, state: State, time: float, level: int) -> tuple[StepResult, State]:
        """Take a step in 2^level pieces, and again halved where that fails; then one level up for the next."""
        self.deepest = level
        pieces = 2**level
        cost = Work()
        for piece in range(1, pieces + 1):
            result, state = self._piece(
                state, time - self.time_step + piece * self.time_step / pieces, level
            )
            cost += result.cost
        self.level = self.deepest if self.deepest > level else level - 1
        self.destroy()  # a resumed run has not seen what the spare solvers did in this step
        return replace(result, cost=replace(cost, steps=1)), state

    def _piece(self, state: State, time: float, level: int) -> tuple[StepResult, State]:
        self.deepest = max(self.deepest, level)
        try:
            result, after = self._take(level, state, time)
            return replace(result, cost=result.cost + Work(substeps=1)), after
        except StepFailed as failure:
            if level == DEEPEST:
                raise StepFailed(
                    f"{failure} (and failed in {2**level} pieces)", failure.kind
                ) from None
        half = self.time_step / 2 ** (level + 1)
        first, state = self._piece(state, time - half, level + 1)
        second, state = self._piece(state, time, level + 1)
        return replace(second, cost=first.cost + second.cost), state

    def _take(self, level: int, state: State, time: float) -> tuple[StepResult, State]:
        """Take one step of t / 2^level; states outside are of steps of t."""
        short = self.time_step / 2**level
        if level not in self.spare:
            self.spare[level] = self._new(short)
            self.spare[level].set_up()
            self.spare[level].forget()  # as those that are kept
        before = state.over(self.time_step, short)
        result, after = self.balance.step(self.spare[level], before, time)
        previous = State(result.position, result.previous).over(short, self.time_step).q_previous
        return replace(result, previous=previous), after.over(short, self.time_step)

    def _new(self, short: float) -> Integrator:
        """Make another integrator: implicit Euler's, or the scene's if static or Verlet's."""
        is_fallback = self.on_failure == "fallback"
        kept = ("static",) if is_fallback else ("static", "verlet")
        name = self.time.integrator if self.time.integrator in kept else "implicit-euler"
        time = self.time.model_copy(update={"step": short, "integrator": name})
        if is_fallback:
            return self.make(
                time, Solver(preset=ROBUST, error=self.solver.error, max_iterations=None), PREFIX
            )
        return self.make(time, self.solver, "")

    def destroy(self) -> None:
        for integrator in self.spare.values():
            integrator.destroy()
        self.spare.clear()
