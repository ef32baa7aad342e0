"""Nodes, cells and springs of a rank's part of a lattice, numbered in Morton order."""

from typing import NamedTuple

import numpy as np

from msmpetsc.backend.arrays import Array, Indices, Mask
from msmpetsc.backend.kernel import njit
from msmpetsc.geometry.cages import Cages
from msmpetsc.geometry.grid import CORNERS
from msmpetsc.geometry.morton import COPIES, decode_morton, encode_morton
from msmpetsc.geometry.partition import SortedKeys

# direction (8, 8) from corner a to b [-]; an index into the 3 x 3 x 3 nodes around a
DIRECTION = (CORNERS[None, :, :] - CORNERS[:, None, :] + 1) @ np.array([9, 3, 1])
# kind (27,) of the spring in each direction [-]: its squared length in cells
DIRECTION_KIND = ((np.stack(np.unravel_index(np.arange(27), (3, 3, 3))) - 1) ** 2).sum(axis=0)


class SpringNet(NamedTuple):
    """Springs of a rank, without material; owned springs come first.

    ends    : (s, 2) local ends
    owned   : number of springs that the rank owns
    slot    : (s,) place of each spring in the sums of its first end (``find_slot``)
    sharing : (s,) number of cells that share each spring
    """

    ends: Indices
    owned: int
    slot: Indices
    sharing: Array

    @property
    def direction(self) -> Indices:
        """Direction (s,) of each spring from its first end, as in DIRECTION."""
        return self.slot % 27


class Topology(NamedTuple):
    """Nodes and cells of a rank, without material. Further fields are those of Lattice.

    corners : (c, 8) global corner nodes of the cells that this rank owns
    ijk     : (l, 3) grid index of the nodes, ghosts included
    octants : (owned, 8) bool, which of the 8 cells around each owned node have it as a corner
    keys    : (d,) keys of all cells around the owned nodes
    cells   : (d, 8) their local corner nodes
    cages   : the cells of all ranks
    further : number of further rows of sums, of nodes with several neighbours in a direction
    """

    table: SortedKeys
    corners: Indices
    ijk: Indices
    octants: Mask
    ghosts: Indices
    keys: Indices
    cells: Indices
    cages: Cages
    further: int

    @property
    def _numbers(self) -> Indices:
        """Global number (l,) of each local node."""
        return np.concatenate([self.table.first + np.arange(len(self.octants)), self.ghosts])

    def count_springs(self) -> int:
        """Return the number of springs that this rank owns."""
        return int(_neighbours(self.cells, self._numbers, len(self.octants), self.further)[-1])

    def springs(self) -> SpringNet:
        """Return the springs between the corners of cells."""
        return SpringNet(*_springs(self.cells, self._numbers, len(self.octants), self.further))


def topology_of(cages: Cages) -> Topology:
    """Return the nodes, cells and springs of this rank's part of the cages (collective)."""
    corner_keys = cages.corner_keys(cages.table.keys)
    table = SortedKeys(cages.table.comm, corner_keys.ravel())
    corners = table.find(corner_keys)
    owned = len(table.keys)
    keys, octants, several = _cells_around(cages, table)
    corner_keys = cages.corner_keys(keys)
    node_keys = np.concatenate([table.keys, np.setdiff1d(corner_keys, table.keys)])
    order = np.argsort(node_keys)
    cells = order[np.searchsorted(node_keys, corner_keys, sorter=order)].astype(np.int32)
    ghosts = table.find(node_keys[owned:])
    ijk = decode_morton(node_keys)
    further = (COPIES - 1) * several
    return Topology(table, corners, ijk, octants, ghosts, keys, cells, cages, further)


