#!/usr/bin/env python3
"""Compares steps chosen by time.error with steps of one length, and prints a Markdown table. Needs the meshes.

    scripts/steps_study.py [CELLS] [--scenes NAME...]     1000 cells if not given

Errors are those of the trajectory (msmpetsc.study.distances) against BDF2 in the shortest steps, which time.error also
takes, of one length, so that they too end where an anchor lets go. The heart is held against verlet, which keeps what
BDF2 damps as it snaps back. Of the steps of one length, powers of two of the scene's, the row has the longest that come
as near; none of them may. Costs are products with the Hessian, and steps.
"""

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from clone import ROOT, parser

from msmpetsc.output.reader import Result
from msmpetsc.study.distances import trajectory_error

OUT, ERRORS = ROOT / "out" / "steps_study", (0.03, 0.01)


@dataclass(frozen=True)
class Study:
    """A scene of the study.

    step, duration : [s]
    finest, fixed  : how often the step is halved for the reference, and for the steps of one length
    changes        : of the scene
    substep        : [s] of a reference by verlet
    """

    file: str
    step: float
    duration: float
    finest: int
    fixed: tuple[int, ...]
    changes: tuple[str, ...]
    substep: float | None = None


HEART = ("cages.count={cells}", 'material.law="stiffening"')
STUDIES = {
    "beam_soft": Study("studies/beam_soft.toml", 1 / 60, 2.0, 6, (-1, 0, 1, 2, 3, 4), ("cages={{cell_size=0.0625}}",)),
    "bunny_fall": Study("bunny_fall.toml", 1e-3, 0.25, 5, (-1, 0, 1, 2, 3, 4), ("cages.count={cells}",)),
    "lung_press": Study("lung_press.toml", 0.02, 0.6, 7, (0, 1, 2, 3, 4, 5, 6), ("cages.count={cells}",)),
    "heart_pull": Study("heart_pull.toml", 0.02, 0.9, 0, (0, 1, 2, 3, 4, 5), HEART, 1e-5),  # later nobody knows it
    "heart_pull_on": Study("heart_pull.toml", 0.02, 1.2, 0, (0, 1, 2, 3, 4, 5), HEART, 1e-5),
}


def run(name: str, cells: int, halvings: int, more: dict[str, float], integrator: str = "bdf2") -> Path:
    """The result in steps of one length, or as more of the scene's time says; frames at the scene's steps."""
    study = STUDIES[name]
    path = OUT / f"{name}_{cells}_{halvings}{'_'.join(['', *map(str, more.values())])}.h5"
    time = {"step": study.step / 2**halvings, "duration": study.duration, **more}
    table = ", ".join([*(f"{key}={value!r}" for key, value in time.items()), f'integrator="{integrator}"'])
    changes = [f"time={{{table}}}", "output.surface=false", f"output.every={max(1, 2**halvings)}"]
    changes += [change.format(cells=cells) for change in study.changes]
    words = [word for change in changes for word in ("--set", change)]
    command = [sys.executable, "-m", "msmpetsc", "run", ROOT / "scenes" / study.file, "-o", path, "--overwrite", *words]
    subprocess.run([str(word) for word in command], check=True)
    return path


def costs(path: Path) -> tuple[int, int, float]:
    """Products with the Hessian, steps, and seconds of a run."""
    with Result(path) as result:
        return tuple(result.frames[key][1:].sum() for key in ("products", "steps", "wall_time"))


def reference(name: str, cells: int) -> Path:
    """The result that stands for the true motion."""
    study = STUDIES[name]
    if study.substep:
        return run(name, cells, 0, {"substep": study.substep}, "verlet")
    finest = study.step / 2**study.finest
    return run(name, cells, study.finest, {"error": 0.5, "shortest": finest, "longest": finest})


def rows(name: str, cells: int) -> list[str]:
    """A row of the table for each error asked."""
    study, lines, exact = STUDIES[name], [], reference(name, cells)
    fixed = {halvings: run(name, cells, halvings, {}) for halvings in study.fixed}
    for asked in ERRORS:
        path = run(name, cells, 0, {"error": asked})
        reached, (products, steps, seconds) = trajectory_error(path, exact), costs(path)
        with Result(path) as result:
            estimate = result.frames.time_error[-1]
        near = [h for h in study.fixed if trajectory_error(fixed[h], exact) <= reached]
        best = "none of them"
        if near:
            error, (p, s, t) = trajectory_error(fixed[near[0]], exact), costs(fixed[near[0]])
            best = f"{study.step / 2 ** near[0]:.3g} s: {error:.2g}, {p:,} products, {s:,} steps, {t:.1f} s"
        errors = f"{asked:g} | {reached:.2g} ({reached / asked:.1f}) | {estimate:.2g}"
        lines.append(f"| `{name}` | {errors} | {products:,} | {steps:,} | {seconds:.1f} | {best} |")
    return lines


def main() -> None:
    arguments = parser(__doc__)
    arguments.add_argument("cells", nargs="?", type=int, default=1000)
    arguments.add_argument("--scenes", nargs="+", choices=STUDIES, default=list(STUDIES))
    given = arguments.parse_args()
    OUT.mkdir(parents=True, exist_ok=True)
    print("| scene | error asked | reached (over asked) | estimate | products | steps | s | one length, as near |")
    print("|---|---|---|---|---|---|---|---|")
    for name in given.scenes:
        print(*rows(name, given.cells), sep="\n", flush=True)


if __name__ == "__main__":
    main()
