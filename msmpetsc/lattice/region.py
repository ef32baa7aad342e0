"""Find the nodes and the samples of cells in the regions of a scene.

A region selects material (README: regions and clamps):

- a node, if the region contains the body's point nearest to the node;
- a node in the region, if the region also contains the body half a cell away from the node;
- a share of a cell, by samples of the cell (lattice.cell_materials).
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Indices, Mask, Positions, Rows
from msmpetsc.comm import log, on_root
from msmpetsc.errors import InputError, did_you_mean, printable
from msmpetsc.geometry.cages import BodySurface, Cages
from msmpetsc.geometry.embedding import cells_at
from msmpetsc.geometry.grid import unpacked
from msmpetsc.geometry.inside import inside_bodies
from msmpetsc.geometry.morton import COPIES, encode_morton
from msmpetsc.geometry.surface import SINGLE, Surface, bounds_of, examine, is_inside
from msmpetsc.geometry.valid_cells import touched_cells
from msmpetsc.lattice.cell_samples import COUNT, CellSamples
from msmpetsc.lattice.lattice import Lattice
from msmpetsc.lattice.nearest_points import NodePoints, nearest_in_bodies
from msmpetsc.scene.schema import OfBody

# most names of groups in a message [-]; more would fill the screen
MOST_LISTED = 20


@dataclass(frozen=True)
class Finder:
    """Finder of the nodes and cells in a region.

    folder : directory of the files with painted points
    """

    bodies: tuple[BodySurface, ...]
    cages: Cages
    folder: Path

    @property
    def comm(self) -> MPI.Comm:
        return self.bodies[0].comm

    @property
    def bounds(self) -> Rows:
        """Bounding box at rest (b, 2, 3) [m] of each body."""
        return np.array([body.bounds for body in self.bodies])

    def find(self, table: OfBody, lattice: Lattice, nearest: NodePoints) -> Mask:
        """Return the mask (l,) of local nodes in the region of a scene's table (collective).

        nearest : body points nearest to the nodes

        Raises InputError on all ranks if the region has no node.
        """
        region = table.table.region
        if region.is_of_mesh:
            where = around = self._nodes_of_mesh(table, lattice, nearest)
        else:
            where = self.inside(table, nearest.points, lattice.body)
            around = self.inside(table, lattice.nodes, lattice.body) & ~nearest.of_part
            where = where | self._at_edge(table, lattice, around & ~where)
        selected, outside = self.comm.allreduce(
            np.array([mask[: lattice.owned].sum() for mask in (where, around & ~where)])
        )
        if selected == 0:
            raise InputError(
                f"{table.key}.region holds no node of the lattice{self.extents(table)}"
            )
        if selected < outside:
            log.warning(
                "%s.region only grazes the body: it holds %d nodes, and leaves out %d nodes "
                "that lie in the region but outside the body%s",
                table.key, selected, outside, self.extents(table),
            )  # fmt: skip
        return where

    def _at_edge(self, table: OfBody, lattice: Lattice, outside: Mask) -> Mask:
        """Return the mask (l,) of nodes in ``outside`` (l,) near material in the region.

        From a node, six places lie half a cell away along the grid's axes. The region must contain
        the body's point nearest to one of these places (collective).
        """
        rows = np.flatnonzero(outside)
        sides = np.concatenate([np.eye(3), -np.eye(3)])
        half_way = lattice.nodes[rows, None] + self.cages.grids.cell_size / 2 * sides
        body = np.repeat(lattice.body[rows], len(sides))
        nearest = nearest_in_bodies(self.bodies, half_way.reshape(-1, 3), body)
        where = np.zeros_like(outside)
        where[rows] = self.inside(table, nearest, body).reshape(-1, len(sides)).any(axis=1)
        return where

    def inside(self, table: OfBody, points: Positions, body: Indices) -> Mask:
        """Return the mask (n,) of points (n, 3) [m] of bodies (n,) in a table's region of space."""
        return inside_bodies(table.table.region, points, self.bounds, body, table.body)

    def find_samples(self, table: OfBody, cells: CellSamples) -> Mask:
        """Return the mask (c, s) of the samples of cells in a region (collective).

        A region of painted points contains all samples of the cells with these points. An open
        group contains all samples of the cells that its triangles cut.
        """
        where, keys = np.zeros((len(cells.ijk), COUNT), bool), encode_morton(cells.ijk)
        if table.table.region.painted is not None:
            painted = self._painted_cells(table)
            where[np.isin(keys, painted - painted % COPIES)] = True
        elif table.table.region.group is not None:
            for number, group, marked in self._groups(table, are_nodes=False):
                is_marked = np.isin(keys, marked)
                if not examine(group).closed:
                    where[is_marked] = True
                    continue
                # a cell that no triangle cuts is inside or outside as a whole
                whole = np.flatnonzero((cells.body == number) & ~is_marked)
                middles = self.cages.grids.node_positions(cells.ijk[whole] + 0.5)
                where[whole] |= is_inside(group, middles)[:, None]
                for rows, points in cells.points(np.flatnonzero(is_marked)):
                    where[rows] |= is_inside(group, points).reshape(-1, COUNT)
        else:
            for rows, points in cells.points(np.arange(len(where))):
                body = np.repeat(cells.body[rows], COUNT)
                where[rows] = self.inside(table, points, body).reshape(-1, COUNT)
        return where

    def check_holds(self, table: OfBody, where: Mask) -> None:
        """Raise InputError on all ranks if no sample (c, s) is in a table's region (collective)."""
        if not self.comm.allreduce(bool(where.any()), MPI.LOR):
            raise InputError(f"{table.key}.region holds no part of a cell{self.extents(table)}")

    def shares_inside(self, cells: CellSamples, rows: Indices) -> Rows:
        """Return the share (k, s) of each sample in the part of its cell inside (collective).

        Samples outside the surface have the share 0. If all are outside, all have the same share.

        rows : (k,) cells
        """
        is_within = np.ones((len(rows), COUNT), bool)
        cut = cells.cut(rows)
        given = np.concatenate([np.zeros((0, 3)), *(points for _, points in cells.points(cut))])
        nearest = nearest_in_bodies(self.bodies, given, np.repeat(cells.body[cut], COUNT))
        # a point inside is its own nearest point
        is_within[np.isin(rows, cut)] = (nearest == given).all(axis=1).reshape(-1, COUNT)
        is_within[~is_within.any(axis=1)] = True
        shares: Rows = is_within / is_within.sum(axis=1, keepdims=True)
        return shares

    def extents(self, table: OfBody) -> str:
        """Return the end of a message: the extent of a table's bodies."""
        bounds = self.bounds if table.body is None else self.bounds[[table.body]]
        low, high = (
            ", ".join(f"{x:.4g}" for x in end)
            for end in (bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0))
        )
        return f": the body is from ({low}) to ({high}) m"

    def _nodes_of_mesh(self, table: OfBody, lattice: Lattice, nearest: NodePoints) -> Mask:
        """Return the mask (l,) of nodes in a region of painted points or a group (collective).

        A group contains the nodes that are nearest to a point of its triangles. A closed group also
        contains the nodes that it encloses. At a slit narrower than a cell, the nearest point on
        the node's own side stands for the node.
        """
        keys = lattice.table.with_ghosts(lattice.ghosts, lattice.table.keys)
        if table.table.region.group is None:
            return np.isin(keys, self.cages.copies.corner_keys(self._painted_cells(table)))
        where = np.zeros(len(keys), bool)
        points = np.where(nearest.of_part[:, None], nearest.points, lattice.nodes)
        for number, group, marked in self._groups(table, are_nodes=True):
            near, closed = np.isin(keys - keys % COPIES, marked), examine(group).closed
            own = lattice.body == number
            rows = np.flatnonzero(nearest.of_part & own & (near | closed))
            where |= near & ~nearest.of_part
            where[rows] |= _are_on(group, points[rows])
            if closed:
                where[own] |= is_inside(group, points[own])
        return where

    def _groups(self, table: OfBody, are_nodes: bool) -> Iterator[tuple[int, Surface, Indices]]:
        """Yield body number, triangles and keys (k,) of a region's groups (collective).

        The keys are of the cells that the triangles cut, or of the nodes nearest to them.
        """
        group = table.table.region.group
        assert group is not None
        for number, surface in groups_named(
            self.bodies, table.key + ".region", group, table.body
        ).items():
            grid = self.cages.grids.grids[number]
            # a node is nearest to the points of the cell centred at the node
            corners = grid.to_cells(surface.points)[surface.triangles] + are_nodes / 2
            touched, _ = touched_cells(corners, np.zeros(3, np.int64), grid.shape + 1)
            marked = unpacked(np.unique(touched)) + self.cages.grids.first(number)
            yield number, surface, encode_morton(marked)

    def _painted_cells(self, table: OfBody) -> Indices:
        """Return the keys (k,) of cells with painted points of a body's surface (collective)."""
        # a table without a body belongs to a scene with a single body
        key, number = table.key, table.body or 0
        surface = self.bodies[number].surface

        def cells() -> Indices:
            # only rank 0 calls this function, and it has the surface
            assert surface is not None
            points = surface.points
            numbers = np.array(self._numbers(key, table.table.region.painted))
            if numbers.max() >= len(points):
                raise InputError(
                    f"{key}.region.painted: there is no point {numbers.max()}: "
                    f"the surface has {len(points)}"
                )
            return cells_at(self.cages, number, points[numbers])[0]

        keys: Indices = self.comm.bcast(on_root(self.comm, cells))
        return keys

    def _numbers(self, key: str, painted: str | tuple[int, ...]) -> list[int]:
        if not isinstance(painted, str):
            return list(painted)
        path = self.folder / painted
        numbers: list[int] = []
        with suppress(OSError, ValueError):
            if path.is_file():
                numbers = [int(word) for word in path.read_text().split()]
        if not numbers or not 0 <= min(numbers) <= max(numbers) < 2**63:
            raise InputError(
                f"{key}.region.painted: {path} must be a file of point numbers, from 0"
            )
        return numbers


