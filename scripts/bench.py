#!/usr/bin/env python3
"""Measure the cost of a step by `newton`, also with Jacobi's and GAMG's preconditioner.

    scripts/bench.py [--only NAME ...] [--laws LAW ...] [--alone] [--frames N] [--repeats N]
        [--ranks N] [--gpu] [--large]

The scenes are the paper's, and clamped beams of 9,000, 96,000 and, with --large, 995,000 cells. All
are solved to a step error of 1e-3 on a single core. The methods are `newton` with `-pc_type jacobi`
and with `gamg`, with --ranks `newton` on N ranks, and `newton`. Each repeat runs all methods in
turn. --only selects rows whose name contains NAME. --alone runs only `newton`, and with --ranks
also `newton` on N ranks. --gpu runs `newton` on the CPU and on the machine's GPU. The meshes of the
scenes are needed.

Figures leave out the first frame, which contains start-up costs. Times are medians of the repeats'
means, with least and greatest in brackets; `slowest tenth` is the mean of the slowest tenth of the
frames. KSP iterations and products with the Hessian are means; `/` separates the methods. `times as
fast` and the columns after it describe the last method. `proof` is the share of products spent on
estimates and negative curvature. `coarse` is a cycle's share of time outside products at the finest
level.
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

NUMBERS = ("wall_time", "iterations", "ksp_its", "products", "proof_products", "step_error")
# material laws; "own" is the scene's
LAWS = ("own", "neo-hookean")
# number of nodes below which most of the memory is Python's own
SMALL = 50_000
# cells along the beam, Young's modulus [Pa], frames
BEAMS = {
    "beam 1e4": (40, 5e5, 30),
    "beam 1e4 stiff": (40, 5e7, 30),
    "beam 1e5": (88, 5e5, 10),
    "beam 1e6": (192, 5e5, 4),
}
LARGE = "beam 1e6"
# sides of a beam [m]
SIDES = (1.0, 0.375, 0.375)


class Method(NamedTuple):
    """A method to run a scene: options of `msmpetsc run`, and the number of ranks."""

    words: tuple[str, ...]
    ranks: int = 1


class Sample(NamedTuple):
    """Measurements of a run: columns of all frames except frame 0, and the measure file."""

    frames: dict[str, np.ndarray]
    cost: dict


METHODS = {
    "newton, jacobi": Method(("--preset", "newton", "-pc_type", "jacobi")),
    "newton, gamg": Method(("--preset", "newton", "-pc_type", "gamg")),
    "newton": Method(("--preset", "newton")),
}
NEWTON = "newton"


# ---- runs


def beam(name: str, folder: Path) -> tuple[str, ...]:
    """Write the mesh of a beam; return the changes of studies/beam_soft.toml that describe it."""
    along, young, frames = BEAMS[name]
    size = f"cages.cell_size={SIDES[0] / along!r}"
    duration = f"time.duration={frames / 60!r}"
    mesh = lab.box(folder / "beam.obj", SIDES)
    return mesh, size, f"material.young_modulus={young!r}", duration


def measured(name: str, method: Method, frames: int | None, law: str = LAWS[0]) -> Sample | None:
    """Run a row's scene with a method and return its measurements; None if it failed."""
    folder = lab.OUT / "bench"
    is_beam = name in BEAMS
    of_law = () if law == LAWS[0] else (f'material.law="{law}"',)
    changes = ("output.surface=false", *of_law, *(beam(name, folder) if is_beam else ()))
    words = ["--error", "1e-3", *method.words, *(["--frames", frames] if frames else [])]
    scene = "studies/beam_soft" if is_beam else name
    run = lab.run(scene, folder / "run.h5", words, changes, method.ranks)
    return None if run.failure else Sample(run.frames(*NUMBERS), run.cost)


# ---- figures


def means(runs: Sequence[Sample], number: str) -> list[float]:
    """Return the mean of a column over all frames but the first, for each repeat."""
    return [float(run.frames[number][1:].mean()) for run in runs]


def row(name: str, runs: dict[str, list[Sample]]) -> lab.Row:
    """Return a row of the table; the last method is compared with the fastest of the rest."""
    times = {
        method: [1e3 * mean for mean in means(repeats, "wall_time")]
        for method, repeats in runs.items()
    }
    entries: dict[str, object] = {"scene": name}
    entries |= {f"{method} [ms]": lab.spread(of) if of else None for method, of in times.items()}
    for number in ("ksp_its", "products"):
        entries[number] = " / ".join(
            lab.shown(means(of, number)[0]) if of else "-" for of in runs.values()
        )
    *rivals, last = runs
    if not runs[last]:
        return entries
    best = min((median(times[method]) for method in rivals if times[method]), default=None)
    return (
        entries
        | {"times as fast": best / median(times[last]) if best else None}
        | of_method(name, runs[last])
    )


def of_method(name: str, runs: Sequence[Sample]) -> dict[str, object]:
    """Return the columns that describe a single method."""
    cost = runs[0].cost
    paper = PAPER.get(name.split("_")[0])
    seconds = median(means(runs, "wall_time"))
    memory = min(run.cost["memory"] for run in runs) / cost["nodes"] / 1e3
    products = means(runs, "products")[0]
    times = [run.cost["time"] for run in runs]
    # a GPU still computes when a launch returns, which falsifies times within a cycle
    on_gpu = cost["device"] == "cuda"
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
    """Yield the selected rows as they are run; repeats alternate between the methods."""
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
    """Return the methods to run; the last is compared with the rest."""
    newton = METHODS[NEWTON]
    parallel = {}
    if args.ranks > 1:
        parallel = {f"{NEWTON}, {args.ranks} ranks": Method(newton.words, args.ranks)}
    if args.gpu:
        return {NEWTON: newton, **parallel, "GPU": Method((*newton.words, "--device", "cuda"))}
    rivals = {}
    if not args.alone:
        rivals = {name: method for name, method in METHODS.items() if name != NEWTON}
    return rivals | parallel | {NEWTON: newton}


def main() -> int:
    """Print the table of the selected rows; return the exit status."""
    options = lab.parser(__doc__)
    options.add_argument(
        "--only",
        nargs="+",
        default=[""],
        metavar="NAME",
        help="run only rows whose name contains NAME",
    )
    options.add_argument(
        "--laws", nargs="+", metavar="LAW", help="material laws: own, neo-hookean (both)"
    )
    options.add_argument("--alone", action="store_true", help="run no method except newton")
    options.add_argument("--frames", type=int, metavar="N", help="number of steps (the scene's)")
    options.add_argument(
        "--repeats", type=int, default=5, metavar="N", help="runs of each method (%(default)s)"
    )
    options.add_argument("--ranks", type=int, default=1, metavar="N", help="also run on N ranks")
    options.add_argument("--gpu", action="store_true", help="also run on a GPU")
    options.add_argument("--large", action="store_true", help=f"also run {LARGE}, for hours")
    args = options.parse_args()
    if args.gpu and (lacking := device.what_is_missing()):
        print(f"bench: {lacking}", file=sys.stderr)
        return 2
    lab.heading()
    if args.gpu:
        # only machines with a GPU have cupy
        import cupy

        name = cupy.cuda.runtime.getDeviceProperties(cupy.cuda.Device().id)["name"].decode()
        print(f"{name}, PETSc {'.'.join(map(str, PETSc.Sys.getVersion()))}")
    lab.table(rows(methods_of(args), args))
    return 0


if __name__ == "__main__":
    sys.exit(main())
