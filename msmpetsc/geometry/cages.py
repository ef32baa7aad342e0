"""Surfaces filled with uniform grid cells, the cages (paper section 4.1).

Rank 0 holds the surfaces; each rank finds the cells of one slab of each grid, then the cells are
spread over the ranks in Morton order. The three kinds of cell are external (not kept), boundary
and interior; the last two are the valid ones.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Array, Indices, Rows
from msmpetsc.comm import Route, SortedKeys, log, together
from msmpetsc.errors import InputError
from msmpetsc.geometry.fill_fractions import LEAK, OUTSIDE, Columns, sampled_inside
from msmpetsc.geometry.grid import (
    CHUNK,
    BodyGrids,
    Grid,
    decode_morton,
    encode_morton,
    packed,
    unpacked,
)
from msmpetsc.geometry.surface import Surface, SurfaceReport, is_inside
from msmpetsc.geometry.valid_cells import (
    Slab,
    cells_of_gaps,
    enclosed_gaps,
    slab_edges,
    touched_cells,
)

BOUNDARY, INTERIOR = 1, 2
LEAST_SHARE = 1e-3  # of a corner that the inside is far from
WHOLE = 1 - 1e-9  # a share above this is rounding away from 1
LEAST_OF_A_CELL = 1000  # [byte] of the lattice: a run takes four times that
# share of a wanted number of cells, or of a volume, that need not be met
TOLERANCE = 0.01
# cells across the mean thickness of a thin body, as advised: a strip then bends by 3% too little, with one cell by
# 16%, with half a cell by 61%
ACROSS = 2
SEARCH_LIMIT = 30  # sizes tried; a real model needs three to six


@dataclass(frozen=True)
class BodySurface:
    """What all ranks know of a surface, and on rank 0 the surface itself.

    bounds : (2, 3) bounding box [m]
    """

    comm: MPI.Comm
    surface: Surface | None
    report: SurfaceReport
    bounds: Rows


@dataclass(frozen=True)
class Cages:
    """Valid cells of bodies, each rank's share in Morton order.

    table : keys of the cells (geometry.grid)
    kind  : (n_local,) uint8, BOUNDARY or INTERIOR
    share : (n_local, 2, 2, 2) of the cells' corners, LEAST_SHARE to 1 (geometry.fill_fractions) [-]; None where all
            are whole
    squares : (n_local, 3) of what is inside them, from their middles (geometry.fill_fractions) [cells^5]; None as share
    fills : of each body, whether its boundary cells count by their fill
    """

    grids: BodyGrids
    table: SortedKeys
    kind: Array
    share: Rows | None = None
    squares: Rows | None = None
    fills: tuple[bool, ...] = (False,)

    @property
    def ijk(self) -> Indices:
        """Grid index (n_local, 3) of this rank's cells."""
        return decode_morton(self.table.keys)

    def of_cells(self, ijk: Indices, rows: Rows | None) -> Rows | None:
        """Return the rows, those of ``share`` or ``squares``, of valid cells (c, 3) of any rank (collective)."""
        return None if rows is None else self.table.rows_of(encode_morton(ijk), rows)


@dataclass(frozen=True)
class SlabCells:
    """Valid cells in a rank's slab of the grid, whose axes are cycled so that the longest is first.

    boundary : (b, 3) cells that the surface touches
    gaps     : (g, 4) interior cells (geometry.valid_cells)
    columns  : what the triangles cut out of cells; None where that was not asked for or the surface does not tell
    """

    boundary: Indices
    gaps: Indices
    columns: Columns | None

    @property
    def interior(self) -> int:
        """Number of interior cells of this rank."""
        return int((self.gaps[:, 3] - self.gaps[:, 2] + 1).sum())

    def count(self, comm: MPI.Comm) -> int:
        """Return the number of valid cells on all ranks (collective)."""
        return int(comm.allreduce(len(self.boundary) + self.interior))


