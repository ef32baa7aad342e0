"""Velocity Verlet: a step t of the scene in N substeps dt under the stability limit, with nothing to solve.

Each substep kicks, drifts and kicks, with a = M^(-1) (f_ext - grad E), contact included:

    v_(n+1/2) = v_n + dt/2 a(q_n),    q_(n+1) = q_n + dt v_(n+1/2),    v_(n+1) = v_(n+1/2) + dt/2 a(q_(n+1))

The two half kicks at one time are one, but for a step's first and last: so v is of the same time as q wherever a
frame may be stored. It is stable while dt < 2 / omega, omega^2 the greatest eigenvalue of M^(-1) (Hessian of E).

That limit is of small swings (README). What all substeps of a step then gain is the error of the trapezoidal rule for
the springs' work,

    E(q_N) - E(q_0) - sum_n 1/2 (grad E(q_n) + grad E(q_(n+1))) . (q_(n+1) - q_n)

which is none for a quadratic E. A step that gains too much is taken again, in twice as many substeps.
"""

import sys
from itertools import pairwise
from typing import ClassVar

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Floats, Indices, Mask, Positions, Rows, greatest, like
from msmpetsc.backend.kernel import kernel
from msmpetsc.checkpoint import FINITE, Checkpoint, Range
from msmpetsc.comm import log
from msmpetsc.contact.obstacles.friction import Movers
from msmpetsc.contact.obstacles.reflection import StepTaken
from msmpetsc.elasticity.energy import Elasticity
from msmpetsc.environment import Environment
from msmpetsc.errors import StepFailed
from msmpetsc.lattice.lattice import Lattice
from msmpetsc.scene.schema import Solver
from msmpetsc.scene.time import Time
from msmpetsc.solve.integrators.integrator import Integrator, State
from msmpetsc.solve.linear.unknowns import Ghosted
from msmpetsc.solve.nonlinear.step import StepResult
from msmpetsc.solve.work import Work

SAFETY = 0.8  # of the limit where a step starts: the Hessian changes within it
RETRIES = 4  # of a step
GAIN = 2e-3  # of all energy, from nowhere in a step: worth half the substep
CREDIT = 0.1  # of it, that springs may lose and gain again
EASED = 1 / 32  # of that: twice the substep, which gains from 4 to 16 times as much, will do again
HALVINGS = 5  # of substeps, for what they gain
MOST_SUBSTEPS = 1e6  # of a step
ROUNDING = 1e-14  # of the energy below, that a step may gain
SETTLED = 1e-3  # relative change of omega^2 by which the power iteration ends
MOST_ITERATIONS = 100  # of it
TORN = 100.0  # of the energy that presses every spring to a point: no body lives through that


