#!/usr/bin/env python3
"""Holds what plan --surface-error chooses against finer runs, and prints a Markdown table. Needs the meshes.

    scripts/plan_study.py [SCENE...] [--errors 0.1 0.03 0.01] [--cells N] [--frames N] [--limit SECONDS]

The finer run has 32 times the cells of the choice, or 8 times where that takes longer than the limit, and a quarter
more than the plan's finest trial at least. It takes explicit substeps or a quarter of the step; a static one is
static. Where no choice meets the error, the best one is held against a finer run if that takes no longer than the
limit. Where the choice would take over 5 s for all of the scene, it is run in full too, to tell the plan's own time
beside it. SCENE is a name of the study or a scene file. Runs stay in out/plan_study, so the same command goes on where
it stopped.
"""

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter

from clone import ROOT, parser

from msmpetsc.cli.commands.plan import print_size_trial
from msmpetsc.errors import InputError
from msmpetsc.scene.statics import STATIC
from msmpetsc.study.cases import Case
from msmpetsc.study.distances import surface_error
from msmpetsc.study.process import Processes
from msmpetsc.study.runner import Bench, CaseResult
from msmpetsc.study.sizing.answer import SizePlan
from msmpetsc.study.sizing.choice import Candidate, Choice
from msmpetsc.study.sizing.trials import Sizer
from msmpetsc.study.table import Row

OUT, ERRORS, LIMIT = ROOT / "out" / "plan_study", (0.1, 0.03, 0.01), 900.0  # [s] a finer run
HEAD = (
    "scene", "asked", "chosen, cells", "expected: cells + time + step", "true error", "over asked", "s a simulated s",
    "plan, s", "choice in full, s", "what bounds it",
)  # fmt: skip
FINER = 32, 8  # times the cells: 8 are half the edge, and err by half as much where the order is 1
MORE = 1.25  # times the cells of the plan's finest trial, at least
SHORTER = 4  # times, of implicit steps
LONG = 5.0  # [s] a choice that takes as long for the whole scene is run so


@dataclass(frozen=True)
class Setting:
    """A scene of the study.

    frames, cells : the first frames, that are tried, and the cells of the plan's finest trial, for each of ERRORS
    """

    file: str
    frames: tuple[int, int, int] = (20, 20, 20)
    cells: tuple[int, int, int] = (1000, 2000, 4000)


STUDIES = {
    "armadillo_forehead": Setting("armadillo_forehead.toml", (2, 2, 2), (1000, 4000, 8000)),
    "armadillo_leg": Setting("armadillo_leg.toml", (4, 2, 2), (1000, 4000, 8000)),
    "armadillo_palm": Setting("armadillo_palm.toml", (4, 2, 2), (1000, 4000, 8000)),
    "dragon_raise_push": Setting("dragon_raise_push.toml", (4, 2, 2), (1000, 8000, 16000)),
    "heart_pull": Setting("heart_pull.toml", (20, 20, 20), (1000, 2000, 4000)),
    "lung_press": Setting("lung_press.toml", (20, 20, 20), (1000, 2000, 4000)),
    "bunny_fall": Setting("bunny_fall.toml", (130, 130, 130), (1000, 2000, 4000)),
    "brain_fall": Setting("brain_fall.toml", (120, 120, 120), (1000, 2000, 4000)),
    "beam_soft": Setting("studies/beam_soft.toml", (20, 20, 20), (1000, 2000, 2000)),
    "beam_stiff": Setting("studies/beam_stiff.toml", (10, 10, 10), (2000, 2000, 8000)),
    "press": Setting("studies/atlas/press.toml", (6, 6, 6), (512, 2000, 4000)),
}