def fill(
    bodies: Sequence[BodySurface],
    cell_size: float,
    max_cells: int = 5_000_000,
    boundary: str = "fill",
) -> Cages:
    """Return the valid cells of side ``cell_size`` [m] of all bodies (collective).

    boundary : "fill": a boundary cell counts for the share of it that is inside; "whole", as in the paper
    raises   : InputError if there would be more than ``max_cells``
    """
    comm, grids = bodies[0].comm, BodyGrids.covering([body.bounds for body in bodies], cell_size)
    found = slabs_of_all(bodies, grids, max_cells, boundary)
    refuse_beyond_memory(comm, sum(cells.count(comm) for cells in found))
    parts = [_cells_of(*part, boundary) for part in zip(bodies, grids.grids, found, strict=True)]
    keys = encode_morton(
        np.concatenate([ijk + grids.first(body) for body, (ijk, _, _) in enumerate(parts)])
    )
    table = SortedKeys(comm, keys)
    route = Route(comm, table.owner(keys))
    order = np.argsort(route.send(keys))
    kind = np.concatenate([kind for _, kind, _ in parts])
    fills = tuple(inside is not None for _, _, inside in parts)
    share = squares = None
    if any(fills):
        of_bodies = [_whole(len(kind)) if inside is None else inside for _, kind, inside in parts]
        share, squares = (
            route.send(np.concatenate(rows))[order] for rows in zip(*of_bodies, strict=True)
        )
    return Cages(grids, table, route.send(kind)[order], share, squares, fills)


Inside = tuple[Rows, Rows]  # shares (n, 2, 2, 2) of cells' corners, and their squares (n, 3)


def _whole(count: int) -> Inside:
    return np.ones((count, 2, 2, 2)), np.full((count, 3), 1 / 12)


def _cells_of(
    body: BodySurface, grid: Grid, cells: SlabCells, boundary: str
) -> tuple[Indices, Array, Inside | None]:
    """Return grid index (n, 3), kind (n,), shares and squares of a rank's cells (collective)."""
    interior = cells_of_gaps(cells.gaps)
    ijk = np.concatenate([cells.boundary, interior])[:, np.argsort(_axes(body))]
    kind = np.repeat(np.array([BOUNDARY, INTERIOR], np.uint8), [len(cells.boundary), len(interior)])
    cut = _inside(body, grid, cells) if boundary == "fill" else None
    if cut is None:
        return ijk, kind, None
    share, squares = (np.concatenate(rows) for rows in zip(cut, _whole(len(interior)), strict=True))
    return ijk, kind, (share, squares)


def _inside(body: BodySurface, grid: Grid, cells: SlabCells) -> Inside | None:
    """Return shares and squares of boundary cells; None, with a warning, where none are defined.

    A share that is raised to the least, or lowered to 1, is mass put into or taken out of that very corner, which then
    counts in the squares, too.
    """
    axes = np.argsort(_axes(body))
    if cells.columns is not None:
        share, squares = cells.columns.inside(cells.boundary)
        held = np.clip(share, 0, 1).mean(axis=(1, 2, 3)).sum() + cells.interior
        _warn_of_parts(abs(body.report.volume), body.comm.allreduce(held) * grid.cell_size**3)
        share, squares = share.transpose(0, *(1 + axes)), squares[:, axes]
    elif body.report.closed:
        log.warning(
            'triangles are wound against each other, so boundary cells count whole: prepare = ["orient"]'
        )
        return None
    else:
        share, squares = sampled_inside(
            body.comm.bcast(body.surface), grid, cells.boundary[:, axes]
        )
    counted = np.clip(np.where(share > WHOLE, 1.0, share), LEAST_SHARE, 1.0)
    return counted, squares + (counted - share).mean(axis=(1, 2, 3))[:, None] / 4


def _warn_of_parts(enclosed: float, held: float) -> None:
    """Warn if cells hold another volume [m^3] than the mesh, in which each part counts with its sign."""
    if abs(held - enclosed) > TOLERANCE * enclosed:
        remedy = (
            'some parts are wound inwards, which prepare = ["orient"] mends'
            if held > enclosed
            else 'parts overlap or lie in each other; prepare = ["union"] joins them, ["orient"] makes cavities of '
            "inner parts"
        )
        log.warning(
            "the mesh encloses %.4g m^3, its cells hold %.4g m^3: %s", enclosed, held, remedy
        )


def slabs_of_all(
    bodies: Sequence[BodySurface], grids: BodyGrids, max_cells: int, boundary: str
) -> list[SlabCells]:
    """Return the valid cells of each body in this rank's slab (collective)."""
    found: list[SlabCells] = []
    comm, before = bodies[0].comm, 0
    for body, grid in zip(bodies, grids.grids, strict=True):
        of_volume = abs(body.report.volume) / grid.cell_size**3 / 2
        least = before + max(of_volume, body.report.area / grid.cell_size**2 / 8)
        _refuse_above(max_cells, least, grid)
        refuse_beyond_memory(comm, least)
        found.append(_slab_cells(body, grid, boundary))
        before += found[-1].count(comm)
        _refuse_above(max_cells, before, grid)
    return found


