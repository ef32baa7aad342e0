"""Functional that one implicit step minimises, its gradient, norms of both, and what rounding leaves of them.

g(x) = 1/2 (x - y)^T M (x - y) + t^2 (E(x) - x^T f_ext), for implicit Euler y = 2 q_n - q_(n-1)
(paper Eq. 10-12); F(x) = grad g(x) = M (x - y) + t^2 (grad E(x) - f_ext).
"""

import sys
from dataclasses import dataclass

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.backend.arrays import Floats, Indices, Positions, Rows, greatest, like, to_host
from msmpetsc.contact.obstacles.penalty import Contact
from msmpetsc.contact.surface.term import SurfaceContact
from msmpetsc.elasticity.energy import Elasticity
from msmpetsc.errors import InputError, StepFailed
from msmpetsc.lattice.initial_state import uniform
from msmpetsc.solve.linear.unknowns import Unknowns, VectorPool
from msmpetsc.solve.petsc.events import CONTACT, ENERGY, GRADIENT

ROUNDINGS = 3 * np.finfo(float).eps  # of a row of F: in free fall one eps was passed now and then
SINGLE_ROW = 10.0  # times as much in a single row
NEGLIGIBLE = 1e-6  # of the body's size: rounding that moves it less is of no concern
# Greatest coordinates of the body that a load may move a node by: beyond, no digits of its shape are left.
FARTHEST = 1e6
HOPELESS = (
    0.3  # of what its forces move a body: rounding that moves it more leaves no step to speak of
)


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
    """A position of the step, with the residual there.

    x : unknowns; no method writes to them
    q : positions (l, 3) [m], ghosts included
    f : F [kg m]
    """

    x: PETSc.Vec
    q: Positions
    f: PETSc.Vec


class StepFunctional:
    """g of the problem given to ``begin``. All methods are collective.

    Positions are (l, 3) [m], ghosts included; vectors are of unknowns (solve.linear.unknowns).
    """

    def __init__(
        self, comm: MPI.Comm, unknowns: Unknowns, elasticity: Elasticity, time_step: float
    ):
        self.comm, self.unknowns, self.elasticity = comm, unknowns, elasticity
        self.time_step, self.t2 = time_step, time_step**2
        self.lattice, self.memory = unknowns.lattice, unknowns.memory
        self.mass = np.tile(self.lattice.mass[unknowns.free], 3)
        self.per_mass = 1 / self.mass
        nodes = self.lattice.nodes
        self.problem = StepProblem(nodes, nodes, np.zeros((self.lattice.owned, 3), like=nodes))
        self.extent = 0.0  # greatest coordinate of the problem's q [m]
        self.vectors = VectorPool(unknowns)
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

    def evaluate(self, x: PETSc.Vec, f: PETSc.Vec, q: Positions | None = None) -> Iterate:
        """Return the iterate of x; its F is written into f [kg m], and q (l, 3) [m] are its positions if known."""
        problem, gradient, owned = self.problem, self._gradient, self.lattice.owned
        with GRADIENT:
            q = self.positions(x) if q is None else q
            gradient[:] = 0
            self.elasticity.add_gradient(q, gradient)
            gradient[:owned] -= problem.load
            if problem.contact:
                with CONTACT:
                    problem.contact.add_gradient(q, gradient)
            self.unknowns.scaled_sum(q[:owned] - problem.y[:owned], self.t2, gradient, f)
        return Iterate(x, q, f)

    def at(self, q: Positions) -> Iterate:
        """Return the iterate whose free nodes are at q (l, 3) [m]."""
        x = self.vectors.take()
        self.unknowns.from_nodes(q, x)
        return self.iterate(x)

    def iterate(self, x: PETSc.Vec, q: Positions | None = None) -> Iterate:
        """Return the iterate of a vector of the pool, which the iterate keeps; q (l, 3) [m] as in ``evaluate``."""
        iterate = self.evaluate(x, self.vectors.take(), q)
        self.vectors.lend(iterate, iterate.x, iterate.f)
        return iterate

    def value(self, q: Positions, met: bool = False) -> float:
        """g of positions q (l, 3) but for a constant of the step [kg m^2]: to compare guesses that are far apart.

        met : self-contact included, which costs most, and means little where triangles cross
        """
        problem, owned = self.problem, slice(self.lattice.owned)
        moved = q[owned] - problem.y[owned]
        acting = self.elasticity.energy(q) - float(np.vdot(moved, problem.load))
        if problem.contact:
            acting += problem.contact.change_at_nodes(q, problem.y)
            if met and problem.contact.surface:
                acting += problem.contact.surface.change(q, problem.q)
        inertia = 0.5 * self._inner(moved, moved)
        return float(self.comm.allreduce(inertia + self.t2 * acting))

    def change(self, q: Positions, base: Positions) -> tuple[float, float]:
        """g(q) - g(base) [kg m^2] and |q - base|^2 [m^2] of positions (l, 3); a difference that keeps its digits."""
        problem, owned = self.problem, slice(self.lattice.owned)
        with ENERGY:
            moved = q[owned] - base[owned]
            twice = q[owned] + base[owned] - 2 * problem.y[owned]
            inertia = 0.5 * self._inner(moved, twice)
            elastic = self.elasticity.change(q, base) - float(np.vdot(moved, problem.load))
            if problem.contact:
                with CONTACT:
                    elastic += problem.contact.change(q, base)
            change, squared = self.comm.allreduce(
                np.array([inertia + self.t2 * elastic, float(np.vdot(moved, moved))])
            )
        return change, squared

    @property
    def surface(self) -> SurfaceContact | None:
        """What keeps the surface from crossing itself in this step, if anything does."""
        return self.problem.contact.surface if self.problem.contact else None

    def free_share(self, base: Positions, q: Positions, begin: float | None = None) -> float:
        """Share, up to 1, of the straight way from base to q (l, 3) on which the surface meets nothing.

        begin : obstacles go from their place at this time [s] to their present place; None: they stay
        """
        if self.surface is None:
            return 1.0
        with CONTACT:
            return self.surface.contacts.free_share(base, q, begin)

    def noise(self, count: int) -> Rows:
        """Random numbers (count, n) in [-1/2, 1/2), the same for any number of ranks."""
        lattice, free = self.lattice, to_host(self.unknowns.free)
        numbers = lattice.global_numbers[: lattice.owned][free]
        seeds = lattice.table.total * np.arange(count)
        return like(
            self.mass, np.stack([uniform(numbers + seed).T.ravel() - 0.5 for seed in seeds])
        )

    def _inner(self, a: Rows, b: Rows) -> float:
        """a^T M b of this rank's (owned, 3); 0 in an equilibrium."""
        return float(np.vdot(self.unknowns.inertia[:, None] * a, b))

    def norm(self, displacement: PETSc.Vec) -> float:
        """|v|_M = sqrt(v^T M v)."""
        return float(
            np.sqrt(self.comm.allreduce(float(self.memory.read(displacement) ** 2 @ self.mass)))
        )

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


