"""Finest level of multigrid: the matrix-free projected Hessian, and its diagonal blocks."""

from typing import NamedTuple

import numpy as np
from petsc4py import PETSc

from msmpetsc.backend.arrays import Array, Indices, Mask, Positions, Rows
from msmpetsc.backend.kernel import kernel
from msmpetsc.contact.surface.surface_contact import SurfaceHessian
from msmpetsc.elasticity.energy import Elasticity, Hessian
from msmpetsc.solve.linear.unknowns import Unknowns
from msmpetsc.solve.multigrid.contact import ContactSmoother
from msmpetsc.solve.multigrid.galerkin import DIAGONAL, UPPER
from msmpetsc.solve.petsc.events import FINE


class ProjectedHessian:
    """Apply H = M + t^2 (projected Hessian of E and of contact) (a context of MATPYTHON).

    H belongs to the positions of the last ``update`` and is positive definite.

    products   : number of products so far
    diagonal   : (m, 6) upper triangles of D without contact [kg]
    inverse    : (m, 9) D^-1 with contact of nodes [1/kg], zero in fixed components
    moves      : (m, 3) bool, the components that are not fixed
    contact    : (owned, 9) or (0, 9) diagonal blocks of contact [N/m]
    touched    : nodes with contact
    joined     : surface contact that couples nodes; None without it
    compliance : (owned,) estimated compliance of a node at rest [m/N]
    """

    def __init__(self, unknowns: Unknowns, elasticity: Elasticity, t2: float):
        self.unknowns, self.elasticity, self.t2 = unknowns, elasticity, t2
        lattice = unknowns.lattice
        # The rows of pinned nodes stay zero.
        self.v = np.zeros_like(lattice.nodes, dtype=np.float32)
        self.product = np.empty_like(self.v)
        self.elastic: Hessian | None = None
        self.products = 0
        self.contact = np.empty((0, 9), like=lattice.nodes)
        self.touched = np.flatnonzero(self.contact)
        self.diagonal = np.empty((0, 6), like=lattice.nodes)
        self.inverse = np.empty((unknowns.size, 9), np.float32, like=lattice.nodes)
        self.moves = ~lattice.fixed[unknowns.free]
        blocks = np.zeros((len(lattice.nodes), 9), like=lattice.nodes)
        elasticity.add_bound(lattice.nodes, blocks)
        self.compliance = 1 / (
            unknowns.ballast / t2 + blocks[: lattice.owned, [0, 4, 8]].sum(axis=1) / 3
        )
        self.joined: SurfaceHessian | None = None
        self.smoother: ContactSmoother | None = None

    def update(self, q: Positions, contact: Rows, joined: SurfaceHessian | None = None) -> None:
        """Compute H and D^-1 at positions q (l, 3) [m].

        contact : (owned, 9) or (0, 9) diagonal blocks of contact [N/m]
        joined  : surface contact that couples nodes; None without it
        """
        # Free the memory of the old Hessian before the new Hessian takes memory
        self.elastic = None
        self.elastic = self.elasticity.hessian_at(q, projected=True, dtype=np.float32)
        self.joined = joined
        blocks = np.zeros((len(q), 9), like=q)
        self.elasticity.add_bound(q, blocks)
        free = self.unknowns.free
        self.diagonal = self.t2 * blocks[free][:, UPPER]
        self.diagonal[:, DIAGONAL] += self.unknowns.ballast[free][:, None]
        self.take_contact(contact)
        self.smoother = (
            ContactSmoother(self.unknowns, joined, self.t2, self.inverse) if joined else None
        )

    def take_contact(self, contact: Rows) -> None:
        """Replace the diagonal blocks of contact, (owned, 9) or (0, 9) [N/m]."""
        self.contact, unknowns = contact, self.unknowns
        self.touched = np.flatnonzero(contact.any(axis=1))
        nodes = FreeNodes(unknowns.free, self.moves, contact, self.t2)
        invert_blocks(unknowns.size, self.inverse, self.diagonal, nodes)

    def mult(self, _: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Write H x to y."""
        assert self.elastic is not None, "the hierarchy was not built"
        self.products += 1
        with FINE:
            self.unknowns.to_nodes(x, self.v)
            self.product[:] = 0
            self.elastic.add_product(self.v, self.product)
            if len(self.touched):
                add_node_blocks(len(self.touched), self.touched, self.contact, self.v, self.product)
            if self.joined:
                self.joined.add_product(self.v, self.product)
            self.unknowns.scaled_sum(self.v, self.t2, self.product, y)


class DiagonalBlocks:
    """Apply the inverse of D + C, the finest level's blocks and surface contact (for PCPYTHON)."""

    def __init__(self, hessian: ProjectedHessian):
        self.hessian = hessian

    def apply(self, _: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        unknowns, smoother = self.hessian.unknowns, self.hessian.smoother
        columns = unknowns.columns_to_write(y)
        apply_blocks(unknowns.size, unknowns.columns(x), self.hessian.inverse, columns)
        if smoother:
            smoother.correct(columns)

    def view(self, _: PETSc.PC, viewer: PETSc.Viewer) -> None:
        viewer.printfASCII("  the 3 x 3 blocks of each node, inverted\n")


@kernel
def add_node_blocks(
    first: int, count: int, step: int, nodes: Indices, blocks: Rows, v: Array, product: Array
) -> None:
    for at in range(first, count, step):
        i = nodes[at]
        for r in range(3):
            for c in range(3):
                product[i, r] += blocks[i, 3 * r + c] * v[i, c]


@kernel
def apply_blocks(first: int, count: int, step: int, x: Rows, inverse: Array, y: Rows) -> None:
    for i in range(first, count, step):
        a, b, c = x[0, i], x[1, i], x[2, i]
        for r in range(3):
            y[r, i] = inverse[i, 3 * r] * a + inverse[i, 3 * r + 1] * b + inverse[i, 3 * r + 2] * c


class FreeNodes(NamedTuple):
    """Free nodes and their contact.

    free    : (m,) numbers of the free nodes
    moves   : (m, 3) bool, the components that are not fixed
    contact : (owned, 9) or (0, 9) diagonal blocks of contact [N/m]
    t2      : t^2 [s^2]
    """

    free: Indices
    moves: Mask
    contact: Rows
    t2: float


@kernel
def invert_blocks(
    first: int, count: int, step: int, inverse: Array, diagonal: Rows, nodes: FreeNodes
) -> None:
    """Write the inverse (m, 9) of the blocks D + t^2 contact, over components that are not fixed.

    diagonal : (m, 6) upper triangles of D without contact [kg]
    """
    free, moves, contact, t2 = nodes
    for i in range(first, count, step):
        a, b, c = diagonal[i, 0], diagonal[i, 1], diagonal[i, 2]
        e, f, g = diagonal[i, 3], diagonal[i, 4], diagonal[i, 5]
        if len(contact):
            p = contact[free[i]]
            a, b, c = a + t2 * p[0], b + t2 * p[1], c + t2 * p[2]
            e, f, g = e + t2 * p[4], f + t2 * p[5], g + t2 * p[8]
        x, y, z = moves[i]
        b, c, f = x * y * b, x * z * c, y * z * f
        u, v, w = e * g - f * f, c * f - b * g, b * f - c * e
        over = 1.0 / (a * u + b * v + c * w)
        inverse[i, 0], inverse[i, 1], inverse[i, 2] = x * over * u, over * v, over * w
        inverse[i, 3], inverse[i, 4], inverse[i, 5] = (
            over * v,
            y * over * (a * g - c * c),
            over * (b * c - a * f),
        )
        inverse[i, 6], inverse[i, 7], inverse[i, 8] = (
            over * w,
            over * (b * c - a * f),
            z * over * (a * e - b * b),
        )
