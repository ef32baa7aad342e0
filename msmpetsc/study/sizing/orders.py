"""Discretisation error from runs of several sizes, by Richardson extrapolation with the observed order.

A size is the edge of a cell, or the time step. Where the error is e = C size^p, three runs tell p
and C (Roache 1994, the grid convergence index). Errors are fields: that of a coarse run is its
distance d to a finer one, plus the finer one's error, as vectors at an angle,

    e_a^2 = d^2 + e_b^2 + 2 c d e_b,        c its cosine.

With c = 1, which is Roache's, all err to the same side, as time steps do. Lattices of unlike cells
err by chance as well, each in its own way: distances of three of them tell c.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from scipy.optimize import brentq

ORDERS = (
    1.0,
    2.2,
)  # that are believed: of a boundary seen by the share of its cells, of linear cells; of steps
ALIKE = 1.9  # times: sizes nearer than that differ by chance as much as by their order
CLOSE = 1.01  # times: what parts sizes nearer than that is chance alone
UNSEEN = 0.05  # a measured order may lie so far below the range before it counts as not seen


@dataclass(frozen=True)
class ErrorLaw:
    """A power law of the error, factor size^order."""

    factor: float
    order: float
    seen: bool = (
        True  # the order was measured; else it is the end of the range that the measurements left
    )
    cosine: float = 1.0  # of what parts two runs and the finer one's error

    def error(self, size: float) -> float:
        """Return the error of a size [-]."""
        return float(self.factor * size**self.order)

    def size(self, error: float) -> float:
        """Return the largest size with this error."""
        return float((error / self.factor) ** (1 / self.order))

    def through(self, *known: tuple[float, float]) -> "ErrorLaw":
        """Return the law through the (size, error) of one run, with this order, or of two runs, the coarser first."""
        (a, error), (b, less) = known[0], known[-1]
        order = (
            math.log(error / less) / math.log(a / b)
            if a > CLOSE * b and error > less > 0
            else self.order
        )
        return replace(self, factor=error / a**order, order=order)

    def measured(self, apart: float, finer: float) -> float:
        """Return the error of a run from its distance to a finer one."""
        error = self.error(finer)
        return math.sqrt(apart**2 + error**2 + 2 * self.cosine * apart * error)

    def measured_finer(self, apart: float, size: float, coarser: float) -> float:
        """Return the error of a run from its distance to a coarser one."""
        return _finer_error(apart, (coarser / size) ** self.order, self.cosine)


def _finer_error(apart: float, ratio: float, cosine: float) -> float:
    """Return e_b from d, c and e_a / e_b."""
    return apart * (cosine + math.sqrt(cosine**2 + ratio**2 - 1)) / (ratio**2 - 1)


def cosine_of(first: float, second: float, across: float) -> float:
    """Return the cosine c of three runs from the distances of neighbours and of the ends, within 0 and 1."""
    if not first or not second:
        return 1.0
    return min(1.0, max(0.0, (across**2 - first**2 - second**2) / (2 * first * second)))


def error_law(
    sizes: Sequence[float],
    distances: Sequence[float],
    orders: tuple[float, float],
    across: float | None = None,
    cosine: float = 1.0,
) -> ErrorLaw:
    """Return the law of the error from the distances between runs of descending sizes.

    sizes     : two or three of them
    distances : one fewer; of the last two runs the last
    orders    : the least and the greatest that are believed; of two sizes the least is taken
    across    : distance of the first and the last run, which is taken where no order is seen and the last two are alike
    """
    order, seen = orders[0], False
    if len(sizes) > 2 and distances[-1] > 0:
        order, seen = _order(sizes, distances[-2] / distances[-1], cosine, orders)
    (a, b), apart = sizes[-2:], distances[-1]
    if not seen and across is not None and a < ALIKE * b:
        a, apart = sizes[0], across
    return ErrorLaw(_finer_error(apart, (a / b) ** order, cosine) / b**order, order, seen, cosine)


def _order(
    sizes: Sequence[float], ratio: float, cosine: float, orders: tuple[float, float]
) -> tuple[float, bool]:
    """Return the order at which distances have this ratio, clipped to the range, and whether it was observed."""
    a, b, c = sizes[-3:]
    low, high = orders

    def excess(order: float) -> float:  # rises with the order
        middle = (b / c) ** order * _finer_error(1.0, (b / c) ** order, cosine)
        coarse = (a / b) ** order * middle
        return float(math.sqrt(coarse**2 - (1 - cosine**2) * middle**2) - cosine * middle - ratio)

    if excess(low) >= 0:
        return low, excess(low - UNSEEN) < 0
    if excess(high) <= 0:
        return high, True
    return float(brentq(excess, low, high)), True