@dataclass
class LastingBench(Bench):
    """A bench whose rows stay beside its results: nothing is run twice that ended, or that had as much time.

    spared : seconds of the runs that were known
    """

    spared: float = field(default=0.0, init=False)

    def measure(self, case: Case, keep: bool = False) -> CaseResult:
        """Run a case if it is not known; its result stays."""
        path = self.result_of(case).with_suffix(".row")
        if path.is_file():
            known = json.loads(path.read_text())
            ended, spent = known["row"]["status"], known["limit"] >= case.timeout
            if self.result_of(case).is_file() if ended == "ok" else ended == "failed" or spent:
                self.spared += known["seconds"]
                return CaseResult(known["row"], None, known["seconds"])
        result = super().measure(case, True)
        if not self.processes.stopped:
            known = {"row": result.row, "seconds": result.seconds, "limit": case.timeout}
            path.write_text(json.dumps(known, default=float))
        return result


def finer_cells(sizer: Sizer, choice: Choice, times: int) -> int:
    """Return the cells of the finer run, so many times those of the choice, and more than any trial of the plan."""
    return round(max(times * choice.cells, MORE * max(each.cells for each in sizer.trials)))


def finer_methods(sizer: Sizer, choice: Choice, cells: int) -> list[tuple[float, Candidate]]:
    """Return ways to step the finer run of so many cells, the cheapest first, each with the seconds that it may take.

    Explicit substeps of the lattice's own length, if a trial of them ended well, and BDF2 in shorter steps. Of statics
    there is one way, solved to 1e-3.
    """
    known = {each.method.integrator: each for each in sizer.trials if each.method.time_step == sizer.step}
    method = choice.method
    ways: list[tuple[float, Candidate]] = []
    if explicit := known.get("verlet"):
        growth = (cells / explicit.cells) ** (4 / 3)
        ways.append((explicit.cost * growth * sizer.duration, Candidate("verlet", sizer.step)))
    if method.integrator == STATIC:
        ways = [(choice.cost * cells / choice.cells, replace(method, step_error=1e-3))]
    elif method.integrator != "verlet":
        step = method.time_step / SHORTER
        shorter = Candidate("bdf2", min(step, sizer.step), "newton", min(1e-3, method.step_error or 1e-3))
        ways.append((choice.cost * cells / choice.cells * SHORTER * sizer.duration, shorter))
    return sorted(ways, key=lambda way: way[0])


def true_error(sizer: Sizer, choice: Choice, limit: float) -> tuple[float | None, Row, str]:
    """Return the error of a choice against a finer run, the row of its own run, and why there is no error."""
    case = sizer.case(choice.method, choice.cells)
    row = sizer.bench.measure(replace(case, timeout=limit), keep=True).row
    if row["status"] != "ok":
        return None, row, f"the choice: {row['reason']}"
    why, finest = "no way to run it finer", [finer_cells(sizer, choice, times) for times in FINER]
    for cells, (seconds, method) in ((count, way) for count in finest for way in finer_methods(sizer, choice, count)):
        if seconds > limit:
            why = f"the finer run ({method.integrator}) would take {seconds:.0f} s"
            continue
        finer = replace(sizer.case(method, cells), timeout=limit)
        print(f"finer: {method.integrator}, {cells} cells, expected {seconds:.0f} s", flush=True)
        ended = sizer.bench.measure(finer, keep=True).row
        if ended["status"] == "ok":
            return surface_error(sizer.bench.result_of(case), sizer.bench.result_of(finer)), row, ""
        why = f"the finer run: {ended['reason']}"
    return None, row, why


def timed_plan(sizer: Sizer, bench: LastingBench) -> tuple[SizePlan, float]:
    """Return the plan and the seconds that it takes, with those of trials made before."""
    began, spared = perf_counter(), bench.spared
    plan = sizer.plan()
    return plan, perf_counter() - began + bench.spared - spared


def full_seconds(sizer: Sizer, choice: Choice, limit: float) -> float | None:
    """Return the seconds of the choice for all of the scene; None where they are few, or more than the limit."""
    tried, sizer.duration = sizer.duration, sizer.as_given.time.duration
    case = replace(sizer.case(choice.method, choice.cells), timeout=limit)
    sizer.duration = tried
    if not LONG <= choice.cost * sizer.as_given.time.duration <= limit:
        return None
    ended = sizer.bench.measure(case.changed("output.surface=false"), keep=True)
    return ended.seconds if ended.row["status"] == "ok" else None


