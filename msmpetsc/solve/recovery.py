"""Recovery of failed steps: a step is tried again in these ways, in this order.

1. ``take_step``: BDF2 takes the step without its history if the history gains energy. After an
   impact the history holds the energy that the impact took.
2. ``Halving``: pieces of a load (integrators.static), of a step that ``time.error`` chooses
   (integrators.adaptive.StepControl) or of a scene's step (``Recovery``). A shorter piece starts
   nearer to its solution, and inertia holds nodes nearer to their places.
3. ``Recovery``: a robust preset solves the step, if ``safety.on_failure`` says so.

Solvers also have retries of their own, which need iterates or problems that callers lack:

- the projected Hessian (nonlinear.newton)
- softer solids, and another point after a saddle (nonlinear.step)
- a start that crosses nothing (nonlinear.carried_start)
- other contacts (integrators.implicit.ContactFaces)
- the rest shape in place of a given start (integrators.static)
- stable substeps (integrators.verlet)
"""

from collections.abc import Callable
from dataclasses import replace
from typing import ClassVar

from msmpetsc.checkpoint import COUNT, Range
from msmpetsc.comm import log
from msmpetsc.errors import StepFailed
from msmpetsc.scene.schema import Solver
from msmpetsc.scene.time import Time
from msmpetsc.solve.energy_balance import EnergyBalance
from msmpetsc.solve.integrators.integrator import Integrator, State
from msmpetsc.solve.nonlinear.step import StepResult
from msmpetsc.solve.work import Work

# greatest number of halvings; 1024 pieces bound the cost of a hopeless step or load
DEEPEST = 10
# preset of the fallback solver
ROBUST = "newton-projected"
# prefix of the PETSc options of the fallback solver
PREFIX = "fallback_"
# safety.on_failure -> description in messages
WORDS = {"substep": "taken in shorter steps", "fallback": f"solved by {ROBUST}"}

# tables of the scene, prefix of the PETSc options -> integrator
MakeIntegrator = Callable[[Time, Solver, str], Integrator]
# state, end time [s] -> result, state after the step
TakeStep = Callable[[State, float], tuple[StepResult, State]]


def take_step(
    balance: EnergyBalance, integrator: Integrator, before: State, time: float
) -> tuple[StepResult, State]:
    """Take an integrator's step that ends at ``time`` [s] and passes the balance (collective).

    Raises StepFailed.
    """
    result, after = integrator.advance(before, time)
    after, history_gains = balance.examine(before, result, after, time, integrator.time_step)
    if not history_gains:
        return result, after
    again, after = take_step(balance, integrator, replace(before, history=None), time)
    cost = replace(result.cost + again.cost, steps=1, step_error=again.cost.step_error)
    return replace(again, cost=cost), after


class Halving:
    """Pieces of a step or of a load: half as long after a failure, twice as long after a success.

    reached : end of the last piece, from 0 to 1
    level   : number of halvings of the next piece
    count   : number of pieces taken
    """

    def __init__(self, level: int = 0):
        self.reached, self.level, self.count = 0.0, level, 0

    @property
    def end(self) -> float:
        """Return the end of the next piece."""
        return self.reached + 2.0**-self.level

    def run(self, take: Callable[[], None]) -> None:
        """Call ``take``, which takes the next piece, until 1 is reached. Raises StepFailed."""
        while self.reached < 1:
            try:
                take()
            except StepFailed as failure:
                if self.level == DEEPEST:
                    raise StepFailed(
                        f"{failure} (and failed in {2**DEEPEST} pieces)", failure.kind
                    ) from None
                self.level += 1
            else:
                self.reached, self.count = self.end, self.count + 1
                self.level = max(self.level - 1, 0)
                while self.reached < 1 < self.end:
                    self.level += 1


class Recovery:
    """Take the steps of a run, and repeat failed steps as ``safety.on_failure`` says.

    take      : takes a step as the scene defines it
    spare     : number of halvings -> integrator for this step length
    level     : number of halvings with which the next step starts, because failures persist
    recovered : number of recovered steps
    """

    state: ClassVar[dict[str, Range]] = {"level": (0, DEEPEST), "recovered": COUNT}

    def __init__(
        self,
        time: Time,
        solver: Solver,
        on_failure: str,
        make: MakeIntegrator,
        balance: EnergyBalance,
        take: TakeStep,
    ):
        self.time, self.solver = time, solver
        self.make, self.balance, self.take = make, balance, take
        self.on_failure, self.time_step = on_failure, time.step
        self.spare: dict[int, Integrator] = {}
        self.recovered = self.level = 0

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
        try:
            if self.on_failure == "fallback":
                result, after = self._take(0, state, time)
                return replace(result, cost=result.cost + Work(fallbacks=1)), after
            return self._in_pieces(state, time)
        finally:
            # A resumed run starts without spare integrators.
            self.destroy()

    def sum_up(self) -> None:
        """Log at the end of a run how many steps were recovered."""
        if self.recovered and self.on_failure != "stop":
            were = "s were" if self.recovered > 1 else " was"
            log.warning("%d step%s %s", self.recovered, were, WORDS[self.on_failure])

    def _in_pieces(self, state: State, time: float) -> tuple[StepResult, State]:
        """Take a step in pieces; the first piece starts with the level that the last step left."""
        pieces, cost = Halving(self.level or 1), Work()
        result = StepResult(state.q, state.q_previous, cost)

        def take() -> None:
            nonlocal state, result, cost
            end = time - (1 - pieces.end) * self.time_step
            result, state = self._take(pieces.level, state, end)
            cost += result.cost + Work(substeps=1)

        pieces.run(take)
        self.level = pieces.level
        return replace(result, cost=replace(cost, steps=1)), state

    def _take(self, level: int, state: State, time: float) -> tuple[StepResult, State]:
        """Take a step of length t / 2^level, from and to states for steps of length t."""
        short = self.time_step / 2**level
        if level not in self.spare:
            self.spare[level] = self._new(short)
            self.spare[level].set_up()
        before = state.over(self.time_step, short)
        result, after = take_step(self.balance, self.spare[level], before, time)
        previous = State(result.position, result.previous).over(short, self.time_step).q_previous
        return replace(result, previous=previous), after.over(short, self.time_step)

    def _new(self, short: float) -> Integrator:
        """Return a new integrator with steps of length ``short`` [s].

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
