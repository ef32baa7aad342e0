"""Discretisation error by Richardson extrapolation from runs of several sizes.

A size is the edge of a cell. If the error is e = C size^p, three runs determine p and C (Roache
1994, the grid convergence index). The errors are fields. With distance d between a coarse run a and
a finer run b, and the angle between the fields d and e_b of cosine c,

    e_a^2 = d^2 + e_b^2 + 2 c d e_b.

Roache's method has c = 1: all errors have the same direction. Errors of lattices that do not nest
also have a random part. The distances of three lattices determine c.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from scipy.optimize import brentq

# range of orders accepted: 1 for partly filled boundary cells, 2 for linear cells
ORDERS = (1.0, 2.2)
# largest order through two runs [-]; keeps powers of sizes finite
STEEPEST = 100.0
# distance below the range within which a measured order still counts as observed [-]
ORDER_TOLERANCE = 0.05


@dataclass(frozen=True)
class ErrorLaw:
    """The power law e = factor * size^order of an error.

    observed : whether the order was measured; otherwise it is an assumption
    cosine   : cosine c of the angle between distance and error of the finer run
    """

    factor: float
    order: float
    observed: bool = True
    cosine: float = 1.0

    def error(self, size: float) -> float:
        """Return the error at a size [-]."""
        return float(self.factor * size**self.order)

    def size(self, error: float) -> float:
        """Return the size that has this error."""
        return float((error / self.factor) ** (1 / self.order))

    def through(self, *known: tuple[float, float]) -> "ErrorLaw":
        """Return the law through one or two known (size, error), the coarser run first.

        The order changes only if two runs determine it.
        """
        (a, error_a), (b, error_b) = known[0], known[-1]
        order = self.order
        if a > b and error_a > error_b > 0:
            order = min(math.log(error_a / error_b) / math.log(a / b), STEEPEST)
        return replace(self, factor=error_a / a**order, order=order)

    def measured(self, distance: float, finer: float) -> float:
        """Return the error of a run from its distance to a run of the size ``finer``."""
        error = self.error(finer)
        return math.sqrt(distance**2 + error**2 + 2 * self.cosine * distance * error)


def _finer_error(distance: float, ratio: float, cosine: float) -> float:
    """Return e_b from d, e_a / e_b and c."""
    return distance * (cosine + math.sqrt(cosine**2 + ratio**2 - 1)) / (ratio**2 - 1)


def cosine_of(first: float, second: float, across: float) -> float:
    """Return the cosine c of three runs from distances 1-2, 2-3 and 1-3, clipped to [0, 1]."""
    if not first or not second:
        return 1.0
    return min(1.0, max(0.0, (across**2 - first**2 - second**2) / (2 * first * second)))


def error_law(
    sizes: Sequence[float],
    distances: Sequence[float],
    orders: tuple[float, float],
    cosine: float = 1.0,
    assumed: float | None = None,
) -> ErrorLaw:
    """Return the law of the error from distances between runs.

    sizes     : two or three sizes, descending
    distances : distances between consecutive runs
    orders    : least and greatest order accepted
    cosine    : cosine c of the angle between distance and error
    assumed   : order if the distances show none, for example with two runs; the least if None
    """
    order = None
    if len(sizes) > 2 and distances[-1] > 0:
        order = _order(sizes, distances[-2] / distances[-1], cosine, orders)
    observed = order is not None
    if order is None:
        order = orders[0] if assumed is None else assumed
    a, b = sizes[-2:]
    factor = _finer_error(distances[-1], (a / b) ** order, cosine) / b**order
    return ErrorLaw(factor, order, observed, cosine)


def _order(
    sizes: Sequence[float], ratio: float, cosine: float, orders: tuple[float, float]
) -> float | None:
    """Return the order that gives a ratio of distances, clipped; None if there is no such order."""
    a, b, c = sizes[-3:]
    low, high = orders

    # increases with the order
    def excess(order: float) -> float:
        middle = (b / c) ** order * _finer_error(1.0, (b / c) ** order, cosine)
        coarse = (a / b) ** order * middle
        return float(math.sqrt(coarse**2 - (1 - cosine**2) * middle**2) - cosine * middle - ratio)

    if excess(low) >= 0:
        return low if excess(low - ORDER_TOLERANCE) < 0 else None
    if excess(high) <= 0:
        return high
    return float(brentq(excess, low, high))