def _slab_cells(body: BodySurface, grid: Grid, boundary: str) -> SlabCells:
    """Return the valid cells of a body in this rank's slab (collective)."""
    axes = _axes(body)
    edges = slab_edges(body.comm.size, grid.shape[axes[0]])
    slab = Slab(*edges[body.comm.rank : body.comm.rank + 2])
    corners = _slab_triangles(body, grid, axes, edges)
    touched = marked_cells(corners, grid.shape[axes], slab)
    if not body.report.closed:
        return SlabCells(touched, _gaps_by_winding(body, grid, axes, slab, touched), None)
    gaps = enclosed_gaps(body.comm, touched, slab)
    columns = _columns(body, corners, grid.shape[axes], slab) if boundary == "fill" else None
    if columns is not None:  # a cave that a surface of its own bounds is enclosed, but not inside
        gaps = gaps[columns.inside(gaps[:, [0, 1, 3]])[0][:, 0, 0, 0] > OUTSIDE]
    return SlabCells(touched, gaps, columns)


def _columns(body: BodySurface, corners: Rows, shape: Indices, slab: Slab) -> Columns | None:
    """Return the cells that triangles cut; None if those are wound inconsistently (collective)."""
    outwards = corners if body.report.volume > 0 else corners[:, ::-1]
    columns = Columns.crossed(outwards, *_limits(shape, slab))
    return columns if body.comm.allreduce(columns.leak, MPI.MAX) < LEAK else None


def _limits(shape: Indices, slab: Slab) -> tuple[Indices, Indices]:
    """Return the first cell of a slab, and the one after its last, along each axis."""
    return np.array([slab.first, 0, 0]), np.array([slab.last, *shape[1:]])


def refuse_beyond_memory(comm: MPI.Comm, cells: float) -> None:
    """Raise InputError for a lattice whose parts cannot fit into memory (collective)."""
    memory, needed = (
        os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"),
        cells * LEAST_OF_A_CELL / comm.size,
    )
    with together(comm):
        if needed > memory:
            has = f"this machine has {memory / 1e9:.3g} GB"
            raise InputError(
                f"cages: {cells:.3g} cells need {needed / 1e9:.3g} GB a rank or more, and {has}"
            )


def _axes(body: BodySurface) -> Indices:
    return np.roll([0, 1, 2], -int(np.argmax(body.bounds[1] - body.bounds[0])))


def _refuse_above(max_cells: int, cells: float, grid: Grid) -> None:
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
    reached = [planes.min(axis=1), planes.max(axis=1)]
    first, last = np.searchsorted(edges[1:], reached, side="right")
    copies = last - first + 1
    rank = (
        np.repeat(first, copies)
        + np.arange(copies.sum())
        - np.repeat(np.cumsum(copies) - copies, copies)
    )
    return Route(body.comm, rank).send(np.repeat(corners, copies, axis=0))


def marked_cells(corners: Rows, shape: Indices, slab: Slab) -> Indices:
    """Return the distinct cells (b, 3) of the slab that triangles touch, in lexicographic order."""
    keys = [np.empty(0, np.int64)]
    for start in range(0, len(corners), CHUNK):
        cells = touched_cells(corners[start : start + CHUNK], *_limits(shape, slab))
        keys.append(np.unique(packed(cells)))
    return unpacked(np.unique(np.concatenate(keys)))


def _gaps_by_winding(
    body: BodySurface, grid: Grid, axes: Indices, slab: Slab, boundary: Indices
) -> Indices:
    """Return the interior cells of an open surface, by the winding numbers of their centres.

    (Jacobson et al. 2013.) Time follows the bounding box here, memory does not.
    An open surface has no slabs of its own meaning: every rank needs all of it.
    """
    surface = body.comm.bcast(body.surface)
    shape = grid.shape[axes]
    marked = packed(boundary)
    first, last = slab.first * shape[1] * shape[2], slab.last * shape[1] * shape[2]
    gaps = [np.empty((0, 4), np.int64)]
    for start in range(first, last, CHUNK):
        cells = np.stack(
            np.unravel_index(np.arange(start, min(start + CHUNK, last)), shape), axis=1
        )
        cells = cells[~np.isin(packed(cells), marked)]
        centres = np.empty(cells.shape)
        centres[:, axes] = cells + 0.5
        inside = cells[is_inside(surface, grid.node_positions(centres))]
        gaps.append(inside[:, [0, 1, 2, 2]])  # a gap of one cell each
    return np.concatenate(gaps)


