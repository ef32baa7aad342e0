"""``msmpetsc inspect``: what a scene would need on so many ranks, without running it there."""

import argparse
import shlex
import signal
from pathlib import Path

import numpy as np
import petsc4py
from mpi4py import MPI
from scipy.optimize import brentq

from msmpetsc.cli.cost import peak_memory
from msmpetsc.cli.study import refuse_ranks, stop
from msmpetsc.comm import log
from msmpetsc.errors import InputError
from msmpetsc.scene import Scene
from msmpetsc.scene_reading import load_scene

MOST_BUILT = 200_000  # cells that are built here to count; what is more is scaled
MOST_CELLS = 1e15  # where limits are looked for
GB = 1e9


def add_parser(commands: argparse._SubParsersAction) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "inspect",
        help="say what a scene would need on so many ranks",
        description="Count cells, nodes, springs, ghosts and messages of each rank, and expect memory and time of a "
        "frame from two short runs here, on coarser lattices. PETSc options (one dash) may follow.",
    )
    parser.add_argument("scene", type=Path, metavar="SCENE", help="scene file (TOML)")
    parser.add_argument("--ranks", type=int, default=1, metavar="R", help="MPI ranks (1)")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="override a scene key: cages.count=3000"
    )
    parser.add_argument("--frames", type=int, default=10, metavar="N", help="steps of the short runs (10)")
    parser.add_argument("--measure-here", action="store_true", help="make the short runs again")
    parser.add_argument("--no-times", action="store_true", help="make none: counts and limits only")
    parser.add_argument("--latency", type=float, default=2e-6, metavar="S", help="of a message [s] (2e-6)")
    parser.add_argument("--bandwidth", type=float, default=1e10, metavar="B", help="of a rank [byte/s] (1e10)")


def run(args: argparse.Namespace) -> int:
    """Inspect; returns the exit status."""
    refuse_ranks("inspect")
    refuse_bad_numbers(args)
    petsc4py.init(["msmpetsc", *args.petsc_options])
    from msmpetsc.model.shares import count_shares
    from msmpetsc.solve.presets import PRESETS

    signal.signal(signal.SIGTERM, stop)
    scene = load_scene(args.scene, args.set, PRESETS)
    body, lattice, cages, cells, mesh = build(scene)
    shares = count_shares(body, cages, lattice, args.ranks)
    if cells != len(lattice.cells):
        shares = shares.scaled(cells)
    tell_counts(args, shares, len(lattice.cells), scene)
    if not args.no_times:
        tell_needs(args, scene, body, shares, cells, mesh)
    tell_limits(shares, len(lattice.cells))
    return 0


def refuse_bad_numbers(args: argparse.Namespace) -> None:
    for name in ("ranks", "frames"):
        if getattr(args, name) < 1:
            raise InputError(f"--{name} must be at least 1, not {getattr(args, name)}")
    if not (args.latency >= 0 and np.isfinite(args.latency)):
        raise InputError(f"--latency must be no less than 0, not {args.latency:g}")
    if not args.bandwidth > 0:
        raise InputError(f"--bandwidth must be more than 0, not {args.bandwidth:g}")


def build(scene: Scene):
    """The body, its lattice and cages or coarser ones, the cells asked for, and the bytes that its mesh took."""
    from msmpetsc.geometry.cages import fill
    from msmpetsc.geometry.cell_size import choose_cell_size
    from msmpetsc.model.build import read_body
    from msmpetsc.model.lattice import build_lattice

    before = peak_memory()
    body = read_body(MPI.COMM_WORLD, scene)
    mesh = peak_memory() - before
    wanted, h = scene.cages.count, scene.cages.cell_size
    volume = abs(body.report.volume) if body.report.closed else 0.0
    if h and max(volume / h**3, body.report.area / h**2) < 2 * MOST_BUILT or wanted and wanted <= MOST_BUILT:
        size = h or choose_cell_size(body, wanted, scene.cages.method, scene.cages.max_cells)
    else:
        size = choose_cell_size(body, MOST_BUILT, scene.cages.method)
    cages = fill(body, size, scene.cages.method)
    found = len(cages.table.keys)
    cells = found
    if h and size != h:  # volume / h^3 + b / h^2
        bulk = volume or found * size**3
        cells = round(bulk / h**3 + (found - bulk / size**3) * (size / h) ** 2)
    elif wanted and wanted > MOST_BUILT:
        cells = wanted
    if cells > scene.cages.max_cells:
        log.warning("run refuses %d cells until cages.max_cells = %d is raised", cells, scene.cages.max_cells)
    return body, build_lattice(cages, 1.0, 1.0), cages, cells, mesh


