"""State of a run, which a file holds: positions, velocities, and what the run has counted so far.

What solvers know of the steps before is no part of it. A run forgets that wherever a checkpoint
may be (solve.simulate), so that one that goes on and one that is resumed are the same bit by bit.
"""

import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field, is_dataclass, replace
from typing import Any, Protocol

import numpy as np
from mpi4py import MPI

from msmpetsc.backend.arrays import Array
from msmpetsc.comm import together
from msmpetsc.errors import InputError

MOST = 1e60  # of any number: its fourth power is still finite
MOST_COUNT = 2**53  # the whole numbers that a double holds
Range = tuple[float, float]
COUNT: Range = (0, MOST_COUNT)
ANY: Range = (-math.inf, math.inf)
FINITE: Range = (-sys.float_info.max, sys.float_info.max)
LENGTH: Range = (0.0, sys.float_info.max)


class Counting(Protocol):
    """A part of a run that counts.

    state : names of its attributes, numbers or dataclasses of numbers, that a checkpoint holds, and the range of each
    """

    @property
    def state(self) -> dict[str, Range]: ...


def _numbers(part: Counting) -> Iterator[tuple[str, Any]]:
    """Yield the numbers of a part by the names that they are stored under."""
    for attribute in part.state:
        value = getattr(part, attribute)
        inner = vars(value) if is_dataclass(value) else {"": value}
        for name, number in inner.items():
            yield f"{type(part).__name__}.{attribute}.{name}".strip("."), number


@dataclass
class Checkpoint:
    """The state of a run after ``step`` steps; empty, it is what a run begins with.

    rows    : by name, what there is of each node, this rank's owned ones: (owned, 3) or (owned,); q and q_previous
        [m] among them
    numbers : by name, of the whole run
    """

    step: int = 0
    rows: dict[str, Array] = field(default_factory=dict)
    numbers: dict[str, float] = field(default_factory=dict)

    def keep(
        self, rows: dict[str, Array] | None = None, numbers: dict[str, float] | None = None
    ) -> None:
        """Store a part's rows and numbers."""
        self.rows |= rows or {}
        self.numbers |= numbers or {}

    def keep_counts(self, part: Counting) -> None:
        """Store the numbers of a part."""
        self.keep(numbers=dict(_numbers(part)))

    def restore_counts(self, part: Counting) -> None:
        """Give a part its stored numbers. Raises InputError for what no run can have had."""
        for attribute, bounds in part.state.items():
            value, name = getattr(part, attribute), f"{type(part).__name__}.{attribute}"
            if is_dataclass(value) and not isinstance(value, type):
                inner = {
                    each: self._like(f"{name}.{each}", number, bounds)
                    for each, number in vars(value).items()
                }
                setattr(part, attribute, replace(value, **inner))
            else:
                setattr(part, attribute, self._like(name, value, bounds))

    def _like(self, name: str, value: Any, bounds: Range) -> Any:
        """Return the number of a name, of the kind that ``value`` is."""
        if isinstance(value, float) and math.isnan(value):  # it may be unknown
            return self.numbers.get(name, value)
        least, most = bounds
        if isinstance(value, int):
            least, most = max(least, -MOST_COUNT), min(most, MOST_COUNT)
        return type(value)(self.number(name, value, least, most))

    def row(self, name: str) -> Array:
        """Return the rows of a name. Raises InputError where there are none."""
        if name not in self.rows:
            raise InputError(f"the checkpoint is damaged: it lacks {name}")
        return self.rows[name]

    def number(
        self, name: str, default: float, least: float = -math.inf, most: float = math.inf
    ) -> float:
        """Return the number of a name. Raises InputError for one that no run can have had."""
        value = self.numbers.get(name, default)
        if not least <= value <= most:
            raise InputError(f"the checkpoint is damaged: {name} is {value:g}")
        return value

    def refuse_rows_unlike(self, comm: MPI.Comm, like: "Checkpoint") -> None:
        """Raise InputError for rows of another shape than in ``like``, or absurd (collective)."""
        with together(comm):
            for name in self.rows.keys() & like.rows.keys():
                rows = self.rows[name]
                if rows.shape != like.rows[name].shape or not (np.abs(rows) < MOST).all():
                    raise InputError(
                        f"the checkpoint is damaged: {name} is not of finite numbers, {like.rows[name].shape}"
                    )
