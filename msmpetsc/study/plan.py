"""The cheapest way to simulate a scene to an error: few trials on its first frames, in an order that stops early."""

import math
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from msmpetsc.errors import InputError
from msmpetsc.output.reader import Result
from msmpetsc.scene.reading import load_scene
from msmpetsc.scene.statics import STATIC
from msmpetsc.scene.values import IntegratorName
from msmpetsc.study.cases import Case, study_cases
from msmpetsc.study.runner import Bench
from msmpetsc.study.schema import ReferenceRun, Study, StudyScene, Sweep
from msmpetsc.study.table import Row

FIRST = 120.0  # [s] a trial may take while nothing is known
REFERENCE_TIME = 60.0  # [s] that a verlet reference may be expected to take
FINER = 4  # times: the substeps of a verlet reference; its error is then 1/16 of verlet's
IMPLICIT_FINER = 16  # times: the steps of an implicit reference
LOOSEST, TIGHTEST = 0.3, 1e-8  # step errors that are tried
MOST_SHORTENED = 5  # times
LIKES_GAIN = 4  # times that newton's likes may be cheaper than newton
QUIET = 1e-6  # elastic energy over kinetic, where nothing deforms
ALTERNATIVES = (
    ("newton", "-pc_type icc"),
    ("newton-multigrid", ""),
    ("anderson", ""),
    ("lbfgs", ""),
    ("chebyshev", ""),
    ("ngmres", ""),
)


@dataclass(frozen=True)
class Candidate:
    """A way to step the scene; step_error is None for verlet."""

    integrator: IntegratorName
    time_step: float  # [s]
    preset: str = ""
    options: str = ""
    step_error: float | None = None


@dataclass(frozen=True)
class Trial:
    """The result of a method that was tried.

    cost  : computing seconds a simulated second
    error : as asked for; both None with a reason where there is none
    """

    method: Candidate
    cost: float | None
    error: float | None
    reason: str = ""

    def meets(self, target: float) -> bool:
        """Return whether the error is at most this."""
        return self.cost is not None and self.error is not None and self.error <= target


Try = Callable[[Candidate, Sequence[Trial]], Trial]  # the trials so far say how long this one may take


def cheapest(trials: Iterable[Trial], target: float) -> Trial | None:
    """Return the trial to take; None if none meets the error."""
    return min((trial for trial in trials if trial.meets(target)), key=cost_of, default=None)


def cost_of(trial: Trial | None) -> float:
    """Return the cost of a trial; none costs infinitely much."""
    return math.inf if trial is None or trial.cost is None else trial.cost


def nearest_miss(trials: Iterable[Trial]) -> Trial | None:
    """Return the trial with the smallest error; None if all failed."""
    known = [(trial.error, index, trial) for index, trial in enumerate(trials) if trial.error is not None]
    return min(known)[2] if known else None


def plan_trajectory(attempt: Try, step: float, target: float, *, verlet: bool, methods: Collection) -> list[Trial]:
    """Try verlet, which needs one trial; then newton with steps as short as they must be; then methods like it."""
    done: list[Trial] = []
    if verlet:
        done.append(attempt(Candidate("verlet", step), done))
    start = Candidate("implicit-euler", step, "newton", "", min(0.1, max(target, TIGHTEST)))
    _shorten(attempt, start, target, done)
    best = _best_implicit(done, target)
    if best is None:
        return done
    best = _relax(attempt, best, target, done)
    if cost_of(best) > LIKES_GAIN * cost_of(cheapest(done, target)):
        return done
    for preset, options in methods:
        done.append(attempt(replace(best.method, preset=preset, options=options), done))
    return done


def plan_step(attempt: Try, step: float, target: float, methods: Collection) -> list[Trial]:
    """Try each method with the goal itself, and where the estimate was a little low, with half of it."""
    done: list[Trial] = []
    for preset, options in (("newton", ""), *methods):
        for goal in (target, target / 2):
            done.append(attempt(Candidate("implicit-euler", step, preset, options, goal), done))
            best = cheapest(done, target)  # a goal that is tighter would make a dearer trial dearer still
            if done[-1].meets(target) or done[-1].error is None or cost_of(done[-1]) > cost_of(best):
                break
    return done


def _shorten(attempt: Try, method: Candidate, target: float, done: list[Trial]) -> None:
    """Try shorter steps until the error is met or cannot be met cheaply; better solved ones where that is what helps.

    The error of implicit Euler is of first order in the step. Where it does not follow the step, it may be that of
    the steps' solution: one better solved trial tells.
    """
    before, looser = math.inf, None
    for _ in range(1 + MOST_SHORTENED):
        trial = attempt(method, done)
        done.append(trial)
        if trial.error is None or trial.meets(target):
            return
        stuck = trial.error > 0.7 * before
        if stuck and looser is not None:
            method = looser  # that was not it
        elif stuck and method.step_error is not None and method.step_error > TIGHTEST:
            looser, method = method, replace(method, step_error=method.step_error / 10)
            continue
        shorter = 2 ** min(4, max(1, math.ceil(math.log2(trial.error / target) - 0.1)))
        if cost_of(trial) * math.sqrt(shorter) > cost_of(cheapest(done, target)):
            return  # shorter steps are somewhat easier, never so much
        before, method = min(before, trial.error), replace(method, time_step=method.time_step / shorter)