def _are_on(surface: Surface, points: Positions) -> Mask:
    """Return which points (n, 3) [m] lie on a surface."""
    import igl

    squares = igl.point_mesh_squared_distance(points, surface.points, surface.triangles)[0]
    low, high = bounds_of(surface)
    on: Mask = squares <= (SINGLE * (high - low).max()) ** 2
    return on


def groups_named(
    bodies: Sequence[BodySurface], key: str, name: str, number: int | None = None
) -> dict[int, Surface]:
    """Return the surfaces of the group ``name`` by body number (collective).

    key    : key of the scene's table, for messages
    number : number of the body to search; None for all bodies

    Raises InputError on all ranks if no mesh has the group.
    """

    def groups_by_body() -> dict[int, Surface]:
        asked = {
            n: body.surface.groups
            for n, body in enumerate(bodies)
            if body.surface and number in (None, n)
        }
        named = {n: groups[name] for n, groups in asked.items() if name in groups}
        if not named:
            names = list(dict.fromkeys(chain.from_iterable(asked.values())))
            has = f"it has {listed(names)}" if names else "it names none"
            raise InputError(
                f"{key}.group: the mesh has no group {name!r}{did_you_mean(name, names)}: {has}"
            )
        return named

    groups: dict[int, Surface] = bodies[0].comm.bcast(on_root(bodies[0].comm, groups_by_body))
    return groups


def listed(names: Sequence[str]) -> str:
    """Return the first MOST_LISTED names as text, and the number of further names."""
    more = len(names) - MOST_LISTED
    return ", ".join(printable(name, 60) for name in names[:MOST_LISTED]) + (
        f" and {more} more" if more > 0 else ""
    )