class Verlet(Integrator):
    """Velocity Verlet's method. ``time.substep`` may only shorten its substeps."""

    state: ClassVar[dict[str, Range]] = {
        "substep": (sys.float_info.min, np.inf),
        "halvings": (0, HALVINGS),
        "gained": FINITE,
    }

    def __init__(
        self, comm: MPI.Comm, environment: Environment, time: Time, _: Solver, _prefix: str
    ):
        self.comm, self.lattice, self.environment = comm, environment.lattice, environment
        self.time_step, self.substep = time.step, time.substep or np.inf
        self.elasticity = Elasticity(self.lattice)
        self.position, self.velocity = Ghosted(comm, self.lattice), Ghosted(comm, self.lattice)
        self.highest = HighestMode(comm, self.lattice, self.elasticity)
        owned = self.lattice.owned
        self.q, self.v = self.position.values[:owned], self.velocity.values[:owned]
        self.gradient, self.per_mass = np.zeros_like(self.lattice.nodes), 1 / self.lattice.mass
        self.elastic = self.gradient[:owned]  # grad E without what obstacles push
        self.sides = environment.obstacles.no_sides[:, :owned]
        self.damping = environment.damping
        # [J] in a step: work on this rank's nodes, of obstacles without friction, of loads that change, of anchors
        self.work = 0.0
        self.springs_work = 0.0  # [J] in a step, that the springs of this rank's nodes took in
        self.gained = 0.0  # [J] by the springs since the start, from nowhere and not lost since; negative: a credit
        self.halvings = 0  # of substeps, for what they gained
        self.end = 0.0  # of the step [s]
        self.known: Floats | None = (
            None  # positions (l, 3) that ``gradient`` and the highest frequency are of
        )
        self.anchors: int | None = None  # how many hold
        self.fixed = environment.anchors.fixed_at(self.time_step)[:owned]
        self.free = np.flatnonzero(~self.fixed)
        self.most = TORN * comm.allreduce(crushing_energy(self.lattice))  # [J]

    def save(self, checkpoint: Checkpoint) -> None:
        checkpoint.keep_counts(self)
        self.known = self.anchors = None

    def restore(self, checkpoint: Checkpoint, time: float) -> None:
        checkpoint.restore_counts(self)

    def forget(self) -> None:
        self.known = self.anchors = None
        self.gained, self.halvings = 0.0, 0

    def advance(self, state: State, time: float) -> tuple[StepResult, State]:
        """Take the step that ends at ``time`` (collective). Raises StepFailed.

        Taken again with shorter substeps where its end shows that they were too long: a blow may
        stiffen a body, folds may heat it.
        """
        start, self.end = time - self.time_step, time
        self.environment.forces.begin_step(state.q, state.velocity(self.time_step), start)
        self._begin(state, start)
        pushed = self._pushed(start, time)
        squared = pushed + (self.highest.squared or self.highest.squared_at(self.position.values))
        for retry in range(1 + RETRIES):
            count = self._count(squared) * 2**self.halvings
            begun = self._squared_acceleration(start)
            with np.errstate(over="ignore", invalid="ignore"):  # its energy tells of what runs away
                self._take(count, start, time)
            energy = self.comm.allreduce(self.elasticity.energy(self.position.values))
            dt = self.time_step / count
            after = (
                pushed + self.highest.squared_at(self.position.values)
                if energy <= self.most
                else np.inf
            )
            is_stable = dt**2 * after <= 4
            if is_stable and (not self._is_to_halve(state.q, energy) or retry == RETRIES):
                return self._result(count, dt**2 / 8 * (self._squared_acceleration(time) - begun))
            if not is_stable:
                squared = np.clip(after, 2 * squared, 16 * squared)
            self._begin(state, start)
        raise StepFailed(
            f"became unstable: elastic energy {energy:.2e} J after substeps of {dt:.2e} s; "
            "try a smaller time.step, a softer material, or implicit-euler",
            "unstable",
        )

    def _begin(self, state: State, start: float) -> None:
        self.velocity.values[:] = (state.q - state.q_previous) / self.time_step
        self._hold(start)
        self.work = self.springs_work = 0.0
        if state.q is not self.known:
            self.position.values[:] = state.q
            before = state.sides
            if before is not None:
                before = before[:, : self.lattice.owned]
            self.sides = self.environment.obstacles.contact_faces(
                self.q, self.q, start, 0.0, before, self.fixed
            )
            self._pull(start)
            self.highest.squared = 0.0

    def _take(self, count: int, start: float, time: float) -> None:
        self.known = None
        times = np.linspace(start, time, 1 + count).tolist()
        duration = 0.5 * (times[1] - start)
        for begin, end in pairwise(times):
            self._kick(begin, duration, begin, end)
            before, held = self.q.copy(), self.fixed
            self._drift(begin, end)
            moved, held = self.q - before, held | self.fixed
            self._count_work(moved, held)
            self.work += self.environment.obstacles.energy_of_new_obstacles(
                self.q, begin, end, self.sides
            )
            self._pull(end)
            self._count_work(moved, held)
            duration = end - begin
        self._kick(time, 0.5 * duration, begin, time)

    def _count_work(self, moved: Rows, held: Mask) -> None:
        """Add half of the present forces' work [J] on a substep's moves (owned, 3) [m]: of springs, and of anchors.

        Anchors lead ``held`` nodes (owned,) against all forces, with the load as the energy balance has it.
        """
        self.springs_work += 0.5 * np.vdot(self.elastic, moved)
        against = self.gradient[: self.lattice.owned] - self.environment.forces.at(self.end)
        self.work += 0.5 * float(np.vdot(against[held], moved[held]))

    def _is_to_halve(self, start: Rows, energy: float) -> bool:
        """Whether a step from ``start`` (l, 3) [m] to elastic ``energy`` [J] gained too much, and
        its substeps are now halved; they are doubled again for the next one where it gained next to
        nothing (collective). Where obstacles push, what springs seem to gain may be theirs."""
        own = self.elasticity.change(self.position.values, start) - float(self.springs_work)
        mass = self.lattice.mass[: self.lattice.owned, None]
        gain, kinetic = self.comm.allreduce(
            np.array([own, 0.5 * float(np.vdot(mass * self.v, self.v))])
        )
        most = energy + kinetic
        enough, gained = GAIN * most + ROUNDING * self.most, max(self.gained + gain, -CREDIT * most)
        if (
            min(gain, gained) > enough
            and self.halvings < HALVINGS
            and not self.environment.obstacles.penalties
        ):
            self.halvings += 1
            return True
        self.gained = gained
        if gain < EASED * enough and self.halvings:
            self.halvings -= 1
        return False

    def _squared_acceleration(self, time: float) -> float:
        """|M^(-1) (f_ext - grad E)|_M^2 of this rank's free nodes [J/s^2]."""
        force = (self.environment.forces.at(time) - self.gradient[: self.lattice.owned])[self.free]
        return float(self.per_mass[self.free] @ (force**2).sum(axis=1))

    def _result(self, count: int, swing: float) -> tuple[StepResult, State]:
        self.velocity.update()
        self.known = self.position.values.copy()
        previous = self.known - self.time_step * self.velocity.values
        cost = Work(iterations=count, steps=1)
        result = StepResult(self.known, previous, cost, self.work, explicit=True, swing=swing)
        return result, State(self.known, previous, sides=self.sides)

    def _pull(self, time: float) -> None:
        self.gradient[:] = 0
        self.elasticity.add_gradient(self.position.values, self.gradient)
        self.elastic = self.gradient[: self.lattice.owned]
        contact = self.environment.obstacles.push(time, self.sides)
        if contact:
            self.elastic = self.elastic.copy()
            contact.add_gradient(self.q, self.gradient)

    def _kick(self, time: float, duration: float, begin: float, end: float) -> None:
        """Change v by the forces at ``time``; obstacles move as in the substep to its end."""
        self._damp(0.5 * duration)
        beyond = self.environment.forces.beyond(time, self.end)
        load = self.environment.forces.at(time)
        before = None if beyond is None else self.v.copy()
        kick(len(self.free), load, duration, self._movers())
        if (
            beyond is not None and before is not None
        ):  # f (v- + v+) / 2 is what a kick by f does to the kinetic energy
            self.work += (
                0.5 * duration * float(np.vdot(beyond[self.free], (before + self.v)[self.free]))
            )
        self._damp(0.5 * duration)
        self.work += duration * self.environment.obstacles.power(
            self.q, time, begin, end, self.sides
        )
        self.environment.obstacles.apply_friction(
            self._movers(), time, duration, (begin, end), self.sides
        )

    def _movers(self) -> Movers:
        return Movers(self.q, self.v, self.free, self.per_mass, self.gradient)

    def _damp(self, duration: float) -> None:
        """Slow the free nodes down as damping by the mass does in this time [s]."""
        if self.damping:
            self.v[self.free] *= np.exp(-self.damping * duration)

    def _drift(self, begin: float, end: float) -> None:
        """Bring q to the end of a substep: anchored nodes along their path, nodes that strike something back."""
        self._hold(end)
        drift(len(self.free), self.q, end - begin, self._movers())
        prescribed = self.environment.anchors.prescribed(self.position.values, end)
        if prescribed is not None:
            anchored = np.flatnonzero(self.fixed & ~self.lattice.pinned[: self.lattice.owned])
            freed = anchored[~self.environment.anchors.fixed_at(self.end)[anchored]]
            self.work -= self._kinetic(freed)
            self.v[anchored] = (prescribed[anchored] - self.q[anchored]) / (end - begin)
            self.q[anchored] = prescribed[anchored]
            self.work += self._kinetic(freed)
        if self.environment.obstacles.strikes or self.environment.obstacles.has_sides:
            self._strike(begin, end)
        self.position.update()

    def _kinetic(self, nodes: Indices) -> float:
        """Kinetic energy [J] of this rank's ``nodes`` (k,)."""
        return 0.5 * float(self.lattice.mass[nodes] @ (self.v[nodes] ** 2).sum(axis=1))

    def _strike(self, begin: float, end: float) -> None:
        """Find faces of contact; the velocity of a node that bounces off is what then led it there."""
        start = self.q - (end - begin) * self.v
        self.sides = self.environment.obstacles.contact_faces(
            start, self.q, end, end - begin, self.sides, self.fixed
        )
        step = StepTaken(end, end - begin, self.sides)
        after, before, work = self.environment.obstacles.strike(self.q, start, step, self.fixed)
        self.work += work
        if before is not start:
            struck = np.flatnonzero((before != start).any(axis=1))
            self.v[struck] = (after[struck] - before[struck]) / (end - begin)
            self.q[struck] = after[struck]

    def _hold(self, time: float) -> None:
        """Update the free nodes where an anchor begins or ends."""
        anchors = len(self.environment.anchors.acting(time))
        if anchors != self.anchors:
            self.anchors = anchors
            self.fixed = self.environment.anchors.fixed_at(time)[: self.lattice.owned]
            self.free = np.flatnonzero(~self.fixed)
            self.highest.hold(self.fixed)

    def _pushed(self, start: float, time: float) -> float:
        """Bound what obstacles may add to omega^2 [1/s^2] until ``time``, by Weyl (collective)."""
        fall = self.environment.forces.at(start) * self.per_mass[:, None] * self.time_step
        speed = greatest(np.linalg.norm(np.abs(self.v) + np.abs(fall), axis=1))
        speed = self.comm.allreduce(speed, MPI.MAX)
        stiffness = self.environment.obstacles.contact_stiffness_bound(
            self.q, speed, start, time, self.sides
        )
        squared = greatest(stiffness[self.free] * self.per_mass[self.free])
        return float(self.comm.allreduce(squared, MPI.MAX))

    def _count(self, squared: float) -> int:
        """The least number of substeps that keeps to the limit 2 / omega. Raises StepFailed where there is none."""
        limit = SAFETY * 2 / np.sqrt(squared) if squared > 0 else np.inf
        if limit < self.substep < np.inf:
            log.warning(
                "time.substep = %.3g s is beyond the stability limit: %.3g s is taken, and under it later",
                self.substep, limit,
            )  # fmt: skip
            self.substep = np.inf  # said once
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