def tell_counts(args: argparse.Namespace, shares, built: int, scene: Scene) -> None:
    """A table: what there is, and what a rank has of it."""
    how = "counted" if built == round(shares.cells.sum()) else f"scaled from a lattice of {built} cells"
    print(f"{args.scene} on {args.ranks} rank{'s' * (args.ranks > 1)}, {how}\n")
    print(f"{'':34}{'all':>15}{'a rank, mean':>15}{'most':>15}")
    springs = shares.all_springs, shares.springs.mean(), shares.springs.max()
    rows = {
        "cells": of(shares.cells),
        "nodes": of(shares.nodes),
        "springs (a rank: and those it shares)": springs,
        "nonzeros of A": of(shares.nonzeros),
        "ghosts": of(shares.ghosts),
        "messages an exchange": of(shares.neighbours),
    }
    for name, (total, mean, most) in rows.items():
        print(f"{name:34}{total:15.0f}{mean:15.1f}{most:15.0f}")
    frames = 1 + -(-scene.time.steps // scene.output.every)
    print(f"{'positions of ' + str(frames) + ' frames in the file [GB]':34}{24 * frames * shares.nodes.sum() / GB:15.3g}")


def of(values: np.ndarray) -> tuple[float, float, float]:
    return values.sum(), values.mean(), values.max()


def tell_needs(args: argparse.Namespace, scene: Scene, body, shares, cells: int, mesh: float) -> None:
    """Memory and time, and what they rest on."""
    from msmpetsc.study.forecast import Network, forecast

    options = shlex.join(args.petsc_options)
    try:
        found = forecast(args.scene, args.set, options, scene, body.surface, cells, args.frames, args.measure_here)
    except OSError as error:
        raise InputError(f"{error.filename}: {error.strerror}") from None
    memory = found.memory(shares, len(body.surface.points) if scene.output.surface else 0, mesh)
    print(f"{'memory [GB]':34}{memory.sum() / GB:15.3g}{memory.mean() / GB:15.3g}{memory.max() / GB:15.3g}")
    computing, messages = found.computing(shares), found.messages(shares, Network(args.latency, args.bandwidth))
    every = scene.output.every
    print(
        f"\ntime of a frame {every * (computing + messages):.3g} s: computing {every * computing:.3g} s, "
        f"messages {every * messages:.3g} s; without writing it"
    )
    coarse, fine = found.coarse, found.fine
    print(
        f"  expected with {found.its(shares.cells.sum()):.1f} KSP iterations and {fine.iterations:.1f} outer ones a step: "
        f"the first {args.frames} steps took {coarse.its:.1f} on {coarse.cells:.0f} cells and {fine.its:.1f} on {fine.cells:.0f}"
    )
    print(
        f"  on cores, and memory for each, as here; messages of {args.latency:g} s and {args.bandwidth:g} byte/s "
        "(--latency, --bandwidth)"
    )


def tell_limits(shares, built: int) -> None:
    """At how many cells of this body integers end."""
    from msmpetsc.solve.limits import BITS, LARGEST, LARGEST_COUNT

    counted = {
        "unknowns, three a node, over all ranks": (lambda s: 3 * s.nodes.sum(), LARGEST, f"{BITS}-bit PetscInt"),
        "nonzeros of A on a rank": (lambda s: s.nonzeros.max(), LARGEST, f"{BITS}-bit PetscInt"),
        "nodes of a rank in one MPI call": (lambda s: (s.nodes + s.ghosts).max(), LARGEST_COUNT, "MPI's int"),
    }
    print()
    for name, (count, limit, integer) in counted.items():
        cells = largest(shares, count, limit)
        state = "" if cells >= shares.cells.sum() else ": too many here"
        print(f"{name} end at {limit} ({integer}): {cells:.3g} cells{state}")


def largest(shares, count, limit: int) -> float:
    """The cells with which this body's ``count`` comes to its limit, on as many ranks."""
    found = brentq(lambda x: np.log(count(shares.scaled(np.exp(x))) / limit), 0.0, np.log(MOST_CELLS))
    return float(np.exp(found))
