"""Probes: points of bodies whose positions a run stores."""

from collections.abc import Sequence

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Indices, Positions, Rows, to_host
from msmpetsc.errors import InputError
from msmpetsc.geometry.cages import BodySurface, Cages
from msmpetsc.geometry.embedding import cells_at
from msmpetsc.geometry.grid import CORNERS, packed
from msmpetsc.geometry.partition import places_of
from msmpetsc.lattice.lattice import Lattice
from msmpetsc.lattice.region import groups_named
from msmpetsc.scene.schema import Probe

# tolerance of a point's place in a cell [cell]; a point of a face lies in both cells
ON_FACE = 1e-9


def probe_points(bodies: Sequence[BodySurface], probes: Sequence[Probe]) -> list[Sequence[float]]:
    """Return the rest positions [m] of probes (collective).

    The probe of a group is the group's point nearest to its centroid.

    Raises InputError on all ranks if no body has a probe's group.
    """
    points: list[Sequence[float]] = []
    for number, probe in enumerate(probes):
        if probe.group is None:
            assert probe.point is not None
            points.append(probe.point)
            continue
        # A scene without regions and obstacles starts without igl.
        import igl

        group = next(iter(groups_named(bodies, f"output.probe.{number}", probe.group).values()))
        corners = group.points[group.triangles]
        areas = np.linalg.norm(
            np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
        )
        middle = np.average(corners.mean(axis=1), axis=0, weights=areas)
        points.append(
            igl.point_mesh_squared_distance(middle[None], group.points, group.triangles)[2][0]
        )
    return points


class ProbePoints:
    """Points of bodies, interpolated trilinearly from the corners of their cells."""

    def __init__(self, lattice: Lattice, cages: Cages, points: Sequence[Sequence[float]]):
        """Locate points by their rest positions (w, 3) [m] (collective).

        Raises InputError on all ranks if a point is in no cell.
        """
        self.comm = comm = lattice.table.comm
        of_part = np.sort(self._corners_of_parts(lattice, cages, np.array(points)), axis=1)
        cells = to_host(lattice.local_cells)[: lattice.cells_owned]
        low, numbers = to_host(lattice.nodes)[cells[:, 0]], lattice.global_numbers[cells[:, 0]]
        self.corners = np.zeros((len(points), 8), np.int64)
        self.weights = np.zeros((len(points), 8))
        for row, point in enumerate(points):
            place = (np.array(point) - low) / lattice.cell_size
            around = np.flatnonzero(((place >= -ON_FACE) & (place <= 1 + ON_FACE)).all(axis=1))
            corners = np.sort(lattice.global_numbers[cells[around]], axis=1)
            is_own = (corners == of_part[row]).all(axis=1)
            if comm.allreduce(bool(is_own.any()), MPI.LOR):
                around = around[is_own]
            own = int(numbers[around].min(initial=lattice.table.total))
            # A point on a face or in overlapping bodies has several cells.
            first = comm.allreduce(own, MPI.MIN)
            if first == lattice.table.total:
                place_text = ", ".join(f"{x:g}" for x in point)
                raise InputError(
                    f"output.probe.{row}.point: ({place_text}) m "
                    "lies in no cell of the body at rest"
                )
            if own == first:
                cell = around[np.argmin(numbers[around])]
                self.corners[row] = cells[cell]
                self.weights[row] = np.where(CORNERS == 1, place[cell], 1 - place[cell]).prod(
                    axis=1
                )

    @staticmethod
    def _corners_of_parts(lattice: Lattice, cages: Cages, points: Positions) -> Indices:
        """Return the corners (w, 8) of cells that hold points and have several parts (collective).

        They are global numbers, and -1 for a point in another cell.
        """
        keys = np.full(len(points), -1)
        # Rank 0 alone has the parts.
        for body, parts in enumerate(cages.parts):
            if parts:
                ijk = np.floor(cages.grids.grids[body].to_cells(points)).astype(np.int64)
                own = (places_of(parts.keys, packed(ijk)) >= 0) & (keys < 0)
                keys[own] = cells_at(cages, body, points[own])[0]
        keys = lattice.table.comm.bcast(keys)
        numbers = lattice.table.find(cages.corner_keys(np.maximum(keys, 0)))
        corners: Indices = np.where(keys[:, None] < 0, -1, numbers)
        return corners

    def __call__(self, q: Positions) -> Rows:
        """Return the positions (w, 3) [m] of the points for nodes at q (l, 3) [m] (collective)."""
        own = (self.weights[:, :, None] * to_host(q)[self.corners]).sum(axis=1)
        places: Rows = self.comm.allreduce(own)
        return places
