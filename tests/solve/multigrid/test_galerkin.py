"""Coarse matrices are P^T H P with the projected Hessian H, for lattices of all kinds."""

import numpy as np
import pytest
from hierarchies import COMM, LATTICES, SHAPES, Case, build, hierarchy
from lattices import block

from msmpetsc.solve.multigrid.coarse_products import CoarseOperator

# lattice, shape, contact, further arguments
CASES = {
    "pinned": ("block", "twisted", False, {"pins": True}),
    "crushed": ("block that begins at odd indices", "crushed", False, {}),
    "of two materials": ("L", "twisted", False, {"contrast": 1e6, "pins": True}),
    "touching": ("tilted beam", "twisted", True, {"pins": True}),
    "in two pieces": ("two bodies in one coarse cell", "crushed", True, {}),
    "many": ("many bodies", "twisted", True, {}),
    "thin": ("thin sheet", "twisted", False, {"pins": True}),
    "solid": ("block that begins at odd indices", "twisted", True, {"poisson": 0.45, "pins": True}),
    "solid, crushed": ("limbs", "crushed", True, {"poisson": 0.49, "contrast": 1e3}),
}


def raised(matrix: np.ndarray, case: Case) -> np.ndarray:
    """Return a matrix with its diagonal raised, more if a body is free."""
    return matrix + (1e-5 if case.multigrid.bodies.free.any() else 1e-8) * np.diag(
        matrix.diagonal()
    )


def assert_close(found: np.ndarray, expected: np.ndarray, accuracy: float = 1e-12) -> None:
    """Assert equality relative to the nodes' own entries, since soft and stiff parts are joined."""
    size = np.sqrt(expected.diagonal())
    np.testing.assert_allclose(
        found / np.outer(size, size), expected / np.outer(size, size), rtol=0, atol=accuracy
    )


def check_levels(case: Case) -> None:
    h = case.hessian()
    for level in range(len(case.multigrid.levels)):
        p, found = case.interpolation(level), case.level(level)
        assert_close(found, raised(p.T @ h @ p, case))
        assert np.linalg.eigvalsh(found).min() > 0
        if level < len(case.multigrid.coarse):
            check_operator(case.multigrid.coarse[level], found)
        h = found


def check_operator(coarse: CoarseOperator, matrix: np.ndarray) -> None:
    """Check that the operator is the matrix in single precision, also for translations."""
    x, found = coarse.operator.createVecs()
    noise = np.random.default_rng(1).standard_normal(x.getLocalSize())
    translation = np.tile([1.0, 2.0, 3.0], len(noise) // 3)
    for values in (noise, translation):
        x.array[:] = values
        coarse.operator.mult(x, found)
        expected = matrix @ values
        np.testing.assert_allclose(found.array, expected, rtol=0, atol=2e-6 * abs(expected).max())


@pytest.mark.parametrize("seed", [0, 3, 4, 5])
def test_levels_of_random_lattices_are_galerkin_products(seed: int):
    """Pinned nodes belong to several parts, each with its own copies of coarse nodes."""
    rng = np.random.default_rng(seed)
    cells = block(7, 7, 7)
    lattice = build(COMM, cells[rng.random(len(cells)) < 0.3])
    lattice = lattice.pin(rng.random(len(lattice.nodes)) < 0.4)
    with hierarchy(COMM, lattice, SHAPES["twisted"], coarsest=10) as case:
        check_levels(case)


@pytest.mark.parametrize("name", CASES)
def test_levels_are_galerkin_products(name: str):
    """Coarse matrices are positive definite at any positions."""
    lattice, shape, contact, more = CASES[name]
    with hierarchy(
        COMM, build(COMM, LATTICES[lattice], **more), SHAPES[shape], contact=contact, coarsest=10
    ) as case:
        # each body is a single cell, so no grid is coarser
        assert len(case.multigrid.levels) > 1 or name == "many"
        check_levels(case)
        finest = case.dense(lambda x, y: case.multigrid.fine.mult(None, x, y))
        exact = case.hessian()
        np.testing.assert_allclose(finest, exact, rtol=0, atol=1e-5 * np.abs(exact).max())


def test_a_new_hierarchy_takes_nothing_of_the_old_one():
    """A new hierarchy takes over neither positions, nor contact, nor entries of matrices."""
    lattice = build(COMM, LATTICES["limbs"], pins=True)
    with hierarchy(COMM, lattice, SHAPES["crushed"], contact=True, coarsest=10) as case:
        check_levels(case)
        case.q, case.blocks = SHAPES["twisted"](case.lattice.nodes), np.empty((0, 9))
        case.multigrid.update(case.q, case.blocks)
        check_levels(case)
        again = case.cycle()
    with hierarchy(COMM, lattice, SHAPES["twisted"], coarsest=10) as case:
        np.testing.assert_array_equal(case.cycle(), again)


def test_a_hierarchy_says_what_its_levels_are():
    """The nonzeros told for the finest level, never assembled, are those of its dense matrix."""
    lattice = build(COMM, LATTICES["block"], pins=True)
    with hierarchy(COMM, lattice, SHAPES["twisted"], coarsest=10) as case:
        blocks = case.hessian().reshape(-1, 3, len(case.hessian()) // 3, 3)
        dense = 9 * int(np.abs(blocks).max(axis=(1, 3)).astype(bool).sum())
        coarse = [
            np.count_nonzero(case.level(level)) for level in range(len(case.multigrid.levels))
        ]
        nodes, nonzeros = zip(*case.multigrid.sizes, strict=True)
        assert nonzeros[0] == dense and nodes[0] == len(case.hessian()) // 3
        assert all(stored >= needed for stored, needed in zip(nonzeros[1:], coarse, strict=True))
        said = repr(case.multigrid).splitlines()
        assert (
            said[0]
            == f"multigrid of {len(nodes)} levels, operator complexity {sum(nonzeros) / dense:.3f}"
        )
        assert [int(line.split()[2]) for line in said[2:]] == list(nonzeros)
