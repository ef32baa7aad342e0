"""What a step starts from."""

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

from msmpetsc.model.lattice import Lattice
from msmpetsc.model.saved import Saved
from msmpetsc.solve.ghosted import with_ghosts

HISTORY = ("history_q", "history_v")


@dataclass(frozen=True)
class State:
    """q_n and q_(n-1), (l, 3) [m], ghosts included; the velocity is (q_n - q_(n-1)) / t. After contact a step's are
    not what the frame shows, which is the step as it was solved.

    history : q and the velocity [m/s] of one step before, of integrators that look so far back; None: start anew
    """

    q: np.ndarray
    q_previous: np.ndarray
    history: tuple[np.ndarray, np.ndarray] | None = None

    def velocity(self, time_step: float) -> np.ndarray:
        """(l, 3) [m/s]"""
        return (self.q - self.q_previous) / time_step

    def over(self, time_step: float, shorter: float) -> "State":
        """The same for steps of another length."""
        return State(self.q, self.q - shorter / time_step * (self.q - self.q_previous))

    def save(self, saved: Saved, owned: int, looks_back: bool) -> None:
        """looks_back : whether the integrator has a use for the history"""
        saved.rows |= {"q": self.q[:owned], "q_previous": self.q_previous[:owned]}
        if looks_back:
            saved.numbers["history"] = self.history is not None
            history = self.history or (np.zeros((owned, 3)),) * 2
            saved.rows |= {name: rows[:owned] for name, rows in zip(HISTORY, history, strict=True)}

    @staticmethod
    def restored(comm: MPI.Comm, lattice: Lattice, saved: Saved) -> "State":
        """Collective."""
        names = ("q", "q_previous", *HISTORY) if saved.count("history", 1) else ("q", "q_previous")
        q, q_previous, *history = (with_ghosts(comm, lattice, saved.row(name)) for name in names)
        return State(q, q_previous, tuple(history) or None)