def _cells_around(cages: Cages, table: SortedKeys) -> tuple[Indices, Mask, int]:
    """Return the cells around this rank's owned nodes (collective).

    The result is

    - the keys (d,) of the cells,
    - the mask (owned, 8) of the cells that have each owned node as a corner,
    - the number of owned nodes of cells in ``cages.copies``.
    """
    around = encode_morton(decode_morton(table.keys)[:, None, :] - CORNERS)
    octants = cages.table.find(around) >= 0
    if cages.copies is None:
        return np.unique(around[octants]), octants, 0
    is_ordinary = cages.copies.place(around) < 0
    octants &= is_ordinary & (table.keys % COPIES == 0)[:, None]
    keys = around[octants]
    node = np.searchsorted(table.keys, cages.copies.corners)
    owned = np.append(table.keys, -1)[node] == cages.copies.corners
    cell, octant = np.nonzero(owned)
    octants[node[owned], octant] = True
    keys = np.unique(np.concatenate([keys, cages.copies.keys[cell]]))
    return keys, octants, len(np.unique(node[owned]))


@njit()
def find_slot(
    neighbour: Indices, following: Indices, node: int, direction: int, end: int
) -> tuple[int, int]:
    """Return the row and the column of a node's neighbour ``end`` in a direction.

    A node has the row of its own number. A node with several copies of a neighbour in a direction
    has further rows, which ``following`` chains; its last entry counts the rows in use.
    """
    row = node
    while neighbour[row, direction] >= 0 and neighbour[row, direction] != end:
        if following[row] < 0:
            following[row] = following[-1]
            following[-1] += 1
        row = following[row]
    neighbour[row, direction] = end
    return row, direction


@njit()
def slots(owned: int, further: int) -> tuple[Indices, Indices]:
    """Return empty tables ``neighbour`` and ``following`` of ``find_slot``."""
    following = np.full(owned + further + 1, -1, np.int32)
    following[-1] = owned
    return np.full((owned + further, 27), -1, np.int32), following


@njit()
def _neighbours(
    cells: Indices, numbers: Indices, owned: int, further: int
) -> tuple[Indices, Indices, Array, int, int]:
    """Return the neighbours of nodes in cells.

    cells   : (d, 8) local corner nodes; nodes below ``owned`` are owned
    numbers : (l,) global node numbers
    further : number of further rows for nodes with several neighbours in a direction

    Returns the tables of ``find_slot`` and the number of cells that share each neighbour. The last
    two numbers are those of the rank's springs, and of the springs that it owns.
    """
    neighbour, following = slots(owned, further)
    sharing = np.zeros((owned + further, 27), np.uint8)
    for cell in cells:
        for a in range(8):
            if cell[a] < owned:
                for b in range(8):
                    sharing[find_slot(neighbour, following, cell[a], DIRECTION[a, b], cell[b])] += 1
    # Direction 13 is the node itself.
    neighbour[:, 13] = -1
    first = np.arange(owned + further)
    for row in range(owned + further):
        if following[row] >= 0:
            first[following[row]] = first[row]
    count, own = 0, 0
    for row in range(owned + further):
        for end in neighbour[row]:
            is_own = end >= 0 and numbers[end] > numbers[first[row]]
            own += is_own
            count += is_own or end >= owned
    return neighbour, following, sharing, count, own


@njit()
def _springs(
    cells: Indices, numbers: Indices, owned: int, further: int
) -> tuple[Indices, int, Indices, Array]:
    """Return the fields of SpringNet; the arguments are those of ``_neighbours``."""
    neighbour, following, sharing, count, _ = _neighbours(cells, numbers, owned, further)
    springs = np.empty((count, 2), np.int32)
    slot = np.empty(count, np.int64)
    shared = np.empty(count, np.uint8)
    ends, places = np.empty(27 * COPIES, np.int64), np.empty(27 * COPIES, np.int64)
    # Owned springs fill the arrays from the front, all further springs from the back.
    low, high = 0, count
    for node in range(owned):
        n, row = 0, node
        while row >= 0:
            for direction in range(27):
                if neighbour[row, direction] >= 0:
                    ends[n], places[n] = neighbour[row, direction], 27 * row + direction
                    n += 1
            row = following[row]
        for i in np.argsort(numbers[ends[:n]]):
            if numbers[ends[i]] > numbers[node]:
                s = low
                low += 1
            elif ends[i] >= owned:
                high -= 1
                s = high
            else:
                continue
            springs[s, 0], springs[s, 1] = node, ends[i]
            slot[s], shared[s] = places[i], sharing.ravel()[places[i]]
    return springs, low, slot, shared
