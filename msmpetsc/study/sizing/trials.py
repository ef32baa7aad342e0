"""Trial runs of a plan, which measure errors and costs of time steps and cells."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from msmpetsc.errors import InputError
from msmpetsc.scene.reading import load_scene
from msmpetsc.scene.time import STATIC
from msmpetsc.scene.toml import toml_value
from msmpetsc.scene.values import IntegratorName
from msmpetsc.study.cases import Case, with_tables
from msmpetsc.study.metrics import surface_error
from msmpetsc.study.runner import Bench
from msmpetsc.study.sizing.choice import (
    Budget,
    Candidate,
    Choice,
    CostModel,
    SizePlan,
    SizeTrial,
    Stepping,
    inverted_bound,
    size_bounds,
)
from msmpetsc.study.sizing.orders import ORDERS, ErrorLaw, cosine_of, error_law

# solver preset of the trials; it chooses the preconditioner itself
PRESET = "newton"
# ratio of cell edges of successive lattices, and of the scene to the finest choice
REFINEMENT = 2
# powers of REFINEMENT by which the coarsest lattice is coarsened; the first that runs
COARSEST_POWERS = (2.0, 5 / 3, 4 / 3)
IMPLICIT: tuple[IntegratorName, ...] = ("bdf2", "implicit-euler")
# largest numbers of halvings of the scene's step and of verlet's substeps
HALVINGS, SUBSTEP_HALVINGS = 6, 3
# ratio of cells below which the distance of a finer to a coarser lattice is random
DISTINCT_CELLS = 4
# least cells of the finest lattice in the first round
START_CELLS = 1000
# target / error of the finest step; so that this step stands for the true motion
STEP_MARGIN = 8
# distance of lattices [-] above which the motions are out of phase and show no order
OUT_OF_PHASE = 0.15
# order assumed if lattices show none; clamped bars show 1.5 to 2
USUAL_ORDER = 1.5
# difference of the orders of coarser and finer lattices above which one is chance
ALIKE = 0.5
# time limits of a trial on coarse lattices and on the finest [s]
TIMEOUT, FINEST_TIMEOUT = 150.0, 900.0
MAX_CHOICES = 6
# ratio of most to least cells at which the search for cells ends
NARROW = 1.05
# error / target above which the finest lattice is refined if its order is uncertain
UNCERTAIN = 1 / 3
# error / target that a choice aims at, and the least that ends the search
AIM, ACCEPTED = 0.9, 0.75


class Asked(NamedTuple):
    """The request of a plan.

    target  : largest surface error [-]
    frames  : number of frames, from the scene's first, that the trials run
    cells   : cells of the finest trial lattice; the scene's number if None
    advised : cells on which the thin tenth of each body bends enough
    """

    target: float
    frames: int
    cells: int | None = None
    ranks: int = 1
    advised: float = 0.0


class Sizer:
    """Planner that runs trials of a scene for a surface error and reports each of them."""

    def __init__(
        self, scene: Path, bench: Bench, asked: Asked, report: Callable[[SizeTrial | str], None]
    ):
        self.scene = scene
        self.bench = bench
        self.target = asked.target
        self.ranks = asked.ranks
        self.as_given = load_scene(scene)
        count = asked.cells or self.as_given.cages.count
        if count is None:
            raise InputError(
                f"{scene} has cages.cell_size: --cells N says how many cells the finest trial has"
            )
        self.cells = count
        self.report = report
        self.advised = asked.advised
        self.step = self.as_given.time.step
        steps = min(asked.frames, self.as_given.time.steps)
        self.is_static = self.as_given.time.integrator == STATIC
        # an even number of steps, so that twice the step fits
        self.duration = self.step * max(1, steps if self.is_static else steps // 2 * 2)
        self.halved = [self.step / 2**halving for halving in range(-1, 1 + HALVINGS)]
        # step error of all runs
        self.solved = min(1e-2, self.target / 10)
        self.bounds: list[str] = []
        self.cell_bound = ""
        self.trials: list[SizeTrial] = []

    def plan(self) -> SizePlan:
        """Return the plan from trials, first on few cells. Raises InputError if too few succeed."""
        most = self.cells
        ratio = REFINEMENT**3
        # coarse cells lock thin walls, which hides the order of their error
        while self.cells >= ratio * max(START_CELLS, self.advised):
            self.cells //= ratio
        while True:
            self.bounds.clear()
            plan = self._plan_on_lattices()
            if self.cells >= most or (plan.met and plan.choice.cells <= self.cells / 2):
                return plan
            self.cells = min(most, ratio * self.cells)

    def _plan_on_lattices(self) -> SizePlan:
        """Return the plan from lattices of at most ``cells`` cells."""
        coarse = self._coarser(1)
        steppings = self._steppings(coarse)
        accurate = [each for each in steppings if each.error <= self.target / 2]
        if accurate:
            method = min(accurate, key=self._cost_at_scale).method
        else:
            method = min(steppings, key=lambda each: each.error).method
        lattices = self._lattices(method)
        cells = next(each.cells for each in self.trials if each.asked == coarse)
        law = self._law(lattices)
        model = CostModel(
            law=law, steppings=steppings, cells=cells, least=1, most=REFINEMENT**3 * self.cells
        )
        wanted = model.cheapest(AIM * self.target)
        finest = lattices[-1]
        # a choice this near the finest lattice cannot be measured from it
        is_near = (
            wanted is not None and finest.cells / 2 < wanted.cells < DISTINCT_CELLS * finest.cells
        )
        # the order determines the error of the finest lattice, which enters all errors
        is_uncertain = not law.observed or _distance(lattices[0], lattices[1]) > OUT_OF_PHASE
        is_too_coarse = law.error(finest.edge) > UNCERTAIN * self.target
        # few cells cannot show that no number of cells is enough
        if (wanted is None or is_near or (is_uncertain and is_too_coarse)) and (
            finer := self._run(method, self._coarser(-0.5))
        ):
            lattices = [*lattices[-2:], finer]
            model = replace(model, law=self._law(lattices, law))
        plan, model = self._refine_choice(model, lattices)
        return replace(plan, bounds=self._bounds(plan, model), tried=self.trials)

    # ---- time step

    def _steppings(self, cells: int) -> list[Stepping]:
        """Return methods with the error of their time step; the finest run is taken as exact."""
        if self.is_static:
            # static states have no error of a time step
            state = self._run(self._method(STATIC, self.step), cells)
            if state is None:
                raise InputError(f"{self.scene}: the trial failed on {cells} cells, see above")
            return [Stepping(state.method, 0.0, state.cost)]
        runs, sizes = self._explicit(cells)
        if not runs:
            runs, sizes = self._implicit(cells)
        if len(runs) < 2:
            raise InputError(
                f"{self.scene}: the trials failed on {cells} cells, see above: "
                "nothing can be compared"
            )
        finest = runs[-1]
        remaining = self._remaining_error(runs, sizes)
        if remaining > self.target / STEP_MARGIN:
            distance = _distance(runs[-2], finest)
            self.bounds.append(
                f"the step: runs of {finest.method.integrator} with the two shortest steps are "
                f"{distance:.1e} apart"
            )
        known = [
            Stepping(each.method, _distance(each, finest) + remaining, each.cost)
            for each in runs[:-1]
        ]
        known.append(Stepping(finest.method, remaining, finest.cost))
        explicit = finest.method.integrator == "verlet"
        # substeps shorter than verlet's stability limit cost more without need
        candidates = known[:1] if explicit else known
        for integrator in IMPLICIT:
            if explicit or integrator != finest.method.integrator:
                candidates += self._implicit_steppings(
                    integrator, candidates, finest=finest, remaining=remaining, cells=cells
                )
        return candidates

    def _explicit(self, cells: int) -> tuple[list[SizeTrial], list[float]]:
        """Return runs of verlet with halved substeps, and the substeps; none if a run fails."""
        first = self._run(self._method("verlet", self.step), cells)
        if first is None:
            return [], []
        runs = [first]
        # a whole number of substeps per step, so that frames have the same times
        sizes = [self.step / math.ceil(first.substeps)]
        for _ in range(SUBSTEP_HALVINGS):
            sizes.append(sizes[-1] / 2)
            run = self._run(self._method("verlet", sizes[-1]), cells)
            if run is None:
                return [], []
            runs.append(run)
            if self._remaining_error(runs, sizes) <= self.target / STEP_MARGIN:
                break
        return runs, sizes

    def _implicit(self, cells: int) -> tuple[list[SizeTrial], list[float]]:
        """Return runs of BDF2 with halved steps until the error is small, and the steps."""
        runs: list[SizeTrial] = []
        for step in self.halved:
            run = self._run(self._method("bdf2", step), cells)
            if run is None:
                break
            runs.append(run)
            sizes = self.halved[: len(runs)]
            if len(runs) > 2 and self._remaining_error(runs, sizes) <= self.target / STEP_MARGIN:
                break
        return runs, self.halved[: len(runs)]

    def _remaining_error(self, runs: list[SizeTrial], sizes: list[float]) -> float:
        """Return the error of the last run; ``sizes`` are the steps or substeps of the runs."""
        distances = [_distance(*pair) for pair in pairwise(runs)]
        return error_law(sizes, distances, ORDERS).error(sizes[-1])

    def _implicit_steppings(
        self,
        integrator: IntegratorName,
        known: list[Stepping],
        *,
        finest: SizeTrial,
        remaining: float,
        cells: int,
    ) -> list[Stepping]:
        """Return runs of an integrator with halved steps, while it may be the cheapest."""
        steppings: list[Stepping] = []
        cheapest = min(
            (self._cost_at_scale(each) for each in known if each.error <= self.target / 2),
            default=math.inf,
        )
        for step in self.halved:
            run = self._run(self._method(integrator, step), cells)
            if run is None:
                break
            error = _distance(run, finest) + remaining
            steppings.append(Stepping(run.method, error, run.cost))
            if error <= self.target / 3 or run.cost > 2 * cheapest:
                break
        return steppings

    def _cost_at_scale(self, stepping: Stepping) -> float:
        """Return the cost on the finest lattice, up to a factor that all methods share."""
        return stepping.cost * (REFINEMENT if stepping.method.integrator == "verlet" else 1)

    # ---- cells

    def _lattices(self, method: Candidate) -> list[SizeTrial]:
        """Return runs on three lattices, or on two if the coarsest lattices fail.

        A coarse lattice fails, for example, if no node lies in a pin. Raises InputError if fewer
        than two lattices run.
        """
        coarsest = (
            run for power in COARSEST_POWERS if (run := self._run(method, self._coarser(power)))
        )
        finer = (self._run(method, self._coarser(power)) for power in (1, 0))
        runs = [run for run in (next(coarsest, None), *finer) if run is not None]
        if len(runs) < 2:
            raise InputError(
                f"{self.scene}: only one lattice could be run, see above: "
                "the error of the cells is not known"
            )
        return runs

    def _law(self, runs: list[SizeTrial], coarser: ErrorLaw | None = None) -> ErrorLaw:
        """Return the law of the cells' error from runs on two or three lattices.

        If they show no order, the order of coarser lattices is assumed, or the usual order if these
        show none. If both differ, one of them is chance, and their mean is assumed. If cells are
        inverted, order 1 is assumed: the inverted region shrinks no faster than the edge of a cell.

        coarser : law of coarser lattices
        """
        distances = [_distance(*pair) for pair in pairwise(runs)]
        least, greatest = ORDERS
        is_out_of_phase = len(runs) > 2 and distances[0] > OUT_OF_PHASE
        is_inverted = runs[-1].inverted > 0
        known = coarser.order if coarser and coarser.observed else None
        orders, assumed = (USUAL_ORDER if is_out_of_phase else least, greatest), known
        if is_inverted:
            orders, assumed, known = (least, least), least, None
        across = _distance(runs[0], runs[-1])
        cosine = cosine_of(distances[0], distances[1], across) if len(runs) > 2 else 0.0
        edges = [each.edge for each in runs]
        law = error_law(
            edges,
            distances,
            orders,
            None if is_out_of_phase else across,
            cosine,
            assumed or USUAL_ORDER,
        )
        if known and law.observed and abs(law.order - known) > ALIKE:
            mean = (law.order + known) / 2
            law = error_law((edges[0], edges[-1]), (across,), ORDERS, None, cosine, mean)
        law = replace(law, observed=law.observed and not is_inverted)
        self.cell_bound = ""
        if not law.observed:
            self.cell_bound = (
                f"the cells: their distances show no order; order {law.order:.2g} is assumed"
            )
        return law

    def _coarser(self, power: float) -> int:
        """Return the cells of the lattice whose edges are REFINEMENT^power times as long."""
        cells: float = self.cells / REFINEMENT ** (3 * power)
        return max(1, round(cells))

    def _refine_choice(
        self, model: CostModel, lattices: Sequence[SizeTrial]
    ) -> tuple[SizePlan, CostModel]:
        """Choose, run and measure until the error is a little less than the target.

        Each choice lies between cells that met the target and cells that did not, because the error
        is not monotonic in the cells. Returns the plan, and the model with the cells narrowed.
        """
        law = model.law
        finest = lattices[-1]
        met = None
        finest_error = law.error(finest.edge)
        # (edge, error) of lattices that are fine enough, and too coarse
        fine = [(finest.edge, finest_error)] if finest_error < AIM * self.target else []
        coarse: list[tuple[float, float]] = []
        for _ in range(MAX_CHOICES):
            choice = model.cheapest(AIM * self.target) or model.cheapest(self.target)
            if choice is None:
                break
            run = self._run(choice.method, choice.cells)
            if run is None:
                model = self._excluding(choice, model, math.ceil(lattices[0].cells))
                continue
            measured = self._measured(choice, run, finest, law)
            error = measured.total / self.target
            if error <= 1:
                met = replace(choice, cost=run.cost, budget=measured)
                fine = [(run.edge, measured.cells)]
                model = replace(model, most=choice.cells - 1)
            else:
                coarse = [(run.edge, measured.cells)]
                model = replace(model, least=choice.cells + 1)
            if ACCEPTED <= error <= 1 or model.least > model.most / NARROW:
                break
            self.report(f"{choice.cells} cells: {measured.total:.1e}, chosen once more")
            model = replace(model, law=law.through(*coarse, *fine))
        return SizePlan(met or model.cheapest(self.target) or model.best(), met is not None), model

    def _excluding(self, choice: Choice, model: CostModel, fewest: int) -> CostModel:
        """Return a model without a failed choice's cells if they are few, or without its method."""
        if choice.cells < fewest:
            return replace(model, least=fewest)
        method = choice.method
        kept = [each for each in model.steppings if each.method != method]
        self.bounds.append(
            f"the step: {method.integrator} with steps of {method.time_step:g} s "
            "fails on finer cells"
        )
        return replace(model, steppings=kept or model.steppings)

    def _measured(self, choice: Choice, run: SizeTrial, finest: SizeTrial, law: ErrorLaw) -> Budget:
        """Return the errors of a choice; its distance to the finest lattice gives the cells' error.

        If the choice is a little finer than the finest lattice, their distance is random and the
        expected error stands.
        """
        if 1 < run.cells / finest.cells < DISTINCT_CELLS:
            return choice.budget
        # the same method, so that only the cells differ
        finest = self._run(choice.method, finest.asked) or finest
        distance = _distance(run, finest)
        if run.edge < finest.edge:
            cells_error = law.measured_finer(distance, run.edge, finest.edge)
        else:
            cells_error = law.measured(distance, finest.edge)
        return replace(choice.budget, cells=cells_error)

    def _bounds(self, plan: SizePlan, model: CostModel) -> list[str]:
        """Return the reasons why the error of a plan is not smaller, or not certain."""
        inverted = inverted_bound(self.trials, self.as_given.material.law)
        thin = []
        if plan.choice.cells < self.advised:
            thin = [
                f"the cells: on {plan.choice.cells} cells a tenth of a body bends too little; "
                f"{float(f'{self.advised:.2g}'):.0f} would do"
            ]
        bounds = [*self.bounds, *filter(None, [self.cell_bound]), *inverted, *thin]
        if not plan.met:
            bounds += size_bounds(model, self.target, bool(self.bounds))
        return bounds

    # ---- runs

    def _method(self, integrator: IntegratorName, step: float) -> Candidate:
        """Return an integrator with a time step [s], solved as the trials are."""
        if integrator == "verlet":
            return Candidate(integrator, step)
        return Candidate(integrator, step, PRESET, self.solved)

    def _run(self, method: Candidate, cells: int) -> SizeTrial | None:
        """Return a trial, run on first use; report a failure and return None."""
        done = next(
            (each for each in self.trials if (each.method, each.asked) == (method, cells)), None
        )
        if done is not None:
            return done
        case = self.case(method, cells)
        row = self.bench.measure(case, keep=True)
        if row["status"] != "ok" or not row.get("time_second"):
            self.report(
                f"{method.integrator}, step {method.time_step:g} s, {cells} cells: {row['reason']}"
            )
            return None
        inverted = row.get("inverted") or 0.0
        result = self.bench.result_of(case)
        trial = SizeTrial(
            method, cells, row["cells"], row["time_second"], row["iterations"], inverted, result
        )
        self.trials.append(trial)
        self.report(trial)
        return trial

    def case(self, method: Candidate, cells: int) -> Case:
        """Return the case of a method and a number of cells, with output at the scene's frames."""
        cages = self.as_given.cages.model_dump(exclude_unset=True) | {
            "count": cells,
            "cell_size": None,
        }
        timeout = TIMEOUT if cells < self.cells else FINEST_TIMEOUT
        case = Case(
            scene=self.scene.stem, file=self.scene, content="", set=(f"cages={toml_value(cages)}",),
            ranks=self.ranks, integrator=method.integrator, time_step=method.time_step,
            preset=method.preset, error=method.step_error, timeout=timeout,
        )  # fmt: skip
        every = max(1, round(self.step / method.time_step))
        case = with_tables(case, self.duration, 1, self.as_given, surface=True)
        return case.changed(f"output.every={every}")


def _distance(run: SizeTrial, reference: SizeTrial) -> float:
    """Return the distance of the surfaces of two trials [-]."""
    return surface_error(run.result, reference.result)
