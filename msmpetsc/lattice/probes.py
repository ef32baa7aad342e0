"""Probes: points of bodies whose positions a run stores."""

from collections.abc import Sequence

import numpy as np

from msmpetsc.backend.arrays import Positions, Rows, to_host
from msmpetsc.errors import InputError
from msmpetsc.geometry.cages import BodySurface, Cages
from msmpetsc.geometry.embedding import cells_at, embed
from msmpetsc.geometry.grid import MOST_ON_PLANE
from msmpetsc.lattice.embedded_surface import EmbeddedPoints, doubled_areas
from msmpetsc.lattice.lattice import Lattice
from msmpetsc.lattice.region import groups_named
from msmpetsc.scene.schema import Probe


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
        # imported here because it is slow
        import igl

        group = next(iter(groups_named(bodies, f"output.probe.{number}", probe.group).values()))
        corners = group.points[group.triangles]
        areas = np.linalg.norm(doubled_areas(corners.swapaxes(0, 1)), axis=1)
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
        at, body = np.array(points), np.full(len(points), -1)
        # a point in several bodies belongs to the first
        for number, grid in reversed([*enumerate(cages.grids.grids)]):
            # only rank 0 has the parts of cells
            keys = comm.bcast(cells_at(cages, number, at)[0])
            moved = np.abs(grid.node_positions(grid.to_cells(at)) - at).max(axis=1)
            body[(cages.table.find(keys) >= 0) & (moved <= MOST_ON_PLANE * lattice.cell_size)] = (
                number
            )
        for row in np.flatnonzero(body < 0):
            place = ", ".join(f"{x:g}" for x in at[row])
            raise InputError(
                f"output.probe.{row}.point: ({place}) m lies in no cell of the body at rest"
            )
        bodies = range(len(cages.grids.grids))
        given = [at[(body == number) & (comm.rank == 0)] for number in bodies]
        embedding = embed(given, cages, lattice.table, "trilinear")
        self._points = EmbeddedPoints(comm, lattice, embedding)
        self._row = np.argsort(np.argsort(body, kind="stable"))

    def __len__(self) -> int:
        return len(self._row)

    def __call__(self, q: Positions) -> Rows:
        """Return the positions (w, 3) [m] of the points for nodes at q (l, 3) [m] (collective)."""
        places: Rows = np.concatenate(self.comm.allgather(self._points(to_host(q))))[self._row]
        return places
