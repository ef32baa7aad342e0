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
    slot    : (s,) flat index of each spring in sums (owned, 27, copies) by its first end
    sharing : (s,) number of cells that share each spring
    direction : (s,) direction of each spring from its first end, as in DIRECTION
    """

    ends: Indices
    owned: int
    slot: Indices
    sharing: Array
    direction: Indices


class Topology(NamedTuple):
    """Nodes and cells of a rank, without material; ``table`` and ``ghosts`` are as in Lattice.

    corners : (c, 8) global corner nodes of the cells that this rank owns
    ijk     : (l, 3) grid index of the nodes, ghosts included
    octants : (owned, 8) bool, whether each of the 8 cells around an owned node has it as a corner
    keys    : (d,) keys of all cells around the owned nodes
    cells   : (d, 8) their local corner nodes
    cages   : the cells of all ranks
    copy    : (l,) number of each local node's copy
    """

    table: SortedKeys
    corners: Indices
    ijk: Indices
    octants: Mask
    ghosts: Indices
    keys: Indices
    cells: Indices
    cages: Cages
    copy: Array

    @property
    def _numbers(self) -> Indices:
        """Global number (l,) of each local node."""
        return np.concatenate([self.table.first + np.arange(len(self.octants)), self.ghosts])

    def count_springs(self) -> int:
        """Return the number of springs that this rank owns."""
        return int(_neighbours(self.cells, self._numbers, self.copy, len(self.octants))[-1])

    def springs(self) -> SpringNet:
        """Return the springs between the corners of cells."""
        found = _springs(self.cells, self._numbers, self.copy, len(self.octants))
        return SpringNet(*found, found[2] // (self.copy.max() + 1) % 27)


def topology_of(cages: Cages) -> Topology:
    """Return the nodes and cells of this rank's part of the lattice (collective)."""
    corner_keys = cages.copies.corner_keys(cages.table.keys)
    table = SortedKeys(cages.table.comm, corner_keys.ravel())
    corners = table.find(corner_keys)
    owned = len(table.keys)
    keys, octants = _cells_around(cages, table)
    corner_keys = cages.copies.corner_keys(keys)
    node_keys = np.concatenate([table.keys, np.setdiff1d(corner_keys, table.keys)])
    order = np.argsort(node_keys)
    cells = order[np.searchsorted(node_keys, corner_keys, sorter=order)].astype(np.int32)
    ghosts = table.find(node_keys[owned:])
    ijk = decode_morton(node_keys)
    copy = (node_keys % COPIES).astype(np.uint8)
    return Topology(table, corners, ijk, octants, ghosts, keys, cells, cages, copy)


def _cells_around(cages: Cages, table: SortedKeys) -> tuple[Indices, Mask]:
    """Return the keys (d,) of the cells around this rank's owned nodes (collective).

    Also return the mask ``octants`` (owned, 8) of Topology.
    """
    around = encode_morton(decode_morton(table.keys)[:, None, :] - CORNERS)
    octants = cages.table.find(around) >= 0
    is_ordinary = cages.copies.place(around) < 0
    octants &= is_ordinary & (table.keys % COPIES == 0)[:, None]
    keys = around[octants]
    node = np.searchsorted(table.keys, cages.copies.corners)
    owned = np.append(table.keys, -1)[node] == cages.copies.corners
    cell, octant = np.nonzero(owned)
    octants[node[owned], octant] = True
    keys = np.unique(np.concatenate([keys, cages.copies.keys[cell]]))
    return keys, octants


@njit()
def _neighbours(
    cells: Indices, numbers: Indices, copy: Array, owned: int
) -> tuple[Indices, Array, int, int]:
    """Return each owned node's neighbours, and the number of cells that share each neighbour.

    Both are (owned, 27 copies). Also return the number of the rank's springs, and the number of
    springs that the rank owns.

    cells   : (d, 8) local corner nodes; nodes below ``owned`` are owned
    numbers : (l,) global node numbers
    copy    : (l,) number of each node's copy
    """
    copies = copy.max() + 1
    neighbour = np.full((owned, 27 * copies), -1, np.int32)
    sharing = np.zeros(neighbour.shape, np.uint8)
    for cell in cells:
        for a in range(8):
            if cell[a] < owned:
                for b in range(8):
                    slot = copies * DIRECTION[a, b] + copy[cell[b]]
                    neighbour[cell[a], slot] = cell[b]
                    sharing[cell[a], slot] += 1
    count, own = 0, 0
    for node in range(owned):
        for end in neighbour[node]:
            is_own = end >= 0 and numbers[end] > numbers[node]
            own += is_own
            count += is_own or end >= owned
    return neighbour, sharing, count, own


@njit()
def _springs(
    cells: Indices, numbers: Indices, copy: Array, owned: int
) -> tuple[Indices, int, Indices, Array]:
    """Return the fields of SpringNet except the directions; arguments as in ``_neighbours``."""
    neighbour, sharing, count, _ = _neighbours(cells, numbers, copy, owned)
    springs = np.empty((count, 2), np.int32)
    slot = np.empty(count, np.int64)
    shared = np.empty(count, np.uint8)
    # owned springs fill the arrays from the front, all further springs from the back
    low, high = 0, count
    for node in range(owned):
        places = np.flatnonzero(neighbour[node] >= 0)
        for place in places[np.argsort(numbers[neighbour[node][places]])]:
            end = neighbour[node, place]
            if numbers[end] > numbers[node]:
                s = low
                low += 1
            elif end >= owned:
                high -= 1
                s = high
            else:
                continue
            springs[s, 0], springs[s, 1] = node, end
            slot[s], shared[s] = neighbour.shape[1] * node + place, sharing[node, place]
    return springs, low, slot, shared
