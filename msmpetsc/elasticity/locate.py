"""Descriptions of the worst node or cell for messages, with its place in the body at rest."""

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Floats, Indices, Positions, like, to_host
from msmpetsc.comm import reduced
from msmpetsc.elasticity.cell_volume import least_volumes, volume_ratios
from msmpetsc.lattice.lattice import Lattice


def node_of_greatest(comm: MPI.Comm, lattice: Lattice, rows: Indices, measure: Floats) -> str:
    """Return a description of the node at which a measure is greatest or NaN (collective).

    rows    : (k,) local nodes
    measure : (k,) the measure at each node
    """
    number, where = _least(
        comm, lattice, rows[:, None], -np.nan_to_num(to_host(measure), nan=np.inf)
    )
    return f"node {number}, {where}"


def _least(comm: MPI.Comm, lattice: Lattice, corners: Indices, measure: Floats) -> tuple[int, str]:
    """Return the global node number and the place at which a measure (k,) is least (collective).

    corners : (k, c) local nodes of each measured item. The item's node is the first of these, its
              place their mean at rest.
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
    """Return the number of inverted cells at q (l, 3) [m] and the place of the worst (collective).

    The place is "" if no cell is inverted. A solid's cell is inverted if its mean J, over the part
    inside the surface, is <= 0: corners outside the surface may fold. A cell of springs, or any
    cell if ``corners``, is inverted if one of its corner volumes is <= 0.
    """
    cells, solid = lattice.local_cells[: lattice.cells_owned], lattice.solid
    if solid is None or corners:
        volumes = least_volumes(q, cells)
    else:
        volumes = volume_ratios(q, cells, solid.forms, lattice.cell_size)
    total = reduced(comm, int((volumes <= 0).sum()))
    if not total:
        return 0, ""
    return total, _least(comm, lattice, cells, volumes)[1]


def describe_inverted(comm: MPI.Comm, lattice: Lattice, q: Positions) -> str:
    """Return ", 3 cells are inside out" and a remedy, or "" if no cell is inverted (collective)."""
    count, _ = worst_inverted(comm, lattice, q)
    if not count:
        return ""
    resists = lattice.solid is not None
    law = "" if resists else ' (material.law = "neo-hookean" resists that)'
    return f", {count} cell{'s are' if count > 1 else ' is'} inside out{law}"


def of_body(lattice: Lattice, number: int) -> str:
    """Return "of body.1 " for the body of a node by its global number; "" for a single body."""
    return f"of body.{lattice.body_of(number)} " if len(lattice.first_of_body) > 1 else ""
