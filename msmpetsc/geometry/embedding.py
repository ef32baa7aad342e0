"""The embedding W: one sparse matrix that carries the surface along, surface = W @ positions (paper 3.1)."""

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from scipy.sparse import coo_array

from msmpetsc.comm import Route, SortedKeys
from msmpetsc.geometry import morton
from msmpetsc.geometry.cages import Cages
from msmpetsc.geometry.stencil import stencil_weights

CHUNK = 1 << 15  # points at once: their 64 weights each take 16 MB
# offsets of the 3 x 3 x 3 cells and the 4 x 4 x 4 nodes around a cell, in the order of stencil_weights
CELLS_AROUND = np.stack(np.unravel_index(np.arange(27), (3, 3, 3)), axis=1) - 1
NODES_AROUND = np.stack(np.unravel_index(np.arange(64), (4, 4, 4)), axis=1) - 1


@dataclass(frozen=True)
class Embedding:
    """Rows of W in the order of the surface's points, a contiguous range of them on each rank.

    indptr, indices, weights : CSR of this rank's rows; the columns are global node numbers
    """

    indptr: np.ndarray
    indices: np.ndarray
    weights: np.ndarray

    @property
    def points(self) -> int:
        """Surface points of this rank."""
        return len(self.indptr) - 1


def embed(points: np.ndarray, cages: Cages, nodes: SortedKeys, kind: str, smoothing: float = 1.0) -> Embedding:
    """W for surface points (collective).

    points    : (v, 3) [m] on rank 0, (0, 3) on the others: all must lie in valid cells
    nodes     : the lattice's node numbers by grid key
    kind, smoothing : see ``stencil_weights``
    """
    comm = cages.table.comm
    total = comm.allreduce(len(points))
    row, ijk, u = _to_cells(points, cages)
    cell_keys, cell = np.unique(morton.encode(ijk), return_inverse=True)
    around = morton.decode(cell_keys)[:, None, :]
    neighbours = cages.table.find(morton.encode(around + CELLS_AROUND)) >= 0
    numbers = nodes.find(morton.encode(around + NODES_AROUND))
    entries = [_entries(u, neighbours, numbers, cell, row, kind, smoothing, part) for part in _parts(len(u))]
    rows, columns, weights = (np.concatenate(part) for part in zip(*entries, strict=True))
    return _gather_rows(comm, rows, columns, weights, total, nodes.total)


def _to_cells(points: np.ndarray, cages: Cages) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Send each point to its cell's rank: its number there, its cell (p, 3), its coordinates in the cell (p, 3)."""
    at = cages.grid.to_cells(points)
    ijk = np.floor(at).astype(np.int64)
    route = Route(cages.table.comm, cages.table.owner(morton.encode(ijk)))
    return route.send(np.arange(len(points))), route.send(ijk), route.send(at - ijk)


def _parts(count: int) -> list[slice]:
    return [slice(start, start + CHUNK) for start in range(0, max(count, 1), CHUNK)]


def _entries(
    u: np.ndarray,
    neighbours: np.ndarray,
    numbers: np.ndarray,
    cell: np.ndarray,
    row: np.ndarray,
    kind: str,
    smoothing: float,
    part: slice,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The nonzero weights of some points as rows, columns and values."""
    weights = stencil_weights(kind, u[part], neighbours[cell[part]], smoothing)
    point, node = np.nonzero(weights)
    return row[part][point], numbers[cell[part]][point, node], weights[point, node]


def _gather_rows(
    comm: MPI.Comm, rows: np.ndarray, columns: np.ndarray, weights: np.ndarray, total: int, nodes: int
) -> Embedding:
    """Bring rows to the ranks that keep them: equal contiguous ranges."""
    first = total * np.arange(comm.size + 1) // comm.size
    route = Route(comm, np.searchsorted(first[1:], rows, side="right"))
    here = slice(first[comm.rank], first[comm.rank + 1])
    shape = (int(here.stop - here.start), nodes)
    csr = coo_array((route.send(weights), (route.send(rows) - here.start, route.send(columns))), shape=shape).tocsr()
    return Embedding(csr.indptr, csr.indices, csr.data)
