"""Fill the bodies' surfaces with uniform grid cells, the cages (paper section 4.1).

A cell is external, boundary or interior. Boundary and interior cells are valid: they form the
lattice. Rank 0 holds the surfaces. Each rank finds the valid cells in its slab of each grid. Then
the ranks exchange cells, so that each has a range of the Morton order.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Array, Indices, Rows
from msmpetsc.comm import Route, log, on_root
from msmpetsc.errors import InputError
from msmpetsc.geometry.cell_parts import CellParts, parts_of
from msmpetsc.geometry.copies import Copies, find_copies
from msmpetsc.geometry.fill_fractions import LEAK, Columns, sampled_inside
from msmpetsc.geometry.grid import CHUNK, CORNERS, BodyGrids, Grid, packed, unpacked
from msmpetsc.geometry.morton import COPIES, decode_morton, encode_morton
from msmpetsc.geometry.partition import SortedKeys, places_of, ranges
from msmpetsc.geometry.parts_of_points import PartsOfPoints
from msmpetsc.geometry.surface import Surface, SurfaceReport, is_inside
from msmpetsc.geometry.thickness import Thickness
from msmpetsc.geometry.valid_cells import cells_below, touched_cells

BOUNDARY, INTERIOR = 1, 2
# least fill of a corner [-]; gives a corner far from the inside some mass
LEAST_FILL = 1e-3
# fill from which a corner counts as full [-]; the difference from 1 is rounding
FULL = 1 - 1e-9
# relative error of a body's mass from which a warning is logged [-]; far above rounding
MASS_TOLERANCE = 0.02


@dataclass(frozen=True)
class BodySurface:
    """A body's surface on rank 0, and its measures on all ranks.

    surface   : None on other ranks
    bounds    : (2, 3) bounding box [m]
    thickness : thickness of a closed body; None if it was not measured
    """

    comm: MPI.Comm
    surface: Surface | None
    report: SurfaceReport
    bounds: Rows
    thickness: Thickness | None = None


@dataclass(frozen=True)
class Cages:
    """Valid cells of bodies, distributed over the ranks in Morton order.

    table       : keys of the cells (geometry.grid)
    kind        : (n_local,) uint8, BOUNDARY or INTERIOR
    fills       : (n_local, 2, 2, 2) fill of the cells' corners, from LEAST_FILL to 1 [-]
                  (geometry.fill_fractions)
    moments     : (n_local, 3) second moments of the material about the cells' middles [cells^5]
    is_weighted : whether boundary cells are weighted by their fill
    copies      : cells whose corners are not the ordinary nodes
    parts       : finder of the part of a cell that holds a point, for each body on rank 0; None
                  on other ranks, and for a body without parts
    """

    grids: BodyGrids
    table: SortedKeys
    kind: Array
    fills: Rows
    moments: Rows
    is_weighted: bool
    copies: Copies
    parts: tuple[PartsOfPoints | None, ...]

    @property
    def ijk(self) -> Indices:
        """Grid index (n_local, 3) of this rank's cells."""
        return decode_morton(self.table.keys)

    def materials_of(self, keys: Indices) -> tuple[Rows, Rows]:
        """Return the fills (c, 8) and second moments (c, 3) of cells of any rank (collective)."""
        fills = self.table.rows_of(keys, self.fills)[:, *CORNERS.T]
        return fills, self.table.rows_of(keys, self.moments)


@dataclass(frozen=True)
class SlabCells:
    """Valid cells in a rank's slab of a grid. The axes are cycled, so that the longest is first.

    boundary : (b, 3) cells that the surface touches
    interior : (n, 3) cells that the surface encloses
    columns  : fill of the boundary cells; None if the surface is open or wound inconsistently
    """

    boundary: Indices
    interior: Indices
    columns: Columns | None

    def count(self, comm: MPI.Comm) -> int:
        """Return the number of valid cells on all ranks (collective)."""
        return int(comm.allreduce(len(self.boundary) + len(self.interior)))


