#!/usr/bin/env python3
"""The cost of a step, `newton` beside what it took the place of. Needs the meshes.

    scripts/bench.py [--only NAME ...] [--laws LAW ...] [--alone] [--frames N] [--repeats N] [--ranks N] [--gpu]
        [--large]

Runs the paper's scenes, clamped beams of 9,000 and 96,000 cells and, with --large, of 995,000, each to a step error of
1e-3 on one core: `newton` with `-pc_type jacobi` and `gamg`, with --ranks `newton` on so many, and `newton`, one after
the other, and all of that again for each repeat. --only takes rows whose name contains NAME. --alone takes `newton`
alone, on one core and with --ranks on so many, --gpu on the GPU of the machine as well.

Figures are of all frames but the first, for what is done once shows in it: the mean time, its median over the repeats
with the least and the greatest of them in brackets; `slowest tenth` is the mean of those frames. KSP iterations and
products with the Hessian, which do not depend on the machine, are means; where `/` divides them they are of the methods
in their order. `times as fast` and what stands behind it is of the last method: `proof`, the share of its products that
estimates and searches for a negative curvature take; `coarse`, the share of a cycle's time beside its products at the
finest level.
"""

import sys
from argparse import Namespace
from collections.abc import Sequence
from functools import partial
from itertools import product
from pathlib import Path
from statistics import median
from typing import NamedTuple

import lab

import numpy as np
from petsc4py import PETSc
from scene_tables import PAPER, SCENES, slowest_tenth

from msmpetsc.solve.petsc import device

NUMBERS = "wall_time", "iterations", "ksp_its", "products", "proof_products", "step_error"
LAWS = "own", "neo-hookean"  # the scene's
SMALL = 50_000  # nodes: of fewer the memory is mostly Python's
BEAMS = {  # cells along the beam, Young's modulus [Pa], frames
    "beam 1e4": (40, 5e5, 30),
    "beam 1e4 stiff": (40, 5e7, 30),
    "beam 1e5": (88, 5e5, 10),
    "beam 1e6": (192, 5e5, 4),
}
LARGE = "beam 1e6"
SIDES = 1.0, 0.375, 0.375  # of a beam [m]


class Method(NamedTuple):
    """A way to run a scene: words of `msmpetsc run`, and the number of ranks."""

    words: tuple[str, ...]
    ranks: int = 1


class Sample(NamedTuple):
    """What one run measured: its numbers frame by frame, frame 0 left out, and what --measure says of it."""

    frames: dict[str, np.ndarray]
    cost: dict


METHODS = {
    "newton, jacobi": Method(("--preset", "newton", "-pc_type", "jacobi")),
    "newton, gamg": Method(("--preset", "newton", "-pc_type", "gamg")),
    "newton": Method(("--preset", "newton")),
}
TODAY = "newton"


# ---- runs


def beam(name: str, folder: Path) -> tuple[str, ...]:
    """Return the changes that make a beam of studies/beam_soft.toml, and write its mesh."""
    along, young, frames = BEAMS[name]
    size, length = f"cages.cell_size={SIDES[0] / along!r}", f"time.duration={frames / 60!r}"
    return lab.box(folder / "beam.obj", SIDES), size, f"material.young_modulus={young!r}", length


def measured(name: str, method: Method, frames: int | None, law: str = LAWS[0]) -> Sample | None:
    """Return what one run of a row measured; None if it failed."""
    folder, is_beam = lab.OUT / "bench", name in BEAMS
    of_law = () if law == LAWS[0] else (f'material.law="{law}"',)
    changes = ("output.surface=false", *of_law, *(beam(name, folder) if is_beam else ()))
    words = ["--error", "1e-3", *method.words, *(["--frames", frames] if frames else [])]
    scene = "studies/beam_soft" if is_beam else name
    run = lab.run(scene, folder / "run.h5", words, changes, method.ranks)
    return None if run.failure else Sample(run.frames(*NUMBERS), run.cost)


# ---- figures


def means(runs: Sequence[Sample], number: str) -> list[float]:
    """Return the mean of a number over all frames but the first, of each repeat."""
    return [float(run.frames[number][1:].mean()) for run in runs]


def row(name: str, runs: dict[str, list[Sample]]) -> lab.Row:
    """Return a row of the table; the last method is the one that is held against the others."""
    times = {
        method: [1e3 * mean for mean in means(repeats, "wall_time")]
        for method, repeats in runs.items()
    }
    found: dict[str, object] = {"scene": name}
    found |= {f"{method} [ms]": lab.spread(of) if of else None for method, of in times.items()}
    for number in ("ksp_its", "products"):
        found[number] = " / ".join(
            lab.shown(means(of, number)[0]) if of else "-" for of in runs.values()
        )
    *others, last = runs
    if not runs[last]:
        return found
    best = min((median(times[method]) for method in others if times[method]), default=None)
    return (
        found
        | {"times as fast": best / median(times[last]) if best else None}
        | of_method(name, runs[last])
    )


