"""Velocity Verlet: take a step t of the scene in N substeps dt below the stability limit.

Each substep kicks, drifts and kicks, with a = M^(-1) (f_ext - grad E), contact included:

    v_(n+1/2) = v_n + dt/2 a(q_n)
    q_(n+1)   = q_n + dt v_(n+1/2)
    v_(n+1)   = v_(n+1/2) + dt/2 a(q_(n+1))

Adjacent half kicks are merged, except at the ends of a step, so that a frame has q and v of the
same time. A kick has the mean of f_ext over its duration. The method is stable if dt < 2 / omega,
with omega^2 the largest eigenvalue of M^(-1) (Hessian of E).

This limit holds for small oscillations only (scripts/docs/pages/integrators.md). A step that raises
omega beyond it is repeated with shorter substeps.
"""

import sys
from itertools import pairwise
from typing import ClassVar

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Floats, Mask, Positions, Rows, greatest
from msmpetsc.backend.kernel import kernel
from msmpetsc.checkpoint import Checkpoint, Range
from msmpetsc.comm import log, reduced
from msmpetsc.contact.obstacles.node_friction import Movers
from msmpetsc.contact.obstacles.reflection import StepTaken
from msmpetsc.contact.step_contact import StepContactAt
from msmpetsc.elasticity.energy import Elasticity
from msmpetsc.elasticity.springs import crushing_energy
from msmpetsc.environment import Environment
from msmpetsc.errors import StepFailed
from msmpetsc.scene.schema import Solver
from msmpetsc.scene.time import Time
from msmpetsc.solve.integrators.integrator import Integrator, State
from msmpetsc.solve.linear.ghosts import Ghosted
from msmpetsc.solve.linear.largest_eigenvalue import HighestMode
from msmpetsc.solve.nonlinear.step import StepResult
from msmpetsc.solve.work import Work

# length of a substep [stability limit]; the Hessian changes within a step
SAFETY = 0.8
# greatest number of repetitions of a step; bounds the cost of an unstable step
RETRIES = 4
# greatest number of substeps in a step; more would take hours
MOST_SUBSTEPS = 1e6
# least elastic energy of an unstable body [energy that crushes all springs]; no load
# reaches it
UNSTABLE = 100.0


