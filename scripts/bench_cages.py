#!/usr/bin/env python3
"""Times cages and embeddings of real scans and prints a Markdown table. Needs the meshes.

Warm: the best of three runs after one that compiles. `mpiexec -n 2 scripts/bench_cages.py` times ranks together.
The 457,000 triangles of the Welsh dragon need a minute of repair: `dragon`, each triangle cut into 16, stands in.
"""

import time
from collections.abc import Callable
from functools import partial

from clone import parser

import numpy as np
import trimesh
from mpi4py import MPI

from msmpetsc.comm import SortedKeys
from msmpetsc.geometry.cages import Body, choose_cell_size, fill
from msmpetsc.geometry.embedding import KINDS, embed
from msmpetsc.geometry.grid import encode_morton
from msmpetsc.geometry.prepare import compact, prepare
from msmpetsc.geometry.registry import load
from msmpetsc.geometry.surface import Surface, examine
from msmpetsc.model.lattice import CORNERS

RUNS = 3
POINTS = 50_000  # embedded
COLUMNS = ["model", "triangles", "cells", "fill [s]", "choose_cell_size + fill [s]", *(f"{k} [s]" for k in KINDS)]

comm = MPI.COMM_WORLD


def bunny() -> Surface:
    """The scan of 50,000 points, repaired but not simplified."""
    return prepare(load("bunny_scan", "."), ["repair"])


def dragon() -> Surface:
    """754,240 triangles."""
    model = load("dragon", ".")
    return Surface(*trimesh.remesh.subdivide(*trimesh.remesh.subdivide(model.points, model.triangles)))


def body_of(read: Callable[[], Surface]) -> Body:
    """The surface on rank 0, what is known of it on all."""
    surface, facts = None, None
    if comm.rank == 0:
        surface = read()
        surface = compact(surface.points, surface.triangles)
        facts = examine(surface), np.array([surface.points.min(axis=0), surface.points.max(axis=0)])
    return Body(comm, surface, *comm.bcast(facts))


def seconds(function: Callable[[], object]) -> float:
    """Best of the warm runs, of the slowest rank."""
    function()
    times = []
    for _ in range(RUNS):
        comm.Barrier()
        start = time.perf_counter()
        function()
        times.append(comm.allreduce(time.perf_counter() - start, MPI.MAX))
    return min(times)


def row(name: str, body: Body, count: int) -> list[str]:
    """The table's cells for one body filled with about ``count`` cells."""
    cell_size = choose_cell_size([body], count)
    cages = fill([body], cell_size)
    nodes = SortedKeys(comm, encode_morton(cages.ijk[:, None, :] + CORNERS).ravel())
    points = np.empty((0, 3))
    triangles = 0
    if body.surface is not None:
        chosen = np.random.default_rng(0).choice(len(body.surface.points), min(POINTS, len(body.surface.points)), False)
        points, triangles = body.surface.points[chosen], len(body.surface.triangles)
    times = [seconds(lambda: fill([body], cell_size)), seconds(lambda: fill([body], choose_cell_size([body], count)))]
    times += [seconds(partial(embed, [points], cages, nodes, kind)) for kind in KINDS]
    return [name, f"{triangles:,}", f"{cages.table.total:,}", *(f"{time:.3f}" for time in times)]


def main() -> None:
    parser(__doc__).parse_args()
    rows = [row("bunny scan", body_of(bunny), 10_000), row("dragon", body_of(dragon), 1_000_000)]
    if comm.rank == 0:
        print(f"{comm.size} rank(s), {POINTS:,} points embedded\n")
        for line in (COLUMNS, ["---"] * len(COLUMNS), *rows):
            print("|", " | ".join(line), "|")


if __name__ == "__main__":
    main()
