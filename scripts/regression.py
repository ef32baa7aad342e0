#!/usr/bin/env python3
"""Runs the scenes small and holds their numbers against those of tests/regression. Needs the meshes.

    scripts/regression.py [SCENE...] [--ranks N] [--update]

Every scene that is stored there, or those named, with few cells and steps, each solved to 1e-9, so that neither the
number of ranks nor the way in which a step is solved shows. Counts must be equal, the numbers of the last frame within
the tolerance. How a scene is run stands under "run" of its file: changes that let few steps show what it is about.
Exit status 0: all are; 1: something differs, or nothing was compared. --update stores the numbers found.
"""

import sys

import lab
from clone import ROOT

from msmpetsc.cli.commands import check as numbers
from msmpetsc.errors import InputError
from msmpetsc.geometry.registry import locate
from msmpetsc.scene.reading import load_scene

STORED = ROOT / "tests" / "regression"


def check(scene: str, ranks: int, update: bool) -> list[str] | None:
    """Run a scene and print its row; what is wrong with it, None if its mesh is not here."""
    path, file = lab.SCENES / f"{scene}.toml", STORED / f"{scene}.json"
    try:
        for mesh in load_scene(path).meshes.values():
            locate(mesh.source, lab.SCENES)
    except InputError as error:
        print(f"{scene:20} skipped: {error}")
        return None
    try:
        if update:
            numbers.update(path, file, None, ranks)
            return []
        return [f"{scene}: {line}" for line in numbers.checked(path, numbers.read(file), ranks)]
    except InputError as error:
        print(f"{scene:20} FAILED")
        return [str(error)]


def main(arguments: list[str] | None = None) -> int:
    every = sorted(path.stem for path in STORED.glob("*.json"))
    options = lab.parser(__doc__)
    options.add_argument("scenes", nargs="*", default=every, help="all if none is named")
    options.add_argument("--ranks", type=int, default=1, metavar="N", help="MPI ranks of the runs (1)")
    options.add_argument("--update", action="store_true", help="store the numbers found in place of those there")
    args = options.parse_args(arguments)
    print(numbers.HEAD)
    outcomes = [check(scene, args.ranks, args.update) for scene in args.scenes]
    print("".join(f"{line}\n" for wrong in outcomes for line in wrong or ()), end="")
    return int(any(outcomes) or all(outcome is None for outcome in outcomes))


if __name__ == "__main__":
    sys.exit(main())
