"""Upper bound on the error of a CG solve of H x = b, from the coefficients of CG.

If mu is at most the smallest eigenvalue of P^(-1) H, the Gauss-Radau rule for b^T H^(-1) b gives

    |x - x_k|_H^2 <= gamma'_k |r_k|_(P^-1)^2,    gamma'_0 = 1 / mu,
    gamma'_(k+1) = (gamma'_k - gamma_k) / (mu (gamma'_k - gamma_k) + delta_(k+1)).

Here gamma_k is the length of CG's step k, and delta_k = |r_k|^2 / |r_(k-1)|^2. Source: Meurant and
Tichy, "On computing quadrature-based bounds for the A-norm of the error in conjugate gradients",
Numerical Algorithms 62, 163 (2013). The residual alone gives the weaker bound
|r_k|_(P^-1) / sqrt(mu).
"""

import numpy as np
from petsc4py import PETSc


class SolveBound:
    """Bound the error of the last solve of a KSP: CG from x = 0 in its natural norm.

    norms    : |r_k|_(P^-1) of the iterations
    energies : b^T x_k of the iterations, which grow by gamma_k |r_k|^2
    """

    def __init__(self) -> None:
        self.norms: list[float] = []
        self.energies: list[float] = []

    def watch(self, ksp: PETSc.KSP, its: int, norm: float) -> None:
        """Record an iteration (a KSP monitor)."""
        if its == 0:
            self.norms.clear()
            self.energies.clear()
        self.norms.append(norm)
        self.energies.append(0.0 if its == 0 else ksp.getRhs().dot(ksp.getSolution()))

    @property
    def reduction(self) -> float:
        """Return the reduction of |r|_(P^-1), at least the machine epsilon and at most 1."""
        if not self.norms or self.norms[-1] >= self.norms[0]:
            return 1.0
        return max(self.norms[-1] / self.norms[0], float(np.finfo(float).eps))

    def of(self, least: float) -> float:
        """Return a bound on |x - x_k|_H, or infinity if CG gives no bound.

        least : lower bound of the eigenvalues of P^(-1) H
        """
        if len(self.norms) < 2 or not least > 0:
            return np.inf
        squares = np.square(self.norms)
        bound = 1 / least
        for gained, before, after in zip(
            np.diff(self.energies), squares, squares[1:], strict=False
        ):
            rest = bound - gained / before
            # ``least`` is above the smallest eigenvalue.
            if not rest > 0:
                return np.inf
            bound = rest / (least * rest + after / before)
        return float(np.sqrt(bound * squares[-1]))
