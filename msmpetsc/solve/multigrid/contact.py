"""Contact of the surface with itself in the smoother of the finest level: C = t^2 W^T H_c W, which joins nodes that no
spring does.

A pair that presses is stiff along one direction of some forty unknowns. Diagonal blocks cannot tell that direction from
the others, so that CG has it to find. Here the smoother inverts D + C, D the block diagonal without that contact, by
Woodbury's formula on the points in contact,

    (D + C)^-1 = D^-1 - D^-1 W^T B (I + B^T G B)^-1 B^T W D^-1,      t^2 H_c = B B^T,      G = W D^-1 W^T.

With B from Cholesky's factorisation, pivoted, a direction 1e9 times as stiff as D keeps seven digits of what it gives.

Where H - C is no more than b D, H is no more than b (D + C) for b >= 1, so that Chebyshev's bound stays. Coarse levels
have the diagonal blocks of C: they see it wherever a hierarchy is built, which takes no other matrix then.
"""

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.linalg.lapack import dpstrf

from msmpetsc.backend.arrays import Array, Rows
from msmpetsc.contact.surface.term import SurfaceHessian
from msmpetsc.solve.linear.unknowns import Unknowns


class ContactSmoother:
    """What turns D^-1 x into (D + C)^-1 x (collective).

    inverse : D^-1 (m, 9) of the free nodes [1/kg]
    """

    def __init__(self, unknowns: Unknowns, surface: SurfaceHessian, t2: float, inverse: Array):
        self.comm, self.inverse = unknowns.comm, inverse
        self.at, weights = surface.carried
        self.weights = weights[:, unknowns.free]
        size = surface.points.shape[0]
        compliance, scaled = np.zeros((size, size)), self.weights.copy()
        for r in range(3):
            for c in range(3):
                scaled.data = self.weights.data * inverse[self.weights.indices, 3 * r + c]
                compliance[np.ix_(3 * self.at + r, 3 * self.at + c)] = (self.weights @ scaled.T).toarray()
        compliance = self.comm.allreduce(compliance)
        self.root = root_of(t2 * surface.points.toarray())
        self.factor = cho_factor(np.eye(self.root.shape[1]) + self.root.T @ compliance @ self.root)

    def correct(self, y: Rows) -> None:
        """Turn y = D^-1 x (3, m) into (D + C)^-1 x."""
        moved = np.zeros((len(self.root) // 3, 3))
        moved[self.at] = self.weights @ y.T
        if self.comm.size > 1:
            moved = self.comm.allreduce(moved)
        forces = self.root @ cho_solve(self.factor, self.root.T @ moved.ravel())
        back = self.weights.T @ forces.reshape(-1, 3)[self.at]
        y -= np.einsum("mrc,mc->rm", self.inverse.reshape(-1, 3, 3), back)


def root_of(matrix: Rows) -> Rows:
    """Return B (n, r) with B B^T a positive semidefinite matrix (n, n) of rank r, by pivoted Cholesky."""
    lower, pivots, rank, _ = dpstrf(matrix, lower=1)
    root = np.zeros((len(matrix), rank))
    root[pivots - 1] = np.tril(lower)[:, :rank]
    return root
