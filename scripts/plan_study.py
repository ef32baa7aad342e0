#!/usr/bin/env python3
"""Compare the choices of `plan --surface-error` with finer runs. Needs the meshes.

    scripts/plan_study.py [SCENE...] [--errors 0.1 0.03 0.01] [--cells N] [--frames N] [--limit S]

The finer run has 32 times the cells of the choice, or 8 times if that exceeds the time limit. It
has at least a quarter more cells than the plan's finest trial. Its steps are explicit substeps, or
implicit with a quarter of the choice's time error; a static scene remains static. If no choice
meets the error, the choice with the least error is compared. SCENE is a name of the study or a
scene file.
"""

import json
from argparse import Namespace
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

import lab

from msmpetsc.scene.reading import load_scene
from msmpetsc.scene.time import STATIC
from msmpetsc.study.metrics import surface_error
from msmpetsc.study.sizing.choice import PlannedMethod, overrides, tables

ERRORS = (0.1, 0.03, 0.01)
# time limit of a finer run [s]
LIMIT = 900.0
# ratios of cells of the finer run to the choice; 8 halves the edge, and so a
# first-order error
FINER = (32, 8)
# least ratio of cells to the plan's finest trial
MORE = 1.25
# ratio of time errors of the choice and of the finer run
TIGHTER = 4
# exit status of a plan that does not meet the error
NOT_MET = 3
FOLDER = lab.OUT / "plan_study"
Setting = tuple[tuple[int | None, ...], tuple[int, ...]]
# for each of ERRORS: number of frames, and cells of the finest trial
STUDIES: dict[str, Setting] = {
    "armadillo_forehead": ((2, 2, 2), (1000, 4000, 8000)),
    "armadillo_leg": ((4, 2, 2), (1000, 4000, 8000)),
    "armadillo_palm": ((4, 2, 2), (1000, 4000, 8000)),
    "dragon_raise_push": ((4, 2, 2), (1000, 8000, 16000)),
    "heart_pull": ((20, 20, 20), (1000, 2000, 4000)),
    "lung_press": ((20, 20, 20), (1000, 2000, 4000)),
    "bunny_fall": ((130, 130, 130), (1000, 2000, 4000)),
    "brain_fall": ((120, 120, 120), (1000, 2000, 4000)),
    "studies/beam_soft": ((20, 20, 20), (1000, 2000, 2000)),
    "studies/beam_stiff": ((10, 10, 10), (2000, 2000, 8000)),
    "studies/atlas/press": ((6, 6, 6), (512, 2000, 4000)),
}
# the same for a scene file
DEFAULT: Setting = ((None, None, None), (1000, 2000, 4000))


class Planned(NamedTuple):
    """The choice of a plan for a scene file.

    frames  : number of frames tried; None for all frames
    seconds : time that the plan took
    """

    file: Path
    frames: int | None
    method: PlannedMethod
    cells: int
    answer: dict
    seconds: float

    def run(self, method: PlannedMethod, cells: int, limit: float) -> lab.Run:
        """Run the scene with a method and cells, with the surface at the scene's own frames."""
        step = load_scene(self.file).time.step
        changes = overrides(
            self.file, {**tables(method), "cages": {"count": cells, "cell_size": None}}
        )
        changes += ["output.surface=true", "output.every=1"]
        if self.frames:
            changes += [f"time.duration={self.frames * step}"]
        path = FOLDER / f"{self.file.stem}_{cells}_{method.integrator}.h5"
        return lab.run(self.file, path, ["--quiet"], changes, timeout=limit)

    def finer(self) -> Iterator[tuple[int, PlannedMethod]]:
        """Yield cells and methods of finer runs, the finest first."""
        method = self.method
        finest = max(each["cells"] for each in self.answer["tried"])
        if method.integrator == STATIC:
            method = replace(method, step_error=1e-3)
        # verlet's substeps shrink with the cells
        elif method.time_error:
            method = replace(method, time_error=method.time_error / TIGHTER)
        for times in FINER:
            yield round(max(times * self.cells, MORE * finest)), method


