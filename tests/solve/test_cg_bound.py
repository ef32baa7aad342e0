"""The bound on what CG leaves, against the error itself."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from petsc4py import PETSc

from msmpetsc.solve.linear.cg_bound import SolveBound


@pytest.fixture(scope="module")
def dense() -> np.ndarray:
    """A matrix H (200, 200) with a diagonal D from 1 to 100."""
    rng = np.random.default_rng(0)
    turns = np.linalg.qr(rng.normal(size=(200, 200)))[0]
    scaled = turns @ np.diag(np.geomspace(0.01, 2, 200)) @ turns.T
    root = np.sqrt(np.geomspace(1, 100, 200) / scaled.diagonal())
    return root[:, None] * scaled * root


@contextmanager
def solved(
    dense: np.ndarray, right: np.ndarray, its: int
) -> Iterator[tuple[SolveBound, float, np.ndarray]]:
    """The bound of so many iterations of CG with D, the residual that they leave, |r|_(D^-1), and
    what they find."""
    bound, ksp, matrix = (
        SolveBound(),
        PETSc.KSP().create(),
        PETSc.Mat().createDense(dense.shape, array=dense),
    )
    matrix.assemble()
    ksp.setType(PETSc.KSP.Type.CG)
    ksp.setNormType(PETSc.KSP.NormType.NATURAL)
    ksp.getPC().setType(PETSc.PC.Type.JACOBI)
    ksp.setOperators(matrix)
    ksp.setTolerances(max_it=its, rtol=1e-30)
    ksp.setMonitor(bound.watch)
    b, x = PETSc.Vec().createWithArray(right), matrix.createVecRight()
    ksp.solve(b, x)
    yield bound, ksp.getResidualNorm(), x.array
    for owned in (ksp, b, x, matrix):
        owned.destroy()


@pytest.mark.parametrize("its", [1, 5, 15, 40])
def test_it_is_no_less_than_the_error_and_nearer_than_the_residual_tells(
    dense: np.ndarray, its: int
):
    right = np.random.default_rng(1).normal(size=200)
    scale = 1 / np.sqrt(dense.diagonal())
    least = np.linalg.eigvalsh(scale[:, None] * dense * scale)[0]
    with solved(dense, right, its) as (bound, residual, x):
        e = np.linalg.solve(dense, right) - x
        error = np.sqrt(e @ dense @ e)
        assert error <= bound.of(least) <= bound.of(0.7 * least) < 2.5 * error
        assert bound.of(least) < 0.7 * residual / np.sqrt(least)


def test_too_great_an_eigenvalue_says_nothing(dense: np.ndarray):
    assert SolveBound().of(0.01) == np.inf  # nothing was solved
    with solved(dense, np.ones(200), 20) as (bound, _, _):
        assert bound.of(1.9) == bound.of(0.0) == np.inf
