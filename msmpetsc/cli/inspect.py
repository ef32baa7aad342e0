"""``msmpetsc inspect``: what a scene would need on so many ranks, without running it there."""

import argparse
import shlex
import signal
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI
from scipy.optimize import brentq

from msmpetsc.cli.arguments import path_argument, refuse_below_one, refuse_ranks
from msmpetsc.cli.profile import peak_memory
from msmpetsc.cli.study import stop
from msmpetsc.comm import log
from msmpetsc.errors import InputError
from msmpetsc.scene.reading import load_scene
from msmpetsc.scene.schema import Scene
from msmpetsc.solve.petsc.initialise import initialise

if TYPE_CHECKING:
    from msmpetsc.geometry.surface import Surface
    from msmpetsc.model.partition import Shares

MOST_BUILT = 200_000  # cells that are built here to count; what is more is scaled
MOST_RANKS = 10**6
MOST_CELLS = 1e15  # where limits are looked for
GB = 1e9
SPRINGS = "springs; of a rank, shared ones too"
WIDTH = 36  # of the first column


def add_parser(commands: argparse._SubParsersAction) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "inspect",
        help="say what a scene would need on so many ranks",
        description="Count cells, nodes, springs, ghosts and messages of each rank, and expect memory and time of a "
        "frame from two short runs here, on coarser lattices. PETSc options (one dash) may follow.",
    )
    parser.add_argument("scene", type=path_argument, metavar="SCENE", help="scene file (TOML)")
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
    refuse_ranks("inspect", "it counts for --ranks R on one process")
    refuse_bad_numbers(args)
    initialise(MPI.COMM_WORLD, args.petsc_options)
    from msmpetsc.model.build import read_body
    from msmpetsc.model.partition import shares_of
    from msmpetsc.solve.options import refuse_early
    from msmpetsc.solve.presets import PRESETS

    refuse_early(MPI.COMM_WORLD, args.parser._option_string_actions)
    signal.signal(signal.SIGTERM, stop)
    scene = load_scene(args.scene, args.set, PRESETS)
    before = peak_memory()
    body = read_body(MPI.COMM_WORLD, scene)
    mesh = peak_memory() - before
    shares, counted = shares_of(body, scene.cages, args.ranks, MOST_BUILT)
    cells = shares.cells.sum()
    if cells > scene.cages.max_cells:
        log.warning("run refuses %d cells until cages.max_cells = %d is raised", cells, scene.cages.max_cells)
    tell_counts(args, scene, shares, counted)
    if not args.no_times:
        tell_needs(args, scene, body.surface, shares, mesh)
    tell_limits(shares)
    return 0


def refuse_bad_numbers(args: argparse.Namespace) -> None:
    refuse_below_one(args, "ranks", "frames")
    if args.ranks > MOST_RANKS:
        raise InputError(f"--ranks must be at most {MOST_RANKS}, not {args.ranks}")
    if not (args.latency >= 0 and np.isfinite(args.latency)):
        raise InputError(f"--latency must be no less than 0, not {args.latency:g}")
    if not args.bandwidth > 0:
        raise InputError(f"--bandwidth must be more than 0, not {args.bandwidth:g}")


def tell_counts(args: argparse.Namespace, scene: Scene, shares: "Shares", counted: int) -> None:
    """A table: what there is, and what a rank has of it."""
    how = "counted" if counted == shares.cells.sum() else f"scaled from a lattice of {counted} cells"
    print(f"{args.scene} on {args.ranks} rank{'s' * (args.ranks > 1)}, {how}\n")
    print(f"{'':{WIDTH}}{'all':>15}{'a rank, mean':>15}{'most':>15}")
    rows = {
        "cells": shares.cells,
        "nodes": shares.nodes,
        SPRINGS: shares.springs,
        "nonzeros of A": shares.nonzeros,
        "ghosts": shares.ghosts,
        "messages an exchange": shares.neighbours,
    }
    for name, values in rows.items():
        total = shares.all_springs if name == SPRINGS else values.sum()
        print(f"{name:{WIDTH}}{total:15.0f}{values.mean():15.1f}{values.max():15.0f}")
    positions = f"positions of {scene.stored} frames, file [GB]"
    print(f"{positions:{WIDTH}}{24 * scene.stored * shares.nodes.sum() / GB:15.3g}")


def tell_needs(args: argparse.Namespace, scene: Scene, surface: "Surface", shares: "Shares", mesh: float) -> None:
    """Memory and time, and what they rest on; ``mesh``: bytes that preparing the surface took."""
    from msmpetsc.study.forecast import Network, forecast

    options, cells = shlex.join(args.petsc_options), shares.cells.sum()
    try:
        found = forecast(
            file=args.scene, changes=args.set, options=options, scene=scene, surface=surface, cells=cells,
            frames=args.frames, again=args.measure_here,
        )  # fmt: skip
    except OSError as error:
        raise InputError(f"{error.filename}: {error.strerror}") from None
    memory = found.memory(shares, len(surface.points) if scene.output.surface else 0, mesh)
    print(f"{'memory [GB]':{WIDTH}}{memory.sum() / GB:15.3g}{memory.mean() / GB:15.3g}{memory.max() / GB:15.3g}")
    every, network = scene.output.every, Network(args.latency, args.bandwidth)
    computing, messages = every * found.computing(shares), every * found.messages(shares, network)
    trials = found.coarse, found.fine
    explicit = scene.time.integrator == "verlet"
    first, second = (f"{t.iterations if explicit else t.its:.1f} on {t.cells:.0f}" for t in trials)
    work = f"{found.iterations(cells):.1f} {'substeps' if explicit else 'outer ones'} a step"
    work = work if explicit else f"{found.its(cells):.1f} KSP iterations and {work}"
    print(
        f"\ntime of a frame {computing + messages:.3g} s: computing {computing:.3g} s, messages {messages:.3g} s; "
        "without writing it\n"
        f"  expected with {work}: the first {args.frames} took {first} cells and {second},\n"
        f"  on cores, and memory for each, as here; messages of {network.latency:g} s and {network.bandwidth:g} byte/s "
        "(--latency, --bandwidth)"
    )


def tell_limits(shares: "Shares") -> None:
    """At how many cells of this body, on as many ranks, integers end."""
    from msmpetsc.solve.petsc.limits import BITS, LARGEST, LARGEST_COUNT

    petsc = f"{BITS}-bit PetscInt"
    ends = {
        "unknowns, three a node": (lambda s: 3 * s.nodes.sum(), LARGEST, petsc),
        "nonzeros of A on a rank": (lambda s: s.nonzeros.max(), LARGEST, petsc),
        "nodes of a rank in one MPI call": (lambda s: (s.nodes + s.ghosts).max(), LARGEST_COUNT, "MPI's int"),
    }
    print()
    for name, (count, limit, integer) in ends.items():
        cells = largest(shares, count, limit)
        here = "" if cells >= shares.cells.sum() else ", fewer than here: run refuses or fails"
        print(f"{name} end at {limit} ({integer}): {cells:.3g} cells{here}")


def largest(shares: "Shares", count: Callable[["Shares"], float], limit: int) -> float:
    """The cells with which this body's ``count`` comes to its limit, on as many ranks."""
    found = brentq(lambda x: np.log(count(shares.scaled(np.exp(x))) / limit), 0.0, np.log(MOST_CELLS))
    return float(np.exp(found))