class Rounding:
    """Rounding in the steps of one lattice and time step: nothing is known better, and no error is smaller.

    All methods are collective.

    diagonal : (m,) of each free node of this rank: its inertia, and t^2 times how stiff it is at rest [kg]
    """

    def __init__(self, functional: StepFunctional, diagonal: Floats):
        self.functional, self.comm, self.diagonal = functional, functional.comm, diagonal
        self.rows = np.tile(ROUNDINGS * diagonal, 3)  # of F [kg m] for each metre of a coordinate
        stiffness, mass = self.comm.allreduce(
            np.array([3 * float(diagonal.sum()), float(functional.mass.sum())])
        )
        # Springs or cells whose forces are k eps off move nodes by no more than sqrt(sum t^2 k) eps in the norm of H
        # where that is positive definite, and in that of M no farther; the diagonal is no less than the sum.
        self.moved, self.size = float(ROUNDINGS * np.sqrt(stiffness)), float(np.sqrt(mass))

    def refuse_loads(self) -> None:
        """Raise InputError for loads of the step that move a node farther than numbers can follow (collective)."""
        functional = self.functional
        load = np.sqrt((functional.problem.load[functional.unknowns.free] ** 2).sum(axis=1))
        local = np.array([greatest(load), functional.t2 * greatest(load / self.diagonal)])
        most, moved = np.max(self.comm.allgather(local), axis=0)
        if moved > FARTHEST * functional.extent:
            raise InputError(
                f"loads of up to {most:.2g} N on a node would move it by {moved:.2g} m in a step, of a body that "
                f"reaches {functional.extent:.2g} m: check gravity, force and their units"
            )

    def is_all_of(self, iterate: Iterate, contact: Contact | None) -> bool:
        """Return whether F is nothing but rounding, row by row, for soft parts have less of it than stiff ones.

        contact : as stiff as it is at the iterate; None to leave it out, which costs less
        """
        functional, known = self.functional, self.rows
        if contact:
            known = known + np.tile(
                ROUNDINGS * functional.t2 * contact.bound(iterate.q)[functional.unknowns.free], 3
            )
        rows = np.abs(functional.memory.read(iterate.f)) / (
            known * max(functional.extent, np.finfo(float).tiny)
        )
        squares, count = self.comm.allreduce(np.array([float(rows @ rows), rows.size]))
        return bool(squares <= count and self.comm.allreduce(greatest(rows), MPI.MAX) <= SINGLE_ROW)

    @property
    def reach(self) -> float:
        """How far rounding moves the body at the most, in the norm of M."""
        return self.moved * self.functional.extent

    def relative(self, length: float, distance: float) -> float:
        """Return |e|_M over |x - y|_M, which is known no better than rounding leaves it."""
        return length / max(distance, self.reach, sys.float_info.min)

    def added_to(self, error: float, away: float, is_rounding: bool = False) -> float:
        """A relative error of a step that took x ``away`` = |x - y|_M from y, or what rounding makes of it if that is
        more; where nothing moves but by rounding, that is relative to the size of the body.

        is_rounding : F has nothing else left, which then is what made the error

        Raises StepFailed where rounding moves the body about as far as its forces do.
        """
        extent = self.functional.extent
        moved, size = self.reach, self.size * extent
        if moved > max(NEGLIGIBLE * size, HOPELESS * away):
            raise StepFailed(
                f"cannot be solved in double precision: rounding in the stiffest springs moves the body by "
                f"{moved / self.size:.1e} m, its forces by {away / self.size:.1e} m; try softer materials, less "
                "different ones, or a smaller time.step",
                "rounding",
            )
        if is_rounding and HOPELESS * away < error * away <= NEGLIGIBLE * size:
            moved = error * away  # a body at rest
        if not away > moved / HOPELESS:
            return moved / max(size, sys.float_info.min)
        return max(error, moved / away)