def fill(
    bodies: Sequence[BodySurface],
    cell_size: float,
    max_cells: int = 5_000_000,
    boundary: str = "fill",
) -> Cages:
    """Return the valid cells of side ``cell_size`` [m] of all bodies (collective).

    boundary : "fill" weights a boundary cell by its fill; "whole" counts it as full (the paper)

    Raises InputError if there would be more than ``max_cells`` cells.
    """
    comm = bodies[0].comm
    grids = BodyGrids.covering([body.bounds for body in bodies], cell_size)
    slabs = slabs_of_all(bodies, grids, max_cells)
    is_weighted = boundary == "fill"
    of_parts = _parts_of_all(bodies, grids, slabs) if is_weighted else [None] * len(bodies)
    cells = [
        _cells_of(*of_body, is_weighted) for of_body in zip(bodies, grids.grids, slabs, strict=True)
    ]
    _warn_of_masses(bodies, [fills for _, _, fills, _ in cells], cell_size, is_weighted)
    keys = encode_morton(
        np.concatenate([of_body[0] + grids.first(body) for body, of_body in enumerate(cells)])
    )
    _, *columns = (np.concatenate(rows) for rows in zip(*cells, strict=True))
    keys, columns = _with_copies(comm, grids, of_parts, keys, columns)
    table = SortedKeys(comm, keys)
    route = Route(comm, table.owner(keys))
    order = np.argsort(route.send(keys))
    kind, fills, moments = (route.send(column)[order] for column in columns)
    copies = find_copies(of_parts, grids, table)
    _log_copies(copies)
    points = tuple(parts.points if parts else None for parts in of_parts)
    return Cages(grids, table, kind, fills, moments, is_weighted, copies, points)


def _log_copies(copies: Copies) -> None:
    """Log the number of copies of cells and of nodes, if any."""
    if len(copies.keys):
        cells = int((copies.keys % COPIES > 0).sum())
        nodes = np.unique(copies.corners)
        log.info(
            "parts of the body that do not meet: %d copies of cells, %d of nodes",
            cells, int((nodes % COPIES > 0).sum()),
        )  # fmt: skip


def _parts_of_all(
    bodies: Sequence[BodySurface], grids: BodyGrids, slabs: Sequence[SlabCells]
) -> list[CellParts | None]:
    """Return the parts of each closed body on rank 0; None on other ranks (collective)."""

    def of_root() -> list[CellParts | None]:
        return [
            parts_of(body.surface, grid, _axes(body), body.report.volume)
            if body.surface and cells.columns
            else None
            for body, grid, cells in zip(bodies, grids.grids, slabs, strict=True)
        ]

    return on_root(bodies[0].comm, of_root) or [None] * len(bodies)


def _with_copies(
    comm: MPI.Comm,
    grids: BodyGrids,
    of_parts: Sequence[CellParts | None],
    keys: Indices,
    columns: list[Array],
) -> tuple[Indices, list[Array]]:
    """Return the keys and columns of the cells, with a copy for each part in a cell (collective).

    A copy has the share of its part in fills and second moments.

    keys    : (n,) keys of this rank's cells
    columns : kind (n,), fills (n, 2, 2, 2) and second moments (n, 3)
    """

    def of_root() -> list[Array]:
        rows = [
            (np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 2, 2, 2)), np.empty((0, 3)))
        ]
        for body, parts in enumerate(of_parts):
            if parts:
                several = np.flatnonzero(parts.count > 1)
                ijk = unpacked(parts.keys[several]) + grids.first(body)
                number = ranges(np.zeros_like(several), parts.count[several])
                of_cell = np.repeat(encode_morton(ijk), parts.count[several])
                rows.append((of_cell, number, parts.shares, parts.spread))
        return [np.concatenate(column) for column in zip(*rows, strict=True)]

    of_key, copy, shares, spread = comm.bcast(on_root(comm, of_root))
    order = np.argsort(keys)
    place = places_of(keys[order], of_key)
    own = place >= 0
    cell, copy = order[place[own]], copy[own]
    kind, fills, moments = columns
    of_copies = _clipped(fills[cell] * shares[own], moments[cell] * spread[own])
    kept = np.ones(len(keys), bool)
    kept[cell] = False
    keys = np.concatenate([keys[kept], keys[cell] + copy])
    rows = zip((kind, fills, moments), (kind[cell], *of_copies), strict=True)
    return keys, [np.concatenate([whole[kept], copies]) for whole, copies in rows]


