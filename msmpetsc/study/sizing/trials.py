"""Trial runs of a plan: they measure the errors and costs of integrators and cell counts."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

from msmpetsc.errors import InputError
from msmpetsc.scene.reading import load_scene
from msmpetsc.scene.time import STATIC
from msmpetsc.scene.toml import overrides_of
from msmpetsc.study.cases import Case
from msmpetsc.study.metrics import surface_error
from msmpetsc.study.runner import Bench
from msmpetsc.study.sizing.choice import Budget, Choice, PlannedMethod, SizePlan, SizeTrial, tables
from msmpetsc.study.sizing.orders import ORDERS, ErrorLaw, cosine_of, error_law

# powers of 2 that coarsen the coarsest lattice; the first that runs is used
COARSEST_POWERS = (2.0, 5 / 3, 4 / 3)
# least cells of the finest lattice in the first round
START_CELLS = 1000
# target over the time error of implicit steps [-]; leaves most of the target to cells
STEP_MARGIN = 8
# distance of lattices above which motions are out of phase and show no order [-]
OUT_OF_PHASE = 0.15
# order assumed if lattices show none; clamped bars show 1.5 to 2
USUAL_ORDER = 1.5
# time limit of a trial [s]
TIMEOUT = 900.0
MAX_CHOICES = 6
CELLS_HINT = "--cells N says how many cells the finest trial has"
# error over target at which a choice aims, and least ratio that ends the search [-]
AIM, ACCEPTED = 0.9, 0.75


class Sizer:
    """Planner that runs trials of a scene for a surface error, and reports each trial.

    target  : largest surface error [-]
    frames  : number of the scene's first steps that the trials run
    cells   : number of cells of the finest trial lattice; the scene's number if None
    advised : number of cells on which the thin tenth of each body bends enough
    """

    def __init__(
        self,
        scene: Path,
        bench: Bench,
        report: Callable[[SizeTrial | str], None],
        *,
        target: float,
        frames: int,
        cells: int | None = None,
        ranks: int = 1,
        advised: float = 0.0,
    ):
        self.scene = scene
        self.bench = bench
        self.target = target
        self.ranks = ranks
        self.as_given = load_scene(scene)
        count = cells or self.as_given.cages.count
        if count is None:
            raise InputError(f"{scene} has cages.cell_size: {CELLS_HINT}")
        self.cells = count
        self.report = report
        self.advised = advised
        self.step = self.as_given.time.step
        self.is_static = self.as_given.time.integrator == STATIC
        self.duration = self.step * min(frames, self.as_given.time.steps)
        # step error of all runs
        self.solved = min(1e-3, self.target / 10)
        # whether verlet may be chosen
        self.explicit = True
        self.bounds: list[str] = []
        self.trials: list[SizeTrial] = []

    @property
    def most(self) -> int:
        """Largest number of cells that may be chosen, of half the edge."""
        return 8 * self.cells

    def plan(self) -> SizePlan:
        """Return the plan, from trials first on few cells, then on more.

        Raises InputError if too few trials succeed.
        """
        finest = self.cells
        # coarse cells lock thin walls, which hides the order of their error
        while self.cells >= 8 * max(START_CELLS, self.advised):
            self.cells //= 8
        while True:
            self.bounds.clear()
            plan = self._plan_on_lattices()
            if self.cells >= finest or (plan.met and plan.choice.cells <= self.cells / 2):
                return plan
            self.cells = min(finest, 8 * self.cells)

    def _plan_on_lattices(self) -> SizePlan:
        """Return the plan from lattices of at most ``cells`` cells."""
        method, time_error = self._chosen_method(self._coarser(1))
        lattices = self._lattices(method)
        law = self._law(lattices)
        wanted = fewest_cells(law, AIM * self.target - time_error)
        finest = lattices[-1]
        # the error of a choice cannot be measured on a lattice that is hardly finer
        if wanted > finest.cells / 2 and (finer := self._run(method, self._coarser(-0.5))):
            lattices = [*lattices[-2:], finer]
            law = self._law(lattices)
        plan = self._refine_choice(method, time_error, law, lattices)
        if plan is None:
            self.explicit = False
            return self._plan_on_lattices()
        return replace(plan, bounds=self._bounds(plan, law), tried=self.trials)

    # ---- integrator

    def _chosen_method(self, cells: int) -> tuple[PlannedMethod, float]:
        """Return the cheapest method and the error of its time steps [-].

        Verlet takes steps of its stability limit. It may be chosen if its run is near an implicit
        run with steps chosen by their error. The distance of the two runs is mostly the time error
        of the implicit run, so it is an upper estimate of verlet's time error.

        Raises InputError if no implicit run succeeds.
        """
        if self.is_static:
            # static states have no error of a time step
            return PlannedMethod(STATIC, step_error=self.solved), 0.0
        allowed = self.target / STEP_MARGIN
        methods = (PlannedMethod(name, allowed, self.solved) for name in ("bdf2", "implicit-euler"))
        implicit = next(filter(None, (self._run(method, cells) for method in methods)), None)
        if implicit is None:
            raise InputError(
                f"{self.scene}: the trials failed on {cells} cells, see above: "
                "nothing can be compared"
            )
        explicit = self._run(PlannedMethod("verlet"), cells) if self.explicit else None
        if explicit is not None:
            distance = _distance(explicit, implicit)
            if distance > 2 * allowed:
                self.bounds.append(
                    f"the step: runs of verlet and {implicit.method.integrator} are "
                    f"{distance:.1e} apart"
                )
            # verlet's substeps shorten with the edges of cells
            elif 2 * explicit.cost < implicit.cost:
                return explicit.method, distance
        return implicit.method, allowed

    # ---- cells

    def _lattices(self, method: PlannedMethod) -> list[SizeTrial]:
        """Return runs on three lattices, or on two if the coarsest lattices fail.

        A coarse lattice fails, for example, if no node lies in a pin. Raises InputError if fewer
        than two lattices run.
        """
        coarsest = (
            run for power in COARSEST_POWERS if (run := self._run(method, self._coarser(power)))
        )
        finer = (self._run(method, self._coarser(power)) for power in (1, 0))
        # with few cells, different numbers may give the same lattice
        runs = {run.edge: run for run in (next(coarsest, None), *finer) if run is not None}
        if len(runs) < 2:
            raise InputError(
                f"{self.scene}: only one lattice could be run, see above: "
                f"the error of the cells is not known; {CELLS_HINT}"
            )
        return list(runs.values())

    def _law(self, runs: list[SizeTrial]) -> ErrorLaw:
        """Return the law of the cells' error from runs on two or three lattices.

        If the runs show no order, the usual order is assumed. If cells are inverted, order 1 is
        assumed, because the inverted region shrinks no faster than the edge of a cell.
        """
        distances = [_distance(*pair) for pair in pairwise(runs)]
        across = _distance(runs[0], runs[-1])
        cosine = cosine_of(distances[0], distances[1], across) if len(runs) > 2 else 0.0
        edges = [run.edge for run in runs]
        least, greatest = ORDERS
        if runs[-1].inverted > 0:
            # two runs show no order, so the least is assumed
            return error_law(edges[-2:], distances[-1:], ORDERS, cosine)
        is_out_of_phase = len(runs) > 2 and distances[0] > OUT_OF_PHASE
        orders = (USUAL_ORDER if is_out_of_phase else least, greatest)
        return error_law(edges, distances, orders, cosine, USUAL_ORDER)

    def _coarser(self, power: float) -> int:
        """Return the number of cells with edges 2^power times as long."""
        return max(1, round(self.cells / 8**power))

    def _refine_choice(
        self, method: PlannedMethod, time_error: float, law: ErrorLaw, lattices: Sequence[SizeTrial]
    ) -> SizePlan | None:
        """Choose, run and measure until the error is a little less than the target.

        Each choice lies between numbers of cells that met and that missed the target, because the
        error is not monotonic. Returns None if verlet fails on finer cells.
        """
        finest = lattices[-1]
        met = None
        finest_error = law.error(finest.edge)
        # (edge, error) of lattices that are fine enough, and too coarse
        fine = [(finest.edge, finest_error)] if finest_error < AIM * self.target else []
        coarse: list[tuple[float, float]] = []
        least, most = 1, self.most
        for _ in range(MAX_CHOICES):
            wanted = fewest_cells(law, AIM * self.target - time_error)
            if wanted > most:
                break
            cells = max(least, int(wanted))
            run = self._run(method, cells)
            if run is None:
                if cells < lattices[0].cells:
                    least = math.ceil(lattices[0].cells)
                    continue
                self.bounds.append(f"the step: {method.integrator} fails on finer cells")
                if method.integrator == "verlet":
                    return None
                break
            of_cells = law.error(run.edge)
            if run.cells <= finest.cells:
                # both runs have the same method, so that only the cells differ
                of_cells = law.measured(_distance(run, finest), finest.edge)
            measured = Budget(of_cells, time_error)
            error = measured.total / self.target
            if error <= 1:
                met = Choice(method, cells, measured, run.cost)
                fine = [(run.edge, measured.cells)]
                most = cells - 1
            else:
                coarse = [(run.edge, measured.cells)]
                least = cells + 1
            if ACCEPTED <= error <= 1 or least > most:
                break
            self.report(f"{cells} cells: {measured.total:.1e}, chosen once more")
            law = law.through(*coarse, *fine)
        budget = Budget(law.error(self.most ** (-1 / 3)), time_error)
        cost = finest.cost * self.most / finest.cells
        return SizePlan(met or Choice(method, self.most, budget, cost), met is not None)

    def _bounds(self, plan: SizePlan, law: ErrorLaw) -> list[str]:
        """Return the reasons why the error of a plan is not smaller, or not certain."""
        bounds = [*self.bounds]
        if not law.observed:
            bounds.append(
                f"the cells: their distances show no order; order {law.order:.2g} is assumed"
            )
        finest = max(self.trials, key=lambda trial: trial.cells)
        if finest.inverted:
            bounds.append(
                f"the motion: of {finest.cells:.0f} cells {finest.inverted:.0f} end inside out, "
                "each lattice in its own way; fewer --frames may help"
            )
        if plan.choice.cells < self.advised:
            bounds.append(
                f"the cells: on {plan.choice.cells} cells a tenth of a body bends too little; "
                f"{float(f'{self.advised:.2g}'):.0f} would do"
            )
        if not plan.met:
            half = fewest_cells(law, self.target / 2)
            bounds.append(
                f"the mesh's cells: {plan.choice.budget.cells:.1e} is left with "
                f"{plan.choice.cells} cells; half the error asked for would take {half:.2g}"
            )
        return bounds

    # ---- runs

    def _run(self, method: PlannedMethod, cells: int) -> SizeTrial | None:
        """Return a trial, run on first use; report a failure and return None."""
        done = next(
            (each for each in self.trials if (each.method, each.asked) == (method, cells)), None
        )
        if done is not None:
            return done
        case = self.case(method, cells)
        row = self.bench.measure(case, keep=True)
        if row["status"] != "ok" or not row.get("time_second"):
            self.report(f"{method.integrator}, {cells} cells: {row['reason']}")
            return None
        inverted = row.get("inverted") or 0.0
        result = self.bench.result_of(case)
        trial = SizeTrial(method, cells, row["cells"], row["time_second"], inverted, result)
        self.trials.append(trial)
        self.report(trial)
        return trial

    def case(self, method: PlannedMethod, cells: int) -> Case:
        """Return the case of a method and a number of cells, with output at the scene's frames."""
        own = tables(method)
        changes = {
            **own,
            "cages": self.as_given.cages.model_dump(exclude_unset=True)
            | {"count": cells, "cell_size": None},
            "time": {**own["time"], "step": self.step, "duration": self.duration},
            "output.every": 1,
            "output.surface": True,
        }
        return Case(
            scene=self.scene.stem, file=self.scene, content="", set=tuple(overrides_of(changes)),
            ranks=self.ranks, integrator=method.integrator, time_step=self.step,
            timeout=TIMEOUT,
        )  # fmt: skip


def fewest_cells(law: ErrorLaw, error: float) -> float:
    """Return the fewest cells whose error is at most ``error``; infinity if no number is enough."""
    if error <= 0:
        return math.inf
    if law.factor <= 0:
        return 1
    # a size of 1e-103 and below has more cells than a double counts
    try:
        return max(1, math.ceil(law.size(error) ** -3))
    except (OverflowError, ZeroDivisionError):
        return math.inf


def _distance(run: SizeTrial, reference: SizeTrial) -> float:
    """Return the distance of the surfaces of two trials [-]."""
    return surface_error(run.result, reference.result)
