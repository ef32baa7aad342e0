"""Contact of surfaces in the multigrid cycle, which couples nodes on the finest and coarsest level.

An active contact pair is stiff in a single direction of about forty unknowns, and stacked bodies
move together. Diagonal blocks represent neither, because they act as springs to the ground.
"""

from itertools import zip_longest

import numpy as np
from scipy.linalg import solve_triangular
from scipy.linalg.lapack import dpstrf
from scipy.sparse import csr_array, eye_array, kron

from msmpetsc.backend.arrays import Array, Rows
from msmpetsc.comm import reduced
from msmpetsc.contact.surface.surface_contact import SurfaceHessian
from msmpetsc.solve.linear.unknowns import Unknowns
from msmpetsc.solve.multigrid.interpolation import Interpolation


class ContactSmoother:
    """Smoother of the finest level with contact C = t^2 W^T H_c W between nodes.

    D is the block diagonal without C. The smoother inverts D + C by Woodbury's formula on the
    points in contact:

        (D + C)^-1 = D^-1 - D^-1 W^T B (I + B^T G B)^-1 B^T W D^-1
        t^2 H_c = B B^T,    G = W D^-1 W^T

    The pivoted Cholesky factor B keeps seven digits in a direction 1e9 times as stiff as D. If
    H - C <= b D with b >= 1, then H <= b (D + C). Therefore Chebyshev's bound b remains valid.

    inverse : (m, 9) D^-1 [1/kg] of the free nodes
    nodes   : (c,) free nodes that carry the k points in contact
    weights : (k, c) interpolation W from nodes to points
    middle  : (3k, 3k) B (I + B^T G B)^-1 B^T
    """

    def __init__(self, unknowns: Unknowns, surface: SurfaceHessian, t2: float, inverse: Array):
        self.comm = unknowns.comm
        weights = surface.weights[:, unknowns.free]
        self.nodes = np.unique(weights.indices)
        self.weights = csr_array(weights[:, self.nodes])
        self.inverse = inverse[self.nodes].reshape(-1, 3, 3)
        self.back = csr_array(self.weights.T)
        size = surface.points.shape[0]
        compliance, scaled = np.zeros((size, size)), self.weights.copy()
        for r in range(3):
            for c in range(3):
                scaled.data = self.weights.data * self.inverse[self.weights.indices, r, c]
                compliance[r::3, c::3] = (self.weights @ scaled.T).toarray()
        compliance = reduced(self.comm, compliance)
        root = root_of(t2 * surface.points.toarray())
        lower = np.linalg.cholesky(np.eye(root.shape[1]) + root.T @ compliance @ root)
        root = solve_triangular(lower, root.T, lower=True, check_finite=False)
        self.middle = root.T @ root

    def correct(self, y: Rows) -> None:
        """Change y (3, m) from D^-1 x to (D + C)^-1 x (collective)."""
        moved = self.weights @ y[:, self.nodes].T
        if self.comm.size > 1:
            moved = reduced(self.comm, moved)
        back = self.back @ (self.middle @ moved.ravel()).reshape(-1, 3)
        y[:, self.nodes] -= np.einsum("mrc,mc->rm", self.inverse, back)


def root_of(matrix: Rows) -> Rows:
    """Return the factor B (n, r) of a positive semidefinite matrix B B^T (n, n) of rank r."""
    lower, pivots, rank, _ = dpstrf(matrix, lower=1)
    root = np.zeros((len(matrix), rank))
    root[pivots - 1] = np.tril(lower)[:, :rank]
    return root


def coarse_contact(
    weights: csr_array,
    surface: SurfaceHessian,
    interpolations: list[Interpolation],
    t2: float,
    blocks: list[Rows],
) -> csr_array:
    """Return this rank's rows of contact C = t^2 (W P)^T H_c (W P) on the coarsest level.

    The levels between the finest and the coarsest get only the diagonal blocks of C, so that their
    nonzeros do not change. The function is collective.

    weights        : W of the free nodes
    interpolations : P from each coarse level to the next finer level
    blocks         : diagonal blocks (n, 9) of each level except the coarsest, to which C is added
    """
    for p, diagonal in zip_longest(interpolations, blocks):
        # The order of the ranks makes the sum reproducible.
        whole = sum(surface.comm.allgather(weights @ p.rows()))
        weights = csr_array(whole[:, p.first : p.first + p.own])
        if diagonal is not None:
            own = SurfaceHessian(surface.comm, weights, surface.points)
            diagonal += t2 * own.blocks
    wide = kron(whole, eye_array(3), "csr")
    return csr_array(t2 * kron(weights, eye_array(3), "csr").T @ (surface.points @ wide))
