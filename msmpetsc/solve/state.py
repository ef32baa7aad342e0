"""What a step starts from."""

from dataclasses import dataclass

import numpy as np


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
