#!/usr/bin/env python3
"""The paper's Table 1 beside ours, the paper's figures in brackets. Needs the meshes.

    scripts/table1.py [SCENE...] [--frames N] [-o PAGE]

Runs every scene of the paper, or those named, on one core, N steps of it or all: with its own springs, and as its
twin, a neo-Hookean solid of the same Young's modulus and Poisson's ratio 1/4. Frames a second are those of the steps
alone, as each frame's wall_time has them: the mean over the run, and the slowest tenth of the frames. Products are
those with the Hessian, a frame. The error is the largest relative error of a step that the runs report.
"""

from collections.abc import Sequence

import lab

import numpy as np

from msmpetsc.results.reader import Result

# vertices, facets, valid cells, springs, frames a second on the CPU and on the GPU
PAPER = {
    "armadillo": (12602, 25200, 8338, 164343, 8.1, 30.0),
    "dragon": (23620, 47140, 11536, 232240, 5.5, 23.9),
    "lung": (43040, 86085, 6499, 127843, 10.1, 29.5),
    "heart": (43594, 108357, 3126, 62465, 19.9, 53.4),
    "bunny": (20667, 41330, 9946, 193589, 7.3, 30.1),
    "brain": (55024, 110047, 13661, 264481, 5.1, 20.0),
}
ARMADILLOS = ("armadillo_leg", "armadillo_palm", "armadillo_forehead")
SCENES = (*ARMADILLOS, "dragon_raise_push", "lung_press", "heart_pull", "bunny_fall", "brain_fall")
LAWS = {"springs": (), "neo-Hookean": ("material.law=neo-hookean",)}
ARRAYS = {
    "vertices": "surface/points", "facets": "surface/triangles", "valid cells": "lattice/cells",
    "springs": "lattice/springs",
}  # fmt: skip


def slowest_tenth(seconds: np.ndarray) -> float:
    """Return the mean of the slowest tenth of the frames, of one at least [s]."""
    return float(np.sort(seconds)[-max(1, len(seconds) // 10) :].mean())


def row(scene: str, words: Sequence[object]) -> lab.Row:
    """Run a scene by both laws; its row of the table, our figures with the paper's in brackets."""
    *counts, cpu, _ = PAPER[scene.split("_")[0]]
    found: dict[str, object] = {"scene": scene}
    worst = 0.0
    for law, changes in LAWS.items():
        path = lab.OUT / "table1" / f"{scene}_{law}.h5"
        with Result(lab.run(scene, path, words, changes).path) as result:
            ours = [len(result[name]) for name in ARRAYS.values()]
            seconds, products = result.frames.wall_time[1:], result.frames.products[1:]
            worst = max(worst, float(result.frames.step_error[1:].max()))
        if len(found) == 1:
            beside = zip(ARRAYS, ours, counts, strict=True)
            found |= {name: f"{own:,} ({paper:,})" for name, own, paper in beside}
        paper = f" ({cpu})" if law == "springs" else ""
        found[f"{law}: frames a second"] = f"{1 / seconds.mean():.3g}{paper}"
        found[f"{law}: slowest tenth"] = float(1 / slowest_tenth(seconds))
        found[f"{law}: products"] = float(products.mean())
    return found | {"step error": worst}


def main() -> None:
    options = lab.parser(__doc__)
    options.add_argument("scenes", nargs="*", metavar="SCENE", help="all of them if none is named")
    options.add_argument("--frames", type=int, metavar="N", help="steps of each scene; all of them if absent")
    args = options.parse_args()
    with lab.page(args):
        lab.table(row(scene, ["--frames", args.frames] if args.frames else []) for scene in args.scenes or SCENES)


if __name__ == "__main__":
    main()
