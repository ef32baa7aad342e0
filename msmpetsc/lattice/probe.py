"""Probes: points of a body that move with the corners of their cells, by trilinear functions."""

from collections.abc import Sequence

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Positions, Rows, to_host
from msmpetsc.errors import InputError
from msmpetsc.lattice.lattice import CORNERS, Lattice

SAME = 1e-9  # of a cell: a point of a face lies in both cells


class ProbePoints:
    """Points by their places at rest (w, 3) [m]. Raises InputError on all ranks for one in no cell (collective)."""

    def __init__(self, comm: MPI.Comm, lattice: Lattice, points: Sequence[Sequence[float]]):
        self.comm = comm
        cells = to_host(lattice.local_cells)[: lattice.cells_owned]
        low, numbers = to_host(lattice.nodes)[cells[:, 0]], lattice.global_numbers[cells[:, 0]]
        self.corners = np.zeros((len(points), 8), np.int64)
        self.weights = np.zeros((len(points), 8))
        for row, point in enumerate(points):
            place = (np.array(point) - low) / lattice.cell_size
            around = np.flatnonzero(((place >= -SAME) & (place <= 1 + SAME)).all(axis=1))
            own = int(numbers[around].min(initial=lattice.table.total))
            first = comm.allreduce(own, MPI.MIN)  # of several cells on a face, or of bodies in one place
            if first == lattice.table.total:
                place_text = ", ".join(f"{x:g}" for x in point)
                raise InputError(f"output.probe.{row}.point: ({place_text}) m lies in no cell of the body at rest")
            if own == first:
                cell = around[np.argmin(numbers[around])]
                self.corners[row] = cells[cell]
                self.weights[row] = np.where(CORNERS == 1, place[cell], 1 - place[cell]).prod(axis=1)

    def __call__(self, q: Positions) -> Rows:
        """Return where the points are (w, 3) [m] with nodes at q (l, 3) [m] (collective)."""
        own = (self.weights[:, :, None] * to_host(q)[self.corners]).sum(axis=1)
        places: Rows = self.comm.allreduce(own)
        return places
