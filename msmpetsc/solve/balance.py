"""The energy of a body from step to step: what came in as work, and what came from nowhere.

A step that is solved exactly, of a convex energy, ends with no more than it began with (implicit Euler):

    T(v_(n+1)) + E(q_(n+1)) + C(q_(n+1))  <=  T(v_n) + E(q'_n) + C(q'_n) + f_ext . (q_(n+1) - q'_n) + W

T of the free nodes; C the push of obstacles, both times as they stand at the end; q'_n is q_n with the nodes that
anchors lead where they will be; W no less than the work of obstacles that drag. What the left side has more, and what later steps have not lost again, came from nowhere.
Solved loosely, or where springs are pressed, steps do gain a little; a run that is out of hand gains without end.
"""

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

from msmpetsc.errors import StepFailed
from msmpetsc.model.elasticity import Elasticity
from msmpetsc.model.lattice import Lattice
from msmpetsc.model.saved import Saved
from msmpetsc.model.surroundings import Surroundings
from msmpetsc.model.worst import inside_out, place_of_greatest
from msmpetsc.solve.state import State
from msmpetsc.solve.step import StepResult

MOST = 3.0  # times all that the body ever had: explicit substeps near their limit let energy swing by nearly two
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
    """put_in: the most that the body had by right; gained: from nowhere, and not lost since; last: in the last step [J]."""

    put_in: float = 0.0
    gained: float = 0.0
    last: float = 0.0


class EnergyBalance:
    """Keeps the ledger of a run."""

    def __init__(self, comm: MPI.Comm, lattice: Lattice, surroundings: Surroundings, elasticity: Elasticity):
        self.comm, self.lattice, self.around, self.elasticity = comm, lattice, surroundings, elasticity
        self.ledger, self.known = Ledger(), None
        springs = slice(lattice.springs_owned)
        self.floor = FLOOR * comm.allreduce(0.5 * lattice.stiffness[springs] @ lattice.rest_length[springs] ** 2)

    def energies(self, q: np.ndarray, v: np.ndarray, time: float) -> Energies:
        """Of positions (l, 3) [m] and velocities (l, 3) [m/s] as things stand at ``time`` (collective)."""
        lattice, around = self.lattice, self.around
        owned = slice(lattice.owned)
        at, contact, v = q[owned], around.push(time), v[owned]
        momenta, free = lattice.mass[:, None] * v, ~around.pinned_at(time)[owned]
        sums = self._sums(
            0.5 * np.vdot(momenta, v),
            0.5 * np.vdot(momenta * free[:, None], v),
            self.elasticity.energy(q),
            contact.energy(at) if contact else 0.0,
            -np.vdot(around.load(time), at),
            *momenta.sum(axis=0),
        )
        return Energies(*sums[:5], sums[5:])

    def check(self, before: State, result: StepResult, time: float, time_step: float) -> tuple[Energies, Ledger]:
        """Energies after a step, and the ledger with it (collective).

        Raises StepFailed where a number is not finite, or far more came from nowhere than the body ever had.
        """
        v = (result.position - result.previous) / time_step
        after = self.energies(result.position, v, time)
        if not np.isfinite(after.kinetic + after.inner):
            raise StepFailed(f"left numbers that are not finite, {self._worst(result.position)}", "not finite")
        start, work = self._start(before, result, time, time_step)
        gained = after.inner - start - work
        ledger = self.ledger
        put_in = max(ledger.put_in, start - ledger.gained + max(work, 0.0), self.floor)
        ledger = Ledger(put_in, max(0.0, ledger.gained + gained), gained)
        if ledger.gained > MOST * put_in:
            raise StepFailed(
                f"gained {ledger.gained:.2e} J from nowhere, of {put_in:.2e} J that were there: "
                f"{self._worst(v)}{inside_out(self.comm, self.lattice, result.position)}; "
                'try a smaller solver.error (or more iterations), a smaller time.step, or safety.on_failure = "fallback"',
                "energy",
            )
        return after, ledger

    def keep(self, after: Energies, ledger: Ledger, result: StepResult) -> None:
        """The step is taken."""
        self.known, self.ledger = (result.position, after.elastic), ledger

    def save(self, saved: Saved) -> None:
        saved.numbers |= vars(self.ledger)

    def restore(self, saved: Saved) -> None:
        most = np.finfo(float).max
        self.ledger = Ledger(**{name: saved.number(name, 0.0, -most, most) for name in vars(Ledger())})

    def _start(self, before: State, result: StepResult, time: float, time_step: float) -> tuple[float, float]:
        """Right side of the balance, and the work in it: of loads, and of obstacles that drag [J] (collective)."""
        lattice, around = self.lattice, self.around
        owned = slice(lattice.owned)
        led = around.led(before.q, time)
        q, v = before.q if led is None else led, before.velocity(time_step)[owned]
        contact, free = around.push(time), ~around.pinned_at(time)[owned]
        known = self.known is not None and q is self.known[0]
        sums = self._sums(
            0.5 * np.vdot((lattice.mass * free)[:, None] * v, v),
            0.0 if known else self.elasticity.energy(q),
            contact.energy(q[owned]) if contact else 0.0,
            np.vdot(around.load(time), result.position[owned] - q[owned])
            + around.dragged(q[owned], result.position[owned], time, time_step),
        )
        kinetic, elastic, contact, work = sums
        return kinetic + (self.known[1] if known else elastic) + contact, work

    def _sums(self, *values: float) -> np.ndarray:
        """Over all ranks; the values may be on a GPU."""
        return self.comm.allreduce(np.array([float(value) for value in values]))

    def _worst(self, vectors: np.ndarray) -> str:
        owned = np.arange(self.lattice.owned)
        return "worst at " + place_of_greatest(self.comm, self.lattice, owned, np.linalg.norm(vectors[owned], axis=1))
