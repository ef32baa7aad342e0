"""Nodes, cells and springs of a rank's part of a lattice, numbered in Morton order."""

from typing import NamedTuple

import numpy as np

from msmpetsc.backend.arrays import Indices, Mask, Rows
from msmpetsc.backend.kernel import njit
from msmpetsc.geometry.cages import Cages
from msmpetsc.geometry.grid import CORNERS
from msmpetsc.geometry.morton import COPIES, decode_morton, encode_morton
from msmpetsc.geometry.partition import SortedKeys

# direction (8, 8) from corner a to b [-]; an index into the 3 x 3 x 3 nodes around a
DIRECTION = (CORNERS[None, :, :] - CORNERS[:, None, :] + 1) @ np.array([9, 3, 1])
# kind (27,) of the spring in each direction [-]: its squared length in cells
DIRECTION_KIND = ((np.stack(np.unravel_index(np.arange(27), (3, 3, 3))) - 1) ** 2).sum(axis=0)


class Topology(NamedTuple):
    """Nodes, cells and springs of a rank, without material. Further fields are those of Lattice.

    corners : (c, 8) global corner nodes of the cells that this rank owns
    ijk     : (l, 3) grid index of the nodes, ghosts included
    octants : (owned, 8) bool, which of the 8 cells around each owned node have it as a corner
    keys    : (d,) keys of all cells around the owned nodes
    cells   : (d, 8) their local corner nodes
    fills   : (d, 8) fills of their corners (geometry.fill_fractions); None if all cells are whole
    moments : (d, 3) second moments (geometry.fill_fractions); None if all cells are whole
    slot    : (s,) place of each spring in the sums of its first end (``find_slot``)
    sharing : (s,) number of cells that share each spring
    further : number of further rows of sums, of nodes with several neighbours in a direction
    """

    table: SortedKeys
    corners: Indices
    ijk: Indices
    octants: Mask
    ghosts: Indices
    keys: Indices
    cells: Indices
    fills: Rows | None
    moments: Rows | None
    springs: Indices
    springs_owned: int
    slot: Indices
    sharing: Indices
    further: int

    @property
    def direction(self) -> Indices:
        """Direction (s,) of each spring from its first end, as in DIRECTION."""
        return self.slot % 27


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
    cells = order[np.searchsorted(node_keys, corner_keys, sorter=order)]
    ghosts = table.find(node_keys[owned:])
    fills = cages.of_cells(keys, cages.fills)
    fills = None if fills is None else fills[:, *CORNERS.T]
    moments = cages.of_cells(keys, cages.moments)
    numbers = np.concatenate([table.first + np.arange(owned), ghosts])
    further = (COPIES - 1) * several
    springs = _springs(cells, numbers, owned, further)
    ijk = decode_morton(node_keys)
    return Topology(
        table, corners, ijk, octants, ghosts, keys, cells, fills, moments, *springs, further
    )


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
def _springs(
    cells: Indices, numbers: Indices, owned: int, further: int
) -> tuple[Indices, int, Indices, Indices]:
    """Return the springs between the corners of cells.

    cells   : (d, 8) local corner nodes; nodes below ``owned`` are owned
    numbers : (l,) global node numbers
    further : number of further rows for nodes with several neighbours in a direction

    Returns the local ends (s, 2), the number of owned springs, the slots (s,), and the number (s,)
    of cells that share each spring. Owned springs come first.
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
    count = 0
    for row in range(owned + further):
        for end in neighbour[row]:
            count += end >= 0 and (numbers[end] > numbers[first[row]] or end >= owned)
    springs = np.empty((count, 2), np.int32)
    slot = np.empty(count, np.int64)
    shared = np.empty(count, np.int64)
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
