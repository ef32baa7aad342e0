"""Checkpoints: the positions, velocities and counters that the next step of a run depends on.

Solver histories are not part of a checkpoint. A run clears them at each step at which a checkpoint
may be written (solve.simulate). So a resumed run equals an uninterrupted run bit by bit.
"""

import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field, is_dataclass, replace
from typing import Any

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Array
from msmpetsc.comm import together
from msmpetsc.errors import InputError

# largest absolute value of a stored row; its fourth power stays finite
MAX_VALUE = 1e60
# largest counter; a double holds every whole number up to it
MAX_COUNT = 2**53
# number stored for the state after a run's last step n, plus n; no run resumes from
# this state, because an uninterrupted longer run would keep its histories
AT_END = -2
Range = tuple[float, float]
COUNT: Range = (0, MAX_COUNT)
ANY: Range = (-math.inf, math.inf)
FINITE: Range = (-sys.float_info.max, sys.float_info.max)
LENGTH: Range = (0.0, sys.float_info.max)


def _numbers(part: Any) -> Iterator[tuple[str, Any]]:
    """Yield the stored name and the value of each counter of a part of a run.

    ``part.state`` has name and range of each stored attribute, a number or a dataclass of numbers.
    """
    for attribute in part.state:
        value = getattr(part, attribute)
        inner = vars(value) if is_dataclass(value) else {"": value}
        for name, number in inner.items():
            yield f"{type(part).__name__}.{attribute}.{name}".strip("."), number


@dataclass
class Checkpoint:
    """The state of a run after ``step`` steps; an empty checkpoint is the start of a run.

    rows    : arrays (owned, 3) or (owned,) of this rank's nodes by name, with q and q_previous [m]
    numbers : counters and scalars of the whole run by name
    """

    step: int = 0
    rows: dict[str, Array] = field(default_factory=dict)
    numbers: dict[str, float] = field(default_factory=dict)

    def keep(
        self, rows: dict[str, Array] | None = None, numbers: dict[str, float] | None = None
    ) -> None:
        """Add rows and numbers to the checkpoint."""
        self.rows |= rows or {}
        self.numbers |= numbers or {}

    def keep_counts(self, part: Any) -> None:
        """Add the counters of a part to the checkpoint."""
        self.keep(numbers=dict(_numbers(part)))

    def restore_counts(self, part: Any) -> None:
        """Set the counters of a part to their stored values; raise InputError out of range."""
        for attribute, bounds in part.state.items():
            value = getattr(part, attribute)
            name = f"{type(part).__name__}.{attribute}"
            if is_dataclass(value) and not isinstance(value, type):
                inner = {
                    item: self._like(f"{name}.{item}", number, bounds)
                    for item, number in vars(value).items()
                }
                setattr(part, attribute, replace(value, **inner))
            else:
                setattr(part, attribute, self._like(name, value, bounds))

    def _like(self, name: str, value: Any, bounds: Range) -> Any:
        """Return the stored number of a name, as the type of ``value``, which is its default."""
        # the default nan stands for an unknown quantity, which no range contains
        if isinstance(value, float) and math.isnan(value):
            return self.numbers.get(name, value)
        least, most = bounds
        if isinstance(value, int):
            least = max(least, -MAX_COUNT)
            most = min(most, MAX_COUNT)
        return type(value)(self.number(name, value, least, most))

    def row(self, name: str) -> Array:
        """Return the rows of a name; raise InputError if the checkpoint lacks them."""
        if name not in self.rows:
            raise InputError(f"the checkpoint is damaged: it lacks {name}")
        return self.rows[name]

    def number(
        self, name: str, default: float, least: float = -math.inf, most: float = math.inf
    ) -> float:
        """Return the number of a name; raise InputError if it is out of range."""
        value = self.numbers.get(name, default)
        if not least <= value <= most:
            raise InputError(f"the checkpoint is damaged: {name} is {value:g}")
        return value

    def refuse_rows_unlike(self, comm: MPI.Comm, like: "Checkpoint") -> None:
        """Raise InputError if rows differ in shape from ``like`` or are too large (collective)."""
        with together(comm):
            for name in self.rows.keys() & like.rows.keys():
                rows = self.rows[name]
                shape = like.rows[name].shape
                if rows.shape != shape or not (np.abs(rows) < MAX_VALUE).all():
                    raise InputError(
                        f"the checkpoint is damaged: {name} is no {shape} array of finite numbers"
                    )
