"""Trial runs of a plan: coarse lattices show the step's error, three lattices the cells'."""

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
    Solving,
    Stepping,
    inverted_bound,
    size_bounds,
)
from msmpetsc.study.sizing.orders import ORDERS, ErrorLaw, cosine_of, error_law

PRESET = "newton"  # which itself chooses how its linear systems are preconditioned
COARSER = 2  # times: the edge of a cell from one lattice to the next; the finest chosen is so much finer than the scene
COARSEST = (2.0, 5 / 3, 4 / 3)  # times that it is done, the first that can be run
IMPLICIT: tuple[IntegratorName, ...] = ("bdf2", "implicit-euler")
HALVINGS = 6  # of the scene's step
REFINED = 3  # times that explicit substeps are halved, at most
FINE = 4  # times the cells: of a choice less fine than that its distance from a coarser lattice tells nothing
FEWEST = 1000  # cells of the finest lattice that is worth beginning with
PART = 8  # the error of the finest step must be so small a part of the error asked for
FAR = 0.15  # surfaces so far apart move out of step: that is no small error any more, and shrinks with no order
USUAL = 1.5  # order of cells that count by their fill: 1.5 to 2 on clamped bars
LOOSE = (1e-1, 1e-2)  # step errors that are tried beside that of the trials
TIME, LONG_TIME = 150.0, 900.0  # [s] a trial on a coarse lattice, or on a fine one, may take
CHOICES = 6  # that are tried
NARROW = 1.05  # times the cells: between cells so alike none are tried
VAGUE = (
    1 / 3
)  # of the error asked for: the most that the finest lattice may have by an order that is not sure
AIM, ENOUGH = (
    0.9,
    0.75,
)  # times the error asked for: what is tried, and where fewer cells are not tried any more


class Asked(NamedTuple):
    """The request of a plan."""

    target: float  # error of the surface
    frames: int  # first frames of the scene that are tried
    cells: int | None = None  # of the finest lattice that is tried; the scene's if None
    ranks: int = 1


