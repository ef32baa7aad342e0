"""Recovery from failed steps: repeat the step in shorter pieces or with a robust solver."""

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

# most halvings of a step; 1024 pieces bound the cost of a hopeless step
DEEPEST = 10
# preset of the fallback solver
ROBUST = "newton-projected"
# prefix of the PETSc options of the fallback solver
PREFIX = "fallback_"
# safety.on_failure -> description in messages
WORDS = {"substep": "taken in shorter ones", "fallback": f"solved by {ROBUST}"}

# tables of the scene, prefix of the PETSc options -> integrator
MakeIntegrator = Callable[[Time, Solver, str], Integrator]
# state, end time [s] -> result, state after the step
TakeStep = Callable[[State, float], tuple[StepResult, State]]


class Recovery:
    """Take the steps of a run, and repeat failed steps as ``safety.on_failure`` says.

    take    : takes a step as the scene defines it
    spare   : number of halvings -> integrator of that step length
    level   : halvings that the next step starts with, because failures persist
    deepest : most halvings of the step in progress
    """

    state: ClassVar[dict[str, Range]] = {"level": (0, DEEPEST), "recovered": COUNT}

    def __init__(self, scene: Scene, make: MakeIntegrator, balance: EnergyBalance, take: TakeStep):
        self.time, self.solver = scene.time, scene.solver
        self.make, self.balance, self.take = make, balance, take
        self.on_failure, self.time_step = scene.safety.on_failure, scene.time.step
        self.spare: dict[int, Integrator] = {}
        self.recovered = self.level = self.deepest = 0

    def step(self, state: State, time: float) -> tuple[StepResult, State]:
        """Take or recover the step that ends at ``time`` [s] (collective). Raises StepFailed."""
        # A checkpoint of a scene with "substep" may resume with another ``on_failure``.
        if not self.level or self.on_failure != "substep":
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
        # Checkpoints do not hold the spare integrators.
        for integrator in self.spare.values():
            integrator.forget()
        if self.on_failure == "fallback":
            result, after = self._take(0, state, time)
            return replace(result, cost=result.cost + Work(fallbacks=1)), after
        return self._in_pieces(state, time, self.level or 1)

    def sum_up(self) -> None:
        """Log at the end of a run how many steps were recovered."""
        if self.recovered and self.on_failure != "stop":
            were = "s were" if self.recovered > 1 else " was"
            log.warning("%d step%s %s", self.recovered, were, WORDS[self.on_failure])

    def _in_pieces(self, state: State, time: float, level: int) -> tuple[StepResult, State]:
        """Take a step in 2^level pieces; halve the pieces that fail.

        The next step starts at the deepest level of this step, or, if no piece failed, a level up.
        """
        self.deepest = level
        pieces = 2**level
        cost = Work()
        for piece in range(1, pieces + 1):
            end = time - self.time_step + piece * self.time_step / pieces
            result, state = self._piece(state, end, level)
            cost += result.cost
        self.level = self.deepest if self.deepest > level else level - 1
        # A resumed run starts without spare solvers.
        self.destroy()
        return replace(result, cost=replace(cost, steps=1)), state

    def _piece(self, state: State, time: float, level: int) -> tuple[StepResult, State]:
        """Take a piece of t / 2^level that ends at ``time`` [s], in halves if it fails."""
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
        """Take a step of t / 2^level between states that belong to steps of t."""
        short = self.time_step / 2**level
        if level not in self.spare:
            self.spare[level] = self._new(short)
            self.spare[level].set_up()
            # A new integrator must not differ from a kept integrator.
            self.spare[level].forget()
        before = state.over(self.time_step, short)
        result, after = self.balance.step(self.spare[level], before, time)
        previous = State(result.position, result.previous).over(short, self.time_step).q_previous
        return replace(result, previous=previous), after.over(short, self.time_step)

    def _new(self, short: float) -> Integrator:
        """Return a new integrator of steps of ``short`` [s].

        Implicit Euler replaces BDF2, and in a fallback also Verlet.
        """
        is_fallback = self.on_failure == "fallback"
        unchanged = ("static",) if is_fallback else ("static", "verlet")
        name = self.time.integrator if self.time.integrator in unchanged else "implicit-euler"
        time = self.time.model_copy(update={"step": short, "integrator": name})
        if is_fallback:
            robust = Solver(preset=ROBUST, error=self.solver.error, max_iterations=None)
            return self.make(time, robust, PREFIX)
        return self.make(time, self.solver, "")

    def destroy(self) -> None:
        """Destroy the spare integrators (collective)."""
        for integrator in self.spare.values():
            integrator.destroy()
        self.spare.clear()
