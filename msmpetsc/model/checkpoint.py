"""All that the next step depends on beside the scene: saved and restored, a run goes on as if it had never stopped.

Each part of a run that remembers something has ``save`` and ``restore``, and names what it stores. What PETSc's
solvers remember is not among it: they begin each step anew (solve.nonlinear.step).
"""

import math
from dataclasses import dataclass, field

import numpy as np
from mpi4py import MPI

from msmpetsc.comm import together
from msmpetsc.errors import InputError

MOST = 1e60  # of any number: its fourth power is still finite
AT_REST = "at_rest"  # number of a run that ends at rest (time.until): whether it has come there


@dataclass
class Checkpoint:
    """After ``step`` steps. Empty, it is what a run begins with.

    rows    : by name, what there is of each node, this rank's owned ones: (owned, 3) or (owned,); q and q_previous
        [m] among them
    numbers : by name, of the whole run
    """

    step: int = 0
    rows: dict[str, np.ndarray] = field(default_factory=dict)
    numbers: dict[str, float] = field(default_factory=dict)

    def keep(self, rows: dict[str, np.ndarray] | None = None, numbers: dict[str, float] | None = None) -> None:
        """Store a part's rows and numbers; no two parts may store one name."""
        if twice := (self.rows.keys() & (rows or {}).keys()) | (self.numbers.keys() & (numbers or {}).keys()):
            raise ValueError(f"two parts of a checkpoint store {', '.join(sorted(twice))}")
        self.rows |= rows or {}
        self.numbers |= numbers or {}

    def row(self, name: str) -> np.ndarray:
        """Raises InputError where there is none."""
        if name not in self.rows:
            raise InputError(f"the checkpoint is damaged: it lacks {name}")
        return self.rows[name]

    def number(self, name: str, default: float, least: float = -math.inf, most: float = math.inf) -> float:
        """Raises InputError for one that no run can have had."""
        value = self.numbers.get(name, default)
        if not least <= value <= most:
            raise InputError(f"the checkpoint is damaged: {name} is {value:g}")
        return value

    def count(self, name: str, most: int = 2**53) -> int:
        """A whole number, 0 if there is none. Raises InputError likewise."""
        return int(self.number(name, 0, 0, most))

    def refuse_rows_unlike(self, comm: MPI.Comm, like: "Checkpoint") -> None:
        """Raise InputError for rows not of the shape of those in ``like``, not finite or absurd (collective)."""
        with together(comm):
            for name in self.rows.keys() & like.rows.keys():
                rows = self.rows[name]
                if rows.shape != like.rows[name].shape or not (np.abs(rows) < MOST).all():
                    raise InputError(
                        f"the checkpoint is damaged: {name} is not of finite numbers, {like.rows[name].shape}"
                    )
