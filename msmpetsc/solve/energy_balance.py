"""Energy balance of each step: legitimate work, and spurious energy that has no source.

If the energy is convex, an exactly solved step of implicit Euler satisfies

    T(v_(n+1)) + E(q_(n+1)) + C(q_(n+1))
        <=  T(v_n) + E(q'_n) + C(q'_n) + f . (q_(n+1) - q'_n) + W

- T is the kinetic energy of the free nodes.
- C is the contact energy. Both sides take the obstacles at their positions at the step's end.
- f is the mean of f_ext over the step.
- q'_n is q_n with the anchored nodes at their prescribed positions at the step's end.
- W bounds the work of moving obstacles: by friction, and by impacts as impulse times velocity. W
  also has the energy that viscosity and the elastic slips of friction release.

Spurious energy is the excess of the left side, less its later dissipation. Messages call it energy
from nowhere. If nodes rebound after the solve, their energy enters the balance of the next step,
because the next step dissipates most of it.

For Verlet, W is the work of anchors, moving obstacles and f_ext in the substeps. Therefore f is
absent, q'_n is q_n, and C is taken at the start of the step.

BDF2 spreads the impulse of an obstacle over several steps, so W may lack its work. Therefore a step
of BDF2 gains the lesser of the gains in a frame at rest and in a frame that moves with the
obstacles.

The energy of Verlet and BDF2 oscillates, so a step may regain a limited share of earlier losses. In
a linear body, the energy of Verlet with substeps dt oscillates by

    dt^2/8 |M^(-1) (f_ext - grad E)|_M^2

(Hairer, Lubich and Wanner, Geometric Numerical Integration, IX). A warning needs a gain both with
and without this oscillation.
"""

from dataclasses import dataclass, replace
from typing import SupportsFloat

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Floats, Indices, Positions, Rows, like, to_host
from msmpetsc.comm import reduced
from msmpetsc.contact.surface.pairs import ContactSummary
from msmpetsc.elasticity.energy import Elasticity
from msmpetsc.elasticity.locate import describe_inverted, node_of_greatest
from msmpetsc.elasticity.springs import crushing_energy
from msmpetsc.environment import Environment
from msmpetsc.errors import StepFailed
from msmpetsc.solve.integrators.integrator import EnergyBudget, State
from msmpetsc.solve.nonlinear.step import StepResult

# spurious energy that fails a step [largest legitimate energy]; Verlet may oscillate by
# nearly 2
FAILING_GAIN = 3.0
# spurious energy that is worth a warning [largest legitimate energy]; a viewer may
# notice more
NOTABLE_GAIN = 0.01
# energy that an oscillation may regain [largest legitimate energy]; BDF2 loses 0.06 in
# an impact
OSCILLATION_CREDIT = 0.1
# least legitimate energy [energy that crushes all springs]; rounding gains less
FLOOR = 1e-10


@dataclass(frozen=True)
class Energies:
    """Energies [J] and momentum (3,) [kg m/s] of a body at a given time.

    free    : kinetic energy of the nodes without prescribed displacement
    contact : penalty energy of obstacles
    touch   : contacts of surfaces, with their energy
    """

    kinetic: float
    free: float
    elastic: float
    contact: float
    potential: float
    momentum: Floats
    touch: ContactSummary

    @property
    def inner(self) -> float:
        """Return the kinetic energy of the free nodes plus elastic and contact energy [J]."""
        return self.free + self.elastic + self.contact + self.touch.energy


@dataclass(frozen=True)
class SolvedStep:
    """Step to be examined.

    before, after : states before and after the step
    time          : its end [s]
    time_step     : its length [s]
    """

    before: State
    result: StepResult
    after: State
    time: float
    time_step: float


