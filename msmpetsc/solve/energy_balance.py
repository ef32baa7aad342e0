"""The energy of a body from step to step: what came in as work, and what came from nowhere.

A step that is solved exactly, of a convex energy, ends with no more than it began with (implicit Euler):

    T(v_(n+1)) + E(q_(n+1)) + C(q_(n+1))  <=  T(v_n) + E(q'_n) + C(q'_n) + f_ext . (q_(n+1) - q'_n) + W

T of the free nodes; C the push of obstacles, both times as they stand at the end; q'_n is q_n with the nodes that
anchors lead where they will be; W no less than the work of obstacles that drag, and that of those that strike, the
impulse times their velocity. What the left side has more, and what later steps have not lost again, came from nowhere.
What nodes gain when they bounce off a solved step counts to the next step, which mostly loses it before a frame shows
it.

Verlet counts in W the work of anchors and moving obstacles in its substeps, so that q'_n is q_n and C that of the
start. It also counts the work of forces that change, beyond f_ext of the end. The energy of its steps and of BDF2's
swings about what it should be: what they lose, up to a share, they may gain again.
In a linear body Verlet's, of substeps dt, swings just as dt^2/8 |M^(-1) (f_ext - grad E)|_M^2 does (Hairer, Lubich and
Wanner, Geometric Numerical Integration, IX): only what was gained with and without that is worth a word.
"""

from dataclasses import dataclass, replace
from typing import SupportsFloat

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Floats, Indices, Positions, Rows, like
from msmpetsc.contact.surface.pairs import Touch
from msmpetsc.elasticity.energy import Elasticity
from msmpetsc.elasticity.locate import describe_inverted, node_of_greatest
from msmpetsc.environment import Environment
from msmpetsc.errors import StepFailed
from msmpetsc.solve.integrators.integrator import EnergyBudget, Integrator, State
from msmpetsc.solve.integrators.verlet import crushing_energy
from msmpetsc.solve.nonlinear.step import StepResult

MOST = 3.0  # times all that the body ever had: explicit substeps near their limit let energy swing by nearly two
MUCH = 0.01  # of all energy, from nowhere: worth a word
CREDIT = 0.1  # of it, that a swing may take and give back: BDF2's impacts took 6%
FLOOR = 1e-10  # of the energy that presses every spring to a point: what rounding may gain


@dataclass(frozen=True)
class Energies:
    """Energies at one time [J]."""

    kinetic: float  # of all nodes; ``free`` of those that nothing prescribes
    free: float
    elastic: float
    contact: float
    potential: float
    momentum: Floats  # (3,) [kg m/s]
    touch: Touch  # contacts of the surface with itself

    @property
    def inner(self) -> float:
        """All but the potential of loads [J]."""
        return self.free + self.elastic + self.contact + self.touch.energy