def planned(file: Path, target: float, frames: int | None, cells: int) -> Planned | str:
    """Run `msmpetsc plan` and return its choice, or why it failed."""
    words = [
        "--surface-error",
        target,
        *(("--frames", frames) if frames else ()),
        "--cells",
        cells,
        "--json",
    ]
    log = FOLDER / f"{file.stem}_{target:g}.log"
    log.parent.mkdir(parents=True, exist_ok=True)
    begin = perf_counter()
    ended = lab.python(["-m", "msmpetsc", "plan", file, *words], log)
    if ended.status not in (0, NOT_MET):
        return ended.reason
    # trials are reported before the answer
    answer = json.loads("{" + log.read_text().rpartition("\n{\n")[2])
    choice = answer["choice"]
    return Planned(
        file,
        frames,
        PlannedMethod(**choice["method"]),
        choice["cells"],
        answer,
        perf_counter() - begin,
    )


def true_error(plan: Planned, limit: float) -> tuple[float | None, str]:
    """Return the error against the first finer run within the limit and its cells; or why not."""
    choice = plan.run(plan.method, plan.cells, limit)
    if choice.failure:
        return None, f"the choice: {choice.failure}"
    why = ""
    for cells, method in plan.finer():
        finer = plan.run(method, cells, limit)
        if not finer.failure:
            return surface_error(choice.path, finer.path), f"from {cells:,} cells"
        why = f"the finer run: {finer.failure}"
    return None, why


def row(scene: str, target: float, plan: Planned | str, limit: float) -> lab.Row:
    """Return the row of a scene's plan."""
    asked: dict[str, object] = {"scene": scene, "asked": f"{100 * target:g}%"}
    if isinstance(plan, str):
        return asked | {"chosen, cells": plan}
    error, why = true_error(plan, limit)
    method = plan.method
    choice = plan.answer["choice"]
    step = f" to {method.time_error:.2g}" if method.time_error else ""
    bounds = [*([] if plan.answer["met"] else ["**not met**"]), why, *plan.answer["bounds"]]
    return asked | {
        "chosen, cells": f"{method.integrator}{step}, {plan.cells}",
        "expected: cells + time": " + ".join(
            f"{100 * value:.2g}%" for value in choice["budget"].values()
        ),
        "true error": None if error is None else f"{100 * error:.2g}%",
        "over asked": None if error is None else f"{error / target:.2g}",
        "s a simulated s": float(choice["cost"]),
        "plan, s": plan.seconds,
        "what bounds it": "; ".join(bounds),
    }


def rows(args: Namespace) -> lab.Rows:
    """Yield the rows as they are run."""
    for target in args.errors:
        number = next(
            (number for number, error in enumerate(ERRORS) if target >= error), len(ERRORS) - 1
        )
        for scene in args.scenes or STUDIES:
            tried, finest = STUDIES.get(scene, DEFAULT)
            plan = planned(
                lab.file_of(scene),
                target,
                args.frames or tried[number],
                args.cells or finest[number],
            )
            yield row(scene, target, plan, args.limit)


def main() -> None:
    """Print the table of the scenes that the command line names, or of all."""
    options = lab.parser(__doc__)
    options.add_argument("scenes", nargs="*", metavar="SCENE", help=", ".join(STUDIES))
    options.add_argument("--errors", nargs="+", type=float, default=ERRORS)
    options.add_argument("--cells", type=int, help="cells of the finest trial")
    options.add_argument("--frames", type=int, help="number of frames that the trials run")
    options.add_argument("--limit", type=float, default=LIMIT, help="seconds of a finer run")
    args = options.parse_args()
    if unknown := {
        name for name in args.scenes if name not in STUDIES and not Path(name).is_file()
    }:
        options.error(
            f"no such scene: {', '.join(sorted(unknown))}; there are {', '.join(STUDIES)}"
        )
    lab.heading()
    lab.table(rows(args))


if __name__ == "__main__":
    main()