def choose_cell_size(
    bodies: Sequence[BodySurface], count: int, max_cells: int = 5_000_000, boundary: str = "fill"
) -> float:
    """Return the cell size [m] that gives ``count`` cells within 1% (collective).

    The number of cells falls about as a power of the size, so this is a secant search in logarithms,
    kept inside a bracket: the number is a step function and not quite monotone. Where it has no such
    size the nearest is taken, with a warning.

    raises : InputError if ``count`` is more than ``max_cells``, or than memory can hold
    """
    if count > max_cells:
        raise InputError(f"cages.count: {count} is more than cages.max_cells = {max_cells}")
    comm, bounds = bodies[0].comm, [body.bounds for body in bodies]
    refuse_beyond_memory(comm, count)
    excess = {}  # log(size) -> log(cells / count)
    guess = np.log(estimated_size(bodies, count))
    for _ in range(SEARCH_LIMIT):
        grids = BodyGrids.covering(bounds, np.exp(guess))
        found = slabs_of_all(bodies, grids, 20 * max_cells, boundary)
        excess[guess] = np.log(sum(cells.count(comm) for cells in found) / count)
        nearest = min(excess, key=lambda size: abs(excess[size]))
        if abs(np.expm1(excess[nearest])) <= TOLERANCE:
            return float(np.exp(nearest))
        guess = _next_guess(excess, nearest)
    taken = round(count * np.exp(excess[nearest]))
    log.warning(
        "cages.count: no cell size was found that gives %d cells within 1%%; taking %d",
        count,
        taken,
    )
    return float(np.exp(nearest))


def estimated_cells(bodies: Sequence[BodySurface], cell_size: float) -> float:
    """Return about how many cells of side h [m] fill bodies: V / h^3 + 3/4 A / h^2, as boundary cells stick out."""
    return sum(
        abs(body.report.volume) / cell_size**3 + 0.75 * body.report.area / cell_size**2
        for body in bodies
    )


def estimated_size(bodies: Sequence[BodySurface], count: float) -> float:
    """Return about the cell size [m] that gives ``count`` cells."""
    area, volume = (
        sum(body.report.area for body in bodies),
        sum(abs(body.report.volume) for body in bodies),
    )
    roots = np.roots([count, 0, -0.75 * area, -volume])
    return float(roots.real.max())


def warn_of_thin_bodies(bodies: Sequence[BodySurface], cell_size: float) -> None:
    """Warn of bodies whose mean thickness 2 V / A is less than a cell [m]: they are too stiff in bending."""
    for number, body in enumerate(bodies):
        thickness = 2 * abs(body.report.volume) / body.report.area
        if body.report.closed and thickness < cell_size:
            enough = thickness / ACROSS
            log.warning(
                "%s is %.3g m thick on average (2 V / A), %.2g of a cell, and so too stiff in bending: "
                "cages.count = %d or cages.cell_size = %.2g puts %d cells there",
                f"body.{number}" if len(bodies) > 1 else "the body", thickness, thickness / cell_size,
                float(f"{estimated_cells(bodies, enough):.2g}"), enough, ACROSS,
            )  # fmt: skip


def _next_guess(excess: dict[float, float], nearest: float) -> float:
    """Return the zero of the secant through the two best tries, else the middle of the bracket."""
    slope = -2.5  # between that of a shell and that of a solid
    if len(excess) > 1:
        second = min(
            (size for size in excess if size != nearest), key=lambda size: abs(excess[size])
        )
        secant = (excess[nearest] - excess[second]) / (nearest - second)
        slope = secant if -5 < secant < -1 else slope
    guess = nearest - excess[nearest] / slope
    low = max((size for size in excess if excess[size] > 0), default=-np.inf)
    high = min((size for size in excess if excess[size] < 0), default=np.inf)
    if low < guess < high and guess not in excess:
        return guess
    return (low + high) / 2 if np.isfinite(low + high) else guess
