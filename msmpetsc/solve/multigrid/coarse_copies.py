"""Copies of coarse nodes near a slit, so that coarse grids do not join its sides.

The interpolation function of a coarse node spans the fine nodes around it. If a slit separates
these fine nodes into several connected parts, the coarse node has a copy for each part. Each fine
node then has the copies of its part as parents. Fine nodes are connected if they share a cell.
"""

from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from msmpetsc.backend.arrays import Indices, Mask
from msmpetsc.comm import SortedKeys, places_of
from msmpetsc.geometry.copies import Copies
from msmpetsc.geometry.embedding import CELLS_AROUND
from msmpetsc.geometry.grid import CORNERS
from msmpetsc.geometry.morton import COPIES, decode_morton, encode_morton

# place of a parent in a row of parents, from its index minus half the node's index
PLACE = np.argsort(CORNERS @ [4, 2, 1])
ON_AXES = np.array([4, 2, 1])


class ParentCopies(NamedTuple):
    """Numbers of the copies that are parents of the fine nodes of a level.

    keys   : (n,) keys of the nodes with a parent that is not copy 0, ascending
    copies : (n, 8) numbers, of the parents at half the node's index plus CORNERS
    """

    keys: Indices
    copies: Indices


class CoarseCopies:
    """Copies of the parents of all nodes, level by level, the finest first. Known on all ranks.

    levels  : parents of the nodes of each level
    corners : (m, 8) keys of the corners of the cells near copies, on the last level
    """

    def __init__(self, copies: Copies | None, table: SortedKeys, offsets: Indices):
        """Start with the nodes of a lattice (collective).

        table   : keys of its nodes
        offsets : (owned,) keys added to those of this rank's nodes, to separate bodies
        """
        self.levels: list[ParentCopies] = []
        self.corners = copies.around if copies else np.empty((0, 8), np.int64)
        if copies:
            self.corners = _with_ring(self.corners, table)
            of_nodes = table.rows_of(self.corners.ravel(), offsets).reshape(-1, 8)
            # pinned nodes have no offset: they follow their cell
            self.corners = self.corners + of_nodes.max(axis=1, keepdims=True)
            self._coarsen()

    def add(self, table: SortedKeys) -> None:
        """Add the next level, whose nodes have the keys of ``table`` (collective)."""
        if len(self.corners):
            self.corners = _with_ring(self.corners, table)
            self._coarsen()

    def _coarsen(self) -> None:
        parents, self.corners = _coarser(self.corners)
        self.levels.append(parents)

    def of(self, level: int, keys: Indices) -> Indices:
        """Return the numbers (n, 8) of the copies of the parents of nodes (n,) of a level."""
        numbers = np.zeros((len(keys), 8), np.int64)
        if level < len(self.levels):
            row = places_of(self.levels[level].keys, keys)
            numbers[row >= 0] = self.levels[level].copies[row[row >= 0]]
        return numbers


def _with_ring(corners: Indices, table: SortedKeys) -> Indices:
    """Return the corners (m, 8) of cells, and those of the ordinary cells around (collective).

    A cell counts as one of the lattice if the lattice has all its corners.
    """
    low = np.unique(encode_morton(decode_morton(corners[:, 0])))
    around = np.unique(encode_morton(decode_morton(low)[:, None] + CELLS_AROUND))
    around = np.setdiff1d(around[around >= 0], low)
    of_around = encode_morton(decode_morton(around)[:, None] + CORNERS)
    exists = (table.find(of_around) >= 0).all(axis=1)
    return np.concatenate([corners, of_around[exists]])


def in_cells(low: Indices, ijk: Indices, parents: Indices) -> Indices:
    """Return the copies (n, 8) of the corners of coarse cells, from those of fine nodes in them.

    low     : (n, 3) index of the coarse cells
    ijk     : (n, k, 3) index of fine nodes in each cell
    parents : (n, k, 8) copies of their parents
    """
    is_parent, place = _places(low, ijk)
    copies = np.where(is_parent, np.take_along_axis(parents, place, axis=2), 0)
    numbers: Indices = copies.max(axis=1)
    return numbers


def _places(low: Indices, ijk: Indices) -> tuple[Mask, Indices]:
    """Return which corners of coarse cells are parents of fine nodes, and their places.

    Both are (n, k, 8). A place is a column in a row of 8 parents, 0 where there is no parent.

    low : (n, 3) index of the coarse cells
    ijk : (n, k, 3) index of fine nodes in each cell
    """
    nodes = ijk[:, :, None]
    offset = low[:, None, None] + CORNERS - nodes // 2
    is_parent: Mask = ((offset >= 0) & (offset <= nodes % 2)).all(axis=3)
    return is_parent, PLACE[(offset * is_parent[..., None]) @ ON_AXES] * is_parent


def _coarser(corners: Indices) -> tuple[ParentCopies, Indices]:
    """Return the parents of the corner nodes of cells, and the corners of the coarse cells.

    corners : (m, 8) keys; the result is empty if no node has a copy
    """
    nodes, number = np.unique(corners, return_inverse=True)
    number = number.reshape(corners.shape)
    _, at, counts = np.unique(nodes // COPIES, return_inverse=True, return_counts=True)
    ijk, copied = decode_morton(nodes), counts[at] > 1
    if not copied.any():
        return ParentCopies(np.empty(0, np.int64), np.empty((0, 8), np.int64)), corners[:0]
    low = ijk[number[:, 0]] // 2
    is_parent, place = _places(low, ijk[number])
    # an item is a fine node with a parent; a cell connects its items of the same parent
    cell, corner, parent = np.nonzero(is_parent)
    item = 8 * number[cell, corner] + place[is_parent]
    hub = 8 * len(nodes) + 8 * cell + parent
    size = 8 * (len(nodes) + len(corners))
    graph = coo_array((np.ones(len(item), np.int8), (item, hub)), shape=(size, size))
    label = connected_components(graph, directed=False)[1]
    items = np.unique(item)
    copies = np.zeros(8 * len(nodes), np.int64)
    of_parent = encode_morton(ijk[items // 8] // 2 + CORNERS[items % 8])
    copies[items] = _numbers(of_parent, label[items], copied[items // 8])
    by_node = copies.reshape(-1, 8)
    own = by_node.any(axis=1)
    coarse = encode_morton(low[:, None] + CORNERS)
    np.maximum.at(coarse, (cell, parent), (coarse[cell, parent] // COPIES * COPIES) + copies[item])
    return ParentCopies(nodes[own], by_node[own]), np.unique(coarse, axis=0)


def _numbers(parent: Indices, part: Indices, copied: Indices) -> Indices:
    """Return the number (n,) of the copy of a parent for each item, from 0 at each parent.

    Only parts with a copied node have numbers of their own. The last number is shared.

    parent : (n,) parent of each item
    part   : (n,) connected part
    copied : (n,) whether the item's node has copies
    """
    distinct, place = np.unique(part, return_inverse=True)
    of_part = np.zeros(len(distinct), np.int64)
    of_part[place] = parent
    counts = np.zeros(len(distinct), bool)
    counts[place[copied]] = True
    order = np.lexsort([distinct, of_part])
    counted = np.cumsum(counts[order]) - counts[order]
    first = np.searchsorted(of_part[order], of_part[order])
    number = np.empty(len(distinct), np.int64)
    number[order] = np.minimum(counted - counted[first], COPIES - 1) * counts[order]
    return number[place]
