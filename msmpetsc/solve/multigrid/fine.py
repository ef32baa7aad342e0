"""The finest level of the cycle: the projected Hessian, spring by spring in single precision, and a block diagonal D
to smooth with, of which it is no more than twice."""

import numpy as np
from petsc4py import PETSc

from msmpetsc.backend.kernel import kernel
from msmpetsc.elasticity.energy import Elasticity, Hessian
from msmpetsc.solve.linear.operators import Viewable
from msmpetsc.solve.linear.unknowns import Unknowns
from msmpetsc.solve.petsc.events import FINE, count_flops

BLOCK = 15  # operations of a product with a 3 x 3 block


class ProjectedHessian(Viewable):
    """H = M + t^2 (projected Hessian of E, and of contact) at the positions that the hierarchy was built at.

    It is positive definite whatever these are (a context of MATPYTHON).

    products : so far
    """

    def __init__(self, unknowns: Unknowns, elasticity: Elasticity, t2: float):
        self.unknowns, self.elasticity, self.t2 = unknowns, elasticity, t2
        lattice = unknowns.lattice
        self.v = np.zeros_like(lattice.nodes, dtype=np.float32)  # pinned nodes stay zero
        self.product = np.empty_like(self.v)
        self.elastic: Hessian | None = None  # until ``update``
        self.products, self.q = 0, lattice.nodes
        self.contact = np.empty((0, 9), like=lattice.nodes)
        self.inverse = np.empty((unknowns.size, 9), np.float32, like=lattice.nodes)

    def update(self, q: np.ndarray, contact: np.ndarray) -> None:
        """Take the Hessian at positions q (l, 3) [m]; ``contact`` (owned, 9), or (0, 9), of the nodes [N/m]."""
        self.elastic, self.q, self.contact = self.elasticity.hessian_at(q, projected=True, dtype=np.float32), q, contact
        unknowns, blocks = self.unknowns, self._half_bound()
        invert_blocks(unknowns.size, blocks, unknowns.free, unknowns.ballast, contact, self.t2, self.inverse)

    def getDiagonal(self, _: PETSc.Mat, diagonal: PETSc.Vec) -> None:
        """Write that of D, for -mg_levels_pc_type jacobi."""
        unknowns, (blocks, contact) = self.unknowns, (self._half_bound(), self.contact)
        acting = blocks[unknowns.free] + (contact[unknowns.free] if len(contact) else 0)
        own = unknowns.ballast[unknowns.free] + self.t2 * acting[:, [0, 4, 8]].T
        unknowns.columns_to_write(diagonal)[:] = own

    def _half_bound(self) -> np.ndarray:
        blocks = np.zeros((len(self.q), 9), like=self.q)
        self.elasticity.add_half_bound(self.q, blocks)
        return blocks

    def mult(self, _: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = H x."""
        assert self.elastic is not None, "the hierarchy was not built"
        self.products += 1
        with FINE:
            self.unknowns.to_nodes(x, self.v)
            self.product[:] = 0
            self.elastic.add_product(self.v, self.product)
            if len(self.contact):
                add_node_blocks(len(self.contact), self.contact, self.v, self.product)
            self.unknowns.scaled_sum(self.v, self.t2, self.product, y)
            count_flops(self.elasticity.flops.product + (BLOCK + 3) * len(self.contact))


class DiagonalBlocks:
    """Inverse of the 3 x 3 diagonal blocks of the finest level (a context of PCPYTHON)."""

    def __init__(self, hessian: ProjectedHessian):
        self.hessian = hessian

    def apply(self, _: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        unknowns = self.hessian.unknowns
        apply_blocks(unknowns.size, unknowns.columns(x), self.hessian.inverse, unknowns.columns_to_write(y))
        count_flops(BLOCK * unknowns.size)

    def view(self, _: PETSc.PC, viewer: PETSc.Viewer) -> None:
        viewer.printfASCII("  the 3 x 3 blocks of each node, inverted\n")


@kernel
def add_node_blocks(first, count, step, blocks, v, product):
    for i in range(first, count, step):
        for r in range(3):
            for c in range(3):
                product[i, r] += blocks[i, 3 * r + c] * v[i, c]


@kernel
def apply_blocks(first, count, step, x, inverse, y):
    for i in range(first, count, step):
        a, b, c = x[0, i], x[1, i], x[2, i]
        for r in range(3):
            y[r, i] = inverse[i, 3 * r] * a + inverse[i, 3 * r + 1] * b + inverse[i, 3 * r + 2] * c


@kernel
def invert_blocks(first, count, step, blocks, free, mass, contact, t2, inverse):
    for i in range(first, count, step):
        node = free[i]
        m, d = mass[node], blocks[node]
        a, b, c = t2 * d[0], t2 * d[1], t2 * d[2]
        e, f, g = t2 * d[4], t2 * d[5], t2 * d[8]
        if len(contact):
            p = contact[node]
            a, b, c, e, f, g = a + t2 * p[0], b + t2 * p[1], c + t2 * p[2], e + t2 * p[4], f + t2 * p[5], g + t2 * p[8]
        a, e, g = a + m, e + m, g + m
        u, v, w = e * g - f * f, c * f - b * g, b * f - c * e
        over = 1.0 / (a * u + b * v + c * w)
        inverse[i, 0], inverse[i, 1], inverse[i, 2] = over * u, over * v, over * w
        inverse[i, 3], inverse[i, 4], inverse[i, 5] = over * v, over * (a * g - c * c), over * (b * c - a * f)
        inverse[i, 6], inverse[i, 7], inverse[i, 8] = over * w, over * (b * c - a * f), over * (a * e - b * b)
