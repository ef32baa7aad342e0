"""The cycle is symmetric, positive definite, and at most the inverse of its own Hessian.

CG on the true Hessian takes few iterations with the cycle at any time step, and not more on a finer
lattice.
"""

import numpy as np
import pytest
from hierarchies import COMM, LATTICES, SHAPES, Case, block, build, figure, heavier, hierarchy
from scipy.linalg import eigh

# relative to the greatest entry; single precision has 6e-8
SYMMETRIC = 1e-6
# effect of single precision on the greatest eigenvalue, 1
BEYOND = 1e-5
# cases in which some bodies are free
LOOSE = {"two bodies", "many bodies"}


def check(
    case: Case, least: float, beyond: float = BEYOND, moves: np.ndarray | None = None
) -> None:
    """Check that B is symmetric and B H has eigenvalues between ``least`` and 1.

    Each part of B moves along a descent, not too far.

    moves : mask of the moving components of a lattice with rollers; only these count
    """
    b, h = case.cycle(), case.hessian()
    if moves is not None:
        b, h = b[moves][:, moves], h[moves][:, moves]
    assert np.isfinite(b).all()
    assert np.abs(b - b.T).max() < SYMMETRIC * np.abs(b).max()
    b = (b + b.T) / 2
    assert np.linalg.eigvalsh(b).min() > 0
    values = eigh(h, np.linalg.inv(b), eigvals_only=True)
    assert least < values.min() and values.max() < 1 + beyond, values[[0, -1]]


@pytest.mark.parametrize("coarsest", [pytest.param(800, marks=pytest.mark.slow), 10])
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("name", LATTICES)
def test_cycles(name: str, shape: str, coarsest: int):
    """The least eigenvalue occurs if bodies share a coarse node although no spring joins them."""
    with hierarchy(COMM, build(COMM, LATTICES[name]), SHAPES[shape], coarsest=coarsest) as case:
        check(case, {"many bodies": 0.07, "two bodies in one coarse cell": 0.18}.get(name, 0.3))


@pytest.mark.parametrize("coarsest", [pytest.param(800, marks=pytest.mark.slow), 10])
@pytest.mark.parametrize("name", ["block", "limbs", "thin sheet", "a cell"])
def test_cycles_of_solids_with_contact_and_pins(name: str, coarsest: int):
    """If cells are pressed to a fifth, the cycle is weaker.

    Their curvature is along few directions, which the cycle cannot smooth.
    """
    lattice = build(COMM, LATTICES[name], poisson=0.25, pins=True)
    with hierarchy(COMM, lattice, SHAPES["crushed"], contact=True, coarsest=coarsest) as case:
        check(case, 0.002)


@pytest.mark.parametrize("mass", [1e-9, pytest.param(1e9, marks=pytest.mark.slow)])
@pytest.mark.parametrize("shape", ["twisted", "crushed"])
@pytest.mark.parametrize("name", LATTICES)
def test_cycles_of_light_and_heavy_bodies(name: str, shape: str, mass: float):
    """A light free body moves as a whole as far as the raised diagonal allows, by 1e-10."""
    pinned = heavier(build(COMM, LATTICES[name], pins=True), mass)
    with hierarchy(COMM, pinned, SHAPES[shape], coarsest=10) as case:
        loose = name in LOOSE and mass < 1
        check(case, 1e-10 if loose else 0.07, 5e-2 if loose else BEYOND)


@pytest.mark.parametrize("contrast", [1e3, 1e6])
@pytest.mark.parametrize("pins", [False, True])
@pytest.mark.parametrize("name", ["block", "limbs", "thin sheet", "rod"])
def test_cycles_of_two_materials(name: str, contrast: float, pins: bool):
    """A single precision serves both parts: the softer part, by 1e6, keeps about a digit."""
    with hierarchy(
        COMM, build(COMM, LATTICES[name], contrast=contrast, pins=pins), SHAPES["twisted"]
    ) as case:
        check(
            case,
            0.1 if contrast < 1e6 else 0.02,
            beyond=1e-7 * contrast if contrast > 1e3 else 1e-4,
        )


def test_one_free_node():
    lattice = build(COMM, LATTICES["a cell"])
    lattice = lattice.pin(np.arange(8) != 5)
    with hierarchy(COMM, lattice, SHAPES["twisted"]) as case:
        assert case.size == 3
        check(case, 0.9)


@pytest.mark.parametrize("shape", ["rest", "twisted"])
@pytest.mark.parametrize("name", ["block", "limbs", "thin sheet"])
def test_cycles_of_bodies_on_rollers(name: str, shape: str):
    """Planes of symmetry at both ends of an axis, and all nodes between two walls.

    The cycle is as good as without rollers, up to 1 / GROUND of each coarse component, because of
    the springs to the ground.
    """
    lattice = build(COMM, LATTICES[name])
    low, high = lattice.nodes.min(axis=0) + 0.01, lattice.nodes.max(axis=0) - 0.01
    x, y, _ = lattice.nodes.T
    planes, walls = np.zeros((2, len(x), 3), bool)
    planes[:, 0], planes[:, 1], walls[:, 2] = x > high[0], y < low[1], True
    for held in (planes, walls):
        with hierarchy(COMM, lattice.pin(held), SHAPES[shape], coarsest=10) as case:
            check(case, 0.3, beyond=0.01, moves=~held.ravel())


@pytest.mark.parametrize("density", [1e-3, 1e3])
@pytest.mark.parametrize("shape", SHAPES)
def test_a_sheet_with_its_underside_held(density: float, shape: str):
    """Free nodes lie halfway between layers of coarse nodes.

    So P^T H P is singular without the raised diagonal.
    """
    lattice = build(COMM, LATTICES["thin sheet"], density=density)
    with hierarchy(
        COMM, lattice.pin(lattice.nodes[:, 2] < 3.01), SHAPES[shape], coarsest=10
    ) as case:
        p = case.interpolation(0)
        assert np.linalg.matrix_rank(p) <= p.shape[1] / 2
        check(case, 0.3)


# -ksp_rtol of newton's presets
TOLERANCE = 3e-2
# time steps [s], from nearly decoupled nodes to statics
STEPS = [1e-4, 1e-3, 1e-2, 1 / 60, 1e-1, 1.0]
# cells at a fineness, whether they are pinned, and the fineness
NAMED = {
    "clamped beam": (lambda n: block(10 * n, 2 * n, 2 * n), True, (1, 2, 4)),
    "block": (lambda n: block(3 * n, 3 * n, 3 * n), False, (1, 2, 4)),
    "clamped sheet": (lambda n: block(10 * n, 10 * n, 1), True, (1, 2, 4)),
    "figure": (figure, False, (1, 2)),
}
# most iterations, with a margin of 1; the legs of the figure share coarse nodes, as
# only one cell lies between them
MOST = {"clamped beam": 3, "block": 3, "clamped sheet": 4, "figure": 9}
# most additional iterations from the coarsest lattice to the finest
GROWTH = 1


def counts(name: str, fineness: int, shape: str) -> np.ndarray:
    """Return the iterations (steps, 2) under weight, and with rough pushes."""
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
