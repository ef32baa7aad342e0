"""Find the connected parts of the body in each cell that its surface cuts.

A slit narrower than a cell leaves several parts of the body in a cell. They are found in 3 steps:

1. Triangles in a cell that mesh edges join within the cell form a piece of surface. The body along
   the inner side of a piece is connected. So a cell has at most as many parts as pieces. Triangles
   that end in a low face of the cell bound the body in the cell below: they are a separate piece.
2. In a cell of several pieces, LINES x LINES lines run along each axis, and their crossings form a
   grid of points. Neighbouring points, and points and pieces, are joined if the line between them
   is inside the body. Joined pieces bound the same part.
   If no line meets a piece, a ray runs inwards from it. The piece is joined with the first piece
   that the ray meets. If there is none, it is joined with a point seen from the ray's middle.
3. Parts of two cells meet in the common face if a piece crosses the face. They also meet if a line
   of step 2 crosses the face inside both parts. For two cells of a single part, the middle of an
   uncrossed face decides.

Steps 1 and 3 are exact. Step 2 may separate a part at a neck that is thinner than the distance of
the lines (geometry.lines_in_cells).

All lengths are in cells. Only rank 0, which holds the surface, calls these functions.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from msmpetsc.backend.arrays import Array, Indices, Mask, Rows
from msmpetsc.geometry.grid import Grid, packed, unpacked
from msmpetsc.geometry.lines_in_cells import LINES, split_cell
from msmpetsc.geometry.morton import COPIES
from msmpetsc.geometry.partition import places_of, ranges, rows_of
from msmpetsc.geometry.parts_of_points import PartsOfPoints
from msmpetsc.geometry.surface import Surface, first_of_equal, is_inside
from msmpetsc.geometry.valid_cells import touched_cells

# distance from a face of the point that stands for it, on its low side [cells]; above
# rounding, below the thickness of any wall
BESIDE = 1e-4


class Links(NamedTuple):
    """Parts of neighbouring cells that meet.

    low, high : (n,) numbers of the two cells, which share a face
    axis      : (n,) axis normal to the face
    part      : (n, 2) numbers of the parts in the two cells
    """

    low: Indices
    high: Indices
    axis: Indices
    part: Indices


@dataclass(frozen=True)
class CellParts:
    """Parts of the body in the cells that a closed surface cuts.

    keys      : (b,) packed grid indices of the cut cells, ascending
    count     : (b,) number of parts in each cell
    links     : parts of neighbouring cut cells that meet
    faces     : (b, 6) parts at the faces of each cell as bit masks, the low faces first; 1 in a
                cell of a single part
    separated : (b,) whether no parts meet in one of the faces shared with another cut cell
    shares    : (s, 2, 2, 2) share of each part in the fills of its cell's corners, for the parts of
                cells with several parts
    spread    : (s, 3) share of the same parts in their cells' second moments
    points    : finder of the part that holds a point
    """

    keys: Indices
    count: Indices
    links: Links
    faces: Array
    separated: Mask
    shares: Rows
    spread: Rows
    points: PartsOfPoints


def parts_of(surface: Surface, grid: Grid, axes: Indices, volume: float) -> CellParts:
    """Return the parts of the body in the cells that a closed surface cuts.

    axes   : (3,) cycled axes of the search for the cut cells (geometry.cages)
    volume : the surface's volume [m^3]; negative if its triangles are wound inwards
    """
    keys, codes, flush, ends, corners = _rows_in_cells(surface, grid, axes, volume)
    size = len(corners)
    cell, triangle = codes // size, codes % size
    piece, pieces = _pieces(cell, len(keys), ends[:, flush[ends[0]] == flush[ends[1]]])
    several = np.flatnonzero(pieces > 1)
    own, first_piece = rows_of(cell, several), np.cumsum(pieces) - pieces
    begin = np.searchsorted(cell[own], np.append(several, len(keys)))

    ijk = unpacked(keys[several])
    split = _split(corners, triangle[own], piece[own], flush[own], begin, ijk, pieces[several])
    part_of_piece = np.zeros(pieces.sum(), np.int64)
    part_of_piece[ranges(first_piece[several], pieces[several])] = split.part
    part = part_of_piece[first_piece[cell] + piece]
    count = np.ones(len(keys), np.int64)
    count[several] = split.parts
    sides = Sides.of_cells(count, split.faces)
    crossing = _crossing_rows(codes, keys, size, flush, ends)
    links, separated = _links(surface, grid, keys, cell, part, crossing, sides)
    kept = np.flatnonzero((count > 1) | separated)
    own = rows_of(cell, kept)
    # a triangle in the low face of a cell of a single part bounds the body below
    own = own[(part[own] >= 0) & ((count[cell[own]] > 1) | (flush[own] == 0))]
    points = PartsOfPoints(
        surface, keys[kept], np.searchsorted(kept, cell[own]), triangle[own], part[own]
    )
    return CellParts(keys, count, links, sides.masks, separated, split.shares, split.spread, points)


def _rows_in_cells(
    surface: Surface, grid: Grid, axes: Indices, volume: float
) -> tuple[Indices, Indices, Array, Indices, Rows]:
    """Return the rows, pairs of a cell and a triangle that touch, for arguments of ``parts_of``.

    The result is

    - the packed grid indices (b,) of the cells, ascending,
    - the codes (r,) of the rows, cell number times number of triangles plus triangle, ascending,
    - the bits (r,) of ``_flush``,
    - the pairs of rows (2, e) that mesh edges in a cell join,
    - the triangles (f, 3, 3), wound outwards.
    """
    at = grid.to_cells(surface.points)
    corners = at[surface.triangles] if volume > 0 else at[surface.triangles[:, ::-1]]
    limits = np.zeros(3, np.int64), grid.shape[axes]

    def touched(triangles: Rows) -> tuple[Indices, Indices]:
        return touched_cells(np.ascontiguousarray(triangles[..., axes]), *limits)

    of_row, triangle = touched(corners)
    cycled, cell = np.unique(of_row, return_inverse=True)
    back = packed(unpacked(cycled)[:, np.argsort(axes)])
    order = np.argsort(back)
    keys, cell = back[order], np.argsort(order)[cell]
    size = len(corners)
    codes = np.unique(cell * size + triangle)
    cell, triangle = codes // size, codes % size
    flush = _flush(corners, triangle, keys, cell)
    in_cell, one, other = _edges_in_cells(surface, at, touched)
    number = np.append(np.argsort(order), -1)[places_of(cycled, in_cell)]
    ends = np.stack([places_of(codes, number * size + at_edge) for at_edge in (one, other)])
    ends = ends[:, (number >= 0) & (ends >= 0).all(axis=0)]
    return keys, codes, flush, ends, corners


def _edges_in_cells(
    surface: Surface, at: Rows, touched: Callable[[Rows], tuple[Indices, Indices]]
) -> tuple[Indices, Indices, Indices]:
    """Return pairs (e,) of a cell and a mesh edge that touch: the cell, and the edge's triangles.

    The cells are packed in the axes of ``touched``; the two triangles are (e,) each.
    """
    merged = first_of_equal(surface.points)
    corner = merged[surface.triangles]
    start, end = corner.ravel(), np.roll(corner, -1, axis=1).ravel()
    low, high = np.minimum(start, end), np.maximum(start, end)
    edge = low * len(merged) + high
    order = np.argsort(edge, kind="stable")
    pair = np.flatnonzero(edge[order[1:]] == edge[order[:-1]])
    first, second = order[pair], order[pair + 1]
    ends = at[np.stack([low[first], high[first], high[first]], axis=1)]
    cells, number = touched(ends)
    return cells, first[number] // 3, second[number] // 3


def _flush(corners: Rows, triangle: Indices, keys: Indices, cell: Indices) -> Array:
    """Return the axes, as bits (r,), along which a row's triangle ends in its cell's low face.

    The body at such a triangle lies below the face. A triangle in the face with the body above has
    no bit.
    """
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    top = corners.max(axis=1)
    # a triangle in a face with the body above ends in no low face
    top[(corners.min(axis=1) == top) & (normal < 0)] = -1.0
    bits = np.zeros(len(triangle), np.uint8)
    for axis, index in enumerate(unpacked(keys).T):
        bits |= (top[triangle, axis] == index[cell]).astype(np.uint8) << axis
    return bits


def _pieces(cell: Indices, cells: int, joined: Indices) -> tuple[Indices, Indices]:
    """Return the piece (r,) of each row, and the number of pieces (cells,) of each cell.

    cell   : (r,) cell of each row
    joined : (2, e) joined rows
    """
    size = len(cell)
    graph = coo_array((np.ones(joined.shape[1], np.int8), tuple(joined)), shape=(size, size))
    label = connected_components(graph, directed=False)[1]
    # pieces are numbered from 0 in each cell
    distinct, piece = np.unique(cell * size + label, return_inverse=True)
    pieces = np.bincount(distinct // max(size, 1), minlength=cells)
    return piece - (np.cumsum(pieces) - pieces)[cell], pieces


def _crossing_rows(
    codes: Indices, keys: Indices, size: int, flush: Array, ends: Indices
) -> list[Indices]:
    """Return, for each axis, pairs of rows (2, n) whose surface crosses the face of two cells.

    The rows belong to the lower and the upper cell. Either they have the same triangle, or their
    triangles share a mesh edge in the face. In that case a triangle ends in the face, and its row
    in the upper cell is flush.
    """
    ijk, cell, triangle = unpacked(keys), codes // size, codes % size
    crossing = []
    for axis, step in enumerate(np.eye(3, dtype=np.int64)):
        beyond = places_of(keys, packed(ijk + step))
        other = np.where(beyond[cell] >= 0, places_of(codes, beyond[cell] * size + triangle), -1)
        low = np.flatnonzero(other >= 0)
        below = np.full(len(codes), -1)
        below[other[low]] = low
        at_edge = [
            np.stack([below[a], b])[:, (flush[a] == 1 << axis) & (flush[b] == 0) & (below[a] >= 0)]
            for a, b in (ends, ends[::-1])
        ]
        crossing.append(np.concatenate([np.stack([low, other[low]]), *at_edge], axis=1))
    return crossing


class Sides(NamedTuple):
    """Parts at the faces of cells, the low faces first.

    masks : (b, 6) parts at each face of each cell as bit masks
    row   : (b,) row of ``lines`` of each cell; -1 for a cell with a single part
    lines : (m, 6, LINES^2) part at each line of a face, -1 outside the body
    """

    masks: Array
    row: Indices
    lines: Array

    @classmethod
    def of_cells(cls, count: Indices, lines: Array) -> "Sides":
        """Return the sides of cells with ``count`` (b,) parts each."""
        masks, row = np.ones((len(count), 6), np.uint8), np.full(len(count), -1)
        bits = np.where(lines >= 0, 1 << np.maximum(lines, 0), 0)
        masks[count > 1] = np.bitwise_or.reduce(bits, axis=2)
        row[count > 1] = np.arange(len(lines))
        return cls(masks, row, lines)


def _links(
    surface: Surface,
    grid: Grid,
    keys: Indices,
    cell: Indices,
    part: Indices,
    crossing: list[Indices],
    sides: Sides,
) -> tuple[Links, Mask]:
    """Return the parts of neighbouring cut cells that meet, and the mask (b,) of ``separated``.

    cell     : (r,) cell of each row
    part     : (r,) part of each row, -1 if its piece bounds no part of the cell
    crossing : for each axis, the rows of ``_crossing_rows``
    """
    (masks, row, lines), ijk, steps = sides, unpacked(keys), np.eye(3, dtype=np.int64)
    beyond = np.stack([places_of(keys, packed(ijk + step)) for step in steps])
    # rows of pieces that bound parts
    bounding = [rows[:, (part[rows] >= 0).all(axis=0)] for rows in crossing]
    # the middle of an uncrossed face tells whether two cells of a single part meet
    is_single = row < 0
    asked = (beyond >= 0) & is_single & is_single[beyond]
    for axis, (below, _) in enumerate(bounding):
        asked[axis, cell[below]] = False
    axes, low = np.nonzero(asked)
    middles = ijk[low] + 0.5 + (0.5 - BESIDE) * steps[axes]
    asked[axes, low] = is_inside(surface, grid.node_positions(middles))
    links: list[Indices] = []
    separated = np.zeros(len(keys), bool)
    for axis, (below, above) in enumerate(bounding):
        meeting = [np.stack([cell[below], part[below], part[above]])]
        low = np.flatnonzero(beyond[axis] >= 0)
        high = beyond[axis, low]
        # in cells with several parts, lines tell which parts meet in the face
        both = ~is_single[low] & ~is_single[high]
        neither = is_single[low] & is_single[high]
        for p in range(COPIES):
            for q in range(COPIES):
                meet = (masks[low, 3 + axis] >> p & 1) & (masks[high, axis] >> q & 1) > 0
                meet[neither] &= asked[axis, low[neither]]
                on_low = lines[row[low[meet & both]], 3 + axis] == p
                on_high = lines[row[high[meet & both]], axis] == q
                meet[meet & both] = (on_low & on_high).any(axis=1)
                own = low[meet]
                meeting.append(np.stack([own, np.full_like(own, p), np.full_like(own, q)]))
        own, p, q = np.unique(np.concatenate(meeting, axis=1), axis=1)
        links.append(np.stack([own, beyond[axis, own], np.full_like(own, axis), p, q]))
        lonely = np.setdiff1d(low, own)
        separated[lonely] = separated[beyond[axis, lonely]] = True
    low, high, axes, p, q = np.concatenate(links, axis=1)
    return Links(low, high, axes, np.stack([p, q], axis=1)), separated


class Split(NamedTuple):
    """Parts of cells with several pieces.

    part   : (k,) part of each piece, cell after cell; -1 for a piece that bounds no part
    parts  : (c,) number of parts in each cell
    faces  : (m, 6, LINES^2) part at each line of each face of the m cells with several parts
    shares : (s, 2, 2, 2) share of each of their parts in the fills of the cell's corners
    spread : (s, 3) share of each of their parts in the cell's second moments
    """

    part: Indices
    parts: Indices
    faces: Array
    shares: Rows
    spread: Rows


def _split(
    corners: Rows,
    triangle: Indices,
    piece: Indices,
    flush: Array,
    begin: Indices,
    ijk: Indices,
    pieces: Indices,
) -> Split:
    """Return the parts of cells (c, 3) of several pieces.

    corners         : (f, 3, 3) triangles, wound outwards
    triangle, piece : (r,) triangles of the cells and their pieces, cell after cell
    flush           : (r,) bits of ``_flush``
    begin           : (c + 1,) first row of each cell
    pieces          : (c,) number of pieces of each cell
    """
    part, count = np.zeros(pieces.sum(), np.int64), np.ones(len(ijk), np.int64)
    faces, shares = [np.empty((0, 6, LINES**2), np.int8)], [np.empty((0, 11))]
    first = np.cumsum(pieces) - pieces
    for c in range(len(ijk)):
        rows, own = slice(begin[c], begin[c + 1]), slice(first[c], first[c] + pieces[c])
        at_faces, of_parts = np.full((6, LINES**2), -1, np.int8), np.zeros((COPIES, 11))
        count[c] = split_cell(
            corners[triangle[rows]] - ijk[c],
            piece[rows],
            flush[rows],
            part[own],
            at_faces,
            of_parts,
        )
        if count[c] > 1:
            faces.append(at_faces[None])
            total = of_parts.sum(axis=0)
            share = np.divide(of_parts, total, out=np.zeros_like(of_parts), where=total > 0)
            shares.append(share[: count[c]])
    of_all = np.concatenate(shares)
    fills, moments = of_all[:, :8].reshape(-1, 2, 2, 2), of_all[:, 8:]
    return Split(part, count, np.concatenate(faces), fills, moments)
