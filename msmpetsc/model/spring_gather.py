"""The elastic energy of springs as each node sees it: what a GPU works with, one thread a node.

The formulas are those of model.springs; only the way through the lattice differs. A loop on a CPU takes each spring
once and adds to both its ends. Here a node gathers from its neighbours, each spring is looked at from both ends, and
no two threads write to one place: sums come out the same, to the last bit, every time. Nothing is stored of a
Hessian: positions are read again for each product, which is less to read than the blocks of 26 springs.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from msmpetsc.backend.arrays import like, to_host
from msmpetsc.backend.kernel import kernel
from msmpetsc.model.lattice import Lattice
from msmpetsc.model.springs import block_product, spring_block, spring_change, spring_energy, spring_pull


@dataclass(frozen=True)
class Neighbours:
    """The springs around each owned node, one after another: those of the first node in the first column.

    other     : (w, owned) int32, local number of the node at the far end, -1 past the last
    kind      : (w, owned) u1, which of the lengths
    stiffness : (w, owned) [N/m]
    lengths   : (k,) rest lengths [m]
    """

    other: np.ndarray
    kind: np.ndarray
    stiffness: np.ndarray
    lengths: np.ndarray
    stiffening: float

    @classmethod
    def of(cls, lattice: Lattice) -> "Neighbours":
        """Beside the lattice's nodes."""
        springs, owned = to_host(lattice.springs), lattice.owned
        ends = np.concatenate([springs, springs[:, ::-1]])
        by_node = np.argsort(ends[:, 0], kind="stable")
        by_node = by_node[: np.searchsorted(ends[by_node, 0], owned)]
        node, spring = ends[by_node, 0], by_node % max(len(springs), 1)
        slot = np.arange(len(node)) - np.searchsorted(node, node)
        lengths, kind = np.unique(to_host(lattice.rest_length), return_inverse=True)
        shape = (int(slot.max(initial=0)) + 1, owned)
        other, kinds, stiffness = np.full(shape, -1, np.int32), np.zeros(shape, np.uint8), np.zeros(shape)
        other[slot, node], kinds[slot, node] = ends[by_node, 1], kind[spring]
        stiffness[slot, node] = to_host(lattice.stiffness)[spring]
        return cls(*(like(lattice.nodes, a) for a in (other, kinds, stiffness, lengths)), lattice.stiffening)

    @property
    def all(self) -> tuple:
        return self.other, self.kind, self.stiffness, self.lengths, self.stiffening

    def energy(self, q: np.ndarray) -> float:
        """E [J] of the half of each spring that is nearer to an owned node: the sum of all ranks' is the body's."""
        parts = np.empty(self.other.shape[1], like=q)
        energy_around(len(parts), q, *self.all, parts)
        return float(parts.sum())

    def change(self, q: np.ndarray, base: np.ndarray) -> float:
        """E(q) - E(base) [J], likewise."""
        parts = np.empty(self.other.shape[1], like=q)
        change_around(len(parts), q, base, *self.all, parts)
        return float(parts.sum())

    def add_gradient(self, q: np.ndarray, gradient: np.ndarray) -> None:
        """Add grad E [N] to the owned rows of ``gradient``."""
        gradient_around(self.other.shape[1], q, *self.all, gradient)

    def add_concavity(self, q: np.ndarray, concavity: np.ndarray) -> None:
        """As model.springs's, to the owned rows of ``concavity`` (l,) [N/m]."""
        concavity_around(self.other.shape[1], q, *self.all, concavity)

    def hessian_at(self, q: np.ndarray, projected: bool) -> Callable[[np.ndarray, np.ndarray], None]:
        """What adds (Hessian of E at q) v [N] to the owned rows of its second argument."""
        return partial(product_around, self.other.shape[1], q.copy(), *self.all, projected)


@kernel
def energy_around(first, count, step, q, other, kind, stiffness, lengths, stiffening, parts):
    for i in range(first, count, step):
        energy = 0.0
        for s in range(other.shape[0]):
            j = other[s, i]
            if j < 0:
                break
            x, y, z = q[i, 0] - q[j, 0], q[i, 1] - q[j, 1], q[i, 2] - q[j, 2]
            energy += spring_energy(x, y, z, lengths[kind[s, i]], stiffness[s, i], stiffening)
        parts[i] = 0.5 * energy


@kernel
def change_around(first, count, step, q, base, other, kind, stiffness, lengths, stiffening, parts):
    for i in range(first, count, step):
        mx, my, mz = q[i, 0] - base[i, 0], q[i, 1] - base[i, 1], q[i, 2] - base[i, 2]
        change = 0.0
        for s in range(other.shape[0]):
            j = other[s, i]
            if j < 0:
                break
            u, v, w = base[i, 0] - base[j, 0], base[i, 1] - base[j, 1], base[i, 2] - base[j, 2]
            dx, dy, dz = mx - (q[j, 0] - base[j, 0]), my - (q[j, 1] - base[j, 1]), mz - (q[j, 2] - base[j, 2])
            change += spring_change(u, v, w, dx, dy, dz, lengths[kind[s, i]], stiffness[s, i], stiffening)
        parts[i] = 0.5 * change


@kernel
def gradient_around(first, count, step, q, other, kind, stiffness, lengths, stiffening, gradient):
    for i in range(first, count, step):
        gx, gy, gz = 0.0, 0.0, 0.0
        for s in range(other.shape[0]):
            j = other[s, i]
            if j < 0:
                break
            x, y, z = q[i, 0] - q[j, 0], q[i, 1] - q[j, 1], q[i, 2] - q[j, 2]
            f = spring_pull(x, y, z, lengths[kind[s, i]], stiffness[s, i], stiffening)
            gx += f * x
            gy += f * y
            gz += f * z
        gradient[i, 0] += gx
        gradient[i, 1] += gy
        gradient[i, 2] += gz


@kernel
def concavity_around(first, count, step, q, other, kind, stiffness, lengths, stiffening, concavity):
    for i in range(first, count, step):
        total = 0.0
        for s in range(other.shape[0]):
            j = other[s, i]
            if j < 0:
                break
            x, y, z = q[i, 0] - q[j, 0], q[i, 1] - q[j, 1], q[i, 2] - q[j, 2]
            total -= 2.0 * min(spring_pull(x, y, z, lengths[kind[s, i]], stiffness[s, i], stiffening), 0.0)
        concavity[i] += total


@kernel
def product_around(first, count, step, q, other, kind, stiffness, lengths, stiffening, projected, v, product):
    for i in range(first, count, step):
        px, py, pz = 0.0, 0.0, 0.0
        for s in range(other.shape[0]):
            j = other[s, i]
            if j < 0:
                break
            x, y, z = q[i, 0] - q[j, 0], q[i, 1] - q[j, 1], q[i, 2] - q[j, 2]
            c, ex, ey, ez = spring_block(x, y, z, lengths[kind[s, i]], stiffness[s, i], stiffening, projected)
            dx, dy, dz = v[i, 0] - v[j, 0], v[i, 1] - v[j, 1], v[i, 2] - v[j, 2]
            fx, fy, fz = block_product(c, ex, ey, ez, dx, dy, dz)
            px += fx
            py += fy
            pz += fz
        product[i, 0] += px
        product[i, 1] += py
        product[i, 2] += pz