class Sizer:
    """Runs the trials of a scene for a surface error, and reports each."""

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
        self.step = self.as_given.time.step
        steps = min(asked.frames, self.as_given.time.steps)
        self.is_static = self.as_given.time.integrator == STATIC
        self.duration = self.step * max(
            1, steps if self.is_static else steps // 2 * 2
        )  # twice the step fits, too
        self.halved = [self.step / 2**halving for halving in range(-1, 1 + HALVINGS)]
        self.solved = min(1e-3, self.target / 10)  # step error of the trials
        self.bounds: list[str] = []
        self.cell_bound = ""  # what is not sure of the cells' error
        self.trials: list[SizeTrial] = []

    def plan(self) -> SizePlan:
        """Run the trials, on few cells first, and choose. Raises InputError where too few runs succeed."""
        most, between = self.cells, COARSER**3
        while self.cells >= between * FEWEST:
            self.cells //= between
        while True:
            self.bounds.clear()
            plan = self._sized()
            if self.cells >= most or (plan.met and plan.choice.cells <= self.cells / 2):
                return plan
            self.cells = min(most, between * self.cells)

    def _sized(self) -> SizePlan:
        """Return the plan by lattices of at most ``cells`` cells."""
        coarse = self._coarser(1)
        steppings = self._steppings(coarse)
        fair = [each for each in steppings if each.error <= self.target / 2]
        method = (
            min(fair, key=self._at_scale) if fair else min(steppings, key=lambda each: each.error)
        ).method
        solvings = self._solvings(method, coarse)
        lattices = self._lattices(method)
        costs = [(each.cells, each.cost) for each in lattices]
        on = next(each.cells for each in self.trials if each.asked == coarse)
        law = self._law(lattices)
        model = CostModel(
            law,
            steppings,
            solvings,
            on,
            costs,
            method.integrator == "verlet",
            1,
            COARSER**3 * self.cells,
        )
        wanted = model.cheapest(AIM * self.target)
        like = (
            wanted is not None and lattices[-1].cells / 2 < wanted.cells < FINE * lattices[-1].cells
        )
        # such an order makes the error of the finest lattice, which is part of all that are measured
        vague = not law.seen or _apart(lattices[0], lattices[1]) > FAR
        blind = vague and (wanted is None or law.error(lattices[-1].edge) > VAGUE * self.target)
        if (like or blind) and (finer := self._run(method, self._coarser(-0.5))):
            lattices = [*lattices[-2:], finer]  # from which the choice can be told, and the order
            model = replace(model, law=self._law(lattices))
        plan, model = self._checked(model, lattices)
        return replace(plan, bounds=self._bounds(plan, model), tried=self.trials)

    # Time

    def _steppings(self, cells: int) -> list[Stepping]:
        """Return integrators and steps with their time error, the finest run being the true motion."""
        if self.is_static:  # whose states have no such error
            state = self._run(self._method(STATIC, self.step), cells)
            if state is None:
                raise InputError(f"{self.scene}: the trial failed on {cells} cells, see above")
            return [Stepping(state.method, 0.0, state.cost)]
        ladder, sizes = self._explicit(cells)
        if not ladder:
            ladder, sizes = self._implicit(cells)
        if len(ladder) < 2:
            raise InputError(
                f"{self.scene}: the trials failed on {cells} cells, see above: nothing can be compared"
            )
        finest, left = ladder[-1], self._left(ladder, sizes)
        if left > self.target / PART:
            apart = _apart(ladder[-2], finest)
            self.bounds.append(
                f"the step: the two shortest of {finest.method.integrator} are {apart:.1e} apart"
            )
        known = [
            Stepping(each.method, _apart(each, finest) + left, each.cost) for each in ladder[:-1]
        ]
        known.append(Stepping(finest.method, left, finest.cost))
        explicit = finest.method.integrator == "verlet"
        chosen_from = (
            known[:1] if explicit else known
        )  # shorter substeps than verlet's own cost much, and give nothing
        for integrator in IMPLICIT:
            if explicit or integrator != finest.method.integrator:
                chosen_from += self._others(
                    integrator, chosen_from, finest=finest, left=left, cells=cells
                )
        return chosen_from

    def _explicit(self, cells: int) -> tuple[list[SizeTrial], list[float]]:
        """Return runs of verlet with halved substeps, and the substeps; none where one takes too long."""
        first = self._run(self._method("verlet", self.step), cells)
        if first is None:
            return [], []
        runs = [first]
        sizes = [self.step / math.ceil(first.substeps)]  # frames come at the same times
        for _ in range(REFINED):
            sizes.append(sizes[-1] / 2)
            run = self._run(self._method("verlet", sizes[-1]), cells)
            if run is None:
                return [], []
            runs.append(run)
            if self._left(runs, sizes) <= self.target / PART:
                break
        return runs, sizes

    def _implicit(self, cells: int) -> tuple[list[SizeTrial], list[float]]:
        """Return runs of BDF2 with halved steps until the remaining error is small, and the steps."""
        runs: list[SizeTrial] = []
        for step in self.halved:
            run = self._run(self._method("bdf2", step), cells)
            if run is None:
                break
            runs.append(run)
            if len(runs) > 2 and self._left(runs, self.halved[: len(runs)]) <= self.target / PART:
                break
        return runs, self.halved[: len(runs)]

    def _left(self, runs: list[SizeTrial], sizes: list[float]) -> float:
        """Return the error of the last of runs whose steps, or substeps, have these sizes."""
        apart = [_apart(*pair) for pair in pairwise(runs)]
        return error_law(sizes, apart, ORDERS).error(sizes[-1])

    def _others(
        self,
        integrator: IntegratorName,
        known: list[Stepping],
        *,
        finest: SizeTrial,
        left: float,
        cells: int,
    ) -> list[Stepping]:
        """Return runs of an integrator with halved steps, while it may be the cheapest."""
        others: list[Stepping] = []
        enough = min(
            (self._at_scale(each) for each in known if each.error <= self.target / 2),
            default=math.inf,
        )
        for step in self.halved:
            run = self._run(self._method(integrator, step), cells)
            if run is None:
                break
            others.append(Stepping(run.method, _apart(run, finest) + left, run.cost))
            if others[-1].error <= self.target / 3 or run.cost > 2 * enough:
                break
        return others

    def _at_scale(self, stepping: Stepping) -> float:
        """Return the cost on the finest lattice up to a common factor; verlet's substeps shorten with the cells."""
        return stepping.cost * (COARSER if stepping.method.integrator == "verlet" else 1)

    def _solvings(self, method: Candidate, cells: int) -> list[Solving]:
        """Return the step errors that may be chosen, with the error that each leaves in the motion."""
        if method.step_error is None:
            return [Solving(self.solved, 0.0, 1.0)]
        base = self._run(method, cells)
        known: list[Solving] = []
        rest = 0.0
        for step_error in LOOSE:
            if base and (run := self._run(replace(method, step_error=step_error), cells)):
                error = _apart(run, base)
                known.append(Solving(step_error, error, run.cost / base.cost))
                rest = error * self.solved / step_error
        return [*known, Solving(self.solved, rest, 1.0)]

    # Cells

    def _lattices(self, method: Candidate) -> list[SizeTrial]:
        """Return the runs of three lattices, from which the error of the cells is extrapolated.

        Where the coarsest fails, in which a pin may hold no node, a finer one stands in for it.
        """
        coarsest = (run for power in COARSEST if (run := self._run(method, self._coarser(power))))
        finer = (self._run(method, self._coarser(power)) for power in (1, 0))
        runs = [run for run in (next(coarsest, None), *finer) if run is not None]
        if len(runs) < 2:
            raise InputError(
                f"{self.scene}: only one lattice could be run, see above: the cells' error is not known"
            )
        return runs

    def _law(self, runs: list[SizeTrial]) -> ErrorLaw:
        """Return the error of the cells from runs of two lattices or three.

        What turns inside out is as fine as the cells are, and shrinks no faster, whatever the distances say.
        """
        apart = [_apart(*pair) for pair in pairwise(runs)]
        least, greatest = ORDERS
        far, inverted = len(runs) > 2 and apart[0] > FAR, runs[-1].inverted > 0
        orders = (least, least) if inverted else (USUAL if far else least, greatest)
        across = _apart(runs[0], runs[-1])
        cosine = cosine_of(apart[0], apart[1], across) if len(runs) > 2 else 0.0
        law = error_law(
            [each.edge for each in runs], apart, orders, None if far else across, cosine
        )
        law, self.cell_bound = replace(law, seen=law.seen and not inverted), ""
        if not law.seen:
            self.cell_bound = (
                f"the cells: their distances show no order; order {law.order:g} is taken"
            )
        return law

    def _coarser(self, power: float) -> int:
        """Return the number of cells of the lattice coarsened ``power`` times."""
        cells: float = self.cells / COARSER ** (3 * power)
        return max(1, round(cells))

    def _checked(
        self, model: CostModel, lattices: Sequence[SizeTrial]
    ) -> tuple[SizePlan, CostModel]:
        """Choose, run and measure, until the error is little less than the target.

        Each choice lies between the cells that met the error and those that did not, for errors go
        up and down from lattice to lattice. Returns the model with what was learnt, too.
        """
        law, finest, met = model.law, lattices[-1], None
        fine = (
            [(finest.edge, law.error(finest.edge))]
            if law.error(finest.edge) < AIM * self.target
            else []
        )
        coarse: list[
            tuple[float, float]
        ] = []  # sizes and errors of what is too coarse, and of what is not
        for _ in range(CHOICES):
            choice = model.cheapest(AIM * self.target) or model.cheapest(self.target)
            if choice is None:
                break
            run = self._run(choice.method, choice.cells)
            if run is None:
                model = self._without(choice, model, math.ceil(lattices[0].cells))
                continue
            measured = self._measured(choice, run, finest, law)
            error = measured.total / self.target
            if error <= 1:
                met, fine = (
                    replace(choice, cost=run.cost, budget=measured),
                    [(run.edge, measured.cells)],
                )
                model = replace(model, most=choice.cells - 1)
            else:
                coarse = [(run.edge, measured.cells)]
                model = replace(model, least=choice.cells + 1)
            if ENOUGH <= error <= 1 or model.least > model.most / NARROW:
                break
            self.report(f"{choice.cells} cells: {measured.total:.1e}, chosen once more")
            model = replace(model, law=law.through(*coarse, *fine))
        return SizePlan(met or model.cheapest(self.target) or model.best(), met is not None), model

    def _without(self, choice: Choice, model: CostModel, fewest: int) -> CostModel:
        """Return a model without a failed choice: without its cells if they are few, or else without its step."""
        if choice.cells < fewest:
            return replace(model, least=fewest)
        method = self._as_tried(choice.method)
        kept = [each for each in model.steppings if each.method != method]
        self.bounds.append(
            f"the step: {method.integrator} with steps of {method.time_step:g} s fails on finer cells"
        )
        return replace(model, steppings=kept or model.steppings)

    def _measured(self, choice: Choice, run: SizeTrial, finest: SizeTrial, law: ErrorLaw) -> Budget:
        """Return the errors of a choice, that of its cells measured from the finest lattice.

        Where it is the finer one and they are alike, that is as expected: what they are apart is chance.
        """
        if 1 < run.cells / finest.cells < FINE:
            return choice.budget
        finest = (
            self._run(self._as_tried(choice.method), finest.asked) or finest
        )  # so that only the cells differ
        apart = _apart(run, finest)
        if run.edge < finest.edge:
            return replace(choice.budget, cells=law.measured_finer(apart, run.edge, finest.edge))
        return replace(choice.budget, cells=law.measured(apart, finest.edge))

    # What is said

    def _bounds(self, plan: SizePlan, model: CostModel) -> list[str]:
        inverted = inverted_bound(self.trials, self.as_given.material.law)
        bounds = [*self.bounds, *filter(None, [self.cell_bound]), *inverted]
        if not plan.met:
            bounds += size_bounds(model, self.target, bool(self.bounds))
        return bounds

    # Runs

    def _as_tried(self, method: Candidate) -> Candidate:
        """Return a method with its steps solved as those of the trials are."""
        return replace(method, step_error=self.solved if method.step_error else None)

    def _method(self, integrator: IntegratorName, step: float) -> Candidate:
        if integrator == "verlet":
            return Candidate(integrator, step)
        return Candidate(integrator, step, PRESET, self.solved)

    def _run(self, method: Candidate, cells: int) -> SizeTrial | None:
        """Return a trial, run at most once; None if it fails, which is reported."""
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
        trial = SizeTrial(
            method, cells, row["cells"], row["time_second"], row["iterations"], row.get("inverted") or 0.0,
            self.bench.result_of(case),
        )  # fmt: skip
        self.trials.append(trial)
        self.report(trial)
        return trial

    def case(self, method: Candidate, cells: int) -> Case:
        """Return the case of a method and a number of cells, with output at the frames of the scene."""
        cages = self.as_given.cages.model_dump(exclude_unset=True) | {
            "count": cells,
            "cell_size": None,
        }
        timeout = TIME if cells < self.cells else LONG_TIME
        case = Case(
            scene=self.scene.stem, file=self.scene, content="", set=(f"cages={toml_value(cages)}",), ranks=self.ranks,
            integrator=method.integrator, time_step=method.time_step, preset=method.preset, error=method.step_error,
            timeout=timeout,
        )  # fmt: skip
        every = max(1, round(self.step / method.time_step))
        case = with_tables(case, self.duration, 1, self.as_given, surface=True)
        return case.changed(f"output.every={every}")


def _apart(run: SizeTrial, reference: SizeTrial) -> float:
    return surface_error(run.result, reference.result)