class Verlet(Integrator):
    """Take steps by the velocity Verlet method; ``time.substep`` may only shorten its substeps.

    gradient : (l, 3) grad E [N], contact included
    contact  : contact at the present positions; None without contact
    work     : work [J] of obstacles, loads and anchors on this rank's nodes in a step
    end      : end time of the step [s]
    known    : positions (l, 3) [m] of ``gradient`` and of the highest frequency
    """

    state: ClassVar[dict[str, Range]] = {"substep": (sys.float_info.min, np.inf)}

    def __init__(
        self, comm: MPI.Comm, environment: Environment, time: Time, _: Solver, _prefix: str
    ):
        self.comm, self.lattice, self.environment = comm, environment.lattice, environment
        self.time_step, self.substep = time.step, time.substep or np.inf
        self.elasticity = Elasticity(self.lattice)
        self.position, self.velocity = (
            Ghosted.of(comm, self.lattice),
            Ghosted.of(comm, self.lattice),
        )
        self.highest = HighestMode(comm, self.lattice, self.elasticity)
        owned = self.lattice.owned
        self.q, self.v = self.position.values[:owned], self.velocity.values[:owned]
        self.gradient, self.per_mass = np.zeros_like(self.lattice.nodes), 1 / self.lattice.mass
        self.contact: StepContactAt | None = None
        self.sides = environment.obstacles.no_sides[:, :owned]
        self.load = np.zeros((owned, 3), like=self.lattice.nodes)
        self.damping = environment.damping
        self.work = self.end = 0.0
        self.known: Floats | None = None
        self.anchors: int | None = None
        self._fix(environment.anchors.fixed_at(self.time_step)[:owned])
        self.unstable_energy = UNSTABLE * reduced(comm, crushing_energy(self.lattice))

    def save(self, checkpoint: Checkpoint) -> None:
        checkpoint.keep_counts(self)
        self.known = self.anchors = None

    def restore(self, checkpoint: Checkpoint, time: float) -> None:
        checkpoint.restore_counts(self)

    def advance(self, state: State, time: float) -> tuple[StepResult, State]:
        """Take the step that ends at ``time`` [s] (collective). Raises StepFailed.

        If an impact has stiffened the body so that the substeps were too long, the step is repeated
        with shorter substeps.
        """
        start, self.end = time - self.time_step, time
        self.environment.forces.begin_step(state.q, state.velocity(self.time_step), start)
        self._begin(state, start)
        contact_bound = self._contact_bound(start, time)
        squared = contact_bound + (
            self.highest.squared or self.highest.squared_at(self.position.values)
        )
        for _ in range(1 + RETRIES):
            count = self._count(squared)
            dt = self.time_step / count
            self.load = self._mean_load(start, start + 0.5 * dt)
            squared_start = self._squared_acceleration()
            # An overflow shows in the energy below.
            with np.errstate(over="ignore", invalid="ignore"):
                self._take_substeps(count, start, time)
            energy = reduced(self.comm, self.elasticity.energy(self.position.values))
            after = np.inf
            if energy <= self.unstable_energy:
                after = contact_bound + self.highest.squared_at(self.position.values)
            if dt**2 * after <= 4:
                return self._result(
                    count, dt**2 / 8 * (self._squared_acceleration() - squared_start)
                )
            squared = np.clip(after, 2 * squared, 16 * squared)
            self._begin(state, start)
        raise StepFailed(
            f"became unstable: elastic energy {energy:.2e} J after substeps of {dt:.2e} s; "
            "try a smaller time.step, a softer material, or implicit-euler",
            "unstable",
        )

    def _begin(self, state: State, start: float) -> None:
        """Set positions, velocities and forces to a state at time ``start`` [s] (collective)."""
        self.velocity.values[:] = (state.q - state.q_previous) / self.time_step
        self._update_fixed(start)
        self.work = 0.0
        if state.q is not self.known:
            self.position.values[:] = state.q
            before = state.sides
            if before is not None:
                before = before[:, : self.lattice.owned]
            self.sides = self.environment.obstacles.contact_faces(
                self.q, self.q, start, 0.0, before, self.fixed.all(axis=1)
            )
            self._update_gradient(start)
            self.highest.squared = 0.0

    def _take_substeps(self, count: int, start: float, time: float) -> None:
        """Take ``count`` equal substeps from ``start`` to ``time`` [s] (collective)."""
        self.known = None
        times = np.linspace(start, time, 1 + count).tolist()
        duration = 0.5 * (times[1] - start)
        for begin, end in pairwise(times):
            self._kick(begin, duration, begin, end)
            before, fixed = self.q.copy(), self.fixed
            self._drift(begin, end)
            moved, fixed = self.q - before, fixed | self.fixed
            self._count_work(moved, fixed)
            self.work += self.environment.obstacles.energy_of_new_obstacles(
                self.q, begin, end, self.sides
            )
            self._update_gradient(end)
            duration = end - begin
            kicked = min(end + 0.5 * duration, time)
            self.load = self._mean_load(end - 0.5 * duration, kicked)
            self._count_work(moved, fixed)
        self._kick(time, 0.5 * duration, begin, time)

    def _count_work(self, moved: Rows, fixed: Mask) -> None:
        """Add half the work [J] of the present loads and anchors.

        moved : (owned, 3) displacements of the substep [m]
        fixed : (owned, 3) bool, components that anchors move against all forces
        """
        forces = np.where(fixed, self.gradient[: self.lattice.owned], self.load)
        self.work += 0.5 * float(np.vdot(forces, moved))

    def _squared_acceleration(self) -> float:
        """Return |M^(-1) (f_ext - grad E)|_M^2 [J/s^2] of this rank's free nodes."""
        force = self.load - self.gradient[: self.lattice.owned]
        return float(self.per_mass @ (~self.fixed * force**2).sum(axis=1))

    def _result(self, count: int, swing: float) -> tuple[StepResult, State]:
        """Return the result of a step of ``count`` substeps, and the state after it (collective).

        swing : known oscillation of this rank's energy over the step [J]
        """
        self.velocity.update()
        self.known = self.position.values.copy()
        previous = self.known - self.time_step * self.velocity.values
        cost = Work(iterations=count, steps=1)
        result = StepResult(self.known, previous, cost, self.work, explicit=True, swing=swing)
        return result, State(self.known, previous, sides=self.sides)

    def _update_gradient(self, time: float) -> None:
        """Compute the gradient of elastic and contact energy at the present positions."""
        self.gradient[:] = 0
        self.elasticity.add_gradient(self.position.values, self.gradient)
        contact = self.environment.obstacles.push(time, self.sides)
        self.contact = contact.at(self.q) if contact else None
        if self.contact:
            self.contact.add_gradient(self.gradient)

    def _kick(self, time: float, duration: float, begin: float, end: float) -> None:
        """Change v by the forces at ``time`` over ``duration`` [s], with damping and friction.

        begin, end : times [s] of the substep that gives the obstacles' velocities
        """
        kept = self.v[self.partly]
        self._damp(0.5 * duration)
        kick(len(self.free), self.load, duration, self._movers())
        self._damp(0.5 * duration)
        if self.contact:
            self.work += duration * self.contact.power(begin, end)
            self.contact.apply_friction(self._movers(), duration, begin, end)
        self.v[self.partly] = kept

    def _mean_load(self, begin: float, end: float) -> Rows:
        """Return the mean of f_ext (owned, 3) [N] between times [s], at q (collective)."""
        return self.environment.forces.mean(begin, end).at(self.position.values)

    def _movers(self) -> Movers:
        return Movers(self.v, self.free, self.per_mass, self.gradient)

    def _damp(self, duration: float) -> None:
        """Damp the velocities of the free nodes over a duration [s] by exp(-alpha dt)."""
        if self.damping:
            self.v[self.free] *= np.exp(-self.damping * duration)

    def _drift(self, begin: float, end: float) -> None:
        """Move q to the end of a substep: move anchored nodes on their paths, reflect impacts."""
        self._update_fixed(end)
        drift(len(self.free), self.q, end - begin, self._movers())
        prescribed = self.environment.anchors.prescribed(self.position.values, end)
        if prescribed is not None:
            owned = self.lattice.owned
            moved = self.fixed & ~self.lattice.fixed[:owned]
            anchored = np.nonzero(moved)
            freed = moved & ~self.environment.anchors.fixed_at(self.end)[:owned]
            self.work -= self._kinetic(freed)
            self.v[anchored] = (prescribed[:owned] - self.q)[anchored] / (end - begin)
            self.q[anchored] = prescribed[:owned][anchored]
            self.work += self._kinetic(freed)
        if self.environment.obstacles.strikes or self.environment.obstacles.has_sides:
            self._strike(begin, end)
        self.position.update()

    def _kinetic(self, where: Mask) -> float:
        """Return the kinetic energy [J] of this rank's components ``where`` (owned, 3)."""
        return 0.5 * float(self.lattice.mass @ (where * self.v**2).sum(axis=1))

    def _strike(self, begin: float, end: float) -> None:
        """Find the contact faces of a substep and reflect the nodes that strike an obstacle.

        A reflected node gets the velocity that leads to its new position.
        """
        start = self.q - (end - begin) * self.v
        self.sides = self.environment.obstacles.contact_faces(
            start, self.q, end, end - begin, self.sides, self.fixed.all(axis=1)
        )
        step = StepTaken(end, end - begin, self.sides, explicit=True)
        after, before, work = self.environment.obstacles.strike(self.q, start, step, self.fixed)
        self.work += work
        if before is not start:
            struck = np.flatnonzero((before != start).any(axis=1))
            self.v[struck] = (after[struck] - before[struck]) / (end - begin)
            self.q[struck] = after[struck]

    def _update_fixed(self, time: float) -> None:
        """Update the free nodes if the number of anchors that act has changed by ``time`` [s]."""
        anchors = len(self.environment.anchors.acting(time))
        if anchors != self.anchors:
            self.anchors = anchors
            self._fix(self.environment.anchors.fixed_at(time)[: self.lattice.owned])
            self.highest.fix(self.fixed)

    def _fix(self, fixed: Mask) -> None:
        """Set the fixed components (owned, 3), the free nodes and their fixed components."""
        pinned = fixed.all(axis=1)
        self.fixed, self.free = fixed, np.flatnonzero(~pinned)
        self.partly = np.nonzero(fixed & ~pinned[:, None])

    def _contact_bound(self, start: float, time: float) -> float:
        """Return a bound [1/s^2] on the obstacles' part of omega^2, by Weyl (collective)."""
        fall = self._mean_load(start, time) * self.per_mass[:, None] * self.time_step
        speed = greatest(np.linalg.norm(np.abs(self.v) + np.abs(fall), axis=1))
        speed = reduced(self.comm, speed, MPI.MAX)
        stiffness = self.environment.obstacles.contact_stiffness_bound(
            self.q, speed, start, time, self.sides
        )
        squared = greatest(stiffness[self.free] * self.per_mass[self.free])
        return float(reduced(self.comm, squared, MPI.MAX))

    def _count(self, squared: float) -> int:
        """Return the least number of substeps for omega^2 [1/s^2]. Raises StepFailed."""
        limit = SAFETY * 2 / np.sqrt(squared) if squared > 0 else np.inf
        if limit < self.substep < np.inf:
            log.warning(
                "time.substep = %.3g s is beyond the stability limit: %.3g s is taken, and later "
                "substeps stay below the limit",
                self.substep,
                limit,
            )
            # Warn only once.
            self.substep = np.inf
        count = self.time_step / min(limit, self.substep)
        if not count < MOST_SUBSTEPS:
            raise StepFailed(
                f"would need {count:.3g} substeps; try a smaller time.step, or implicit-euler",
                "unstable",
            )
        return max(1, int(np.ceil(count * (1 - 1e-12))))

    def destroy(self) -> None:
        for field in (self.position, self.velocity, self.highest):
            field.destroy()


@kernel
def kick(first: int, count: int, step: int, load: Rows, duration: float, nodes: Movers) -> None:
    """Add M^(-1) (f_ext - grad E) times ``duration`` [s] to v."""
    for row in range(first, count, step):
        i = nodes.rows[row]
        for c in range(3):
            nodes.v[i, c] += duration * nodes.per_mass[i] * (load[i, c] - nodes.gradient[i, c])


@kernel
def drift(first: int, count: int, step: int, q: Positions, duration: float, nodes: Movers) -> None:
    """Add v times ``duration`` [s] to q."""
    for row in range(first, count, step):
        i = nodes.rows[row]
        for c in range(3):
            q[i, c] += duration * nodes.v[i, c]
