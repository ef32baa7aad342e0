"""Copies of cells that contain several parts of the body (Molino, Bao and Fedkiw 2004).

A cell has a copy for each part of the body in it (geometry.cell_parts). Two copies of cells at a
grid node share a copy of the node if their parts meet in faces at the node. The parts may also meet
through further cells at the node. So the two sides of a narrow slit move apart.

Copy 0 of a cell, with copy 0 of each corner, is the ordinary cell. ``Copies`` lists the rest.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.ndimage import label
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from msmpetsc.backend.arrays import Array, Indices, Mask
from msmpetsc.geometry.cell_parts import CellParts
from msmpetsc.geometry.grid import CORNERS, BodyGrids, packed, unpacked
from msmpetsc.geometry.morton import COPIES, decode_morton, encode_morton
from msmpetsc.geometry.partition import SortedKeys, places_of

# offsets of the 8 cells around a node from the node
OCTANTS = -CORNERS
# the 12 faces between them: axis, lower octant, upper octant
FACES = [
    (axis, low, high)
    for low in range(8)
    for high in range(8)
    for axis in range(3)
    if (OCTANTS[high] - OCTANTS[low] == np.eye(3, dtype=int)[axis]).all()
]


@dataclass(frozen=True)
class Copies:
    """Table, on all ranks, of the cells that are not ordinary: the cell or a corner is no copy 0.

    keys    : (e,) keys of the cells, ascending
    corners : (e, 8) keys of their corner nodes
    """

    keys: Indices
    corners: Indices

    def place(self, keys: Indices) -> Indices:
        """Return the row (...,) of each cell, -1 for an ordinary cell."""
        return places_of(self.keys, keys)

    def corner_keys(self, keys: Indices) -> Indices:
        """Return the keys (..., 8) of the corner nodes of cells (...,)."""
        corners = encode_morton(decode_morton(keys)[..., None, :] + CORNERS)
        row = self.place(keys)
        own = row >= 0
        corners[own] = self.corners[row[own]]
        return corners

    def parts_at_nodes(self, table: SortedKeys, keys: Indices) -> Indices:
        """Return the part (n, 8) of each cell around nodes (n,) that has the node (collective).

        The part is -1 if no part of the cell has the node as a corner.

        table : keys of all valid cells
        """
        places = decode_morton(keys)[:, None] + OCTANTS
        cells = encode_morton(np.maximum(places, 0))[..., None] + np.arange(COPIES)
        corners = self.corner_keys(cells)
        corner = np.take_along_axis(corners, np.arange(8)[None, :, None, None], axis=3)[..., 0]
        is_valid = (table.find(cells) >= 0) & (places >= 0).all(axis=2)[..., None]
        has = is_valid & (corner == keys[:, None, None])
        parts: Indices = np.where(has.any(axis=2), has.argmax(axis=2), -1)
        return parts

    def suspects(self, keys: Indices) -> Mask:
        """Return which nodes (n,) may have copies."""
        places = np.unique(self.corners - self.corners % COPIES)
        return np.isin(keys - keys % COPIES, places)


def find_copies(bodies: Sequence[CellParts | None], grids: BodyGrids, table: SortedKeys) -> Copies:
    """Return the cells of all bodies that are not ordinary (collective).

    bodies : parts of each body's cells on rank 0; None on other ranks, and for a body without parts
    table  : keys of all valid cells
    """
    of_bodies = [
        _copies_of_body(parts, grids.first(body), table) for body, parts in enumerate(bodies)
    ]
    keys, corners = (np.concatenate(rows) for rows in zip(*of_bodies, strict=True))
    ordinary = encode_morton(decode_morton(keys)[:, None] + CORNERS)
    own = np.flatnonzero((corners != ordinary).any(axis=1) | (keys % COPIES > 0))
    own = own[np.argsort(keys[own])]
    copies: Copies = table.comm.bcast(Copies(keys[own], corners[own]))
    return copies


def _copies_of_body(
    parts: CellParts | None, first: Indices, table: SortedKeys
) -> tuple[Indices, Indices]:
    """Return the keys (m,) and corner keys (m, 8) of cells near a body's parts (collective).

    first : (3,) grid index of the body's first cell
    """
    nodes = np.empty((0, 3), np.int64) if parts is None else _suspects(parts)
    places = (nodes[:, None] + OCTANTS + first).reshape(-1, 3)
    distinct, inverse = np.unique(encode_morton(places), return_inverse=True)
    cells, around = decode_morton(distinct), inverse.reshape(-1, 8)
    is_valid = (table.find(distinct) >= 0) & (distinct >= 0)
    if parts is None or not len(nodes):
        return np.empty(0, np.int64), np.empty((0, 8), np.int64)
    copy = _node_copies(parts, cells - first, is_valid, around)
    node, octant, part = np.nonzero(copy >= 0)
    distinct, place = np.unique(around[node, octant] * COPIES + part, return_inverse=True)
    ijk = cells[distinct // COPIES]
    corners = encode_morton(ijk[:, None] + CORNERS)
    corners[place, octant] += copy[node, octant, part]
    return encode_morton(ijk) + distinct % COPIES, corners


def _suspects(parts: CellParts) -> Indices:
    """Return the nodes (n, 3) that may have copies.

    They are corners of cells with several parts or separated from a neighbour, or nodes whose cut
    cells are not all connected by faces.
    """
    steps = packed(CORNERS)
    nodes = np.unique(parts.keys[:, None] + steps)
    masks = np.zeros(len(nodes), np.uint8)
    suspect = np.zeros(len(nodes), bool)
    special = (parts.count > 1) | parts.separated
    for octant, step in enumerate(steps):
        node = np.searchsorted(nodes, parts.keys + step)
        masks[node] |= 1 << octant
        suspect[node[special]] = True
    suspect |= _disconnected()[masks]
    return unpacked(nodes[suspect])


@cache
def _disconnected() -> Mask:
    """Return, for each mask (256,) of octants, whether its octants are not all joined by faces."""
    bits = np.zeros((256, 2, 2, 2), np.int64)
    bits[:, *CORNERS.T] = np.arange(256)[:, None] >> np.arange(8) & 1
    return np.array([label(octants)[1] > 1 for octants in bits])


def _node_copies(parts: CellParts, cells: Indices, is_valid: Mask, around: Indices) -> Indices:
    """Return which copy of a node each part of the cells around it has, (n, 8, COPIES).

    The copy is -1 if there is no such part. A node has at most COPIES copies; all further parts
    share the last.

    cells    : (c, 3) grid indices
    is_valid : (c,) bool
    around   : (n, 8) numbers of the cells around each node
    """
    number = places_of(parts.keys, packed(cells))
    count = np.where(number >= 0, parts.count[number], 1) * is_valid
    exists = np.arange(COPIES) < count[around][..., None]
    meets = np.zeros((len(parts.keys), 3), np.int64)
    links = parts.links
    np.bitwise_or.at(meets, (links.low, links.axis), 1 << (links.part @ [COPIES, 1]))
    item = np.arange(exists.size).reshape(exists.shape)
    ends = []
    for axis, low, high in FACES:
        below, above = number[around[:, low]], number[around[:, high]]
        # bit p COPIES + q is set if parts p and q meet; an uncut cell has whole faces
        pairs = np.where(below < 0, _spread(parts.faces[above, axis], 1), meets[below, axis])
        pairs = np.where(above < 0, _spread(parts.faces[below, 3 + axis], COPIES), pairs)
        pairs = np.where((below < 0) & (above < 0), 1, pairs)
        for p in range(COPIES):
            for q in range(COPIES):
                meet = (pairs >> (p * COPIES + q) & 1 > 0) & exists[:, low, p] & exists[:, high, q]
                ends.append(np.stack([item[meet, low, p], item[meet, high, q]]))
    joined = np.concatenate(ends, axis=1)
    graph = coo_array((np.ones(joined.shape[1], np.int8), joined), shape=(item.size,) * 2)
    component = connected_components(graph, directed=False)[1].reshape(exists.shape)
    node, octant, part = np.nonzero(exists)
    # components are numbered from 0 at each node
    distinct, place = np.unique(
        node * item.size + component[node, octant, part], return_inverse=True
    )
    of_node = distinct // item.size
    first = np.searchsorted(of_node, of_node)
    copy = np.full(exists.shape, -1)
    copy[node, octant, part] = np.minimum(np.arange(len(distinct)) - first, COPIES - 1)[place]
    return copy


def _spread(mask: Array, stride: int) -> Indices:
    """Return a bit mask (n,) with bit p moved to bit p times ``stride``."""
    bits = [(mask >> p & 1).astype(np.int64) << p * stride for p in range(COPIES)]
    spread: Indices = np.bitwise_or.reduce(bits)
    return spread
