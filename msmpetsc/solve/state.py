"""What a step starts from."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class State:
    """q_n and q_(n-1), (l, 3) [m], ghosts included; the velocity is (q_n - q_(n-1)) / t. After contact an implicit
    step's are not what the frame shows, which is the step as it was solved."""

    q: np.ndarray
    q_previous: np.ndarray
