"""Elastic energy of linear springs, its gradient and its Hessian (paper Eq. 13-15).

A spring of length l, rest length r and stiffness k has the energy 1/2 k (l - r)^2.

Positions are local, (l, 3) [m]: owned nodes first, then ghosts. A rank has every spring of its
owned nodes, so gradients and products are complete in the owned rows. The rows of ghosts are
incomplete.

``SpringScatter``, the faster loop on a CPU, visits each spring once and adds to both ends.
``SpringGather``, the loop for a GPU, runs a thread per node that sums over the node's springs. No
two threads write to the same row, so the sums are reproducible to the last bit. The gather loop
stores no Hessian blocks, because positions take less memory traffic than the blocks of 26 springs.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from msmpetsc.backend.arrays import Array, Floats, Indices, Positions, Rows, like, on_host, to_host
from msmpetsc.backend.kernel import kernel, njit
from msmpetsc.elasticity.cell_strain import Four
from msmpetsc.elasticity.vectors import Vector, added, dot, vector
from msmpetsc.lattice.lattice import Lattice, Springs

# product(v, result) adds (Hessian) v [N] to ``result``
Product = Callable[[Array, Array], None]

# index of each entry of a symmetric 3 x 3 block in its upper triangle [-]
SYMMETRIC = np.array([0, 1, 2, 1, 3, 4, 2, 4, 5])
# smallest length to divide by [m]; a spring of zero length then has no force
TINY = 1e-300


@njit()
def force_density(e: Vector, r: float, k: float) -> float:
    """Return the force density f = k (1 - r / |e|) [N/m]: grad E is f e at the end of e."""
    return k * (1.0 - r / max(math.sqrt(dot(e, e)), TINY))


@njit()
def spring_block(spring: Vector, r: float, k: float, projected: bool) -> Four:
    """Return c [N/m] and e [sqrt(N/m)] of a spring's Hessian c I + e e^T.

    The eigenvalues are k along the spring and k (1 - r / l) across it, with l the spring's length.
    If ``projected``, the negative eigenvalue of a compressed spring is set to zero.
    """
    length = math.sqrt(max(dot(spring, spring), TINY))
    across = 1.0 - r / length
    if projected:
        across = max(across, 0.0)
    along = math.sqrt(k * (1.0 - across)) / length
    return k * across, along * spring[0], along * spring[1], along * spring[2]


@njit()
def block_product(c: float, e: Vector, d: Vector) -> Vector:
    """Return (c I + e e^T) d."""
    along = dot(e, d)
    return c * d[0] + along * e[0], c * d[1] + along * e[1], c * d[2] + along * e[2]


def springs_of(lattice: Lattice, first: int | None = None) -> Springs:
    """Return the first ``first`` springs of a lattice, or all, on the device of its nodes."""
    arrays = lattice.springs, lattice.rest_length, lattice.stiffness
    return Springs(*(like(lattice.nodes, array[:first]) for array in arrays))


def crushing_energy(lattice: Lattice) -> float:
    """Return the energy [J] that compresses every spring of this rank to zero length.

    For a solid, return the energy of the quadratic form L as every cell is compressed to a point.
    """
    if lattice.solid:
        return float(1.5 * lattice.solid.bounds[: lattice.cells_owned].sum())
    springs = slice(lattice.springs_owned)
    return float(0.5 * lattice.stiffness[springs] @ lattice.rest_length[springs] ** 2)


@kernel
def _elastic_change(
    first: int, count: int, step: int, sums: Floats, springs: Springs, path: tuple[Rows, Rows]
) -> None:
    """Write E(base + moved) - E(base) [J] to ``sums``, with E = 1/2 k (|e| - r)^2 (Eq. 13).

    The change of |e| from e to e' = e + d, d . (e' + e) / (|e'| + |e|), is accurate for a small d.

    path : ``moved`` and ``base``, (l, 3) [m]
    """
    ends, rest_length, stiffness = springs
    moved, base = path
    change = 0.0
    for s in range(first, count, step):
        before = vector(base, ends[s, 1], ends[s, 0])
        # The difference of two springs would lose the digits of a small displacement.
        d = vector(moved, ends[s, 1], ends[s, 0])
        e = added(before, d)
        lengths = math.sqrt(dot(e, e)) + math.sqrt(dot(before, before))
        elongation = dot(d, added(e, before)) / max(lengths, TINY)
        change += 0.5 * stiffness[s] * elongation * (lengths - 2.0 * rest_length[s])
    if first < count:
        sums[first] = change


@dataclass(frozen=True)
class OwnedSprings:
    """The springs that a rank owns, and their energy."""

    owned: Springs

    def change(self, q: Positions, base: Positions) -> float:
        """Return E(q) - E(base) [J] of the owned springs.

        The change is summed spring by spring, so a small change keeps its digits.
        """
        ends = self.owned.ends
        count = len(ends)
        sums = np.zeros(1 if on_host(ends) else count, like=ends, dtype=float)
        _elastic_change(count, sums, self.owned, (q - base, base))
        return float(sums.sum())


@dataclass(frozen=True)
class SpringScatter(OwnedSprings):
    """Spring forces and Hessians on a CPU: a loop over springs that adds to both ends.

    springs : the springs around the owned nodes; the springs that the rank owns come first
    """

    springs: Springs

    @classmethod
    def of_lattice(cls, lattice: Lattice) -> "SpringScatter":
        """Return the springs of a lattice whose arrays are in CPU memory."""
        return cls(springs_of(lattice, lattice.springs_owned), springs_of(lattice))

    def add_gradient(self, q: Positions, gradient: Rows) -> None:
        """Add grad E [N] to ``gradient`` (l, 3)."""
        add_elastic_gradient(q, self.springs, gradient)

    def add_concavity(self, q: Positions, concavity: Floats) -> None:
        """Add the bound of ``add_spring_concavity`` to ``concavity`` (l,) [N/m]."""
        add_spring_concavity(q, self.springs, concavity)

    def hessian_at(self, q: Positions, projected: bool, dtype: type = np.float64) -> Product:
        """Return the product with the Hessian of E at q, from stored blocks of type ``dtype``."""
        blocks: Rows = np.empty((len(self.springs.ends), 4), dtype)
        elastic_hessian(q, self.springs, projected, blocks)
        return partial(add_elastic_product, self.springs.ends, blocks)

    def add_bound(self, q: Positions, blocks: Rows) -> None:
        """Add the springs' part of Elasticity.add_bound to ``blocks`` (l, 9) [N/m]."""
        add_elastic_diagonal(q, self.springs, blocks)


@njit()
def add_elastic_gradient(q: Positions, springs: Springs, gradient: Rows) -> None:
    """Add grad E = L x - J d(x) [N] (Eq. 14-15) to ``gradient`` (l, 3)."""
    ends, rest_length, stiffness = springs
    for s in range(len(ends)):
        a = ends[s, 0]
        b = ends[s, 1]
        e = vector(q, b, a)
        f = force_density(e, rest_length[s], stiffness[s])
        gradient[a, 0] += f * e[0]
        gradient[a, 1] += f * e[1]
        gradient[a, 2] += f * e[2]
        gradient[b, 0] -= f * e[0]
        gradient[b, 1] -= f * e[1]
        gradient[b, 2] -= f * e[2]


@njit()
def add_spring_concavity(q: Positions, springs: Springs, concavity: Floats) -> None:
    """Add 2 |c| of each compressed spring to ``concavity`` (l,) [N/m] at both ends.

    c I + e e^T is the spring's Hessian. For c < 0 and d = v_a - v_b it has the lower bound
    c |d|^2 + (e . d)^2 >= -2 |c| (|v_a|^2 + |v_b|^2).
    """
    ends, rest_length, stiffness = springs
    for s in range(len(ends)):
        e = vector(q, ends[s, 1], ends[s, 0])
        bound = -2.0 * min(force_density(e, rest_length[s], stiffness[s]), 0.0)
        # A branch around a zero bound would take longer than the addition.
        concavity[ends[s, 0]] += bound
        concavity[ends[s, 1]] += bound


@njit()
def elastic_hessian(q: Positions, springs: Springs, projected: bool, blocks: Rows) -> None:
    """Write c and e of ``spring_block`` at q for each spring into ``blocks`` (s, 4).

    projected : leave out negative eigenvalues, so that the Hessian is positive semidefinite
    """
    ends, rest_length, stiffness = springs
    for s in range(len(ends)):
        e = vector(q, ends[s, 1], ends[s, 0])
        block = spring_block(e, rest_length[s], stiffness[s], projected)
        for i in range(4):
            blocks[s, i] = block[i]


@njit()
def add_elastic_diagonal(q: Positions, springs: Springs, blocks: Rows) -> None:
    """Add the diagonal blocks of the projected Hessian of E at q to ``blocks`` (l, 9) [N/m]."""
    ends, rest_length, stiffness = springs
    for s in range(len(ends)):
        e = vector(q, ends[s, 1], ends[s, 0])
        c, ex, ey, ez = spring_block(e, rest_length[s], stiffness[s], True)
        for end in range(2):
            add_block(blocks[ends[s, end]], c, 1.0, (ex, ey, ez))


@njit()
def add_elastic_product(ends: Indices, blocks: Rows, v: Rows, product: Rows) -> None:
    """Add (Hessian of E) v [N] to ``product`` (l, 3), from the ``blocks`` of ``elastic_hessian``.

    Springs with the same first end are consecutive, so its row is read and written once.
    """
    # A zero of v's own type keeps single precision single.
    zero = v.dtype.type(0)
    first, x, y, z, sx, sy, sz = -1, zero, zero, zero, zero, zero, zero
    for s in range(len(ends)):
        a = ends[s, 0]
        b = ends[s, 1]
        if a != first:
            if first >= 0:
                product[first, 0] += sx
                product[first, 1] += sy
                product[first, 2] += sz
            first, x, y, z, sx, sy, sz = a, v[a, 0], v[a, 1], v[a, 2], zero, zero, zero
        d = x - v[b, 0], y - v[b, 1], z - v[b, 2]
        fx, fy, fz = block_product(blocks[s, 0], (blocks[s, 1], blocks[s, 2], blocks[s, 3]), d)
        sx += fx
        sy += fy
        sz += fz
        product[b, 0] -= fx
        product[b, 1] -= fy
        product[b, 2] -= fz
    if first >= 0:
        product[first, 0] += sx
        product[first, 1] += sy
        product[first, 2] += sz


@njit()
def add_block(block: Floats, c: float, factor: float, g: Vector) -> None:
    """Add c I + factor g g^T to a block (9,)."""
    for row in range(3):
        for column in range(3):
            block[3 * row + column] += factor * g[row] * g[column] + c * (row == column)


class Around(NamedTuple):
    """The springs of each owned node: the arrays have a column per node.

    neighbour : (w, owned) int32, local number of the node at the other end, -1 past the last spring
    kind      : (w, owned) u1, index of the rest length in ``lengths``
    stiffness : (w, owned) [N/m]
    lengths   : (k,) distinct rest lengths [m]
    """

    neighbour: Indices
    kind: Array
    stiffness: Floats
    lengths: Floats


class AroundAt(NamedTuple):
    """The springs of each owned node at positions q (l, 3) [m], as kernels take them.

    projected : leave out the negative eigenvalues of the Hessian
    """

    around: Around
    q: Positions
    projected: bool = True


@dataclass(frozen=True)
class SpringGather(OwnedSprings):
    """Spring forces and Hessians on a GPU: a thread per node sums over the node's springs."""

    around: Around

    @classmethod
    def of_lattice(cls, lattice: Lattice) -> "SpringGather":
        """Return the springs of a lattice, on the device of its nodes."""
        springs = to_host(lattice.springs)
        ends = np.concatenate([springs, springs[:, ::-1]])
        rows = rows_of(ends[:, 0], lattice.owned)
        lengths, kind = np.unique(to_host(lattice.rest_length), return_inverse=True)
        neighbour = np.append(ends[:, 1], -1).astype(np.int32)[rows]
        kinds = np.append(np.tile(kind, 2), 0).astype(np.uint8)[rows]
        stiffness = np.append(np.tile(to_host(lattice.stiffness), 2), 0.0)[rows]
        sent = partial(like, lattice.nodes)
        around = Around(sent(neighbour), sent(kinds), sent(stiffness), sent(lengths))
        return cls(springs_of(lattice, lattice.springs_owned), around)

    def _sum_around(self, loop: Callable[..., None], rows: Array, q: Positions) -> None:
        loop(self.around.neighbour.shape[1], rows, AroundAt(self.around, q))

    def add_gradient(self, q: Positions, gradient: Rows) -> None:
        """Add grad E [N] to the owned rows of ``gradient``."""
        self._sum_around(_gradient_around, gradient, q)

    def add_concavity(self, q: Positions, concavity: Floats) -> None:
        """Add the bound of ``add_spring_concavity`` to the owned rows (l,) [N/m]."""
        self._sum_around(_concavity_around, concavity, q)

    def hessian_at(self, q: Positions, projected: bool, _: type = np.float64) -> Product:
        """Return the product with the Hessian of E at q, for the owned rows. Only q is stored."""
        springs = AroundAt(self.around, q.copy(), projected)
        count = self.around.neighbour.shape[1]
        return lambda v, product: _product_around(count, product, springs, v)

    def add_bound(self, q: Positions, blocks: Rows) -> None:
        """Add the springs' part of Elasticity.add_bound to the owned rows (l, 9) [N/m]."""
        self._sum_around(_diagonal_around, blocks, q)


def rows_of(nodes: Indices, owned: int) -> Indices:
    """Return the indices (w, owned) at which each owned node occurs in ``nodes`` (n,).

    w is at least 8. A column is filled up with n after the node's last occurrence.
    """
    by_node = np.argsort(nodes, kind="stable")
    by_node = by_node[: np.searchsorted(nodes[by_node], owned)]
    node = nodes[by_node]
    slot = np.arange(len(node)) - np.searchsorted(node, node)
    rows = np.full((max(int(slot.max(initial=0)) + 1, 8), owned), len(nodes))
    rows[slot, node] = by_node
    return rows


@kernel
def _gradient_around(first: int, count: int, step: int, gradient: Rows, springs: AroundAt) -> None:
    (neighbour, kind, stiffness, lengths), q, _ = springs
    for i in range(first, count, step):
        gx, gy, gz = 0.0, 0.0, 0.0
        for s in range(neighbour.shape[0]):
            j = neighbour[s, i]
            if j < 0:
                break
            e = vector(q, j, i)
            f = force_density(e, lengths[kind[s, i]], stiffness[s, i])
            gx += f * e[0]
            gy += f * e[1]
            gz += f * e[2]
        gradient[i, 0] += gx
        gradient[i, 1] += gy
        gradient[i, 2] += gz


@kernel
def _concavity_around(
    first: int, count: int, step: int, concavity: Floats, springs: AroundAt
) -> None:
    (neighbour, kind, stiffness, lengths), q, _ = springs
    for i in range(first, count, step):
        total = 0.0
        for s in range(neighbour.shape[0]):
            j = neighbour[s, i]
            if j < 0:
                break
            total -= 2.0 * min(
                force_density(vector(q, j, i), lengths[kind[s, i]], stiffness[s, i]), 0.0
            )
        concavity[i] += total


@kernel
def _product_around(
    first: int, count: int, step: int, product: Rows, springs: AroundAt, v: Rows
) -> None:
    (neighbour, kind, stiffness, lengths), q, projected = springs
    for i in range(first, count, step):
        px, py, pz = 0.0, 0.0, 0.0
        for s in range(neighbour.shape[0]):
            j = neighbour[s, i]
            if j < 0:
                break
            length, k = lengths[kind[s, i]], stiffness[s, i]
            c, ex, ey, ez = spring_block(vector(q, j, i), length, k, projected)
            f = block_product(c, (ex, ey, ez), vector(v, j, i))
            px += f[0]
            py += f[1]
            pz += f[2]
        product[i, 0] += px
        product[i, 1] += py
        product[i, 2] += pz


@kernel
def _diagonal_around(first: int, count: int, step: int, blocks: Rows, springs: AroundAt) -> None:
    (neighbour, kind, stiffness, lengths), q, _ = springs
    for i in range(first, count, step):
        for s in range(neighbour.shape[0]):
            j = neighbour[s, i]
            if j < 0:
                break
            length, k = lengths[kind[s, i]], stiffness[s, i]
            c, ex, ey, ez = spring_block(vector(q, j, i), length, k, True)
            add_block(blocks[i], c, 1.0, (ex, ey, ez))