def _cells_of(
    body: BodySurface, grid: Grid, cells: SlabCells, is_weighted: bool
) -> tuple[Indices, Array, Rows, Rows]:
    """Return grid index (n, 3), kind, fills and second moments of a rank's cells (collective)."""
    axes, count = np.argsort(_axes(body)), len(cells.boundary)
    ijk = np.concatenate([cells.boundary, cells.interior])[:, axes]
    kind = np.repeat(np.array([BOUNDARY, INTERIOR], np.uint8), [count, len(ijk) - count])
    fills, moments = np.ones((len(ijk), 2, 2, 2)), np.full((len(ijk), 3), 1 / 12)
    if is_weighted and cells.columns:
        cut = cells.columns.corners.transpose(0, *(1 + axes)), cells.columns.moments[:, axes]
        fills[:count], moments[:count] = _clipped(*cut)
    elif is_weighted:
        cut = sampled_inside(body.comm.bcast(body.surface), grid, ijk[:count])
        fills[:count], moments[:count] = _clipped(*cut)
    return ijk, kind, fills, moments


def _clipped(fills: Rows, moments: Rows) -> tuple[Rows, Rows]:
    """Return fills clipped to LEAST_FILL and 1, and second moments with the mass thus added."""
    clipped = np.clip(np.where(fills > FULL, 1.0, fills), LEAST_FILL, 1.0)
    return clipped, moments + (clipped - fills).mean(axis=(1, 2, 3))[:, None] / 4


def _warn_of_masses(
    bodies: Sequence[BodySurface], fills: Sequence[Rows], cell_size: float, is_weighted: bool
) -> None:
    """Warn of the body whose cells and mesh differ most in volume (collective).

    The volume of a mesh is a sum of signed parts.

    fills : for each body, the fills of this rank's cells
    """
    filled = bodies[0].comm.allreduce(np.array([rows.sum() / 8 for rows in fills])) * cell_size**3
    enclosed = np.array([abs(body.report.volume) for body in bodies])
    # the volume of an open mesh has no meaning
    closed = np.array([body.report.closed for body in bodies])
    excess = np.divide(filled, enclosed, out=np.ones(len(bodies)), where=closed) - 1
    worst = int(np.argmax(abs(excess)))
    if abs(excess[worst]) <= MASS_TOLERANCE:
        return
    if not is_weighted:
        remedy = 'cages.boundary = "whole" counts cut cells whole'
    elif bodies[worst].report.inconsistent_edges:
        remedy = 'triangles are wound against each other, which prepare = ["orient"] mends'
    elif excess[worst] > 0:
        remedy = 'it is far thinner than a cell, or parts are wound inwards: prepare = ["orient"]'
    else:
        remedy = (
            'parts overlap or lie in each other; prepare = ["union"] joins them, '
            '["orient"] makes cavities of inner parts'
        )
    log.warning(
        "the mesh%s encloses %.4g m^3, its cells hold %.4g m^3 and weigh %.3g times as much: %s",
        f" of body.{worst}" if len(bodies) > 1 else "",
        enclosed[worst], filled[worst], 1 + excess[worst], remedy,
    )  # fmt: skip


