"""Nodes, cells and springs of a rank's part of a lattice, numbered in Morton order."""

from typing import NamedTuple

import numpy as np

from msmpetsc.backend.arrays import Indices, Mask, Rows
from msmpetsc.backend.kernel import njit
from msmpetsc.comm import SortedKeys
from msmpetsc.geometry.cages import Cages
from msmpetsc.geometry.morton import decode_morton, encode_morton
from msmpetsc.lattice.cut_cells import CORNERS

# direction (8, 8) from corner a to b [-]; an index into the 3 x 3 x 3 nodes around a
DIRECTION = (CORNERS[None, :, :] - CORNERS[:, None, :] + 1) @ np.array([9, 3, 1])
# kind (27,) of the spring in each direction [-]: its squared length in cells
DIRECTION_KIND = ((np.stack(np.unravel_index(np.arange(27), (3, 3, 3))) - 1) ** 2).sum(axis=0)


class Topology(NamedTuple):
    """Nodes, cells and springs of a rank, without material. Further fields are those of Lattice.

    corners : (c, 8) global corner nodes of the cells that this rank owns
    ijk     : (l, 3) grid index of the nodes, ghosts included
    octants : (owned, 8) bool, which of the 8 cells around each owned node are valid
    cells   : (d, 8) local corner nodes of all cells around the owned nodes
    fills   : (d, 8) fills of their corners (geometry.fill_fractions); None if all cells are whole
    moments : (d, 3) second moments (geometry.fill_fractions); None if all cells are whole
    direction : (s,) direction of each spring from its first end, as in DIRECTION
    sharing : (s,) number of cells that share each spring
    """

    table: SortedKeys
    corners: Indices
    ijk: Indices
    octants: Mask
    ghosts: Indices
    cells: Indices
    fills: Rows | None
    moments: Rows | None
    springs: Indices
    springs_owned: int
    direction: Indices
    sharing: Indices


def topology_of(cages: Cages) -> Topology:
    """Return the nodes, cells and springs of this rank's part of the cages (collective)."""
    corner_keys = encode_morton(cages.ijk[:, None, :] + CORNERS)
    table = SortedKeys(cages.table.comm, corner_keys.ravel())
    corners = table.find(corner_keys)
    owned = len(table.keys)
    ijk, cells, octants = _local_cells(cages, table)
    ghosts = table.find(encode_morton(ijk[owned:]))
    fills = cages.of_cells(ijk[cells[:, 0]], cages.fills)
    fills = None if fills is None else fills[:, *CORNERS.T]
    moments = cages.of_cells(ijk[cells[:, 0]], cages.moments)
    numbers = np.concatenate([table.first + np.arange(owned), ghosts])
    springs = _springs(cells, numbers, owned)
    return Topology(table, corners, ijk, octants, ghosts, cells, fills, moments, *springs)


def _local_cells(cages: Cages, table: SortedKeys) -> tuple[Indices, Indices, Mask]:
    """Return this rank's nodes and the cells around its owned nodes.

    The result is

    - the grid index (l, 3) of owned and ghost nodes,
    - the local corner nodes (d, 8) of the cells,
    - the mask (owned, 8) of the valid cells around each owned node.
    """
    ijk = decode_morton(table.keys)
    around = encode_morton(ijk[:, None, :] - CORNERS)
    octants = cages.table.find(around) >= 0
    cell_keys = np.unique(around[octants])
    corner_keys = encode_morton(decode_morton(cell_keys)[:, None, :] + CORNERS)
    ghost_keys = np.setdiff1d(corner_keys, table.keys)
    keys = np.concatenate([table.keys, ghost_keys])
    order = np.argsort(keys)
    local = order[np.searchsorted(keys, corner_keys, sorter=order)]
    return decode_morton(keys), local, octants


@njit()
def _springs(cells: Indices, numbers: Indices, owned: int) -> tuple[Indices, int, Indices, Indices]:
    """Return the springs between the corners of cells.

    cells   : (d, 8) local corner nodes; nodes below ``owned`` are owned
    numbers : (l,) global node numbers

    Returns the local ends (s, 2), the number of owned springs, the directions (s,), and the number
    (s,) of cells that share each spring. Owned springs come first.
    """
    neighbour = np.full((owned, 27), -1, np.int32)
    sharing = np.zeros((owned, 27), np.uint8)
    for cell in cells:
        for a in range(8):
            if cell[a] < owned:
                for b in range(8):
                    neighbour[cell[a], DIRECTION[a, b]] = cell[b]
                    sharing[cell[a], DIRECTION[a, b]] += 1
    count = 0
    # Direction 13 is the node itself.
    for node in range(owned):
        for direction in range(27):
            end = neighbour[node, direction]
            count += end >= 0 and direction != 13 and (numbers[end] > numbers[node] or end >= owned)
    springs = np.empty((count, 2), np.int32)
    directions = np.empty(count, np.int64)
    shared = np.empty(count, np.int64)
    # Owned springs fill the arrays from the front, all further springs from the back.
    low, high = 0, count
    for node in range(owned):
        row = neighbour[node]
        for direction in np.argsort(numbers[row]):
            end = row[direction]
            if end < 0 or direction == 13:
                continue
            if numbers[end] > numbers[node]:
                s = low
                low += 1
            elif end >= owned:
                high -= 1
                s = high
            else:
                continue
            springs[s, 0], springs[s, 1] = node, end
            directions[s], shared[s] = direction, sharing[node, direction]
    return springs, low, directions, shared
