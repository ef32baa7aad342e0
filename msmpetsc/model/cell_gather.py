"""The resistance of cells to being turned inside out as each node sees it: what a GPU works with, one thread a node.

As model.spring_gather is to model.springs, so this is to model.inversion.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numba
import numpy as np

from msmpetsc.backend.arrays import like, to_host
from msmpetsc.backend.kernel import kernel
from msmpetsc.model.inversion import (
    FRAMES,
    cofactors,
    corner_product,
    corner_slope,
    edges,
    resistance_change,
    resistance_energy,
)
from msmpetsc.model.lattice import Lattice

# what a cell's corner (second) is in one of its frames (first): 0 the frame's own corner, 1 to 3 the far end of that
# edge, -1 nothing
ROLE = np.full((8, 8), -1)
np.put_along_axis(ROLE, FRAMES, np.arange(4)[None, :], axis=1)


@dataclass(frozen=True)
class CellsAround:
    """The cells around each owned node, one after another: those of the first node in the first column.

    cells      : (c, 8) local corner nodes of all; own: how many of them belong to this rank, the first
    resistance : K (c,) [J]
    volume     : J_0 h^3 [m^3]
    around     : (8, owned) int32, which of the cells, -1 past the last
    corner     : (8, owned) u1, which of its corners the node is
    """

    cells: np.ndarray
    own: int
    resistance: np.ndarray
    volume: float
    around: np.ndarray
    corner: np.ndarray

    @classmethod
    def of(cls, lattice: Lattice, resistance: np.ndarray, volume: float) -> "CellsAround":
        """Beside the lattice's nodes."""
        nodes, owned = to_host(lattice.local_cells).ravel(), lattice.owned
        by_node = np.argsort(nodes, kind="stable")
        by_node = by_node[: np.searchsorted(nodes[by_node], owned)]
        node = nodes[by_node]
        slot = np.arange(len(node)) - np.searchsorted(node, node)
        around, corner = np.full((8, owned), -1, np.int32), np.zeros((8, owned), np.uint8)
        around[slot, node], corner[slot, node] = by_node // 8, by_node % 8
        resistance, around, corner = (like(lattice.nodes, a) for a in (resistance, around, corner))
        return cls(lattice.local_cells, lattice.cells_owned, resistance, volume, around, corner)

    def energy(self, q: np.ndarray) -> float:
        """[J] of the own cells."""
        return resistance_energy(q, self.cells[: self.own], self.resistance, self.volume)

    def change(self, q: np.ndarray, base: np.ndarray) -> float:
        """Energy at q less that at base [J], of the own cells."""
        return resistance_change(q, base, self.cells[: self.own], self.resistance, self.volume)

    def add_gradient(self, q: np.ndarray, gradient: np.ndarray) -> None:
        """Add the gradient [N] to the owned rows of ``gradient``."""
        slope_around(self.around.shape[1], q, *self._all, gradient)

    def hessian_at(self, q: np.ndarray, projected: bool) -> Callable[[np.ndarray, np.ndarray], None]:
        """What adds (Hessian at q) v [N] to the owned rows of its second argument."""
        return partial(turn_around, self.around.shape[1], q.copy(), *self._all, projected)

    @property
    def _all(self) -> tuple:
        return self.cells, self.resistance, self.volume, self.around, self.corner


@numba.njit(cache=True)
def share_of(role, vectors):
    """Of three vectors, one for the far end of each edge and for the corner what balances them."""
    a, b, c = vectors
    if role == 0:
        return -(a[0] + b[0] + c[0]), -(a[1] + b[1] + c[1]), -(a[2] + b[2] + c[2])
    if role == 1:
        return a
    return b if role == 2 else c


@kernel
def slope_around(first, count, step, q, cells, resistance, volume, around, corner, gradient):
    for i in range(first, count, step):
        gx, gy, gz = 0.0, 0.0, 0.0
        for a in range(8):
            c = around[a, i]
            if c < 0:
                break
            for frame in range(8):
                role = ROLE[frame, corner[a, i]]
                if role < 0:
                    continue
                e = edges(q, cells[c], frame)
                n = cofactors(e)
                slope = corner_slope(e, n, resistance[c], volume)
                x, y, z = share_of(role, n)
                gx += slope * x
                gy += slope * y
                gz += slope * z
        gradient[i, 0] += gx
        gradient[i, 1] += gy
        gradient[i, 2] += gz


@kernel
def turn_around(first, count, step, q, cells, resistance, volume, around, corner, projected, v, product):
    for i in range(first, count, step):
        px, py, pz = 0.0, 0.0, 0.0
        for a in range(8):
            c = around[a, i]
            if c < 0:
                break
            for frame in range(8):
                role = ROLE[frame, corner[a, i]]
                if role < 0:
                    continue
                e = edges(q, cells[c], frame)
                n = cofactors(e)
                if corner_slope(e, n, resistance[c], volume) >= 0.0:
                    continue
                p = corner_product(e, n, edges(v, cells[c], frame), resistance[c], volume, projected)
                x, y, z = share_of(role, p)
                px += x
                py += y
                pz += z
        product[i, 0] += px
        product[i, 1] += py
        product[i, 2] += pz
