#!/usr/bin/env python3
"""Holds what `plan --surface-error` chooses against finer runs. Needs the meshes.

    scripts/plan_study.py [SCENE...] [--errors 0.1 0.03 0.01] [--cells N] [--frames N] [--limit S]

The finer run has 32 times the cells of the choice, or 8 times where that takes longer than the limit, and a quarter
more than the plan's finest trial at least. It takes explicit substeps or a quarter of the step; a static one is static.
Where no choice meets the error, the best one is held against a finer run. SCENE is a name of the study or a scene file.
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
from msmpetsc.study.sizing.choice import Candidate, overrides, tables

ERRORS, LIMIT = (0.1, 0.03, 0.01), 900.0  # [s] a finer run
FINER = 32, 8  # times the cells: 8 are half the edge, and err by half as much where the order is 1
MORE = 1.25  # times the cells of the plan's finest trial, at least
SHORTER = 4  # times, of implicit steps
NOT_MET = 3  # exit status of a plan that is there all the same
FOLDER = lab.OUT / "plan_study"
Setting = tuple[tuple[int | None, ...], tuple[int, ...]]
STUDIES: dict[
    str, Setting
] = {  # for each of ERRORS: first frames, that are tried, and cells of the finest trial
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
ANOTHER: Setting = ((None, None, None), (1000, 2000, 4000))  # of a scene file


class Planned(NamedTuple):
    """What the plan of a scene file chose on its first frames.

    frames  : None for all
    seconds : that the plan took
    """

    file: Path
    frames: int | None
    method: Candidate
    cells: int
    answer: dict
    seconds: float

    def run(self, method: Candidate, cells: int, limit: float) -> lab.Run:
        """Run so many cells by a method, with the surface at the scene's own frames."""
        step = load_scene(self.file).time.step
        changes = overrides(
            self.file, {**tables(method), "cages": {"count": cells, "cell_size": None}}
        )
        changes += ["output.surface=true", f"output.every={max(1, round(step / method.time_step))}"]
        if self.frames:
            changes += [f"time.duration={self.frames * step}"]
        path = FOLDER / f"{self.file.stem}_{cells}_{method.integrator}.h5"
        return lab.run(self.file, path, ["--quiet"], changes, timeout=limit)

    def finer(self) -> Iterator[tuple[int, Candidate]]:
        """Yield cells and methods of finer runs."""
        method, finest = self.method, max(each["cells"] for each in self.answer["tried"])
        if method.integrator == STATIC:
            method = replace(method, step_error=1e-3)
        elif method.integrator != "verlet":  # whose substeps are as short as the cells ask
            method = Candidate(
                "bdf2", method.time_step / SHORTER, "newton", min(1e-3, method.step_error or 1e-3)
            )
        for times in FINER:
            yield round(max(times * self.cells, MORE * finest)), method


def planned(file: Path, target: float, frames: int | None, cells: int) -> Planned | str:
    """Return what `msmpetsc plan` chooses; or why there is nothing."""
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
    answer = json.loads("{" + log.read_text().rpartition("\n{\n")[2])  # behind what was tried
    choice = answer["choice"]
    return Planned(
        file, frames, Candidate(**choice["method"]), choice["cells"], answer, perf_counter() - begin
    )


def true_error(plan: Planned, limit: float) -> tuple[float | None, str]:
    """Return the error of a choice against the first finer run that ends in time, or why there is none."""
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
    """Return the row of the plan of a scene."""
    found: dict[str, object] = {"scene": scene, "asked": f"{100 * target:g}%"}
    if isinstance(plan, str):
        return found | {"chosen, cells": plan}
    error, why = true_error(plan, limit)
    method, choice = plan.method, plan.answer["choice"]
    step = (
        ""
        if method.step_error is None
        else f", {1000 * method.time_step:.3g} ms to {method.step_error:g}"
    )
    bounds = [*([] if plan.answer["met"] else ["**not met**"]), why, *plan.answer["bounds"]]
    return found | {
        "chosen, cells": f"{method.integrator}{step}, {plan.cells}",
        "expected: cells + time + step": " + ".join(
            f"{100 * value:.2g}%" for value in choice["budget"].values()
        ),
        "true error": None if error is None else f"{100 * error:.2g}%",
        "over asked": None if error is None else f"{error / target:.2g}",
        "s a simulated s": float(choice["cost"]),
        "plan, s": plan.seconds,
        "what bounds it": "; ".join(bounds),
    }


def rows(args: Namespace) -> lab.Rows:
    """Yield the rows, as they are run."""
    for target in args.errors:
        number = next(
            (number for number, error in enumerate(ERRORS) if target >= error), len(ERRORS) - 1
        )
        for scene in args.scenes or STUDIES:
            tried, finest = STUDIES.get(scene, ANOTHER)
            plan = planned(
                lab.file_of(scene),
                target,
                args.frames or tried[number],
                args.cells or finest[number],
            )
            yield row(scene, target, plan, args.limit)


def main() -> None:
    options = lab.parser(__doc__)
    options.add_argument("scenes", nargs="*", metavar="SCENE", help=", ".join(STUDIES))
    options.add_argument("--errors", nargs="+", type=float, default=ERRORS)
    options.add_argument("--cells", type=int, help="of the finest trial")
    options.add_argument("--frames", type=int, help="the first ones, that are tried")
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
