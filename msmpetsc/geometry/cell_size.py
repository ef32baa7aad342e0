"""Find the cell size for a wanted number of cells, and warn of walls too thin for the cells."""

from collections.abc import Sequence

import numpy as np

from msmpetsc.comm import log
from msmpetsc.errors import InputError, body_names
from msmpetsc.geometry.cages import BodySurface, slabs_of_all
from msmpetsc.geometry.grid import BodyGrids
from msmpetsc.geometry.thickness import ADVISED, ENOUGH
from msmpetsc.scene.body import SOLID

# most cell sizes tried [-]; real models need 3 to 6
SEARCH_LIMIT = 30


def choose_cell_size(
    bodies: Sequence[BodySurface], count: int, max_cells: int = 5_000_000
) -> float:
    """Return the cell size [m] that gives ``count`` cells within 1% (collective).

    The number of cells is about a power of the size, so the search is a secant method in
    logarithms. A bracket guards it, because the number is a step function and not quite monotone.
    If no size meets the tolerance, return the best size and log a warning.

    Raises InputError if ``count`` is more than ``max_cells``.
    """
    if count > max_cells:
        raise InputError(f"cages.count: {count} is more than cages.max_cells = {max_cells}")
    comm = bodies[0].comm
    bounds = [body.bounds for body in bodies]
    # excess[log(size)] = log(cells / count)
    excess = {}
    guess = np.log(estimated_size(bodies, count))
    for _ in range(SEARCH_LIMIT):
        grids = BodyGrids.covering(bounds, np.exp(guess))
        slabs = slabs_of_all(bodies, grids, 20 * max_cells)
        excess[guess] = np.log(sum(cells.count(comm) for cells in slabs) / count)
        nearest = min(excess, key=lambda size: abs(excess[size]))
        # a hundredth of the cells changes results by far less than the lattice's error
        if abs(np.expm1(excess[nearest])) <= 0.01:
            return float(np.exp(nearest))
        guess = _next_guess(excess, nearest)
    log.warning(
        "cages.count: no cell size was found that gives %d cells within 1%%; taking %d",
        count,
        round(count * np.exp(excess[nearest])),
    )
    return float(np.exp(nearest))


def estimated_cells(bodies: Sequence[BodySurface], cell_size: float) -> float:
    """Estimate the number of cells of side h [m] in bodies as V / h^3 + 3/4 A / h^2.

    The second term is the part of the boundary cells outside the surface.
    """
    return sum(
        abs(body.report.volume) / cell_size**3 + 0.75 * body.report.area / cell_size**2
        for body in bodies
    )


def estimated_size(bodies: Sequence[BodySurface], count: float) -> float:
    """Estimate the cell size [m] that gives ``count`` cells."""
    area = sum(body.report.area for body in bodies)
    volume = sum(abs(body.report.volume) for body in bodies)
    roots = np.roots([count, 0, -0.75 * area, -volume])
    return float(roots.real.max())


def advised_size(bodies: Sequence[BodySurface], law: str) -> float:
    """Return the largest cell size [m] at which the thinnest tenth of each body bends enough.

    Return infinity if all bodies are open.
    """
    sizes = [body.thickness.advised_size(law) for body in bodies if body.thickness]
    return min(sizes, default=np.inf)


def warn_of_thin_bodies(bodies: Sequence[BodySurface], cell_size: float, law: str) -> None:
    """Warn if a tenth of a body is so thin that it bends too little on cells of side h [m].

    law : law of the material; in a solid, walls along the grid bend freely
    """
    bending = {
        number: body.thickness.bending(cell_size, law)
        for number, body in enumerate(bodies)
        if body.thickness
    }
    thinnest = min(bending, key=lambda number: bending[number], default=None)
    if thinnest is None or bending[thinnest] >= ENOUGH:
        return
    advised = advised_size(bodies, law)
    log.warning(
        "a tenth of %s is so thin%s that it bends by about %.2g of theory: cages.count = %d or "
        "cages.cell_size = %.2g makes that %.2g",
        body_names(len(bodies))[thinnest],
        ", and askew to the grid," if law == SOLID else "",
        bending[thinnest], float(f"{estimated_cells(bodies, advised):.2g}"), advised, ADVISED,
    )  # fmt: skip


def _next_guess(excess: dict[float, float], nearest: float) -> float:
    """Return the root of the secant through the two best sizes, or else a size in the bracket."""
    # slope of the first step: between -2 for a shell and -3 for a solid
    slope = -2.5
    if len(excess) > 1:
        second = min(
            (size for size in excess if size != nearest), key=lambda size: abs(excess[size])
        )
        secant = (excess[nearest] - excess[second]) / (nearest - second)
        slope = secant if -5 < secant < -1 else slope
    guess = nearest - excess[nearest] / slope
    low = max((size for size in excess if excess[size] > 0), default=-np.inf)
    high = min((size for size in excess if excess[size] < 0), default=np.inf)
    if low < guess < high and guess not in excess:
        return guess
    if np.isfinite(low + high):
        return (low + high) / 2
    # all sizes are too small, or all are too large: go beyond the outermost size
    outermost = high if np.isfinite(high) else low
    return outermost - excess[outermost] / slope