def slabs_of_all(
    bodies: Sequence[BodySurface], grids: BodyGrids, max_cells: int
) -> list[SlabCells]:
    """Return the valid cells of each body in this rank's slab (collective)."""
    slabs: list[SlabCells] = []
    comm = bodies[0].comm
    total = 0
    for body, grid in zip(bodies, grids.grids, strict=True):
        # lower bounds of the body's cells by its volume and its area
        by_volume = abs(body.report.volume) / grid.cell_size**3 / 2
        by_area = body.report.area / grid.cell_size**2 / 8
        _refuse_above(max_cells, total + max(by_volume, by_area), grid)
        slabs.append(_slab_cells(body, grid))
        total += slabs[-1].count(comm)
        _refuse_above(max_cells, total, grid)
    return slabs


def _slab_cells(body: BodySurface, grid: Grid) -> SlabCells:
    """Return the valid cells of a body in this rank's slab (collective)."""
    axes, rank = _axes(body), body.comm.rank
    shape = grid.shape[axes]
    edges = shape[0] * np.arange(body.comm.size + 1) // body.comm.size
    limits = np.array([edges[rank], 0, 0]), np.array([edges[rank + 1], *shape[1:]])
    corners = _slab_triangles(body, grid, axes, edges)
    of_pair, number = touched_cells(corners, *limits)
    keys, place = np.unique(of_pair, return_inverse=True)
    touched = unpacked(keys)
    if body.report.closed:
        outwards = corners if body.report.volume > 0 else corners[:, ::-1]
        columns = Columns.crossed(outwards, number, place, keys)
        if body.comm.allreduce(columns.leak, MPI.MAX) < LEAK:
            # winding numbers are 1 inside and 0 outside
            is_inside_body = columns.below[:, 0, 0] > 0.5
            return SlabCells(touched, cells_below(touched, is_inside_body), columns)
    return SlabCells(touched, _interior_by_winding(body, grid, axes, edges, touched), None)


def _axes(body: BodySurface) -> Indices:
    """Return the axes (3,) of the grid, cycled so that the body's longest side is first."""
    return np.roll([0, 1, 2], -int(np.argmax(body.bounds[1] - body.bounds[0])))


def _refuse_above(max_cells: int, cells: float, grid: Grid) -> None:
    """Raise InputError if a grid gives more than ``max_cells`` cells."""
    if cells > max_cells:
        raise InputError(
            f"cages: a cell size of {grid.cell_size:.3g} m gives {cells:.3g} cells or more, "
            f"above cages.max_cells = {max_cells}"
        )


def _slab_triangles(body: BodySurface, grid: Grid, axes: Indices, edges: Indices) -> Rows:
    """Return the triangles (f, 3, 3), in cell units, that reach this rank's slab (collective)."""
    corners = np.empty((0, 3, 3))
    if body.surface is not None:
        corners = grid.to_cells(body.surface.points)[:, axes][body.surface.triangles]
    planes = np.floor(corners[:, :, 0]).astype(np.int64)
    extents = [planes.min(axis=1), planes.max(axis=1)]
    first, last = np.searchsorted(edges[1:], extents, side="right")
    copies = last - first + 1
    return Route(body.comm, ranges(first, copies)).send(np.repeat(corners, copies, axis=0))


def _interior_by_winding(
    body: BodySurface, grid: Grid, axes: Indices, edges: Indices, boundary: Indices
) -> Indices:
    """Return the interior cells (n, 3) of a slab, by the winding numbers of their centres.

    The time grows with the bounding box; the memory does not. Every rank gets the whole surface
    (collective). Source: Jacobson et al. 2013.
    """
    surface = body.comm.bcast(body.surface)
    shape = grid.shape[axes]
    marked = packed(boundary)
    first, last = edges[body.comm.rank : body.comm.rank + 2] * shape[1] * shape[2]
    interior = [np.empty((0, 3), np.int64)]
    for start in range(first, last, CHUNK):
        cells = np.stack(
            np.unravel_index(np.arange(start, min(start + CHUNK, last)), shape), axis=1
        )
        cells = cells[~np.isin(packed(cells), marked)]
        centres = np.empty(cells.shape)
        centres[:, axes] = cells + 0.5
        interior.append(cells[is_inside(surface, grid.node_positions(centres))])
    return np.concatenate(interior)
