"""What is stored of one simulated time."""

import math
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Frame:
    """One time of a run. Arrays hold this rank's rows; the numbers are of the whole body.

    index      : number of the step that it shows, 0 for the start
    position   : (n_local, 3) node positions [m]
    surface    : (v_local, 3) surface points [m], or None where the scene does not ask for them
    step_error : estimated relative error of a step, the greatest since the frame stored before (0 for frame 0)
    true_error, energy_error : true relative errors of such a step, in position and energy; NaN where not measured
    iterations : outer (SNES) iterations of these steps, or their explicit substeps, summed
    ksp_its    : KSP iterations of these steps, summed
    momentum   : (3,) [kg m/s]
    inverted   : cells that are inside out
    substeps   : shorter steps taken where these steps failed; fallbacks: steps that the robust method solved
    energy_gained : in these steps, neither from loads nor from obstacles or anchors
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
    wall_time: float  # [s] that these steps took
    true_error: float = math.nan
    energy_error: float = math.nan
    inverted: int = 0
    substeps: int = 0
    fallbacks: int = 0
    energy_gained: float = 0.0  # [J]
