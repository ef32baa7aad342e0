"""How many iterations CG on the true Hessian takes with the cycle: few, whatever the time step, and no more on a finer
lattice."""

import numpy as np
import pytest
from hierarchies import COMM, SHAPES, block, build, figure, hierarchy

TOLERANCE = 3e-2  # -ksp_rtol of newton's presets
STEPS = [1e-4, 1e-3, 1e-2, 1 / 60, 1e-1, 1.0]  # [s]: from hardly coupled nodes to statics
NAMED = {  # cells at a fineness; pinned; fineness
    "clamped beam": (lambda n: block(10 * n, 2 * n, 2 * n), True, (1, 2, 4)),
    "block": (lambda n: block(3 * n, 3 * n, 3 * n), False, (1, 2, 4)),
    "clamped sheet": (lambda n: block(10 * n, 10 * n, 1), True, (1, 2, 4)),
    "figure": (figure, False, (1, 2)),
}
MOST = {"clamped beam": 3, "block": 3, "clamped sheet": 4, "figure": 9}
# one more than seen; between the figure's legs is one cell, so that they share coarse nodes
GROWTH = 1  # from the coarsest lattice to the finest


def counts(name: str, fineness: int, shape: str) -> np.ndarray:
    """Iterations (steps, 2): under weight, and of rough pushes."""
    cells, pins, _ = NAMED[name]
    lattice, found = build(COMM, cells(fineness), pins=pins), []
    for step in STEPS:
        with hierarchy(COMM, lattice, SHAPES[shape], step) as case:
            found.append([case.iterations(TOLERANCE, rough) for rough in (False, True)])
    return np.array(found)


@pytest.mark.parametrize("shape", ["rest", pytest.param("turned", marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", NAMED)
def test_few_iterations_at_any_step_and_fineness(name: str, shape: str):
    found = [counts(name, fineness, shape) for fineness in NAMED[name][2]]
    print(name, shape, *(each.T.tolist() for each in found))
    assert np.max(found) <= MOST[name]
    assert (found[-1] - found[0]).max() <= GROWTH
