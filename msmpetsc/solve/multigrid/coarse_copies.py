"""Copies of coarse nodes, so that coarse grids do not join the sides of a gap.

The interpolation function of a coarse node spans the fine nodes around the node. If their cells
fall into several connected parts, the coarse node has a copy for each part. Each fine node then has
the copies of its part as parents. Fine nodes are connected if they share a cell.

The parts of a coarse node depend only on the cells around the node. So one rank receives all these
cells, and the result does not depend on the number of ranks.
"""

import numpy as np

from msmpetsc.backend.arrays import Array, Indices, Mask, to_host
from msmpetsc.backend.kernel import njit
from msmpetsc.backend.trees import root
from msmpetsc.comm import Route
from msmpetsc.geometry.grid import CORNERS
from msmpetsc.geometry.morton import COPIES, decode_morton, encode_morton
from msmpetsc.geometry.partition import SortedKeys, places_of
from msmpetsc.lattice.lattice import Lattice

# index in CORNERS of an offset, by the offset's number with place values ON_AXES
PLACE = np.argsort(CORNERS @ [4, 2, 1])
ON_AXES = np.array([4, 2, 1])
# place values that combine the copies of eight corners in a number, and the limit of
# this number
DIGITS = COPIES ** np.arange(8)
MOST_COPIES = COPIES**8
# number of fine nodes under a coarse node's function, with their copies
CHILDREN = 27 * COPIES


def _children() -> Array:
    """Return the children (8, 8, 8) of a coarse cell's corners among the corners of fine cells.

    The axes are the fine cell's place in the coarse cell, the coarse corner and the fine corner.
    A child is numbered 0 to 26 by its offset from the coarse corner; -1 is none.
    """
    offset = CORNERS[:, None, None] + CORNERS - 2 * CORNERS[:, None]
    number = np.where((np.abs(offset) <= 1).all(axis=3), (offset + 1) @ [9, 3, 1], -1)
    return number.astype(np.int16)


CHILD = _children()


