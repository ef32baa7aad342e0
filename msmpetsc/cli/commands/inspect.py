"""``msmpetsc inspect``: print mesh groups, counts and memory of a scene without a run.

The counts assume that each rank has an equal part of the cells and nodes along the Morton curve.
The parts of a run, made by sampling (geometry.partition.SortedKeys), differ by up to an eighth.

The memory of a rank is the memory of the program plus the larger of two peaks: the peak of a step,
which is proportional to the nodes, and the peak while W is built.
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
from msmpetsc.errors import body_names
from msmpetsc.geometry.cages import BodySurface, fill
from msmpetsc.geometry.cell_size import (
    choose_cell_size,
    estimated_cells,
    estimated_size,
    warn_of_thin_bodies,
)
from msmpetsc.geometry.surface import Surface
from msmpetsc.geometry.thickness import thickness_words
from msmpetsc.lattice.partition_counts import Partition, count_partition
from msmpetsc.lattice.region import listed
from msmpetsc.lattice.topology import topology_of
from msmpetsc.scene.body import CagesTable
from msmpetsc.scene.reading import Scene, load_scene
from msmpetsc.solve.petsc.initialise import initialise

# largest lattice built to count [cells]; counts of a larger lattice are scaled
MOST_BUILT = 200_000
GB = 1e9
# memory of a rank without its nodes [byte]; this and the next three numbers were
# measured in runs of 3,000 to 350,000 nodes
PROGRAM = 0.3e9
# memory per node, ghosts included [byte]: for a solid, for springs, and if A is used
OF_SOLID, OF_SPRINGS, WITH_A = 2400, 3200, 3900
# peak memory for a surface point with 64 weights while W is made [byte]; measured with
# the embedding "affine"
BYTES_OF_POINT = 14 * 64 * 8
SPRINGS = "springs; of a rank, with shared springs"
# width of the first column [characters]
WIDTH = 36
# limit on cells of the counted lattice [-]; cages.max_cells is for runs only
NO_LIMIT = 1 << 40


def partition_of(
    bodies: Sequence[BodySurface], wanted: CagesTable, ranks: int
) -> tuple[Partition, int, float]:
    """Return the partition among ``ranks`` ranks, the counted cells, and the scene's cell size [m].

    If the scene has more than MOST_BUILT cells, count a lattice of about MOST_BUILT cells and
    scale the counts.
    """
    h = wanted.cell_size or estimated_size(bodies, wanted.count or 0)
    cells = float(wanted.count or estimated_cells(bodies, h))
    built = h
    if wanted.count or cells > MOST_BUILT:
        built = choose_cell_size(bodies, int(min(cells, MOST_BUILT)), NO_LIMIT)
    cages = fill(bodies, built, NO_LIMIT, wanted.boundary)
    partition = count_partition(topology_of(cages), ranks)
    counted = int(partition.cells.sum())
    if cells > MOST_BUILT:
        return partition.scaled(round(cells)), counted, h
    return partition, counted, built


def run(args: argparse.Namespace) -> int:
    """Inspect a scene; return the exit status."""
    initialise(MPI.COMM_WORLD, [])

    scene = load_scene(args.scene, args.set)
    before = peak_memory()
    bodies = read_bodies(MPI.COMM_WORLD, scene)
    mesh_bytes = peak_memory() - before
    partition, counted, cell_size = partition_of(bodies, scene.cages, args.ranks)
    warn_of_thin_bodies(bodies, cell_size, scene.material.law)
    cells = partition.cells.sum()
    if cells > scene.cages.max_cells:
        log.warning(
            "run refuses %d cells until cages.max_cells = %d is raised",
            cells,
            scene.cages.max_cells,
        )
    surfaces = [body.surface for body in bodies if body.surface is not None]
    stored = surfaces if scene.output.surface else []
    groups = {
        mesh.source: {name: len(group.triangles) for name, group in surface.groups.items()}
        for mesh, surface in zip(scene.meshes.values(), surfaces, strict=True)
    }
    report = {
        "scene": str(args.scene), "ranks": args.ranks, "counted": counted,
        "counts": counts_of(scene, partition),
        "memory": over_ranks(memory_of(scene, partition, stored, mesh_bytes)), "groups": groups,
        "thickness": [body.thickness and body.thickness.cells(cell_size) for body in bodies],
    }  # fmt: skip
    if args.json:
        print(json.dumps(report, indent=1))
    else:
        print_counts(report)
    return 0


def memory_of(
    scene: Scene, partition: Partition, surfaces: Sequence[Surface], mesh_bytes: float
) -> Floats:
    """Return the estimated memory (R,) of each rank [byte].

    surfaces   : surfaces that the result stores
    mesh_bytes : memory that reading and preparing the meshes took, on rank 0 [byte]
    """
    # PETSc must get its options before it is imported
    from msmpetsc.solve.presets import find_preset

    preset = find_preset(scene.solver.preset)
    of_node = OF_SPRINGS if scene.material.law == "linear" else OF_SOLID
    if not preset.true_hessian:
        of_node = WITH_A
    if preset.options.get("pc_type") == "cholesky":
        log.warning(
            "the memory lacks the Cholesky factor of %s, which grows faster than the nodes",
            scene.solver.preset,
        )
    step = of_node * (partition.nodes + partition.ghosts)
    points = sum(len(surface.points) for surface in surfaces)
    needed: Floats = PROGRAM + np.maximum(step, BYTES_OF_POINT * points / len(step))
    needed[0] = max(needed[0], PROGRAM + mesh_bytes)
    return needed


def counts_of(scene: Scene, partition: Partition) -> dict[str, dict[str, float]]:
    """Return counts of cells, nodes, springs and messages: total, mean and maximum over ranks."""
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
    """Print the counts as a table, the thickness of each body and the groups of each mesh."""
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
    names = body_names(len(report["thickness"]))
    thick = [
        f"{name} is {thickness_words(cells)}"
        for name, cells in zip(names, report["thickness"], strict=True)
        if cells
    ]
    if thick:
        print("\n".join(["", *thick]))
    for source, groups in report["groups"].items():
        if groups:
            names = [f"{name} ({count} triangles)" for name, count in groups.items()]
            print(f"\ngroups of {source}: {listed(names)}")
