"""What is stored of one simulated time."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Frame:
    """One time of a run. Arrays hold this rank's rows; the numbers are of the whole body.

    position   : (n_local, 3) node positions [m]
    surface    : (v_local, 3) surface points [m], or None where the scene does not ask for them
    step_error : bound on the relative error of the step (0 for frame 0)
    iterations : outer (SNES) iterations of the step
    ksp_its    : KSP iterations of the step, summed
    momentum   : (3,) [kg m/s]
    """

    index: int
    time: float  # [s]
    position: np.ndarray
    surface: np.ndarray | None
    step_error: float
    iterations: int
    ksp_its: int
    kinetic: float  # [J]
    elastic: float  # [J]
    potential: float  # [J]
    contact: float  # [J] in the penalty springs of obstacles
    momentum: np.ndarray
    wall_time: float  # [s] that the step took
