"""Location of the worst node or cell, for messages: its point in the body at rest."""

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Floats, Indices, Positions, like, to_host
from msmpetsc.elasticity.cell_volume import least_volumes, volume_ratios
from msmpetsc.lattice.lattice import Lattice


def node_of_greatest(comm: MPI.Comm, lattice: Lattice, rows: Indices, measure: Floats) -> str:
    """Describe the node where a measure is greatest, or not a number (collective).

    rows, measure : (k,) local nodes, and what is measured of each
    """
    number, where = _least(
        comm, lattice, rows[:, None], -np.nan_to_num(to_host(measure), nan=np.inf)
    )
    return f"node {number}, {where}"


def _least(comm: MPI.Comm, lattice: Lattice, corners: Indices, measure: Floats) -> tuple[int, str]:
    """Return where a measure (k,) is least: a node's global number, its place (collective).

    corners : (k, c) local nodes of what is measured: its place is their mean, its node the first
    """
    candidate = np.inf, 0, np.zeros(3)
    if len(corners):
        least = int(measure.argmin())
        nodes = to_host(corners[least])
        point = to_host(lattice.nodes[like(lattice.nodes, nodes)].mean(axis=0))
        candidate = float(measure[least]), int(lattice.global_numbers[nodes[0]]), point
    _, number, point = min(comm.allgather(candidate), key=lambda candidate: candidate[0])
    return (
        number,
        f"{of_body(lattice, number)}at rest at ({', '.join(f'{x:.4g}' for x in point)}) m",
    )


def worst_inverted(
    comm: MPI.Comm, lattice: Lattice, q: Positions, corners: bool = False
) -> tuple[int, str]:
    """Return how many cells are inverted at q (l, 3) [m], and where the worst is, "" if none is (collective).

    A solid's cell is where what is inside the surface is, in the mean: corners of a sliver may fold far outside.
    By its ``corners`` it is folded, too, where they are while the mean is not.
    """
    cells, solid = lattice.local_cells[: lattice.cells_owned], lattice.solid
    if solid is None or corners:
        volumes = least_volumes(q, cells)
    else:
        volumes = volume_ratios(q, cells, solid.forms, lattice.cell_size)
    total = comm.allreduce(int((volumes <= 0).sum()))
    if not total:
        return 0, ""
    return total, _least(comm, lattice, cells, volumes)[1]


def describe_inverted(comm: MPI.Comm, lattice: Lattice, q: Positions) -> str:
    """Return ", 3 cells are inside out", and what to do about it; "" if none is (collective)."""
    count, _ = worst_inverted(comm, lattice, q)
    if not count:
        return ""
    resists = lattice.solid is not None
    law = "" if resists else ' (material.law = "neo-hookean" resists that)'
    return f", {count} cell{'s are' if count > 1 else ' is'} inside out{law}"


def of_body(lattice: Lattice, number: int) -> str:
    """Return "of body.1 ", the body of the node of this global number; "" where there is but one."""
    return f"of body.{lattice.body_of(number)} " if len(lattice.first_of_body) > 1 else ""
