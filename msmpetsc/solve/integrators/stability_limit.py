"""The highest frequency of a lattice: what limits explicit steps."""

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import like
from msmpetsc.elasticity.energy import Elasticity
from msmpetsc.lattice.lattice import Lattice
from msmpetsc.solve.linear.ghosted import Ghosted

SETTLED = 1e-3  # relative change of omega^2 by which the power iteration ends
MOST_ITERATIONS = 100


class HighestMode:
    """The mode of the greatest eigenvalue omega^2 [1/s^2] of M^(-1) (Hessian of E), by power iterations that go on
    from the mode found last. ``squared`` is that omega^2, 0 while it is not known."""

    def __init__(self, comm: MPI.Comm, lattice: Lattice, elasticity: Elasticity):
        self.comm, self.lattice, self.elasticity = comm, lattice, elasticity
        self.mode, self.per_mass = Ghosted(comm, lattice), 1 / lattice.mass
        self.fixed, self.squared = lattice.pinned[: lattice.owned], 0.0

    def hold(self, fixed: np.ndarray) -> None:
        """Know the ``fixed`` nodes (owned,) bool, and begin with something of every mode, whatever the number of
        ranks."""
        self.fixed = fixed
        numbers = self.lattice.global_numbers[:, None] + np.array([0.1, 0.4, 0.7])
        self.mode.values[:] = like(self.mode.values, np.sin(1e4 * np.sin(numbers)))
        self.mode.values[: self.lattice.owned][fixed] = 0
        self._normalise()
        self.squared = 0.0

    def squared_at(self, q: np.ndarray) -> float:
        """omega^2 of the springs at q (l, 3) [m] (collective).

        Without the negative curvature across pressed springs, which is no oscillation and has no bound.
        """
        x, owned = self.mode.values, self.lattice.owned
        hessian, product = self.elasticity.hessian_at(q, projected=True), np.empty_like(q)
        for _ in range(MOST_ITERATIONS):
            before = self.squared
            product[:] = 0
            hessian.add_product(x, product)
            np.multiply(product[:owned], self.per_mass[:, None], out=x[:owned])
            x[:owned][self.fixed] = 0
            self.squared = self._normalise()  # |M^(-1) H x|_M for |x|_M = 1
            if not abs(self.squared - before) > SETTLED * self.squared:
                break
        return self.squared

    def _normalise(self) -> float:
        """Make |x|_M = 1; returns what it was (collective)."""
        x = self.mode.values[: self.lattice.owned]
        size = np.sqrt(self.comm.allreduce(float(np.vdot(self.lattice.mass[:, None] * x, x))))
        if size > 0:
            x /= size
        self.mode.update()
        return size

    def destroy(self) -> None:
        """Collective."""
        self.mode.destroy()


def explicit_limit(comm: MPI.Comm, lattice: Lattice, elasticity: Elasticity) -> float:
    """2 / omega [s] at rest: explicit steps are stable below it (collective)."""
    highest = HighestMode(comm, lattice, elasticity)
    highest.hold(lattice.pinned[: lattice.owned])
    squared = highest.squared_at(lattice.nodes)
    highest.destroy()
    return 2 / np.sqrt(squared) if squared > 0 else np.inf
