"""What a plan of a surface error tells: its trials and its answer."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from msmpetsc.study.sizing.choice import Candidate, Choice


@dataclass(frozen=True)
class SizeTrial:
    """A run that was made.

    asked, cells : valid cells asked for, and had
    cost         : computing seconds a simulated second
    substeps     : of a step, for verlet; else iterations; their mean
    inverted     : cells that end inside out
    result       : its file
    """

    method: Candidate
    asked: int
    cells: float
    cost: float
    substeps: float
    inverted: float
    result: Path

    @property
    def edge(self) -> float:
        """Edge of a cell, of a body of one cell."""
        return self.cells ** (-1 / 3)


class Tried(NamedTuple):
    """A trial as a point over cost and expected error."""

    method: str
    cells: float
    cost: float
    error: float


@dataclass
class SizePlan:
    """The answer.

    choice : the cheapest that meets the error, or of the smallest error there is
    met    : whether it is expected to meet the error
    bounds : what keeps the error from being smaller, or the estimate from being sure, in words
    """

    choice: Choice
    met: bool
    bounds: list[str] = field(default_factory=list)
    tried: list[Tried] = field(default_factory=list)
