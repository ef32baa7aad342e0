"""``msmpetsc inspect``: counts and memory of a scene on so many ranks, without running it.

memory of a rank  =  PROGRAM + FACTOR (bytes of its arrays while A is assembled), or W is made if that is more
"""

import argparse
import json
from collections.abc import Sequence
from typing import Any

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Floats
from msmpetsc.backend.machine import peak_memory
from msmpetsc.build import read_bodies
from msmpetsc.comm import log
from msmpetsc.errors import InputError
from msmpetsc.geometry.surface import Surface
from msmpetsc.lattice.partition import Partition, partition_of
from msmpetsc.scene.reading import Scene, load_scene
from msmpetsc.solve.petsc.initialise import initialise

MOST_BUILT = 200_000  # cells that are built here to count; what is more is scaled
MOST_RANKS = 10**6
PROGRAM, FACTOR = 0.29e9, 2.1  # [byte] of a rank without arrays, and times those, as runs of newton show it
BYTES = np.array([145, 41, 24])  # of a lattice's arrays for a cell, a node, ghosts too, and a spring
BYTES_OF_POINT = 14 * 64 * 8  # of the surface, while W is made of up to 64 weights each; as seen with "affine"
GB = 1e9
SPRINGS = "springs; of a rank, shared ones too"
WIDTH = 36  # of the first column


def run(args: argparse.Namespace) -> int:
    """Inspect a scene; return the exit status."""
    if args.ranks > MOST_RANKS:
        raise InputError(f"--ranks must be at most {MOST_RANKS}, not {args.ranks}")
    initialise(MPI.COMM_WORLD, [])

    scene = load_scene(args.scene, args.set)
    before = peak_memory()
    bodies = read_bodies(MPI.COMM_WORLD, scene)
    mesh = peak_memory() - before
    partition, counted = partition_of(bodies, scene.cages, args.ranks, MOST_BUILT)
    cells = partition.cells.sum()
    if cells > scene.cages.max_cells:
        log.warning("run refuses %d cells until cages.max_cells = %d is raised", cells, scene.cages.max_cells)
    surfaces = [body.surface for body in bodies if body.surface is not None] if scene.output.surface else []
    report = {
        "scene": str(args.scene), "ranks": args.ranks, "counted": counted, "counts": counts_of(scene, partition),
        "memory": over_ranks(memory_of(partition, surfaces, mesh)),
    }  # fmt: skip
    if args.json:
        print(json.dumps(report, indent=1))
        return 0
    print_counts(report)
    return 0


def counts_of(scene: Scene, partition: Partition) -> dict[str, dict[str, float]]:
    """Return the counts of cells, nodes, springs and messages: total, mean and maximum of a rank."""
    rows = {
        "cells": partition.cells,
        "nodes": partition.nodes,
        SPRINGS: partition.springs,
        "nonzeros of A": partition.nonzeros,
        "ghosts": partition.ghosts,
        "messages an exchange": partition.neighbours,
    }
    counts = {name: over_ranks(values) for name, values in rows.items()}
    counts[SPRINGS]["all"] = float(partition.all_springs)
    positions = 24 * scene.stored * counts["nodes"]["all"]
    return counts | {f"positions of {scene.stored} frames, file [byte]": {"all": positions}}


def over_ranks(values: Floats) -> dict[str, float]:
    """Return the sum, the mean and the maximum over ranks."""
    return {"all": float(values.sum()), "mean": float(values.mean()), "most": float(values.max())}


def print_counts(report: dict[str, Any]) -> None:
    """Print the counts as a table."""
    counts = report["counts"]
    how = "counted"
    if report["counted"] != counts["cells"]["all"]:
        how = f"scaled from a lattice of {report['counted']} cells"
    print(f"{report['scene']} on {report['ranks']} rank{'s' * (report['ranks'] > 1)}, {how}\n")
    print(f"{'':{WIDTH}}{'all':>15}{'a rank, mean':>15}{'most':>15}")
    for name, row in (counts | {"memory [byte]": report["memory"]}).items():
        if name.endswith("[byte]"):
            columns = "".join(f"{value / GB:15.3g}" for value in row.values())
        else:
            columns = f"{row['all']:15.0f}{row['mean']:15.1f}{row['most']:15.0f}"
        print(f"{name.replace('byte', 'GB'):{WIDTH}}{columns}")


def memory_of(partition: Partition, surfaces: Sequence[Surface], mesh: float) -> Floats:
    """Return the memory (R,) of each rank [byte].

    surfaces : that are stored
    mesh     : bytes that reading and preparing them took, on rank 0
    """
    from msmpetsc.solve.linear.operators import assembly_bytes
    from msmpetsc.solve.linear.unknowns import BYTES_OF_NODE

    nodes, springs = partition.nodes + partition.ghosts, partition.springs
    arrays = BYTES @ np.array([partition.cells, nodes, springs]) + nodes * BYTES_OF_NODE
    arrays += assembly_bytes(nodes, springs, partition.nonzeros)
    points = sum(len(surface.points) for surface in surfaces)
    needed: Floats = PROGRAM + np.maximum(FACTOR * arrays, BYTES_OF_POINT * points / len(nodes))
    needed[0] = max(needed[0], PROGRAM + mesh)
    return needed