def of_method(name: str, runs: Sequence[Sample]) -> dict[str, object]:
    """Return the columns of one method alone."""
    cost, paper = runs[0].cost, PAPER.get(name.split("_")[0])
    seconds = median(means(runs, "wall_time"))
    memory = min(run.cost["memory"] for run in runs) / cost["nodes"] / 1e3
    products, times = means(runs, "products")[0], [run.cost["time"] for run in runs]
    on_gpu = cost["device"] == "cuda"  # which is still at work when a launch returns
    finest = [time["fine"] / time["cycle"] for time in times if time.get("cycle") and not on_gpu]
    return {
        "cells": cost["cells"],
        "frames": len(runs[0].frames["wall_time"]),
        "iterations": means(runs, "iterations")[0],
        "error": float(runs[0].frames["step_error"].max()),
        "proof": f"{means(runs, 'proof_products')[0] / products:.1%}" if products else None,
        "coarse": f"{1 - median(finest):.1%}" if finest else None,
        "us a cell": 1e6 * seconds / cost["cells"],
        "slowest tenth [ms]": 1e3
        * median(slowest_tenth(run.frames["wall_time"][1:]) for run in runs),
        "frames/s (paper's CPU, GPU)": f"{1 / seconds:.3g} ({paper[4]}, {paper[5]})"
        if paper
        else 1 / seconds,
        "set-up [s]": median(run.cost["time"]["setup"] for run in runs),
        "kB a node": memory if cost["nodes"] > SMALL else None,
    }


def rows(methods: dict[str, Method], args: Namespace) -> lab.Rows:
    """Yield the rows that are asked for as they are run, the repeats of each method alternating with the others'."""
    asked = (name for name in (*SCENES, *BEAMS) if any(word in name for word in args.only))
    names = [name for name in asked if name != LARGE or args.large]
    for name, law in product(names, args.laws or LAWS):
        kinds = {
            kind: partial(measured, name, method, args.frames, law)
            for kind, method in methods.items()
        }
        runs = lab.alternated(kinds, args.repeats)
        if any(runs.values()):
            yield {**row(name, runs), "scene": name if law == LAWS[0] else f"{name}, {law}"}


def methods_of(args: Namespace) -> dict[str, Method]:
    """Return what is run, the last of them held against the others."""
    today = METHODS[TODAY]
    more = (
        {f"{TODAY}, {args.ranks} ranks": Method(today.words, args.ranks)} if args.ranks > 1 else {}
    )
    if args.gpu:
        return {TODAY: today, **more, "GPU": Method((*today.words, "--device", "cuda"))}
    others = (
        {} if args.alone else {name: method for name, method in METHODS.items() if name != TODAY}
    )
    return others | more | {TODAY: today}


def main() -> int:
    options = lab.parser(__doc__)
    options.add_argument(
        "--only",
        nargs="+",
        default=[""],
        metavar="NAME",
        help="rows whose name contains one of these",
    )
    options.add_argument(
        "--laws",
        nargs="+",
        metavar="LAW",
        help="of materials; own, the scene's, and neo-hookean if absent",
    )
    options.add_argument("--alone", action="store_true", help="no other methods beside newton")
    options.add_argument(
        "--frames", type=int, metavar="N", help="steps of each run; all of the scene's if absent"
    )
    options.add_argument(
        "--repeats", type=int, default=5, metavar="N", help="runs of each method (%(default)s)"
    )
    options.add_argument("--ranks", type=int, default=1, metavar="N", help="on so many ranks, too")
    options.add_argument("--gpu", action="store_true", help="on a GPU beside the CPU")
    options.add_argument("--large", action="store_true", help=f"{LARGE}, too, which takes hours")
    args = options.parse_args()
    if args.gpu and (lacking := device.what_is_missing()):
        print(f"bench: {lacking}", file=sys.stderr)
        return 2
    lab.heading()
    if args.gpu:
        import cupy  # where there is a GPU

        name = cupy.cuda.runtime.getDeviceProperties(cupy.cuda.Device().id)["name"].decode()
        print(f"{name}, PETSc {'.'.join(map(str, PETSc.Sys.getVersion()))}")
    lab.table(rows(methods_of(args), args))
    return 0


if __name__ == "__main__":
    sys.exit(main())
