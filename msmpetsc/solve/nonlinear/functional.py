"""Functional g that one implicit step minimises, its gradient F, norms, and the rounding of F.

    g(x) = 1/2 (x - y)^T M (x - y) + t^2 (E(x) - x^T f_ext)
    F(x) = grad g(x) = M (x - y) + t^2 (grad E(x) - f_ext)

Implicit Euler has y = 2 q_n - q_(n-1) (paper Eq. 10-12).
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from msmpetsc.backend.arrays import Floats, Indices, Positions, Rows, greatest, like, to_host
from msmpetsc.comm import reduced
from msmpetsc.contact.step_contact import StepContact, StepContactAt
from msmpetsc.contact.surface.surface_contact import SurfaceContact
from msmpetsc.elasticity.energy import Elasticity
from msmpetsc.errors import InputError, StepFailed
from msmpetsc.lattice.initial_state import uniform
from msmpetsc.solve.linear.unknowns import Unknowns, VectorPool
from msmpetsc.solve.petsc.events import CONTACT, ENERGY, GRADIENT

# Rounding of a row of F [terms of the row]; free fall exceeds one eps now and then
ROUNDINGS = 3 * np.finfo(float).eps
# Greatest displacement by rounding that is negligible [body's size]
NEGLIGIBLE = 1e-6
# Rounding of y, a sum of positions of earlier steps [rounding of x]
OF_HISTORY = 10.0
# Displacement by a load beyond which no digits of the body's shape are left [body's
# greatest coordinate]
FARTHEST = 1e6


@dataclass(frozen=True)
class StepProblem:
    """Data of an implicit step.

    q          : q_n (l, 3) [m], ghosts included
    y          : positions (l, 3) [m] of the nodes after the step without forces
    load       : f_ext (owned, 3) [N]
    contact    : contact energy of this step; None without contact
    prescribed : q_n with anchored nodes at their places after the step (l, 3) [m]; None if anchored
                 nodes stay
    rates      : x^ of a viscous solid, and the positions that rotate its K, both (l, 3) [m]
                 (elasticity.viscosity.Viscosity.begin); None if the solid is not viscous
    pressures  : pressures on the lattice's surfaces [Pa]
    system_monitor : called with the first iterate of a solve and its Jacobian; None for no call
    """

    q: Positions
    y: Positions
    load: Rows
    contact: StepContact | None = None
    prescribed: Positions | None = None
    rates: tuple[Positions, Positions] | None = None
    pressures: tuple[float, ...] = ()
    system_monitor: Callable[[Any, Any], None] | None = None

    @property
    def fixed_positions(self) -> Positions:
        """Positions (l, 3) [m] with fixed nodes at their places after the step."""
        return self.q if self.prescribed is None else self.prescribed


@dataclass(frozen=True)
class Configuration:
    """Positions in a step, with the contact there.

    q       : positions (l, 3) [m], ghosts included
    contact : contact at q; None without contact
    """

    q: Positions
    contact: StepContactAt | None


@dataclass(frozen=True)
class Iterate(Configuration):
    """Iterate of a step: a configuration with its unknowns and residual.

    x : unknowns; no method writes to them
    f : F [kg m]
    """

    x: PETSc.Vec
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
        nodes = self.lattice.nodes
        self.problem = StepProblem(nodes, nodes, np.zeros((self.lattice.owned, 3), like=nodes))
        # Greatest coordinate of the problem's q [m]
        self.extent = 0.0
        self.vectors = VectorPool(unknowns)
        # Memory for gradients and for products with the Hessian, which are read at once
        self.scratch = np.empty_like(nodes)

    def begin(self, problem: StepProblem) -> None:
        """Take the data of a new step."""
        self.problem = problem
        if self.elasticity.viscosity and problem.rates:
            self.elasticity.viscosity.begin(*problem.rates)
        if self.elasticity.pressures and problem.pressures:
            self.elasticity.pressures.values = problem.pressures
        self.extent = reduced(self.comm, greatest(np.abs(problem.q)), MPI.MAX)

    def positions(self, x: PETSc.Vec) -> Positions:
        """Return positions (l, 3) [m] of unknowns x, with fixed nodes at their places."""
        q = self.problem.fixed_positions.copy()
        self.unknowns.to_nodes(x, q)
        return q

    def configuration(self, q: Positions) -> Configuration:
        """Return the configuration of positions q (l, 3) [m]."""
        if not self.problem.contact:
            return Configuration(q, None)
        with CONTACT:
            return Configuration(q, self.problem.contact.at(q))

    def evaluate(
        self, x: PETSc.Vec, f: PETSc.Vec, configuration: Configuration | None = None
    ) -> Iterate:
        """Return the iterate of x and write its F into f [kg m].

        configuration : configuration of x if it is known
        """
        problem, gradient, owned = self.problem, self.scratch, self.lattice.owned
        with GRADIENT:
            configuration = configuration or self.configuration(self.positions(x))
            q = configuration.q
            gradient[:] = 0
            self.elasticity.add_gradient(q, gradient)
            gradient[:owned] -= problem.load
            if configuration.contact:
                with CONTACT:
                    configuration.contact.add_gradient(gradient)
            self.unknowns.scaled_sum(q[:owned] - problem.y[:owned], self.t2, gradient, f)
        return Iterate(q, configuration.contact, x, f)

    def at(self, q: Positions) -> Iterate:
        """Return the iterate whose free nodes are at q (l, 3) [m]."""
        x = self.vectors.take()
        self.unknowns.from_nodes(q, x)
        return self.iterate(x)

    def iterate(self, x: PETSc.Vec, configuration: Configuration | None = None) -> Iterate:
        """Return the iterate of x, a vector of the pool that the iterate keeps.

        configuration : configuration of x if it is known
        """
        iterate = self.evaluate(x, self.vectors.take(), configuration)
        self.vectors.lend(iterate, iterate.x, iterate.f)
        return iterate

    def value(self, q: Positions) -> float:
        """Return g [kg m^2] at positions q (l, 3) [m], up to a constant of the step.

        The value is for a comparison of guesses that are far apart. Surface contact is left out: it
        costs most and means little if triangles cross.
        """
        problem, owned = self.problem, slice(self.lattice.owned)
        moved = q[owned] - problem.y[owned]
        acting = self.elasticity.energy(q) - float(np.vdot(moved, problem.load))
        if problem.contact:
            acting += problem.contact.energy(q)
            acting += problem.contact.change_of_friction(q, problem.y)
        inertia = 0.5 * self._inner(moved, moved)
        return float(reduced(self.comm, inertia + self.t2 * acting))

    def change(self, configuration: Configuration, base: Configuration) -> tuple[float, float]:
        """Return the change of g [kg m^2] from a base to a configuration, and |q - q_base|^2 [m^2].

        Differences are summed term by term, so that a small change keeps its digits.
        """
        problem, owned = self.problem, slice(self.lattice.owned)
        q, before = configuration.q, base.q
        with ENERGY:
            moved = q[owned] - before[owned]
            twice = q[owned] + before[owned] - 2 * problem.y[owned]
            inertia = 0.5 * self._inner(moved, twice)
            elastic = self.elasticity.change(q, before) - float(np.vdot(moved, problem.load))
            if configuration.contact and base.contact:
                with CONTACT:
                    elastic += configuration.contact.change(base.contact)
            change, squared = reduced(
                self.comm, [inertia + self.t2 * elastic, float(np.vdot(moved, moved))]
            )
        return change, squared

    @property
    def surface(self) -> SurfaceContact | None:
        """Contact of the surface with itself and obstacles in this step; None without it."""
        return self.problem.contact.surface if self.problem.contact else None

    def collision_free_step(
        self, base: Positions, q: Positions, begin: float | None = None
    ) -> float:
        """Return the collision-free step length, at most 1, on the path from base to q (l, 3) [m].

        begin : time [s] from which obstacles move to their present places; None if they stay
        """
        if self.surface is None:
            return 1.0
        with CONTACT:
            return self.surface.contacts.collision_free_step(base, q, begin)

    def noise(self, count: int) -> Rows:
        """Return random numbers (count, n) in [-1/2, 1/2), the same for any number of ranks."""
        lattice, free = self.lattice, to_host(self.unknowns.free)
        numbers = lattice.global_numbers[: lattice.owned][free]
        seeds = lattice.table.total * np.arange(count)
        noise = [uniform(numbers + seed).T.ravel() - 0.5 for seed in seeds]
        return self.unknowns.projected(like(self.mass, np.stack(noise)))

    def _inner(self, a: Rows, b: Rows) -> float:
        """Return this rank's part of a^T M b for a and b (owned, 3); 0 in statics."""
        return float(np.vdot(self.unknowns.inertia[:, None] * a, b))

    def norm(self, displacement: PETSc.Vec) -> float:
        """Return |v|_M = sqrt(v^T M v)."""
        return float(np.sqrt(reduced(self.comm, self._square(displacement))))

    def dual_norm(self, f: PETSc.Vec) -> float:
        """Return |f|_(M^-1).

        |F|_(M^-1) bounds |x - x*|_M if E is convex, because the Hessian of g is then at least M.
        """
        return float(np.sqrt(reduced(self.comm, self._dual_square(f))))

    def norms(self, displacement: PETSc.Vec, f: PETSc.Vec) -> tuple[float, float]:
        """Return |v|_M and |f|_(M^-1), with a single sum over the ranks."""
        own = np.array([self._square(displacement), self._dual_square(f)])
        of_v, of_f = np.sqrt(reduced(self.comm, own))
        return float(of_v), float(of_f)

    def _square(self, displacement: PETSc.Vec) -> float:
        return float(self.memory.read(displacement) ** 2 @ self.mass)

    def _dual_square(self, f: PETSc.Vec) -> float:
        return float((self.memory.read(f) ** 2 / self.mass).sum())

    def pull(self, f: PETSc.Vec) -> tuple[Indices, Floats]:
        """Return the local numbers of the free nodes (m,), and |F| / m [m] of each node (m,)."""
        columns = (self.memory.read(f) / self.mass).reshape(3, -1)
        return self.unknowns.free, np.sqrt((columns**2).sum(axis=0))

    def distance(self, q: Positions, correction: PETSc.Vec | None = None) -> float:
        """Return |q - e - y|_M over the free nodes: errors of the step are relative to this length.

        correction : e; None for 0
        """
        columns = np.empty_like(self.mass)
        self.unknowns.collect(q - self.problem.y, columns.reshape(3, -1))
        if correction is not None:
            columns -= self.memory.read(correction)
        columns *= columns
        return float(np.sqrt(reduced(self.comm, float(columns @ self.mass))))