def _relax(attempt: Try, best: Trial, target: float, done: list[Trial]) -> Trial:
    """Try a looser solution of the steps, then longer steps, while the error is still met; return the best."""
    first, step_error = best.method, best.method.step_error
    if step_error is not None and step_error < LOOSEST:
        done.append(attempt(replace(first, step_error=min(LOOSEST, 10 * step_error)), done))
    best = _best_implicit(done, target) or best
    while best.error is not None and best.error <= 0.6 * target and best.method.time_step < 4 * first.time_step:
        done.append(attempt(replace(best.method, time_step=2 * best.method.time_step), done))
        if not done[-1].meets(target) or cost_of(done[-1]) >= cost_of(best):
            break
        best = done[-1]
    return _best_implicit(done, target) or best


def _best_implicit(done: Iterable[Trial], target: float) -> Trial | None:
    return cheapest((trial for trial in done if trial.method.integrator != "verlet"), target)


class Planner:
    """Tries methods on the first frames of a scene."""

    def __init__(
        self,
        scene: Path,
        bench: Bench,
        *,
        presets: Collection[str],
        frames: int,
        ranks: int,
        report: Callable[[Trial], None],
    ):
        self.scene, self.bench, self.presets, self.ranks, self.report = scene, bench, presets, ranks, report
        self.as_given = load_scene(scene, (), presets)
        if self.as_given.time.integrator == STATIC:
            raise InputError(f'{scene}: nothing moves where integrator = "{STATIC}": --surface-error plans its cells')
        self.step = self.as_given.time.step
        self.duration = min(frames * self.step, self.as_given.time.duration)
        self.reference: ReferenceRun | None = None
        self.figure = "true_error"
        self.best_seconds = math.inf  # [s] that the cheapest trial took, all in all

    def for_trajectory(self, target: float) -> list[Trial]:
        """Return the trials for an error of the trajectory. Raises InputError if no reference can be made."""
        self.figure = "trajectory_error"
        probe = self._probe()
        self.reference = self._finest(probe)
        return plan_trajectory(
            self._attempt(target), self.step, target, verlet=probe is not None, methods=self._methods()
        )

    def for_step(self, target: float) -> list[Trial]:
        """Return the trials for an error of the step."""
        return plan_step(self._attempt(target), self.step, target, self._methods())

    def _methods(self) -> list[tuple[str, str]]:
        """Return what to try beside newton; PETSc's ICC is for one rank."""
        return [
            (preset, options)
            for preset, options in ALTERNATIVES
            if preset in self.presets and not (self.ranks > 1 and "icc" in options)
        ]

    def _probe(self) -> Row | None:
        """Return verlet's figures of two frames; None if it cannot be done, or not in a reasonable time."""
        row = self._run(Candidate("verlet", self.step), 2 * self.step, FIRST / 4)
        affordable = row["status"] == "ok" and row["time_frame"] * FINER * self.duration / self.step < REFERENCE_TIME
        return row if affordable else None

    def _finest(self, probe: Row | None) -> ReferenceRun:
        """Return a run with tiny steps: explicit where these are affordable."""
        if probe is not None:
            substep = self.step / (FINER * probe["iterations"])
            return ReferenceRun(integrator="verlet", substep=substep, timeout=5 * REFERENCE_TIME)
        step = self.step / IMPLICIT_FINER
        return ReferenceRun(integrator="implicit-euler", step=step, timeout=5 * REFERENCE_TIME)

    def _attempt(self, target: float) -> Try:
        def attempt(method: Candidate, done: Sequence[Trial]) -> Trial:
            best = cheapest(done, target)
            timeout = FIRST if best is None else math.ceil(5 + 1.5 * self.best_seconds)
            row = self._run(method, self.duration, timeout)
            if "no reference" in row["reason"]:
                raise InputError(f"{row['reason']}: fewer --frames may help")
            trial = Trial(method, row.get("time_second"), row.get(self.figure), row["reason"])
            if trial.meets(target) and cost_of(trial) < cost_of(best):
                self.best_seconds = row["seconds"]
            self.report(trial)
            return trial

        return attempt

    def deforms(self) -> bool:
        """Return whether there is elastic energy to speak of: in free flight every method is right."""
        for path in self.bench.references():
            with Result(path) as run:
                elastic, kinetic = run.frames.elastic[:], run.frames.kinetic[:]
            return bool(elastic.max() > QUIET * kinetic.max())
        return True

    def _run(self, method: Candidate, duration: float, timeout: float) -> Row:
        result = self.bench.measure(self._case(method, duration, timeout))
        return result.row | {"seconds": result.seconds}

    def _case(self, method: Candidate, duration: float, timeout: float) -> Case:
        """Return the case of a study of this case alone: the same way from a method to a run."""
        steps = max(1, round(duration / method.time_step))
        scene = StudyScene(
            name=self.scene.stem, file=self.scene.name, duration=max(duration, method.time_step), frame=self.step,
            reference=self.reference, true_error=max(1, steps // 4) if self.figure == "true_error" else None,
        )  # fmt: skip
        sweep = Sweep(
            integrators=(method.integrator,), time_steps=(method.time_step,), options=(method.options,),
            presets=(method.preset,) if method.preset else (), ranks=(self.ranks,),
            errors=(method.step_error,) if method.step_error else (),
        )  # fmt: skip
        study = Study(timeout=timeout, scene=(scene,), sweep=(sweep,))
        return study_cases(study, self.scene.parent, True, self.presets)[0]
