"""The cell size that gives a wanted number of cells."""

import numpy as np

from msmpetsc.comm import log
from msmpetsc.errors import InputError
from msmpetsc.geometry.cages import Body, count_cells, refuse_beyond_memory, slab_cells
from msmpetsc.geometry.grid import Grid

TOLERANCE = 0.01
SEARCH_LIMIT = 30  # sizes tried; a real model needs three to six


def choose_cell_size(body: Body, count: int, method: str = "exact", max_cells: int = 5_000_000) -> float:
    """The cell size [m] that gives ``count`` cells within 1%, or the nearest found with a warning (collective).

    The number of cells falls about as a power of the size, so this is a secant search in logarithms,
    kept inside the bracket found so far: the number is a step function and not quite monotone.

    raises : InputError if ``count`` is more than ``max_cells``, or than memory can hold
    """
    if count > max_cells:
        raise InputError(f"cages.count: {count} is more than cages.max_cells = {max_cells}")
    refuse_beyond_memory(body.comm, count)
    excess = {}  # log(size) -> log(cells / count)
    guess = np.log(_first_guess(body, count))
    for _ in range(SEARCH_LIMIT):
        boundary, gaps = slab_cells(body, Grid.covering(body.bounds, np.exp(guess)), method, 20 * max_cells)
        excess[guess] = np.log(count_cells(body.comm, boundary, gaps) / count)
        nearest = min(excess, key=lambda size: abs(excess[size]))
        if abs(np.expm1(excess[nearest])) <= TOLERANCE:
            return float(np.exp(nearest))
        guess = _next_guess(excess, nearest)
    found = round(count * np.exp(excess[nearest]))
    log.warning("cages.count: no cell size was found that gives %d cells within 1%%; taking %d", count, found)
    return float(np.exp(nearest))


def _first_guess(body: Body, count: int) -> float:
    """The size h with V / h^3 + 3/4 A / h^2 = count: the body's volume, and what the boundary cells stick out."""
    roots = np.roots([count, 0, -0.75 * body.report.area, -abs(body.report.volume)])
    return float(roots.real.max())


def _next_guess(excess: dict[float, float], nearest: float) -> float:
    """Where the secant through the two best tries meets zero, else the middle of the bracket."""
    slope = -2.5  # between that of a shell and that of a solid
    if len(excess) > 1:
        second = min((size for size in excess if size != nearest), key=lambda size: abs(excess[size]))
        secant = (excess[nearest] - excess[second]) / (nearest - second)
        slope = secant if -5 < secant < -1 else slope
    guess = nearest - excess[nearest] / slope
    low = max((size for size in excess if excess[size] > 0), default=-np.inf)
    high = min((size for size in excess if excess[size] < 0), default=np.inf)
    if low < guess < high and guess not in excess:
        return guess
    return (low + high) / 2 if np.isfinite(low + high) else guess