class Rounding:
    """Estimate of errors by rounding, in the steps of one lattice and time step.

    All methods are collective.

    diagonal : (m,) inertia of this rank's free nodes plus t^2 times their stiffness at rest [kg]
    """

    def __init__(self, functional: StepFunctional, diagonal: Floats):
        self.functional, self.comm, self.diagonal = functional, functional.comm, diagonal
        # Rounding of the rows of F [kg m] per metre of a coordinate
        self.rows = np.tile(ROUNDINGS * diagonal, 3)
        stiffness, mass = reduced(
            self.comm, [3 * float(diagonal.sum()), float(functional.mass.sum())]
        )
        # An error of eps k in the forces moves nodes by at most eps sqrt(sum of t^2 k).
        # This holds in the norm of a positive definite H, and so in the norm of M. The
        # diagonal is no less than t^2 k.
        self.moved, self.size = float(ROUNDINGS * np.sqrt(stiffness)), float(np.sqrt(mass))

    def refuse_loads(self) -> None:
        """Raise InputError for loads that move a node so far that the shape has no digits."""
        functional = self.functional
        load = np.sqrt((functional.problem.load[functional.unknowns.free] ** 2).sum(axis=1))
        local = np.array([greatest(load), functional.t2 * greatest(load / self.diagonal)])
        most, moved = reduced(self.comm, local, MPI.MAX)
        if moved > FARTHEST * functional.extent:
            raise InputError(
                f"loads of up to {most:.2g} N on a node would move it by {moved:.2g} m in a step, "
                f"of a body that reaches {functional.extent:.2g} m: "
                "check gravity, force and their units"
            )

    def explains(self, iterate: Iterate) -> bool:
        """Return whether F is rounding alone.

        Each row counts by its own rounding, since soft parts have less rounding than stiff parts.
        Then the mean square of all rows decides.
        """
        functional, known = self.functional, self.rows
        if iterate.contact:
            bound = iterate.contact.bound()[functional.unknowns.free]
            known = known + np.tile(ROUNDINGS * functional.t2 * bound, 3)
        rows = np.abs(functional.memory.read(iterate.f)) / (
            known * max(functional.extent, np.finfo(float).tiny)
        )
        squares, count = reduced(self.comm, [float(rows @ rows), rows.size])
        return bool(squares <= count)

    @property
    def displacement(self) -> float:
        """Greatest displacement by rounding, in the norm of M [m sqrt(kg)]."""
        return self.moved * self.functional.extent

    def relative(self, length: float, distance: float) -> float:
        """Return length / distance, with a distance at least the displacement by rounding.

        length, distance : |e|_M of an error and |x - y|_M [m sqrt(kg)]
        """
        return length / max(distance, self.displacement, sys.float_info.min)

    def step_error(self, error: float, away: float, is_rounding: bool = False) -> float:
        """Return the relative error of a step: ``error``, or the error by rounding if greater.

        If rounding alone moves the body, the error is relative to the body's size.

        away        : |x - y|_M of the step [m sqrt(kg)]
        is_rounding : whether F is rounding alone, so that the error comes from rounding

        Raises StepFailed if rounding moves the body about as far as its forces do.
        """
        extent = self.functional.extent
        moved, size = self.displacement, self.size * extent
        if moved > max(NEGLIGIBLE * size, away):
            raise StepFailed(
                f"cannot be solved in double precision: rounding in the stiffest springs moves the "
                f"body by {moved / self.size:.1e} m, its forces by {away / self.size:.1e} m; "
                "try softer materials, less different ones, or a smaller time.step",
                "rounding",
            )
        if is_rounding and away < error * away <= NEGLIGIBLE * size:
            # The body is at rest
            moved = error * away
        if not away > OF_HISTORY * moved:
            return moved / max(size, sys.float_info.min)
        return max(error, moved / away)
