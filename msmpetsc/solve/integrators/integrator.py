"""The interface of all integrators, and the state that a step starts from."""

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Indices, Positions, Rows, like
from msmpetsc.checkpoint import FINITE, Checkpoint
from msmpetsc.lattice.lattice import Lattice
from msmpetsc.solve.linear.unknowns import with_ghosts
from msmpetsc.solve.nonlinear.step import StepResult

HISTORY, SIDES = ("history_q", "history_v"), "sides"


@dataclass(frozen=True)
class EnergyBudget:
    """Energies that a run keeps account of [J]."""

    put_in: float = 0.0  # the most that the body had by right
    gained: float = 0.0  # from nowhere, and not lost since; negative where a swing may give back
    steady: float = 0.0  # the same without a known swing
    since_frame: float = 0.0  # gained since the frame stored before
    bounced: float = 0.0  # what nodes gained that bounced off its end

    @property
    def share(self) -> float:
        """Share of all energy that came from nowhere."""
        return min(self.gained, self.steady) / self.put_in if self.put_in else 0.0


@dataclass(frozen=True)
class State:
    """q_n and q_(n-1), (l, 3) [m], ghosts included; the velocity is (q_n - q_(n-1)) / t. After
    contact a step's are not what the frame shows, which is the step as it was solved.

    history : q and the velocity [m/s] of one step before, of integrators that look so far back; None: start anew
    sides   : (o, l) by which faces of the obstacles nodes are in contact (environment); None: the nearest
    """

    q: Positions
    q_previous: Positions
    history: tuple[Positions, Rows] | None = None
    sides: Indices | None = None
    budget: EnergyBudget = EnergyBudget()  # of energy, as the steps so far have filled it

    def velocity(self, time_step: float) -> Rows:
        """Velocities (l, 3) [m/s]."""
        return (self.q - self.q_previous) / time_step

    def over(self, time_step: float, shorter: float) -> "State":
        """Return the same state for steps of another length, without history."""
        return replace(
            self, q_previous=self.q - shorter / time_step * (self.q - self.q_previous), history=None
        )

    def save(self, checkpoint: Checkpoint, owned: int, looks_back: bool, has_sides: bool) -> None:
        """Store the state.

        looks_back, has_sides : whether the integrator has a use for the history, and contact for the sides
        """
        rows = {"q": self.q[:owned], "q_previous": self.q_previous[:owned]}
        if looks_back:
            history = self.history or (np.zeros((owned, 3)),) * 2
            rows |= {name: part[:owned] for name, part in zip(HISTORY, history, strict=True)}
            checkpoint.keep(numbers={"history": self.history is not None})
        if has_sides and self.sides is not None:
            rows[SIDES] = 1.0 * self.sides[:, :owned].T
        checkpoint.keep(rows, vars(self.budget))

    @staticmethod
    def restored(comm: MPI.Comm, lattice: Lattice, checkpoint: Checkpoint) -> "State":
        """Return the state that a checkpoint holds (collective)."""
        names = (
            ("q", "q_previous", *HISTORY)
            if checkpoint.number("history", 0, 0, 1)
            else ("q", "q_previous")
        )
        rows = [with_ghosts(comm, lattice, checkpoint.row(name)) for name in names]
        q, q_previous, *last = (like(lattice.nodes, each) for each in rows)
        history = (last[0], last[1]) if last else None
        sides = None
        if SIDES in checkpoint.rows:
            sides = with_ghosts(comm, lattice, checkpoint.rows[SIDES].astype(np.int8))
            sides = like(lattice.nodes, np.ascontiguousarray(sides.T))
        numbers = {name: checkpoint.number(name, 0.0, *FINITE) for name in vars(EnergyBudget())}
        return State(q, q_previous, history, sides, EnergyBudget(**numbers))


class Integrator(Protocol):
    """Takes steps of one length. All methods are collective.

    time_step  : [s]
    looks_back : it has a use for State.history
    """

    time_step: float
    looks_back: bool = False

    def set_up(self) -> None:
        """Make ready for the first step. Raises InputError for options that cannot be."""
        return

    def advance(self, state: State, time: float) -> tuple[StepResult, State]:
        """Take the step that ends at ``time`` [s]: its result, and what the next one starts from. Raises StepFailed."""

    def save(self, checkpoint: Checkpoint) -> None:
        """Store what the next step depends on beside its state, and forget all else."""

    def restore(self, checkpoint: Checkpoint, time: float) -> None:
        """Go on after a step that ended at ``time`` [s]."""

    def forget(self) -> None:
        """Forget what earlier steps showed, so that the next step does not depend on it."""

    def destroy(self) -> None:
        """Destroy all PETSc objects."""
