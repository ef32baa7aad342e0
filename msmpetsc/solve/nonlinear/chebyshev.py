"""Chebyshev's semi-iterative method on the local/global iteration (Wang 2015, A Chebyshev semi-iterative approach
for accelerating position-based and projective dynamics, Eq. 8 and Algorithm 1), as a SNES of type python.

With z = A^(-1) F(x_k) the plain iteration goes to x_k - z, and in the end its error falls by rho an iteration. Here
x_(k+1) = w_(k+1) (x_k - z - x_(k-1)) + x_(k-1): w is 1 in the first iterations, which measure rho, then
2 / (2 - rho^2), then w_(k+1) = 4 / (4 - rho^2 w_k). After the first there are no inner products in it.
"""

from petsc4py import PETSc

PLAIN = 8  # iterations with w = 1
MOST_RHO = 0.995
GROWN = 2.0  # times the least |z| so far: rho was too large, so start again, a little lower
LOWER = 0.9


class Chebyshev:
    """Context of the SNES: PETSc makes it by name, and takes x_k - y for x_(k+1)."""

    def __init__(self) -> None:
        self.last: PETSc.Vec | None = None  # x_k - x_(k-1)
        self.rho = self.w = 0.0
        self._begin(1.0)

    def step(self, snes: PETSc.SNES, x: PETSc.Vec, f: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = w z - (w - 1) (x_k - x_(k-1))."""
        last = self.last = self.last or x.duplicate()
        if snes.its == 0:
            self._begin(1.0)
            last.set(0.0)
        operator, preconditioned = snes.getJacobian()[:2]
        snes.computeJacobian(x, operator, preconditioned)
        snes.ksp.setOperators(operator, preconditioned)
        snes.ksp.solve(f, y)
        w = self._weight(y.norm())
        y.axpby(1 - w, w, last)
        y.copy(last)
        last.scale(-1.0)

    def _begin(self, limit: float) -> None:
        self.count, self.length, self.least, self.limit = 0, 0.0, float("inf"), limit

    def _weight(self, length: float) -> float:
        """w of the next iteration, given |z|."""
        if self.count >= PLAIN and length > GROWN * self.least:
            self._begin(LOWER * self.rho)
        self.count += 1
        if self.count < PLAIN:
            self.rho = min(length / self.length, MOST_RHO, self.limit) if self.length > 0 else 0.0
            self.w = 1.0
        else:
            self.w = 4 / (4 - self.rho**2 * self.w) if self.count > PLAIN else 2 / (2 - self.rho**2)
        self.length, self.least = length, min(length, self.least)
        return self.w

    def destroy(self, _: PETSc.SNES) -> None:
        if self.last is not None:
            self.last.destroy()
