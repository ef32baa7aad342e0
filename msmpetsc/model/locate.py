"""Where it is worst, for the lines that tell of trouble: a node or a cell, by its place in the body at rest."""

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import to_host
from msmpetsc.model.inversion import inverted_cells
from msmpetsc.model.lattice import Lattice


def place_of_greatest(comm: MPI.Comm, lattice: Lattice, rows: np.ndarray, measure: np.ndarray) -> str:
    """The node among the local ``rows`` (k,) where ``measure`` (k,) is greatest, or not a number (collective)."""
    rows, measure = to_host(rows), np.nan_to_num(to_host(measure), nan=np.inf)
    best = int(np.argmax(measure)) if len(rows) else 0
    told = (-1.0, 0, None)
    if len(rows):
        told = measure[best], lattice.global_numbers[rows[best]], to_host(lattice.nodes[int(rows[best])])
    _, number, place = max(comm.allgather(told), key=lambda one: one[0])
    return f"node {number}, {at_rest(place)}"


def inverted(comm: MPI.Comm, lattice: Lattice, q: np.ndarray) -> tuple[int, str]:
    """How many cells are inverted at q (l, 3) [m], and where the worst is, "" if none is (collective)."""
    cells = lattice.local_cells[: lattice.cells_owned]
    count, worst, least = inverted_cells(q, cells)
    total = comm.allreduce(count)
    if not total:
        return 0, ""
    place = to_host(lattice.nodes[cells[worst]].mean(axis=0)) if worst >= 0 else None
    return total, at_rest(min(comm.allgather((least, place)), key=lambda one: one[0])[1])


def inside_out(comm: MPI.Comm, lattice: Lattice, q: np.ndarray) -> str:
    """ ", 3 cells are inside out", and what to do about it; "" if none is (collective)."""
    count, _ = inverted(comm, lattice, q)
    if not count:
        return ""
    law = "" if lattice.stiffening > 0 else ' (material.law = "stiffening" resists that)'
    return f", {count} cell{'s are' if count > 1 else ' is'} inside out{law}"


def at_rest(place: np.ndarray) -> str:
    """(x, y, z) in words."""
    return f"at rest at ({', '.join(f'{x:.4g}' for x in place)}) m"
