"""The energy of a body from step to step: what came in as work, and what came from nowhere.

A step that is solved exactly, of a convex energy, ends with no more than it began with (implicit Euler):

    T(v_(n+1)) + E(q_(n+1)) + C(q_(n+1))  <=  T(v_n) + E(q'_n) + C(q'_n) + f_ext . (q_(n+1) - q'_n) + W

T of the free nodes; C the push of obstacles, both times as they stand at the end; q'_n is q_n with the nodes that
anchors lead where they will be; W no less than the work of obstacles that drag, and that of those that strike, the
impulse times their velocity. What the left side has more, and what later steps have not lost again, came from nowhere.
What nodes gain when they bounce off a solved step counts to the next step, which mostly loses it before a frame shows it.
Solved loosely, or where springs are pressed, steps do gain a little; a run that is out of hand gains without end.

Verlet counts in W what moving obstacles push, so that C(q'_n) is that of where they stand at the start. The energy of
its steps and of BDF2's swings about what it should be: what they lose, up to a share, they may gain again.
In a linear body Verlet's, of substeps dt, swings just as dt^2/8 |M^(-1) (f_ext - grad E)|_M^2 does (Hairer, Lubich and
Wanner, Geometric Numerical Integration, IX): only what was gained with and without that is worth a word.
"""

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

from msmpetsc.errors import StepFailed
from msmpetsc.model.checkpoint import Checkpoint
from msmpetsc.model.elasticity import Elasticity
from msmpetsc.model.environment import Environment
from msmpetsc.model.lattice import Lattice
from msmpetsc.model.locate import describe_inverted, node_of_greatest
from msmpetsc.solve.integrators.state import State
from msmpetsc.solve.nonlinear.step import StepResult

MOST = 3.0  # times all that the body ever had: explicit substeps near their limit let energy swing by nearly two
MUCH = 0.01  # of all energy, from nowhere: worth a word
CREDIT = 0.1  # of it, that a swing may take and give back: BDF2's impacts took 6%
FLOOR = 1e-10  # of the energy that presses every spring to a point: what rounding may gain


@dataclass(frozen=True)
class Energies:
    """Of one time; kinetic of all nodes, ``free`` of those that are no one's to move [J], momentum (3,) [kg m/s]."""

    kinetic: float
    free: float
    elastic: float
    contact: float
    potential: float
    momentum: np.ndarray

    @property
    def inner(self) -> float:
        return self.free + self.elastic + self.contact


@dataclass(frozen=True)
class Ledger:
    """put_in: the most that the body had by right; gained: from nowhere, and not lost since, negative where a swing may
    give back; steady: the same without a known swing; last: in the last step; bounced: what nodes gained that bounced off
    its end [J]."""

    put_in: float = 0.0
    gained: float = 0.0
    steady: float = 0.0
    last: float = 0.0
    bounced: float = 0.0

    @property
    def share(self) -> float:
        """Of all energy, what came from nowhere."""
        return min(self.gained, self.steady) / self.put_in if self.put_in else 0.0