@dataclass(eq=False)
class EnergyBalance:
    """Examiner of a run's steps; states keep the energy budget.

    energies : of the moment shown last
    """

    environment: Environment
    elasticity: Elasticity
    swings: bool  # whether the integrator's energy does

    def __post_init__(self) -> None:
        self.lattice = self.environment.lattice
        self.comm = self.lattice.table.comm
        self.credit = CREDIT * self.swings
        self.energies = Energies(0.0, 0.0, 0.0, 0.0, 0.0, np.zeros(3), Touch())
        self.known: tuple[Positions, Energies] | None = (
            None  # positions that the last step ended at, energies there
        )
        self.floor = FLOOR * self.comm.allreduce(crushing_energy(self.lattice))

    def show(self, q: Positions, v: Rows, time: float, sides: Indices | None) -> None:
        """Let ``energies`` be those of a moment within a step, or at its end (collective)."""
        self.energies = self._energies(q, v, time, sides)

    def _energies(self, q: Positions, v: Rows, time: float, sides: Indices | None) -> Energies:
        """Energies of positions (l, 3) [m] and velocities (l, 3) [m/s] with obstacles as at ``time`` (collective)."""
        lattice, environment = self.lattice, self.environment
        owned = slice(lattice.owned)
        at, contact, v = q[owned], environment.obstacles.push(time, sides), v[owned]
        momenta, free = lattice.mass[:, None] * v, ~environment.anchors.fixed_at(time)[owned]
        sums = self._sums(
            0.5 * np.vdot(momenta, v),
            0.5 * np.vdot(momenta * free[:, None], v),
            self.elasticity.energy(q),
            contact.energy(at) if contact else 0.0,
            -np.vdot(environment.forces.given(time), at),
            *(lattice.mass @ v),
        )
        return Energies(
            **dict(
                zip(("kinetic", "free", "elastic", "contact", "potential"), sums[:5], strict=True)
            ),
            momentum=sums[5:],
            touch=environment.touch(q, time),
        )

    def step(self, integrator: Integrator, before: State, time: float) -> tuple[StepResult, State]:
        """Take the step of an integrator that ends at ``time``, and enter it into the energy budget (collective).

        The history of BDF2 may give back at once much of the energy that an impact took: such a step begins anew.
        Raises StepFailed where a number is not finite, or far more came from nowhere than the body ever had.
        """
        result, after = integrator.advance(before, time)
        budget = self._examine(before, result, after, time, integrator.time_step)
        if before.history is not None and self._history_gains(
            before, result, after, time, integrator.time_step
        ):
            again, after = self.step(integrator, replace(before, history=None), time)
            cost = replace(result.cost + again.cost, steps=1, step_error=again.cost.step_error)
            return replace(again, cost=cost), after
        return result, replace(after, budget=budget)

    def _history_gains(
        self, before: State, result: StepResult, after: State, time: float, time_step: float
    ) -> bool:
        """Return whether a solved step gains more than MUCH of all energy (collective).

        Energy and work are those in a frame that goes with the obstacles that press, or with the body where none does:
        so no motion of all matters.
        """
        lattice, owned = self.lattice, slice(self.lattice.owned)
        way = result.position[owned] - result.previous[owned]
        pressing, led = self.environment.obstacles.way_of_pressing(
            (result.position[owned], after.sides), time, time_step
        )
        is_held = self.environment.anchors.fixed_at(time)[owned].any()
        sums = self._sums(
            lattice.mass.sum(), pressing, is_held, *led, *(lattice.mass @ way / time_step)
        )
        mass, pressing, is_held, momentum = *sums[:3], sums[6:]
        frame = (
            sums[3:6] / (pressing * time_step)
            if pressing > 0
            else np.where(is_held, 0.0, momentum / mass)
        )
        start, _, work, struck, _ = self._start(before, result, after, time, time_step, frame)
        ended = self.energies.inner - momentum @ frame + 0.5 * mass * frame @ frame
        return bool(ended - start - work - struck > MUCH * max(start + max(work, 0.0), self.floor))

    def _examine(
        self, before: State, result: StepResult, after: State, time: float, time_step: float
    ) -> EnergyBudget:
        v = (result.position - result.previous) / time_step
        self.show(result.position, v, time, after.sides)
        solved = ended = self.energies
        if not np.isfinite(solved.kinetic + solved.inner):
            raise StepFailed(
                f"left numbers that are not finite, {self._worst(result.position)}", "not finite"
            )
        if result.static:  # which owes nothing to the state before
            return before.budget
        own = after.q is not result.position or after.q_previous is not result.previous
        bounces = self.environment.obstacles.strikes and self.comm.allreduce(
            own, MPI.LOR
        )  # once the step was solved
        if bounces:
            ended = self._energies(after.q, after.velocity(time_step), time, after.sides)
        sums = self._start(before, result, after, time, time_step)
        budget = self._entered(before.budget, solved, ended, sums, bounces)
        if budget.gained > MOST * budget.put_in:
            raise StepFailed(
                f"gained {budget.gained:.2e} J from nowhere, of {budget.put_in:.2e} J that were there: "
                f"{self._worst(v)}{describe_inverted(self.comm, self.lattice, result.position)}; "
                f"try {self.remedy(result.explicit)}"
                + (
                    ""
                    if self.environment.obstacles.exchanges
                    else ', or safety.on_failure = "fallback"'
                ),
                "energy",
            )
        self.known = after.q, ended
        return budget

    def _entered(
        self, budget: EnergyBudget, solved: Energies, ended: Energies, sums: Floats, bounces: bool
    ) -> EnergyBudget:
        start, pushed, work, struck, swing = sums
        gained = solved.inner - start - work + budget.bounced - (0.0 if bounces else struck)
        bounced = (
            ended.inner + ended.potential - solved.inner - solved.potential - struck
            if bounces
            else 0.0
        )
        by_right = (
            start - max(budget.bounced, 0.0) - pushed - max(budget.gained, 0.0)
        )  # an exchange puts nothing in
        put_in = max(budget.put_in, by_right + max(work, 0.0), self.floor)
        put_in = max(put_in, solved.inner - max(budget.gained + gained, 0.0))
        least = -self.credit * put_in
        steady = max(least, budget.steady + gained - swing)
        since_frame = budget.since_frame + gained
        return EnergyBudget(
            put_in, max(least, budget.gained + gained), steady, since_frame, bounced
        )

    def remedy(self, explicit: bool) -> str:
        """Return a remedy, in words, for energy that comes from nowhere."""
        if self.environment.obstacles.exchanges:
            return 'response = "reflect" in place of "exchange", which moves nodes against their springs'
        if explicit or self.credit:
            return "a smaller time.substep" if explicit else "a smaller time.step"
        return "a smaller time.step or a smaller solver.error"

    def _start(
        self,
        before: State,
        result: StepResult,
        after: State,
        time: float,
        time_step: float,
        frame: Floats | float = 0.0,
    ) -> Floats:
        """Return the terms (5,) [J] of the right side of the balance (collective).

        They are the energies, the push in them, the work of loads and of obstacles that drag,
        the work that the step counted itself, and its swing.

        frame : velocity (3,) [m/s] of the frame in which energies and work are counted
        """
        lattice, environment = self.lattice, self.environment
        owned = slice(lattice.owned)
        prescribed = None if result.explicit else environment.anchors.prescribed(before.q, time)
        q, v = before.q if prescribed is None else prescribed, before.velocity(time_step)[owned]
        free = ~environment.anchors.fixed_at(time)[owned]
        when, sides = (time - time_step, before.sides) if result.explicit else (time, after.sides)
        contact = environment.obstacles.push(when, sides)
        known = self.known[1] if self.known and q is self.known[0] else None
        ended = result.position[owned], after.sides
        along = time_step * np.broadcast_to(frame, 3)
        way, drift = like(lattice.nodes, along), like(lattice.nodes, along / time_step)
        pressing = result.problem and result.problem.contact
        surface = pressing and pressing.surface
        sums = self._sums(
            0.5 * np.vdot((lattice.mass * free)[:, None] * (v - drift), v - drift),
            0.0 if known else self.elasticity.energy(q),
            contact.energy(q[owned] + way) if contact else 0.0,
            np.vdot(environment.forces.at(time), result.position[owned] - q[owned] - way)
            + environment.obstacles.friction_work_bound(
                (q[owned], sides), ended, time, time_step, along
            )
            + result.viscous_work
            + (surface.of_obstacles(result.position, along)[1] / self.comm.size if surface else 0.0)
            + (pressing.released(result.position) if pressing else 0.0),
            result.work,
            result.swing,
        )
        sums[2] += (known.touch if known else environment.touch(q, time - time_step)).energy
        sums[0] += (known.elastic if known else sums[1]) + sums[2]
        return sums[[0, 2, 3, 4, 5]]

    def _sums(self, *values: SupportsFloat) -> Floats:
        sums: Floats = self.comm.allreduce(np.array([float(value) for value in values]))
        return sums

    def _worst(self, vectors: Rows) -> str:
        owned = np.arange(self.lattice.owned)
        return "worst at " + node_of_greatest(
            self.comm, self.lattice, owned, np.linalg.norm(vectors[owned], axis=1)
        )
