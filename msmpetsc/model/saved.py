"""All that the next step depends on beside the scene: saved and restored, a run goes on as if it had never stopped.

Each part of a run that remembers something has ``save`` and ``restore``. What PETSc's solvers remember is not
among it: they begin each step anew (solve.step).
"""

from dataclasses import dataclass, field

import numpy as np


@dataclass
class Saved:
    """After ``step`` steps. Empty, it is what a run begins with.

    rows    : by name, what there is of each node, this rank's owned ones: (owned, 3) or (owned,); q and q_previous
        [m] among them
    numbers : by name, of the whole run
    """

    step: int = 0
    rows: dict[str, np.ndarray] = field(default_factory=dict)
    numbers: dict[str, float] = field(default_factory=dict)