class HighestMode:
    """The mode of the greatest eigenvalue omega^2 [1/s^2] of M^(-1) (Hessian of E), by power iterations that go on
    from the mode found last. ``squared`` is that omega^2, 0 while it is not known."""

    def __init__(self, comm: MPI.Comm, lattice: Lattice, elasticity: Elasticity):
        self.comm, self.lattice, self.elasticity = comm, lattice, elasticity
        self.mode, self.per_mass = Ghosted(comm, lattice), 1 / lattice.mass
        self.fixed, self.squared = lattice.pinned[: lattice.owned], 0.0

    def hold(self, fixed: Mask) -> None:
        """Set the ``fixed`` nodes (owned,) bool, and begin with something of every mode, whatever
        the number of ranks."""
        self.fixed = fixed
        numbers = self.lattice.global_numbers[:, None] + np.array([0.1, 0.4, 0.7])
        self.mode.values[:] = like(self.mode.values, np.sin(1e4 * np.sin(numbers)))
        self.mode.values[: self.lattice.owned][fixed] = 0
        self._normalise()
        self.squared = 0.0

    def squared_at(self, q: Positions) -> float:
        """Return omega^2 [1/s^2] of the springs at q (l, 3) [m] (collective).

        Without the negative curvature across pressed springs, which is no oscillation and has no bound.
        """
        x, owned = self.mode.values, self.lattice.owned
        hessian = self.elasticity.hessian_at(q, projected=True)
        product = np.empty_like(q)
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
        """Scale the mode x to |x|_M = 1, and return what that was (collective)."""
        x = self.mode.values[: self.lattice.owned]
        size = float(
            np.sqrt(self.comm.allreduce(float(np.vdot(self.lattice.mass[:, None] * x, x))))
        )
        if size > 0:
            x /= size
        self.mode.update()
        return size

    def destroy(self) -> None:
        """Collective."""
        self.mode.destroy()


def crushing_energy(lattice: Lattice) -> float:
    """Return the energy [J] that presses every spring of this rank to a point."""
    springs = slice(lattice.springs_owned)
    return float(0.5 * lattice.stiffness[springs] @ lattice.rest_length[springs] ** 2)


@kernel
def kick(first: int, count: int, step: int, load: Rows, duration: float, nodes: Movers) -> None:
    """v += duration M^(-1) (f_ext - grad E)."""
    for row in range(first, count, step):
        i = nodes.rows[row]
        for c in range(3):
            nodes.v[i, c] += duration * nodes.per_mass[i] * (load[i, c] - nodes.gradient[i, c])


@kernel
def drift(first: int, count: int, step: int, q: Positions, duration: float, nodes: Movers) -> None:
    """q += duration v."""
    for row in range(first, count, step):
        i = nodes.rows[row]
        for c in range(3):
            q[i, c] += duration * nodes.v[i, c]