def row_of(name: str, target: float, plan: SizePlan, sizer: Sizer, limit: float, planned: float) -> str:
    """Return the row of a plan that took so many seconds."""
    choice, method, budget = plan.choice, plan.choice.method, plan.choice.budget
    full = full_seconds(sizer, choice, limit)
    error, run, why = true_error(sizer, choice, limit)
    solved = "" if method.step_error is None else f" to {method.step_error:g}"
    step = "" if method.integrator == "verlet" else f", {1000 * method.time_step:.3g} ms{solved}"
    chosen = f"{method.integrator}{step}, {run.get('cells') or choice.cells:.0f}"
    parts = " + ".join(f"{100 * value:.2g}" for value in (budget.cells, budget.time, budget.step)) + "%"
    reached = f"{100 * error:.2g}% | {error / target:.2g}" if error is not None else " | "
    bounds = "; ".join([*([] if plan.met else ["**not met**"]), *filter(None, [why]), *plan.bounds])
    cost = run.get("time_second") or choice.cost
    took = f"{planned:.0f} | {full:.0f}: {planned / full:.1f} times" if full else f"{planned:.0f} | "
    return f"| {name} | {100 * target:g}% | {chosen} | {parts} | {reached} | {cost:.2g} | {took} | {bounds} |"


def main() -> None:
    arguments = parser(__doc__)
    arguments.add_argument("scenes", nargs="*", metavar="SCENE", help=", ".join(STUDIES))
    arguments.add_argument("--errors", nargs="+", type=float, default=ERRORS)
    arguments.add_argument("--cells", type=int, help="of the finest trial")
    arguments.add_argument("--frames", type=int, help="the first ones, that are tried")
    arguments.add_argument("--limit", type=float, default=LIMIT, help="seconds of a finer run")
    given = arguments.parse_args()
    if unknown := {name for name in given.scenes if name not in STUDIES and not Path(name).is_file()}:
        arguments.error(f"no such scene: {', '.join(sorted(unknown))}; there are {', '.join(STUDIES)}")
    OUT.mkdir(parents=True, exist_ok=True)
    rows, bench = [], LastingBench(OUT, Processes(), warm=True)  # as the command's
    try:
        for target in given.errors:
            for name in given.scenes or STUDIES:
                rows.append(plan_row(name, target, bench, cells=given.cells, frames=given.frames, limit=given.limit))
    finally:
        bench.processes.stop()
    print(f"\n| {' | '.join(HEAD)} |\n|{len(HEAD) * '---|'}")
    print(*rows, sep="\n")


def plan_row(
    name: str, target: float, bench: LastingBench, *, cells: int | None, frames: int | None, limit: float
) -> str:
    """Return the row of a scene, made as the command makes a plan."""
    from msmpetsc.solve.presets import preset_names  # late: it begins MPI, which trials forked from here do themselves

    setting = STUDIES.get(name) or Setting(str(Path(name).resolve()))
    name = Path(setting.file).stem
    of_error = next((number for number, error in enumerate(ERRORS) if target >= error), len(ERRORS) - 1)
    print(f"\n{name}, {100 * target:g}%", flush=True)
    sizer = Sizer(
        ROOT / "scenes" / setting.file, bench, target=target, presets=preset_names(),
        frames=frames or setting.frames[of_error], cells=cells or setting.cells[of_error], ranks=1,
        report=print_size_trial,
    )  # fmt: skip
    try:
        plan, seconds = timed_plan(sizer, bench)
        row = row_of(name, target, plan, sizer, limit, seconds)
    except InputError as error:
        row = f"| {name} | {100 * target:g}% | none | | | | | | | {error} |"
    print(row, flush=True)
    return row


if __name__ == "__main__":
    main()
