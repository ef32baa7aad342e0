"""Interface of the integrators, and the state from which a step starts."""

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Indices, Positions, Rows, like
from msmpetsc.checkpoint import FINITE, Checkpoint
from msmpetsc.lattice.lattice import Lattice
from msmpetsc.solve.nonlinear.step import StepResult

HISTORY, SIDES = ("history_q", "history_v"), "sides"


@dataclass(frozen=True)
class EnergyBudget:
    """Account of a run's energies [J], as solve.energy_balance defines them.

    put_in      : largest legitimate energy of the body so far
    gained      : spurious energy that is not yet dissipated; negative for a credit
    steady      : ``gained`` without the known oscillation
    since_frame : spurious energy gained since the last stored frame
    bounced     : energy that nodes gained by rebounding after the last solve
    """

    put_in: float = 0.0
    gained: float = 0.0
    steady: float = 0.0
    since_frame: float = 0.0
    bounced: float = 0.0

    @property
    def share(self) -> float:
        """Return the spurious energy as a share of the largest legitimate energy."""
        return min(self.gained, self.steady) / self.put_in if self.put_in else 0.0


@dataclass(frozen=True)
class State:
    """State from which a step starts: q_n and q_(n-1), (l, 3) [m], ghosts included.

    The velocity is (q_n - q_(n-1)) / t. If nodes rebound after the solve, the state differs from
    the frame, which shows the solution.

    history : q [m] and velocity [m/s] one step earlier, for multistep methods; None without history
    span    : length [s] of the last step; None if it equals the step length of the history
    sides   : (o, l) obstacle faces at which the nodes are in contact; None for the nearest faces
    budget  : energy budget after the steps so far
    """

    q: Positions
    q_previous: Positions
    history: tuple[Positions, Rows] | None = None
    sides: Indices | None = None
    budget: EnergyBudget = EnergyBudget()
    span: float | None = None

    def velocity(self, time_step: float) -> Rows:
        """Return the velocities (l, 3) [m/s]."""
        return (self.q - self.q_previous) / time_step

    def over(self, time_step: float, shorter: float) -> "State":
        """Return the state for steps of length ``shorter`` [s], without history."""
        return replace(
            self, q_previous=self.q - shorter / time_step * (self.q - self.q_previous), history=None
        )

    def save(self, checkpoint: Checkpoint, owned: int, uses_history: bool, has_sides: bool) -> None:
        """Store the state in a checkpoint.

        uses_history : whether the integrator reads the history
        has_sides    : whether contact reads the sides
        """
        rows = {"q": self.q[:owned], "q_previous": self.q_previous[:owned]}
        if uses_history:
            history = self.history or (np.zeros((owned, 3)),) * 2
            rows |= {name: part[:owned] for name, part in zip(HISTORY, history, strict=True)}
            checkpoint.keep(numbers={"history": self.history is not None})
        if has_sides and self.sides is not None:
            rows[SIDES] = 1.0 * self.sides[:, :owned].T
        checkpoint.keep(rows, vars(self.budget))

    @staticmethod
    def restored(comm: MPI.Comm, lattice: Lattice, checkpoint: Checkpoint) -> "State":
        """Return the state that a checkpoint holds (collective). Raises InputError."""
        names = ["q", "q_previous"]
        if checkpoint.number("history", 0, 0, 1):
            names += HISTORY
        rows = [lattice.table.with_ghosts(lattice.ghosts, checkpoint.row(name)) for name in names]
        q, q_previous, *last = (like(lattice.nodes, each) for each in rows)
        history = (last[0], last[1]) if last else None
        sides = None
        if SIDES in checkpoint.rows:
            sides = lattice.table.with_ghosts(
                lattice.ghosts, checkpoint.rows[SIDES].astype(np.int8)
            )
            sides = like(lattice.nodes, np.ascontiguousarray(sides.T))
        numbers = {name: checkpoint.number(name, 0.0, *FINITE) for name in vars(EnergyBudget())}
        return State(q, q_previous, history, sides, EnergyBudget(**numbers))


class Integrator(Protocol):
    """Method that takes steps of a fixed length. All methods are collective.

    time_step    : length of a step [s]
    uses_history : whether the method reads State.history
    """

    time_step: float
    uses_history: bool = False

    def set_up(self) -> None:
        """Prepare the first step. Raises InputError for options that PETSc cannot apply."""
        return

    def advance(self, state: State, time: float) -> tuple[StepResult, State]:
        """Take the step that ends at ``time`` [s]; return its result and the state after it.

        Raises StepFailed, StepStopped after a signal, and InputError (Stepper.step).
        """

    def save(self, checkpoint: Checkpoint) -> None:
        """Store the integrator's own data in a checkpoint, and drop all other caches."""

    def restore(self, checkpoint: Checkpoint, time: float) -> None:
        """Resume after the step that ended at ``time`` [s]."""

    def destroy(self) -> None:
        """Destroy all PETSc objects."""
