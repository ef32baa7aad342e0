"""The error of a discretisation from runs of several sizes: Richardson's extrapolation with the order that is seen.

A size is the edge of a cell, or the time step. Where the error is C size^p, two runs are C (a^p - b^p) apart, so three
runs tell p and C (Roache 1994, the grid convergence index).
"""

from collections.abc import Sequence
from dataclasses import dataclass

from scipy.optimize import brentq

CELL_ORDERS = (1.0, 2.2)  # what is taken seriously: of a boundary seen by the share of its cells, of linear cells
STEP_ORDERS = (1.0, 2.2)
ALIKE = 1.9  # times: sizes nearer than that differ by chance as much as by their order
UNSEEN = 0.05  # a measured order may lie so far below the range before it counts as not seen


@dataclass(frozen=True)
class ErrorLaw:
    """An error that goes as a power of a size: factor size^order.

    seen : whether the order was measured; else it is the end of the range that the measurements left
    """

    factor: float
    order: float
    seen: bool = True

    def error(self, size: float) -> float:
        """Return the error of a size [-]."""
        return self.factor * size**self.order

    def size(self, error: float) -> float:
        """Return the greatest size of this error."""
        return (error / self.factor) ** (1 / self.order)


def error_law(
    sizes: Sequence[float], distances: Sequence[float], orders: tuple[float, float], across: float | None = None
) -> ErrorLaw:
    """Return the law of the error from runs of descending sizes and the distances of neighbours.

    sizes     : two or three of them
    distances : one fewer; of the last two runs the last
    orders    : the least and the greatest that are believed; of two sizes the least is taken
    across    : distance of the first and the last run, which is taken where no order is seen and the last two are alike
    """
    low, high = orders
    order, seen = low, False
    if len(sizes) > 2 and distances[-1] > 0:
        order, seen = _order(sizes, distances[-2] / distances[-1], low, high)
    (a, b), apart = sizes[-2:], distances[-1]
    if not seen and across is not None and a < ALIKE * b:
        a, apart = sizes[0], across
    return ErrorLaw(apart / (a**order - b**order), order, seen)


def _order(sizes: Sequence[float], ratio: float, low: float, high: float) -> tuple[float, bool]:
    """Return the order at which neighbours' distances have this ratio, within the range, and whether it was seen."""
    a, b, c = sizes[-3:]

    def excess(order: float) -> float:  # rises with the order
        return (a**order - b**order) / (b**order - c**order) - ratio

    if excess(low) >= 0:
        return low, excess(low - UNSEEN) < 0
    if excess(high) <= 0:
        return high, True
    return float(brentq(excess, low, high)), True
