"""Storage of a solid's cells in blocks of eight, for vectorised loops and for GPU threads.

The numbers of a block are interleaved: number i of the cell in a lane is row[lane + LANES * i].
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from msmpetsc.backend.arrays import Array, Floats, Indices, Rows, like, on_host, to_host
from msmpetsc.elasticity.cell_strain import LANES
from msmpetsc.elasticity.springs import rows_of
from msmpetsc.lattice.cell_moments import FORM
from msmpetsc.lattice.lattice import Lattice

# number of a cell's constants [-]: its form (lattice.cell_moments), then m = mu V /
# (16 h^2) and lambda V / (16 h^2). The form's entries for modes are multiplied by m
# and, except for XYZ, by 1 - s (elasticity.assumed_strain).
ROWS = FORM + 2
# numbers of a cell in a projected Hessian's state [-]: F by rows, then V U' and V U''
# over 16 h^2
PROJECTED = 11
# numbers of a cell in a true Hessian's state [-]: as above, then the modes XY, XZ and
# YZ over 4 h, with three components each
STATE = 20
# VTK's corner number at each place of the order with x fastest, then y [-]
BY_AXIS = [0, 1, 3, 2, 4, 5, 7, 6]


class CellBlocks(NamedTuple):
    """A solid's cells in blocks of LANES; the blocks of cells that the rank owns come first.

    Cells of zero stiffness fill up the last owned block and the last block of all.

    nodes     : (b, LANES, 8) local corner nodes, x fastest; unsigned, to save a test of their sign
    which     : (b,) row of ``constants`` for each block
    constants : (k, ROWS * LANES) distinct rows of constants, interleaved
    around    : (8, n) on a GPU the cell corners at each owned node, as indices into (b, 8, LANES),
                filled up with an index past the end; (8, 0) on a CPU
    owned     : number of blocks of cells that the rank owns
    h4        : four times the side h of a cell [m]
    u         : number of the volumetric energy (elasticity.neo_hookean)
    """

    nodes: Indices
    which: Indices
    constants: Rows
    around: Indices
    owned: int
    h4: float
    u: int


class CellRows(NamedTuple):
    """Cells in sequence, as kernels take them: cell i is in lane i % LANES of block i // LANES.

    nodes     : (c, 8) local corner nodes, x fastest
    constants : ``CellBlocks.constants``, flat
    by_node   : True on a CPU, where a corner adds to its node's row; False on a GPU, where each
                corner has its own row
    state     : (b, width, LANES) state of a Hessian, flat; empty if the kernel needs none
    width     : numbers of a cell in the state, PROJECTED or STATE
    """

    nodes: Indices
    which: Indices
    constants: Floats
    h4: float
    u: int
    by_node: bool
    state: Floats
    width: int


def one_by_one(blocks: CellBlocks, state: Array | None = None) -> CellRows:
    """Return the cells of blocks in sequence, with the ``state`` of a Hessian if given."""
    constants, by_node = blocks.constants.ravel(), on_host(blocks.nodes)
    own = constants[:0] if state is None else state.ravel()
    width = len(own) // (LANES * len(blocks.nodes))
    nodes = blocks.nodes.reshape(-1, 8)
    return CellRows(nodes, blocks.which, constants, blocks.h4, blocks.u, by_node, own, width)


def blocks_of(lattice: Lattice, constants: Rows, u: int) -> tuple[CellBlocks, Indices]:
    """Return the lattice's cells with their constants (c, ROWS), on the device of its nodes.

    Also return the place (c,) of each cell in the sequence of blocks. Cells with equal constants
    are put into the same blocks, so that few distinct rows are stored.
    """
    cells = to_host(lattice.local_cells)[:, BY_AXIS]
    number = np.arange(len(constants))
    kinds: list[tuple[Indices, Rows]] = []
    places = np.empty(len(constants), np.int64)
    _, alike, count = np.unique(whole_rows(constants), return_inverse=True, return_counts=True)
    # Cells whose constants are too rare to fill a block keep their order, for locality.
    rank = np.where(count[alike] < LANES, len(count), alike)
    for kind in (number < lattice.cells_owned, number >= lattice.cells_owned):
        own = np.flatnonzero(kind)
        order = own[np.argsort(rank[own], kind="stable")]
        places[order] = LANES * sum(len(nodes) for nodes, _ in kinds) + np.arange(len(order))
        kinds.append(_in_blocks(cells[order], constants[order]))
    nodes, rows = (np.concatenate(parts) for parts in zip(*kinds, strict=True))
    _, first, which = np.unique(whole_rows(rows), return_index=True, return_inverse=True)
    around = np.empty((8, 0), np.int64)
    if not on_host(lattice.nodes):
        # Cells without stiffness only fill up blocks. Their corners get no row.
        is_cell = rows.reshape(-1, ROWS, LANES)[:, -2] > 0
        corners = np.where(is_cell[:, None], nodes.transpose(0, 2, 1), lattice.owned)
        around = rows_of(corners.ravel().astype(np.int64), lattice.owned)
    arrays = nodes, which.astype(np.int32), rows[first], around
    nodes, which, distinct, around = (like(lattice.nodes, array) for array in arrays)
    owned, h4 = len(kinds[0][0]), 4 * lattice.cell_size
    return CellBlocks(nodes, which, distinct, around, owned, h4, u), places


def _in_blocks(nodes: Indices, constants: Rows) -> tuple[Indices, Rows]:
    """Return the nodes (b, LANES, 8) and the constants (b, ROWS * LANES) of cells in blocks.

    Cells of zero stiffness fill up the last block.
    """
    lacking = -len(nodes) % LANES
    nodes = np.concatenate([nodes, np.repeat(nodes[-1:], lacking, axis=0)]).astype(np.uint32)
    rows = np.concatenate([constants, np.zeros((lacking, ROWS))]).reshape(-1, LANES, ROWS)
    return nodes.reshape(-1, LANES, 8), rows.transpose(0, 2, 1).reshape(-1, ROWS * LANES)


def whole_rows(rows: Rows) -> Array:
    """Return each row as a single item (n,), which sorts and compares bit by bit."""
    return (
        np.ascontiguousarray(rows).view(np.dtype((np.void, rows.itemsize * rows.shape[1]))).ravel()
    )


def add_corners(write: Callable[[Rows], None], blocks: CellBlocks, rows: Rows) -> None:
    """Add the results of a loop over the corners of all cells to the rows (l, k) of nodes.

    On a CPU ``write`` adds to ``rows``. On a GPU it writes a row per corner, and each owned node
    sums the rows of its corners.
    """
    if on_host(rows):
        write(rows)
        return
    # The last row stays zero: ``around`` refers to it if a node has fewer corners.
    own, around = np.zeros((blocks.nodes.size + 1, rows.shape[1]), like=rows), blocks.around
    write(own)
    rows[: around.shape[1]] += own[around].sum(axis=0)
