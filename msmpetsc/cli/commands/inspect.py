"""``msmpetsc inspect``: groups of meshes, counts and memory of a scene, without a run.

memory of a rank  =  PROGRAM + FACTOR (bytes of its arrays while A is assembled), or W is made if that is more

Ranks own equal parts of cells and of nodes along the Morton curve; those that R ranks make themselves, by a sample
(comm.SortedKeys), are as large within an eighth.
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Array, Floats
from msmpetsc.backend.machine import peak_memory
from msmpetsc.build import read_bodies
from msmpetsc.comm import log
from msmpetsc.errors import InputError
from msmpetsc.geometry.cages import (
    BodySurface,
    choose_cell_size,
    estimated_cells,
    estimated_size,
    fill,
    warn_of_thin_bodies,
)
from msmpetsc.geometry.surface import Surface
from msmpetsc.lattice.lattice import Topology, topology_of
from msmpetsc.lattice.region import listed
from msmpetsc.scene.body import CagesTable
from msmpetsc.scene.reading import Scene, load_scene
from msmpetsc.solve.petsc.initialise import initialise

MOST_BUILT = 200_000  # cells that are built here to count; what is more is scaled
MOST_RANKS = 10**6
PROGRAM, FACTOR = (
    0.29e9,
    2.1,
)  # [byte] of a rank without arrays, and times those, as runs of newton show it
BYTES = np.array(
    [145, 41, 24]
)  # of a lattice's arrays for a cell, a node, ghosts too, and a spring
BYTES_OF_POINT = (
    14 * 64 * 8
)  # of the surface, while W is made of up to 64 weights each; as seen with "affine"
GB = 1e9
SPRINGS = "springs; of a rank, shared ones too"
WIDTH = 36  # of the first column
NO_LIMIT = 1 << 40  # cells: the scene's own limit is for runs
INNER_SPRINGS = 13  # of each cell, where cells have neighbours on all sides


@dataclass(frozen=True)
class Partition:
    """What each rank holds, one number a rank, (R,): whole where they were counted, fractions where they were scaled.

    cells, nodes : that the rank owns
    ghosts       : nodes of others that its springs reach
    cut          : springs of which it owns one end
    nonzeros     : of its rows of A: of each node the diagonal and the far ends of its springs
    neighbours   : ranks that its ghosts come from: messages that it gets in one exchange, and sends
    """

    cells: Array
    nodes: Array
    ghosts: Array
    cut: Array
    nonzeros: Array
    neighbours: Array

    @property
    def springs(self) -> Array:
        """Number of springs (R,) that each rank keeps."""
        springs: Array = (self.nonzeros - self.nodes + self.cut) / 2
        return springs

    @property
    def all_springs(self) -> float:
        """Number of springs, each counted once."""
        return float(self.springs.sum() - self.cut.sum() / 2)

    def scaled(self, cells: float) -> "Partition":
        """Return the partition of the same body with more cells on as many ranks.

        What fills it grows with the cells, the surface with their power 2/3; ghosts and cut springs
        as they do around a cube of as many nodes as a rank has.
        """
        nodes = self.nodes.sum()
        before = self.cells.sum()
        f = cells / before
        grown = cells + (nodes - before) * f ** (2 / 3)
        springs = INNER_SPRINGS * cells + (self.all_springs - INNER_SPRINGS * before) * f ** (2 / 3)
        side, side_before = np.cbrt(np.array([grown, nodes]) / len(self.nodes))
        around = ((side + 2) ** 3 - side**3) / (
            (side_before + 2) ** 3 - side_before**3
        )  # nodes around a cube
        nonzeros = self.nonzeros * (grown + 2 * springs) / self.nonzeros.sum()
        held = (
            self.cells * f,
            self.nodes * grown / nodes,
            self.ghosts * around,
            self.cut * around,
            nonzeros,
        )
        return Partition(*held, self.neighbours)


def partition_of(
    bodies: Sequence[BodySurface], wanted: CagesTable, ranks: int
) -> tuple[Partition, int]:
    """Return the partition among ``ranks`` ranks, and the cells of the lattice that it was counted on.

    That lattice has about MOST_BUILT cells where more are wanted, and its numbers are scaled.
    """
    h = wanted.cell_size or estimated_size(bodies, wanted.count or 0)
    cells = float(wanted.count or estimated_cells(bodies, h))
    built = h
    if wanted.count or cells > MOST_BUILT:
        built = choose_cell_size(bodies, int(min(cells, MOST_BUILT)), NO_LIMIT, wanted.boundary)
    warn_of_thin_bodies(bodies, h if cells > MOST_BUILT else built)
    cages = fill(bodies, built, NO_LIMIT, wanted.boundary)
    partition = count_partition(topology_of(cages), ranks)
    counted = int(partition.cells.sum())
    return partition.scaled(round(cells)) if cells > MOST_BUILT else partition, counted


def count_partition(lattice: Topology, ranks: int) -> Partition:
    """Return the partition among ``ranks`` ranks of a lattice that is whole, built on one rank."""
    cell_rank, rank = (
        np.arange(n) * ranks // n for n in (len(lattice.corners), len(lattice.octants))
    )
    of_end = rank[lattice.springs]
    across = of_end[:, 0] != of_end[:, 1]
    to, node = of_end[across].ravel(), lattice.springs[across][:, ::-1].ravel()
    ghosts = np.unique(to * len(rank) + node)
    holder, owner = ghosts // len(rank), rank[ghosts % len(rank)]
    holders = (
        cell_rank,
        rank,
        holder,
        to,
        np.append(rank, of_end),
        np.unique(holder * ranks + owner) // ranks,
    )
    return Partition(*(np.bincount(rank_of, minlength=ranks) for rank_of in holders))


def run(args: argparse.Namespace) -> int:
    """Inspect a scene; return the exit status."""
    if args.ranks > MOST_RANKS:
        raise InputError(f"--ranks must be at most {MOST_RANKS}, not {args.ranks}")
    initialise(MPI.COMM_WORLD, [])

    scene = load_scene(args.scene, args.set)
    before = peak_memory()
    bodies = read_bodies(MPI.COMM_WORLD, scene)
    mesh = peak_memory() - before
    partition, counted = partition_of(bodies, scene.cages, args.ranks)
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
        "scene": str(args.scene), "ranks": args.ranks, "counted": counted, "counts": counts_of(scene, partition),
        "memory": over_ranks(memory_of(partition, stored, mesh)), "groups": groups,
    }  # fmt: skip
    if args.json:
        print(json.dumps(report, indent=1))
    else:
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
    """Print the counts as a table, then the groups of each mesh."""
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
    for source, groups in report["groups"].items():
        if groups:
            print(
                f"\ngroups of {source}: {listed([f'{name} ({count} triangles)' for name, count in groups.items()])}"
            )


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