class CoarseCopies:
    """Copies of the parents of this rank's nodes, level by level. All methods are collective.

    cells    : (m, 8) keys of the corners of this rank's cells on the last level
    of_nodes : (l, 8) copies of the parents of the lattice's local nodes, ghosts included; the
               parents are at half the node's index plus CORNERS; 0 for a pinned node
    """

    def __init__(self, lattice: Lattice, keys: Indices, offsets: Indices):
        """Start with the nodes and cells of a lattice.

        keys    : (l,) keys of the local nodes
        offsets : (l,) offsets to add to the keys, to separate bodies; 0 for a pinned node, which
                  follows its cell
        """
        corners = to_host(lattice.local_cells)[: lattice.cells_owned]
        self.cells = keys[corners] + offsets[corners].max(axis=1, keepdims=True)
        # A pinned node may hold several bodies, whose copies differ
        unknown = np.where(to_host(lattice.pinned), -1, lattice.global_numbers)
        own = self._coarsen(lattice.table, unknown[corners])
        self.of_nodes = lattice.table.with_ghosts(lattice.ghosts, own)

    def of(self, table: SortedKeys) -> Array:
        """Return the copies (n, 8) of the parents of this rank's nodes of the next level."""
        return self._coarsen(table, table.find(self.cells))

    def _coarsen(self, table: SortedKeys, index: Indices) -> Array:
        """Replace the cells by coarse cells. Return the copies (n, 8) of the nodes' parents.

        table : this level's nodes
        index : (m, 8) indices of the nodes at the cells' corners, -1 for a node without unknowns
        """
        ijk = decode_morton(self.cells)
        low = ijk[:, 0] // 2
        parents = encode_morton(low[:, None] + CORNERS)
        owners = SortedKeys(table.comm, parents.ravel())
        numbers = self._numbers(owners, parents, PLACE[(ijk[:, 0] - 2 * low) @ ON_AXES])
        self.cells = _distinct_cells(owners, parents[:, 0], numbers @ DIGITS)
        copied = np.flatnonzero(numbers.any(axis=1))
        is_parent, place = _places(low[copied], ijk[copied])
        cell, corner, parent = np.nonzero(is_parent)
        of_corners = np.zeros((*is_parent.shape[:2], 8), np.uint8)
        of_corners[cell, corner, place[is_parent]] = numbers[copied[cell], parent]
        nodes = index[copied]
        sent = (nodes >= 0) & of_corners.any(axis=2)
        route = Route(table.comm, table.owner_of_index(nodes[sent]))
        copies = np.zeros((len(table.keys), 8), np.uint8)
        np.maximum.at(copies, route.send(nodes[sent]) - table.first, route.send(of_corners[sent]))
        return copies

    def _numbers(self, owners: SortedKeys, parents: Indices, place: Indices) -> Indices:
        """Return the numbers (m, 8) of the copies of parents to which each cell belongs.

        Parts are numbered in the order of their first nodes. If there are more parts than copies,
        the remaining parts share the last number.

        place : (m,) place of each cell in its coarse cell
        """
        route = Route(owners.comm, owners.owner(parents.ravel()))
        around = CHILD[place].reshape(-1, 8)
        own = np.repeat((self.cells % COPIES).astype(np.int16), 8, axis=0)
        children = np.where(around >= 0, np.int16(COPIES) * around + own, np.int16(-1))
        of_parent = places_of(owners.keys, route.send(parents.ravel()))
        tree = np.arange(CHILDREN * len(owners.keys))
        part = np.empty(len(of_parent), np.int64)
        _unite(tree, of_parent, route.send(children), part)
        distinct, inverse = np.unique(part, return_inverse=True)
        first = np.searchsorted(distinct // CHILDREN, distinct // CHILDREN)
        number = np.minimum(np.arange(len(distinct)) - first, COPIES - 1)
        numbers: Indices = route.answer(number[inverse]).reshape(-1, 8)
        return numbers


@njit()
def _unite(tree: Indices, of_parent: Indices, children: Array, part: Indices) -> None:
    """Unite the children of each row (r, 8), and set the part (r,) of each row.

    tree : (CHILDREN times the number of parents,) trees of children; a tree's root is its least
           child
    """
    for row in range(len(of_parent)):
        first = -1
        for child in children[row]:
            if child >= 0:
                item = root(tree, CHILDREN * of_parent[row] + child)
                if first >= 0:
                    tree[max(item, first)] = min(item, first)
                    item = min(item, first)
                first = item
        part[row] = first
    for row in range(len(of_parent)):
        part[row] = root(tree, part[row])


def _distinct_cells(owners: SortedKeys, first: Indices, copies: Indices) -> Indices:
    """Return the keys (k, 8) of coarse cells' corners, each cell on a single rank (collective).

    first  : (m,) keys of first corners, without copies
    copies : (m,) copies of the eight corners, combined by DIGITS
    """
    route = Route(owners.comm, owners.owner(first))
    place = places_of(owners.keys, route.send(first))
    cells = np.unique(place * MOST_COPIES + route.send(copies))
    low = decode_morton(owners.keys[cells // MOST_COPIES])
    numbers: Indices = encode_morton(low[:, None] + CORNERS) + cells[:, None] // DIGITS % COPIES
    return numbers


def in_cells(low: Indices, ijk: Indices, parents: Array) -> Array:
    """Return the copies (n, 8) of coarse cells' corners, from the parents of fine nodes in them.

    low     : (n, 3) index of each coarse cell
    ijk     : (n, k, 3) index of each fine node in a cell
    parents : (n, k, 8) copies of the fine nodes' parents
    """
    is_parent, place = _places(low, ijk)
    copies = np.where(is_parent, np.take_along_axis(parents, place, axis=2), 0)
    numbers: Array = copies.max(axis=1)
    return numbers


def _places(low: Indices, ijk: Indices) -> tuple[Mask, Indices]:
    """Return whether corners of coarse cells are parents of fine nodes, and the parents' places.

    Both are (n, k, 8). A place is a column in a row of 8 parents; it is 0 without a parent.

    low : (n, 3) index of the coarse cells
    ijk : (n, k, 3) index of fine nodes in each cell
    """
    nodes = ijk[:, :, None]
    offset = low[:, None, None] + CORNERS - nodes // 2
    is_parent: Mask = ((offset >= 0) & (offset <= nodes % 2)).all(axis=3)
    return is_parent, PLACE[(offset * is_parent[..., None]) @ ON_AXES] * is_parent
