"""The cells of a solid around a rank's nodes, in blocks of eight, as loops and threads take them.

Numbers of a block's cells stand beside each other: number i of the cell in a lane is row[lane + LANES * i].
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from msmpetsc.backend.arrays import Array, Floats, Indices, Rows, like, on_host, to_host
from msmpetsc.elasticity.cell_strain import LANES
from msmpetsc.elasticity.springs import rows_of
from msmpetsc.lattice.cell_moments import FORM
from msmpetsc.lattice.lattice import Lattice

ROWS = (
    FORM + 2
)  # of a cell's constants: its form, modes times m = mu V / (16 h^2); m; lambda V / (16 h^2)
STATE = 11  # F by rows, V U' / (16 h^2), V U'' / (16 h^2)
BY_AXIS = [0, 1, 3, 2, 4, 5, 7, 6]  # corners of VTK's order, x fastest, then y


class Blocks(NamedTuple):
    """Cells, those first that a rank owns; the last block of a kind is filled up with cells of no stiffness.

    nodes     : (b, LANES, 8) local corner nodes, x fastest; unsigned, so that no index is looked at for being negative
    which     : (b,) row of the constants
    constants : (k, ROWS * LANES), LANES of each number
    around    : (8, n) on a GPU the corners at each node that the rank owns, by their number in (b, 8, LANES), one past
        the last where a node has fewer; (8, 0) on a CPU
    owned     : number of blocks of cells that the rank owns
    h4        : four times the side of a cell [m]
    """

    nodes: Indices
    which: Indices
    constants: Rows
    around: Indices
    owned: int
    h4: float


class CellRows(NamedTuple):
    """The same cells one after another, as kernels take them: cell i is in lane i % LANES of block i // LANES.

    nodes     : (c, 8)
    constants : rows of ``Blocks.constants``, one after another
    by_node   : a corner adds to the row of its node; on a GPU to one of its own, of which Blocks.around has the number
    state     : what a Hessian keeps of each (b, STATE, LANES), one row of numbers; none where nothing asks for it
    """

    nodes: Indices
    which: Indices
    constants: Floats
    h4: float
    by_node: bool
    state: Floats


def one_by_one(blocks: Blocks, state: Array | None = None) -> CellRows:
    """Return cells as kernels take them."""
    constants, by_node = blocks.constants.ravel(), on_host(blocks.nodes)
    own = constants[:0] if state is None else state.ravel()
    return CellRows(blocks.nodes.reshape(-1, 8), blocks.which, constants, blocks.h4, by_node, own)


def blocks_of(lattice: Lattice, constants: Rows) -> Blocks:
    """Return the lattice's cells with their constants (c, ROWS), in the memory that its nodes are in."""
    cells, kinds, number = to_host(lattice.local_cells)[:, BY_AXIS], [], np.arange(len(constants))
    _, alike, count = np.unique(_whole_rows(constants), return_inverse=True, return_counts=True)
    rank = np.where(
        count[alike] < LANES, len(count), alike
    )  # those that fill no block stay where they are
    for kind in (number < lattice.cells_owned, number >= lattice.cells_owned):
        own = np.flatnonzero(kind)
        order = own[np.argsort(rank[own], kind="stable")]
        kinds.append(_in_blocks(cells[order], constants[order]))
    nodes, rows = (np.concatenate(parts) for parts in zip(*kinds, strict=True))
    _, first, which = np.unique(_whole_rows(rows), return_index=True, return_inverse=True)
    around = np.empty((8, 0), np.int64)
    if not on_host(lattice.nodes):
        is_cell = rows.reshape(-1, ROWS, LANES)[:, -2] > 0  # and does not fill up a last block
        corners = np.where(is_cell[:, None], nodes.transpose(0, 2, 1), lattice.owned)
        around = rows_of(corners.ravel().astype(np.int64), lattice.owned)
    arrays = nodes, which.astype(np.int32), rows[first], around
    nodes, which, distinct, around = (like(lattice.nodes, array) for array in arrays)
    return Blocks(nodes, which, distinct, around, len(kinds[0][0]), 4 * lattice.cell_size)


def _in_blocks(nodes: Indices, constants: Rows) -> tuple[Indices, Rows]:
    """Return cells in blocks (b, LANES, 8) and their constants (b, ROWS * LANES); the last is filled up by no cells."""
    lacking = -len(nodes) % LANES
    nodes = np.concatenate([nodes, np.repeat(nodes[-1:], lacking, axis=0)]).astype(np.uint32)
    rows = np.concatenate([constants, np.zeros((lacking, ROWS))]).reshape(-1, LANES, ROWS)
    return nodes.reshape(-1, LANES, 8), rows.transpose(0, 2, 1).reshape(-1, ROWS * LANES)


def _whole_rows(rows: Rows) -> Array:
    """Return rows as one thing each, (n,), which are sorted and compared bit by bit."""
    return (
        np.ascontiguousarray(rows).view(np.dtype((np.void, rows.itemsize * rows.shape[1]))).ravel()
    )


def add_corners(write: Callable[[Rows], None], around: Indices, corners: int, rows: Rows) -> None:
    """Let a loop add to the rows (l, k) of nodes; on a GPU to so many of its own, one a corner of cells, which each
    owned node then sums.

    around : of ``rows_of``
    """
    if on_host(rows):
        write(rows)
        return
    own = np.zeros((corners + 1, rows.shape[1]), like=rows)  # the last is of no corner
    write(own)
    rows[: around.shape[1]] += own[around].sum(axis=0)
