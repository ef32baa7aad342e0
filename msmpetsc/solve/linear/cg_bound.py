"""What a solve of H x = b by CG leaves of x, bounded by what CG computes anyway.

For any mu that is no greater than the least eigenvalue of P^(-1) H, the Gauss-Radau rule for b^T H^(-1) b gives
|x - x_k|_H^2 <= gamma'_k |r_k|_(P^-1)^2 with gamma'_0 = 1 / mu and
gamma'_(k+1) = (gamma'_k - gamma_k) / (mu (gamma'_k - gamma_k) + delta_(k+1)), where gamma_k is the length of CG's
step k and delta_k = |r_k|^2 / |r_(k-1)|^2 (Meurant and Tichy 2013, Numerical Algorithms 62, 163, "On computing
quadrature-based bounds for the A-norm of the error in conjugate gradients"). By the residual alone the bound is
|r_k|_(P^-1) / sqrt(mu), which is gamma'_k at its greatest.
"""

import numpy as np
from petsc4py import PETSc


class SolveBound:
    """Bound on the error of the solve that a KSP made last: CG from x = 0, in its natural norm."""

    def __init__(self) -> None:
        self.norms: list[float] = []  # |r_k|_(P^-1)
        self.energies: list[float] = []  # b^T x_k, which grows by gamma_k |r_k|^2

    def watch(self, ksp: PETSc.KSP, its: int, norm: float) -> None:
        """Take note of an iteration (a monitor of KSP)."""
        if its == 0:
            self.norms.clear()
            self.energies.clear()
        self.norms.append(norm)
        self.energies.append(0.0 if its == 0 else ksp.getRhs().dot(ksp.getSolution()))

    @property
    def reduction(self) -> float:
        """Of |r|_(P^-1) in that solve, to rounding at the most; 1 where it has not fallen."""
        if not self.norms or self.norms[-1] >= self.norms[0]:
            return 1.0
        return max(self.norms[-1] / self.norms[0], float(np.finfo(float).eps))

    def of(self, least: float) -> float:
        """|x - x_k|_H at most where no eigenvalue of P^(-1) H is below ``least``; infinite where CG shows nothing."""
        if len(self.norms) < 2 or not least > 0:
            return np.inf
        squares = np.square(self.norms)
        bound = 1 / least
        for gained, before, after in zip(
            np.diff(self.energies), squares, squares[1:], strict=False
        ):
            rest = bound - gained / before
            if not rest > 0:  # least is more than the least
                return np.inf
            bound = rest / (least * rest + after / before)
        return float(np.sqrt(bound * squares[-1]))
