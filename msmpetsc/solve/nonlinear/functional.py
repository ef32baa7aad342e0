"""What one implicit Euler step minimises, its gradient, and how far a gradient is from none.

g(x) = 1/2 (x - y)^T M (x - y) + t^2 (E(x) - x^T f_ext), for implicit Euler y = 2 q_n - q_(n-1) (paper Eq. 10-12);
F(x) = grad g(x) = M (x - y) + t^2 (grad E(x) - f_ext).
"""

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.backend.arrays import greatest
from msmpetsc.model.contact.penalty import Contact
from msmpetsc.model.elasticity import Elasticity
from msmpetsc.solve.linear.unknowns import Unknowns


class StepFunctional:
    """g of the step that ``begin`` was last told of, at vectors of unknowns. All methods are collective.

    q : (l, 3) [m] positions last looked at, ghosts included
    y : (l, 3) [m]
    """

    def __init__(self, comm: MPI.Comm, unknowns: Unknowns, elasticity: Elasticity, time_step: float):
        self.comm, self.unknowns, self.elasticity, self.t2 = comm, unknowns, elasticity, time_step**2
        self.lattice, self.memory = unknowns.lattice, unknowns.memory
        self.q, self.gradient = np.empty_like(self.lattice.nodes), np.empty_like(self.lattice.nodes)
        self.mass = np.tile(self.lattice.mass[unknowns.free], 3)
        self.per_mass = 1 / self.mass

    def begin(
        self, q: np.ndarray, y: np.ndarray, load: np.ndarray, contact: Contact | None, prescribed: np.ndarray | None
    ) -> None:
        """A new step, as Stepper.step takes it."""
        self.y, self.load, self.contact = y, load, contact
        self.q[:] = q if prescribed is None else prescribed  # held nodes stay there
        self.reach = self.comm.allreduce(greatest(np.abs(q)), MPI.MAX)  # [m]

    def gradient_at(self, x: PETSc.Vec, f: PETSc.Vec) -> None:
        """f = F(x) [kg m]."""
        self.unknowns.to_nodes(x, self.q)
        self.gradient[:] = 0
        self.elasticity.add_gradient(self.q, self.gradient)
        owned = self.lattice.owned
        self.gradient[:owned] -= self.load
        if self.contact:
            self.contact.add_gradient(self.q, self.gradient)
        moved = self.q[:owned] - self.y[:owned]
        self.unknowns.scaled_sum(moved, self.t2, self.gradient, f)

    def value(self, q: np.ndarray) -> float:
        """g of positions q (l, 3) but for a constant of the step [kg m^2]: to compare guesses that are far apart."""
        owned = slice(self.lattice.owned)
        moved = q[owned] - self.y[owned]
        acting = self.elasticity.energy(q) - float(np.vdot(moved, self.load))
        if self.contact:
            acting += self.contact.change(q, self.y)
        inertia = 0.5 * self._inner(moved, moved)
        return self.comm.allreduce(inertia + self.t2 * acting)

    def change(self, x: PETSc.Vec, base: np.ndarray) -> tuple[float, float]:
        """g(x) - g(base) [kg m^2] and |x - base|^2 [m^2], base (l, 3); a difference that keeps its digits."""
        self.unknowns.to_nodes(x, self.q)
        owned = slice(self.lattice.owned)
        moved = self.q[owned] - base[owned]
        twice = self.q[owned] + base[owned] - 2 * self.y[owned]
        inertia = 0.5 * self._inner(moved, twice)
        elastic = self.elasticity.change(self.q, base) - float(np.vdot(moved, self.load))
        if self.contact:
            elastic += self.contact.change(self.q, base)
        return tuple(self.comm.allreduce(np.array([inertia + self.t2 * elastic, float(np.vdot(moved, moved))])))

    def _inner(self, a: np.ndarray, b: np.ndarray) -> float:
        """a^T M b of this rank's (owned, 3)."""
        return float(np.vdot(self.lattice.mass[:, None] * a, b))

    def norm(self, displacement: PETSc.Vec) -> float:
        """|v|_M = sqrt(v^T M v)."""
        return np.sqrt(self.comm.allreduce(float(self.memory.read(displacement) ** 2 @ self.mass)))

    def dual_norm(self, f: PETSc.Vec) -> float:
        """|f|_(M^-1); of F it bounds |x - x*|_M where E is convex, for there the Hessian of g is at least M."""
        return np.sqrt(self.comm.allreduce(float(self.memory.read(f) ** 2 @ self.per_mass)))

    def pull(self, f: PETSc.Vec) -> tuple[np.ndarray, np.ndarray]:
        """The free nodes, local numbers, and |F| / m of each [m]: how far each is pulled from where it is."""
        columns = (self.memory.read(f) * self.per_mass).reshape(3, -1)
        return self.unknowns.free, np.sqrt((columns**2).sum(axis=0))

    def away(self, correction: PETSc.Vec | None = None) -> float:
        """|q - e - y|_M over the free nodes, e a ``correction`` of q: what errors of the step are relative to."""
        free = self.unknowns.free
        columns = (self.q[free] - self.y[free]).T.ravel()
        if correction is not None:
            columns -= self.memory.read(correction)
        return np.sqrt(self.comm.allreduce(float(columns**2 @ self.mass)))