class EnergyBalance:
    """Keeps the ledger of a run. swings: whether the integrator's energy does."""

    def __init__(
        self,
        comm: MPI.Comm,
        lattice: Lattice,
        environment: Environment,
        elasticity: Elasticity,
        swings: bool = False,
    ):
        self.credit = CREDIT if swings else 0.0
        self.comm, self.lattice, self.around, self.elasticity = comm, lattice, environment, elasticity
        self.ledger, self.known = Ledger(), None
        springs = slice(lattice.springs_owned)
        self.floor = FLOOR * comm.allreduce(0.5 * lattice.stiffness[springs] @ lattice.rest_length[springs] ** 2)

    def energies(self, q: np.ndarray, v: np.ndarray, time: float, sides: np.ndarray) -> Energies:
        """Of positions (l, 3) [m] and velocities (l, 3) [m/s] as things stand at ``time``, sides too (collective)."""
        lattice, around = self.lattice, self.around
        owned = slice(lattice.owned)
        at, contact, v = q[owned], around.push(time, sides), v[owned]
        momenta, free = lattice.mass[:, None] * v, ~around.fixed_at(time)[owned]
        sums = self._sums(
            0.5 * np.vdot(momenta, v),
            0.5 * np.vdot(momenta * free[:, None], v),
            self.elasticity.energy(q),
            contact.energy(at) if contact else 0.0,
            -np.vdot(around.load(time), at),
            *momenta.sum(axis=0),
        )
        return Energies(*sums[:5], sums[5:])

    def check(
        self, before: State, result: StepResult, after: State, time: float, time_step: float
    ) -> tuple[Energies, Energies, Ledger]:
        """Energies of a step's result and of the state ``after`` it, and the ledger with that (collective).

        Raises StepFailed where a number is not finite, or far more came from nowhere than the body ever had.
        """
        v = (result.position - result.previous) / time_step
        solved = ended = self.energies(result.position, v, time, after.sides)
        if not np.isfinite(solved.kinetic + solved.inner):
            raise StepFailed(f"left numbers that are not finite, {self._worst(result.position)}", "not finite")
        bounces = self._bounces(result, after)
        if bounces:
            ended = self.energies(after.q, after.velocity(time_step), time, after.sides)
        start, pushed, work, struck, swing = self._start(before, result, after, time, time_step)
        ledger = self.ledger
        gained = solved.inner - start - work + ledger.bounced - (0.0 if bounces else struck)
        bounced = ended.inner + ended.potential - solved.inner - solved.potential - struck if bounces else 0.0
        put_in = max(ledger.put_in, start - pushed - max(ledger.gained, 0.0) + max(work, 0.0), self.floor)
        put_in = max(put_in, solved.inner - max(ledger.gained + gained, 0.0))
        least = -self.credit * put_in
        steady = max(least, ledger.steady + gained - swing)
        ledger = Ledger(put_in, max(least, ledger.gained + gained), steady, gained, bounced)
        if ledger.gained > MOST * put_in:
            raise StepFailed(
                f"gained {ledger.gained:.2e} J from nowhere, of {put_in:.2e} J that were there: "
                f"{self._worst(v)}{describe_inverted(self.comm, self.lattice, result.position)}; "
                'try a smaller solver.error (or more iterations), a smaller time.step, or safety.on_failure = "fallback"',
                "energy",
            )
        return solved, ended, ledger

    def keep(self, ended: Energies, ledger: Ledger, after: State) -> None:
        """The step is taken."""
        self.known, self.ledger = (after.q, ended.elastic), ledger

    def save(self, saved: Checkpoint) -> None:
        saved.numbers |= vars(self.ledger)

    def restore(self, saved: Checkpoint) -> None:
        most = np.finfo(float).max
        self.ledger = Ledger(**{name: saved.number(name, 0.0, -most, most) for name in vars(Ledger())})

    def _bounces(self, result: StepResult, after: State) -> bool:
        """Whether any node was struck once the step was solved (collective)."""
        if not self.around.reflections:
            return False
        own = after.q is not result.position or after.q_previous is not result.previous
        return self.comm.allreduce(own, MPI.LOR)

    def _start(self, before: State, result: StepResult, after: State, time: float, time_step: float) -> np.ndarray:
        """Of the right side of the balance the energies, and the push in them, the work of loads and of obstacles that
        drag, and that which the step counted itself; and its swing [J] (collective)."""
        lattice, around = self.lattice, self.around
        owned = slice(lattice.owned)
        prescribed = around.prescribed(before.q, time)
        q, v = before.q if prescribed is None else prescribed, before.velocity(time_step)[owned]
        free = ~around.fixed_at(time)[owned]
        when, sides = (time - time_step, before.sides) if result.explicit else (time, after.sides)
        contact = around.push(when, sides)
        sides = around.no_sides if sides is None else sides
        known = self.known is not None and q is self.known[0]
        sums = self._sums(
            0.5 * np.vdot((lattice.mass * free)[:, None] * v, v),
            0.0 if known else self.elasticity.energy(q),
            contact.energy(q[owned]) if contact else 0.0,
            np.vdot(around.load(time), result.position[owned] - q[owned])
            + around.friction_work_bound((q[owned], sides), (result.position[owned], after.sides), time, time_step),
            result.work,
            result.swing,
        )
        sums[0] += (self.known[1] if known else sums[1]) + sums[2]
        return sums[[0, 2, 3, 4, 5]]

    def _sums(self, *values: float) -> np.ndarray:
        """Over all ranks; the values may be on a GPU."""
        return self.comm.allreduce(np.array([float(value) for value in values]))

    def _worst(self, vectors: np.ndarray) -> str:
        owned = np.arange(self.lattice.owned)
        return "worst at " + node_of_greatest(self.comm, self.lattice, owned, np.linalg.norm(vectors[owned], axis=1))
