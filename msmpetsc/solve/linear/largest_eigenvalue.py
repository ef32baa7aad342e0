"""Largest eigenvalue of a Hessian: of M^(-1) H by power iterations, of D^(-1) H by CG.

The eigenvalue of M^(-1) H limits explicit substeps. The eigenvalue of D^(-1) H scales the smoothers
of multigrid.
"""

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.backend.arrays import Floats, Mask, Positions, like
from msmpetsc.comm import reduced
from msmpetsc.elasticity.energy import Elasticity
from msmpetsc.lattice.lattice import Lattice
from msmpetsc.solve.linear.ghosts import Ghosted

# relative change of omega^2 that ends the power iteration [-]; the safety factor of
# substeps covers the error
SETTLED = 1e-3
# greatest number of power iterations; later steps continue from the mode
MOST_POWER_ITERATIONS = 100


class HighestMode:
    """Compute the largest eigenvalue omega^2 [1/s^2] of M^(-1) (Hessian of E).

    Each power iteration starts from the last mode.

    squared : omega^2, or 0 while it is unknown
    mode    : (l, 3) eigenvector x with |x|_M = 1
    """

    def __init__(self, comm: MPI.Comm, lattice: Lattice, elasticity: Elasticity):
        self.comm, self.lattice, self.elasticity = comm, lattice, elasticity
        self.mode, self.per_mass = Ghosted.of(comm, lattice), 1 / lattice.mass
        self.fixed, self.squared = lattice.fixed[: lattice.owned], 0.0

    def fix(self, fixed: Mask) -> None:
        """Set the fixed components (owned, 3); start from a mixture of all modes (collective)."""
        # The start must not depend on the number of ranks.
        self.fixed = fixed
        numbers = self.lattice.global_numbers[:, None] + np.array([0.1, 0.4, 0.7])
        self.mode.values[:] = like(self.mode.values, np.sin(1e4 * np.sin(numbers)))
        self.mode.values[: self.lattice.owned][fixed] = 0
        self._normalise()
        self.squared = 0.0

    def squared_at(self, q: Positions) -> float:
        """Return omega^2 [1/s^2] of the projected Hessian at q (l, 3) [m] (collective).

        The projection leaves out the negative curvature across compressed springs, which causes no
        oscillation and has no bound.
        """
        x, owned = self.mode.values, self.lattice.owned
        hessian = self.elasticity.hessian_at(q, projected=True)
        product = np.empty_like(q)
        for _ in range(MOST_POWER_ITERATIONS):
            before = self.squared
            product[:] = 0
            hessian.add_product(x, product)
            np.multiply(product[:owned], self.per_mass[:, None], out=x[:owned])
            x[:owned][self.fixed] = 0
            # |M^(-1) H x|_M for |x|_M = 1
            self.squared = self._normalise()
            if not abs(self.squared - before) > SETTLED * self.squared:
                break
        return self.squared

    def _normalise(self) -> float:
        """Scale the mode x to |x|_M = 1, and return |x|_M before the scaling (collective)."""
        x = self.mode.values[: self.lattice.owned]
        size = float(np.sqrt(reduced(self.comm, float(np.vdot(self.lattice.mass[:, None] * x, x)))))
        if size > 0:
            x /= size
        self.mode.update()
        return size

    def destroy(self) -> None:
        """Destroy the PETSc objects of the mode (collective)."""
        self.mode.destroy()


def largest_eigenvalue(
    matrix: PETSc.Mat,
    noise: Floats,
    blocks: object | None = None,
    of_diagonal: PETSc.Mat | None = None,
) -> float:
    """Return an estimate of the largest eigenvalue of D^-1 H by ten CG iterations (collective).

    matrix      : H
    noise       : (n,) random numbers of this rank, from 0 to 1
    blocks      : a context of PCPYTHON that applies D^-1; None if D is the 3 x 3 block diagonal of
                  a matrix
    of_diagonal : the matrix with the block diagonal D; None for H
    """
    x, b = matrix.createVecs()
    b.array[:] = noise - 0.5
    ksp = PETSc.KSP().create(matrix.comm)
    ksp.setType(PETSc.KSP.Type.CG)
    ksp.setOperators(matrix, of_diagonal or matrix)
    ksp.getPC().setType(PETSc.PC.Type.PYTHON if blocks else PETSc.PC.Type.PBJACOBI)
    if blocks:
        ksp.getPC().setPythonContext(blocks)
    ksp.setComputeEigenvalues(True)
    ksp.setTolerances(max_it=10, rtol=np.finfo(float).eps)
    ksp.solve(b, x)
    greatest = float(ksp.computeExtremeSingularValues()[0])
    for owned in (ksp, x, b):
        owned.destroy()
    return greatest
