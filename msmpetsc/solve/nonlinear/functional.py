"""Functional that one implicit step minimises, its gradient, and norms of both.

g(x) = 1/2 (x - y)^T M (x - y) + t^2 (E(x) - x^T f_ext), for implicit Euler y = 2 q_n - q_(n-1)
(paper Eq. 10-12); F(x) = grad g(x) = M (x - y) + t^2 (grad E(x) - f_ext).
"""

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.backend.arrays import Floats, Indices, Positions, Rows, greatest
from msmpetsc.contact.obstacles.penalty import Contact
from msmpetsc.contact.surface.term import SurfaceContact
from msmpetsc.elasticity.energy import Elasticity
from msmpetsc.solve.linear.unknowns import Unknowns
from msmpetsc.solve.petsc.events import CONTACT, ENERGY, GRADIENT, count_flops


@dataclass(frozen=True)
class StepProblem:
    """Data of one implicit step.

    prescribed : q_n with the anchored nodes where they will be (l, 3) [m]; None if they stay
    rates      : what those of a viscous solid are of, (l, 3) [m] each (elasticity.viscosity.Viscosity.begin)
    """

    q: Positions  # q_n (l, 3) [m], ghosts included
    y: Positions  # where the nodes would be without forces (l, 3) [m]
    load: Rows  # f_ext (owned, 3) [N]
    contact: Contact | None = None  # penalties that press on the nodes in this step
    prescribed: Positions | None = None
    rates: tuple[Positions, Positions] | None = None

    @property
    def fixed(self) -> Positions:
        """Positions (l, 3) [m] whose rows of fixed nodes hold at the end of the step."""
        return self.q if self.prescribed is None else self.prescribed


@dataclass(frozen=True)
class Iterate:
    """Point of a solver: its positions q (l, 3) [m], ghosts included, and F there [kg m]."""

    q: Positions
    f: PETSc.Vec


class StepFunctional:
    """g of the problem given to ``begin``. All methods are collective.

    Positions are (l, 3) [m], ghosts included; vectors are of unknowns (solve.linear.unknowns).
    """

    def __init__(self, comm: MPI.Comm, unknowns: Unknowns, elasticity: Elasticity, time_step: float):
        self.comm, self.unknowns, self.elasticity = comm, unknowns, elasticity
        self.time_step, self.t2 = time_step, time_step**2
        self.lattice, self.memory = unknowns.lattice, unknowns.memory
        self.mass = np.tile(self.lattice.mass[unknowns.free], 3)
        self.per_mass = 1 / self.mass
        nodes = self.lattice.nodes
        self.problem = StepProblem(nodes, nodes, np.zeros((self.lattice.owned, 3), like=nodes))
        self.extent = 0.0  # greatest coordinate of the problem's q [m]
        self._gradient = np.empty_like(nodes)

    def begin(self, problem: StepProblem) -> None:
        """Take the data of a new step."""
        self.problem = problem
        if self.elasticity.viscosity and problem.rates:
            self.elasticity.viscosity.begin(*problem.rates)
        self.extent = self.comm.allreduce(greatest(np.abs(problem.q)), MPI.MAX)

    def positions(self, x: PETSc.Vec) -> Positions:
        """Positions (l, 3) [m] of unknowns x, the fixed nodes where the problem has them."""
        q = self.problem.fixed.copy()
        self.unknowns.to_nodes(x, q)
        return q

    def evaluate(self, x: PETSc.Vec, f: PETSc.Vec) -> Iterate:
        """Positions of x, and F there, written into f [kg m]."""
        problem, gradient, owned = self.problem, self._gradient, self.lattice.owned
        with GRADIENT:
            q = self.positions(x)
            gradient[:] = 0
            self.elasticity.add_gradient(q, gradient)
            gradient[:owned] -= problem.load
            if problem.contact:
                with CONTACT:
                    problem.contact.add_gradient(q, gradient)
            self.unknowns.scaled_sum(q[:owned] - problem.y[:owned], self.t2, gradient, f)
            count_flops(self.elasticity.flops.gradient)
        return Iterate(q, f)

    def value(self, q: Positions, met: bool = False) -> float:
        """g of positions q (l, 3) but for a constant of the step [kg m^2]: to compare guesses that are far apart.

        met : self-contact included, which has a value only where no two triangles cross
        """
        problem, owned = self.problem, slice(self.lattice.owned)
        moved = q[owned] - problem.y[owned]
        acting = self.elasticity.energy(q) - float(np.vdot(moved, problem.load))
        if problem.contact:
            acting += problem.contact.change_at_nodes(q, problem.y)
            if met and problem.contact.surface:
                acting += problem.contact.surface.change(q, problem.q)
        inertia = 0.5 * self._inner(moved, moved)
        return self.comm.allreduce(inertia + self.t2 * acting)

    def change(self, q: Positions, base: Positions) -> tuple[float, float]:
        """g(q) - g(base) [kg m^2] and |q - base|^2 [m^2] of positions (l, 3); a difference that keeps its digits."""
        problem, owned = self.problem, slice(self.lattice.owned)
        with ENERGY:
            moved = q[owned] - base[owned]
            twice = q[owned] + base[owned] - 2 * problem.y[owned]
            inertia = 0.5 * self._inner(moved, twice)
            elastic = self.elasticity.change(q, base) - float(np.vdot(moved, problem.load))
            count_flops(self.elasticity.flops.change)
            if problem.contact:
                with CONTACT:
                    elastic += problem.contact.change(q, base)
            change, squared = self.comm.allreduce(np.array([inertia + self.t2 * elastic, float(np.vdot(moved, moved))]))
        return change, squared

    @property
    def surface(self) -> SurfaceContact | None:
        """What keeps the surface from crossing itself in this step, if anything does."""
        return self.problem.contact.surface if self.problem.contact else None

    def free_share(self, base: Positions, q: Positions) -> float:
        """Share, up to 1, of the straight way from base to q (l, 3) on which the surface does not meet itself."""
        if self.surface is None:
            return 1.0
        with CONTACT:
            return self.surface.contacts.free_share(base, q)

    def _inner(self, a: Rows, b: Rows) -> float:
        """a^T M b of this rank's (owned, 3); 0 in an equilibrium."""
        return float(np.vdot(self.unknowns.inertia[:, None] * a, b))

    def norm(self, displacement: PETSc.Vec) -> float:
        """|v|_M = sqrt(v^T M v)."""
        return float(np.sqrt(self.comm.allreduce(float(self.memory.read(displacement) ** 2 @ self.mass))))

    def dual_norm(self, f: PETSc.Vec) -> float:
        """|f|_(M^-1); of F it bounds |x - x*|_M where E is convex, for there the Hessian of g is at least M."""
        return float(np.sqrt(self.comm.allreduce(float(self.memory.read(f) ** 2 @ self.per_mass))))

    def pull(self, f: PETSc.Vec) -> tuple[Indices, Floats]:
        """The free nodes, local numbers, and |F| / m of each [m]: how far each is pulled from where it is."""
        columns = (self.memory.read(f) * self.per_mass).reshape(3, -1)
        return self.unknowns.free, np.sqrt((columns**2).sum(axis=0))

    def distance(self, q: Positions, correction: PETSc.Vec | None = None) -> float:
        """|q - e - y|_M over the free nodes, e a ``correction`` of q: what errors of the step are relative to."""
        columns = np.empty_like(self.mass)
        self.unknowns.collect(q - self.problem.y, columns.reshape(3, -1))
        if correction is not None:
            columns -= self.memory.read(correction)
        columns *= columns
        return float(np.sqrt(self.comm.allreduce(float(columns @ self.mass))))
