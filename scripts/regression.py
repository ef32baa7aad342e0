#!/usr/bin/env python3
"""Runs the scenes small and holds their numbers against those of tests/regression. Needs the meshes.

    scripts/regression.py [SCENE...] [--ranks N] [--update]

Every scene of scenes/, or those named, at 400 cells, for a few steps, each solved to 1e-9, so that neither the number
of ranks nor the way in which a step is solved shows. Counts must be equal, the numbers of the last frame within the
tolerance.
Exit status 0: all are; 1: something differs, or nothing was compared. --update stores the numbers found.

The numbers and their tolerance are those of `msmpetsc check` (msmpetsc/study/baselines).
"""

import sys
import tempfile
from pathlib import Path
from time import perf_counter

from clone import ROOT, parser

from msmpetsc.errors import InputError
from msmpetsc.geometry.registry import locate
from msmpetsc.scene.reading import load_scene
from msmpetsc.study.baselines import baseline
from msmpetsc.study.baselines.baseline import HEAD, Recipe, allowed, judged, nearest_to_limit, row

SCENES, STORED = ROOT / "scenes", ROOT / "tests" / "regression"
CELLS = 400
FALLS = 30, ("mesh.base=[0, 0, 0.0005]",)  # 0.5 mm above the ground: there after 10 steps of 1 ms
DRAGS = 6, ()
FALLING = "{velocity=[0, 0, -1.5]}"  # [m/s]
# Steps, and what is changed so that these few show what the scene is about.
SETTINGS = {
    "armadillo_fold": (
        8,
        (
            "self_contact.surface=2000",
            "anchor.0.region={box=[[0.9, 0, 0.65], [1, 0.5, 1]], relative=true}",
            "anchor.0.path=[{time=0.12, by=[-0.075, -0.01, -0.07]}]",
            "anchor.1.region={box=[[0, 0, 0.65], [0.1, 0.5, 1]], relative=true}",
            "anchor.1.path=[{time=0.12, by=[0.075, -0.03, -0.07]}]",
        ),
    ),
    "armadillo_forehead": DRAGS,
    "armadillo_leg": DRAGS,
    "armadillo_palm": DRAGS,
    "brain_fall": FALLS,
    "bunny_fall": FALLS,
    "dragon_raise_push": (6, ("force.0.stop=0.16", "force.1.start=0.16")),
    "heart_pull": (10, ("anchor.0.path.0.time=0.08", "anchor.0.stop=0.12")),
    "lung_press_contact": (6, ("self_contact.surface=2000", "obstacle.1.path.0={time=0.08, by=[0, 0, -0.04]}")),
    "lung_press": (6, ("obstacle.1.path.0={time=0.08, by=[0, 0, -0.04]}",)),
    "pile": (6, ("self_contact.surface=2000", *(f"body.{number}.start={FALLING}" for number in range(4, 8)))),
    "two_bunnies": (6, ("self_contact.surface=1000", f"body.1.start={FALLING}")),
}


def recipe(scene: str) -> Recipe:
    """How a scene is run."""
    steps, changes = SETTINGS[scene]
    return Recipe(CELLS, steps, changes)


def run(scene: str, path: Path, ranks: int) -> None:
    """Simulate; InputError if the mesh is not here, RuntimeError with the last line if the run fails."""
    file = SCENES / f"{scene}.toml"
    for mesh in load_scene(file).meshes.values():
        locate(mesh.source, SCENES)
    baseline.simulate(file, recipe(scene), path, ranks)


def summary(path: Path, scene: str) -> dict:
    """What is stored of a scene: how it was run, counts, what errors are relative to, and the last frame's numbers."""
    return baseline.summary(path, recipe(scene))


def complaints(found: dict, stored: dict) -> list[str]:
    """One line for each thing that is not as stored."""
    if found["run"] != stored["run"]:
        return [f"is run otherwise than when it was stored ({stored['run']}): --update"]
    return [line for line in judged(found, stored).values() if line]


def check(scene: str, ranks: int, update: bool) -> list[str] | None:
    """Run a scene and print its row; what is wrong with it, None if its mesh is not here."""
    begun = perf_counter()
    try:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"{scene}.h5"
            run(scene, path, ranks)
            found = summary(path, scene)
    except InputError as error:
        print(f"{scene:20} skipped: {error}")
        return None
    except RuntimeError as error:
        print(f"{scene:20} FAILED")
        return [f"{scene}: {error}"]
    file, off = STORED / f"{scene}.json", (0.0, allowed(SETTINGS[scene][0], "m"))
    if update:
        baseline.write(file, found)
        wrong, verdict = [], "stored"
    elif not file.is_file():
        wrong, verdict = [f"{scene}: nothing is stored of it: --update"], "UNKNOWN"
    else:
        try:
            stored = baseline.read(file)
            wrong = [f"{scene}: {line}" for line in complaints(found, stored)]
        except InputError:
            print(f"{scene:20} UNKNOWN")
            return [f"{scene}: {file} is not what --update stores"]
        off = nearest_to_limit(found, stored)
        verdict = "DIFFERS" if wrong else "same"
    print(row(scene, found["counts"], off, perf_counter() - begun, verdict), flush=True)
    return wrong


def main(arguments: list[str] | None = None) -> int:
    options = parser(__doc__)
    options.add_argument("scenes", nargs="*", metavar="SCENE", help=f"of {', '.join(SETTINGS)}; all if none is named")
    options.add_argument("--ranks", type=int, default=1, metavar="N", help="MPI ranks of the runs (1)")
    options.add_argument("--update", action="store_true", help="store the numbers found in place of those there")
    args = options.parse_args(arguments)
    unknown = [scene for scene in args.scenes if scene not in SETTINGS]
    if unknown or args.ranks < 1:
        options.error(f"no scene {unknown[0]!r}: {', '.join(SETTINGS)}" if unknown else "--ranks must be at least 1")
    print(HEAD)
    outcomes = [check(scene, args.ranks, args.update) for scene in args.scenes or SETTINGS]
    for line in (line for wrong in outcomes if wrong for line in wrong):
        print(line)
    if all(outcome is None for outcome in outcomes):
        print("no scene was run")
    return int(all(outcome is None for outcome in outcomes) or any(outcomes))


if __name__ == "__main__":
    sys.exit(main())