@dataclass(eq=False)
class EnergyBalance:
    """Check the energy of each step of a run; the states carry the energy budget.

    swings   : whether the energy of the integrator oscillates
    energies : energies of the last call of ``show``
    floor    : least energy [J] that counts as legitimate
    """

    environment: Environment
    elasticity: Elasticity
    swings: bool

    def __post_init__(self) -> None:
        self.lattice = self.environment.lattice
        self.comm = self.lattice.table.comm
        self.credit = OSCILLATION_CREDIT * self.swings
        self.energies = Energies(0.0, 0.0, 0.0, 0.0, 0.0, np.zeros(3), ContactSummary())
        self.floor = FLOOR * reduced(self.comm, crushing_energy(self.lattice))

    def show(self, q: Positions, v: Rows, time: float, sides: Indices | None) -> None:
        """Set ``energies`` to the energies at a time within a step or at its end (collective)."""
        self.energies = self._energies(q, v, time, sides)

    def _energies(self, q: Positions, v: Rows, time: float, sides: Indices | None) -> Energies:
        """Return the energies at q (l, 3) [m] with velocities v (l, 3) [m/s] (collective).

        time  : time [s] of forces and obstacles
        sides : (o, l) contact faces of the nodes
        """
        lattice, environment = self.lattice, self.environment
        owned = slice(lattice.owned)
        at, v = q[owned], v[owned]
        contact, given = environment.obstacles.push(time, sides), environment.forces.at(time, False)
        momenta = lattice.mass[:, None] * v
        free = ~environment.anchors.fixed_at(time)[owned]
        sums = self._sums(
            0.5 * np.vdot(momenta, v),
            0.5 * np.vdot(momenta * free, v),
            self.elasticity.energy(q),
            contact.energy(at) if contact else 0.0,
            given.pressures.change(q, lattice.nodes) - np.vdot(given.force, at),
            *(lattice.mass @ v),
        )
        kinetic, moving, elastic, pressed, potential = sums[:5]
        touch = environment.touch(q, time)
        return Energies(kinetic, moving, elastic, pressed, potential, sums[5:], touch)

    def examine(
        self, before: State, result: StepResult, after: State, time: float, time_step: float
    ) -> tuple[State, bool]:
        """Return the state after a step with its energy budget, and whether a history gains energy.

        The history of BDF2 may return energy that an impact took (collective).

        Raises StepFailed if a number is not finite, or if the spurious energy is above
        FAILING_GAIN times the largest legitimate energy.
        """
        v = (result.position - result.previous) / time_step
        self.show(result.position, v, time, after.sides)
        if not np.isfinite(self.energies.kinetic + self.energies.inner):
            raise StepFailed(
                f"left numbers that are not finite, {self._worst(result.position)}", "not finite"
            )
        # An equilibrium does not depend on earlier energy.
        if result.static:
            return replace(after, budget=before.budget), False
        step = SolvedStep(before, result, after, time, time_step)
        sums, gains = self._start(step), False
        if self.swings and not result.explicit:
            gained, there = self._gained_beside_obstacles(step, sums)
            gains = before.history is not None and gained > NOTABLE_GAIN * max(there, self.floor)
            # W may lack the work of obstacles.
            sums[2] += max(self.energies.inner - sums[0] - sums[2] - gained, 0.0)
        budget = self._budget_after(step, sums)
        return replace(after, budget=budget), gains

    def _gained_beside_obstacles(self, step: SolvedStep, resting: Floats) -> tuple[float, float]:
        """Return the energy [J] that a solved step gains, and all energy before it (collective).

        Energy and work are counted in a frame that moves with the obstacles that press at the start
        or the end of the step. In any other frame these obstacles do work. If no obstacle presses,
        the frame moves with the body, so that rigid motion has no effect. The frame rests along
        components that pins or anchors hold, because in a moving frame they do work.

        resting : (5,) terms [J] of ``_start`` in a frame at rest
        """
        lattice, owned, time_step = self.lattice, slice(self.lattice.owned), step.time_step
        before, result, after = step.before, step.result, step.after
        displacement = result.position[owned] - result.previous[owned]
        pressing, dragged = self.environment.obstacles.pressing_displacement(
            (before.q[owned], before.sides),
            (result.position[owned], after.sides),
            step.time,
            time_step,
        )
        if result.contact and result.contact.surface:
            pushed, carried = result.contact.surface.pressing_displacement()
            pressing, dragged = pressing + pushed, dragged + carried
        is_fixed = self.environment.anchors.fixed_at(step.time)[owned].any(axis=0)
        sums = self._sums(
            lattice.mass.sum(),
            pressing,
            *to_host(is_fixed),
            *dragged,
            *(lattice.mass @ displacement / time_step),
        )
        mass, pressing, is_fixed, momentum = sums[0], sums[1], sums[2:5], sums[8:]
        moving = sums[5:8] / (pressing * time_step) if pressing > 0 else momentum / mass
        frame = np.where(is_fixed, 0.0, moving)
        # Impacts follow the solve, so the next step starts with their energy.
        start, _, work, _, _ = self._start(step, frame) if frame.any() else resting
        ended = self.energies.inner - momentum @ frame + 0.5 * mass * frame @ frame
        return float(ended - start - work), float(start + max(work, 0.0))

    def _budget_after(self, step: SolvedStep, sums: Floats) -> EnergyBudget:
        """Return the energy budget after a step (collective). Raises StepFailed.

        sums : (5,) [J], as ``_start`` returns them
        """
        solved = ended = self.energies
        result, after = step.result, step.after
        # Obstacles that reflect nodes change the state after the solve.
        is_changed = after.q is not result.position or after.q_previous is not result.previous
        bounces = self.environment.obstacles.strikes and reduced(self.comm, is_changed, MPI.LOR)
        if bounces:
            velocity = after.velocity(step.time_step)
            ended = self._energies(after.q, velocity, step.time, after.sides)
        budget = self._updated(step.before.budget, solved, ended, sums, bounces)
        if budget.gained > FAILING_GAIN * budget.put_in:
            raise StepFailed(
                f"gained {budget.gained:.2e} J from nowhere, of {budget.put_in:.2e} J that were "
                f"there: {self._worst(result.position - result.previous)}"
                f"{describe_inverted(self.comm, self.lattice, result.position)}; "
                f"try {self.remedy(result.explicit)}",
                "energy",
            )
        return budget

    def _updated(
        self, budget: EnergyBudget, solved: Energies, ended: Energies, sums: Floats, bounces: bool
    ) -> EnergyBudget:
        """Return the budget after a step.

        solved : energies of the solution
        ended  : energies after nodes have rebounded
        sums   : (5,) [J], as ``_start`` returns them
        """
        start, pushed, work, struck, swing = sums
        gained = solved.inner - start - work + budget.bounced
        bounced = 0.0
        if bounces:
            bounced = ended.inner + ended.potential - solved.inner - solved.potential - struck
        else:
            gained -= struck
        # Energy that nodes gain by exchange with an obstacle is not legitimate.
        legitimate = start - max(budget.bounced, 0.0) - pushed - max(budget.gained, 0.0)
        put_in = max(budget.put_in, legitimate + max(work, 0.0), self.floor)
        put_in = max(put_in, solved.inner - max(budget.gained + gained, 0.0))
        least = -self.credit * put_in
        steady = max(least, budget.steady + gained - swing)
        since_frame = budget.since_frame + gained
        return EnergyBudget(
            put_in, max(least, budget.gained + gained), steady, since_frame, bounced
        )

    def remedy(self, explicit: bool) -> str:
        """Return a remedy, in words, for spurious energy."""
        if self.environment.obstacles.exchanges:
            return (
                'response = "reflect" in place of "exchange", which moves nodes against their '
                "springs"
            )
        if explicit:
            return "a smaller time.substep"
        return "a smaller time.step or a smaller solver.error"

    def _start(self, step: SolvedStep, frame: Floats | float = 0.0) -> Floats:
        """Return the terms (5,) [J] of the right side of the balance (collective).

        The terms are the energy at the start, its contact part, the work of loads and friction, the
        work in StepResult, and the oscillation.

        frame : velocity (3,) [m/s] of the frame in which energies and work are counted
        """
        lattice, environment = self.lattice, self.environment
        before, result, after = step.before, step.result, step.after
        time, time_step, owned = step.time, step.time_step, slice(lattice.owned)
        q, v = before.q, before.velocity(time_step)[owned]
        if result.explicit:
            when, sides = time - time_step, before.sides
        else:
            when, sides = time, after.sides
            prescribed = environment.anchors.prescribed(q, time)
            q = q if prescribed is None else prescribed
        free = ~environment.anchors.fixed_at(time)[owned]
        contact = environment.obstacles.push(when, sides)
        ended = result.position[owned], after.sides
        along = time_step * np.broadcast_to(frame, 3)
        shift, drift = like(lattice.nodes, along), like(lattice.nodes, along / time_step)
        pressing = result.contact
        surface = pressing and pressing.surface
        work = 0.0
        # Explicit steps count the work of loads in StepResult.
        if not result.explicit:
            loads = environment.forces.mean(time - time_step, time, reach=0.5)
            # Damping is a loss, and in a moving frame also the uniform force per mass
            # -alpha times the frame's velocity.
            uniform = environment.damping * lattice.mass[:, None] * drift
            work = np.vdot(loads.force - uniform, ended[0] - q[owned] - shift)
            work -= loads.pressures.change(result.position, q)
        sums = self._sums(
            0.5 * np.vdot(lattice.mass[:, None] * free * (v - drift), v - drift),
            self.elasticity.energy(q),
            contact.energy(q[owned] + shift) if contact else 0.0,
            work
            + environment.obstacles.friction_work_bound(
                (q[owned], sides), ended, time, time_step, along
            )
            + result.viscous_work
            + (surface.of_obstacles(along)[1] / self.comm.size if surface else 0.0)
            + (pressing.released() if pressing else 0.0),
            result.work,
            result.swing,
        )
        sums[2] += environment.touch(q, time - time_step).energy
        sums[0] += sums[1] + sums[2]
        return sums[[0, 2, 3, 4, 5]]

    def _sums(self, *values: SupportsFloat) -> Floats:
        sums: Floats = reduced(self.comm, [float(value) for value in values])
        return sums

    def _worst(self, vectors: Rows) -> str:
        owned = np.arange(self.lattice.owned)
        return "worst at " + node_of_greatest(
            self.comm, self.lattice, owned, np.linalg.norm(vectors[owned], axis=1)
        )
