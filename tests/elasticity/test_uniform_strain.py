"""Large uniform strains of a neo-Hookean block against the textbook's forces, by which they are exact."""

from collections.abc import Iterator

import material_study as study
import numpy as np
import pytest
from scipy.optimize import brentq
from skfem.models.elasticity import lame_parameters
from solid_study import POISSON

from msmpetsc.elasticity.energy import Elasticity


def textbook(F: np.ndarray, poisson: float) -> np.ndarray:
    """Return P = mu (F - F^-T) + lambda (J - 1) J F^-T [Pa]."""
    lame, mu = lame_parameters(study.E, poisson)
    J, inverse = np.linalg.det(F), np.linalg.inv(F).T
    return mu * (F - inverse) + lame * (J - 1) * J * inverse


def stretched(poisson: float, s: float, sides: int) -> np.ndarray:
    """Return the deformation gradient of stretches s along all axes but the last so many, whose faces are free."""

    def shape(free: float) -> np.ndarray:
        return np.diag([*(3 - sides) * [s], *sides * [free]])

    return shape(brentq(lambda free: textbook(shape(free), poisson)[2, 2], 0.1, 10, xtol=1e-15))


def strains(poisson: float) -> Iterator[tuple[str, np.ndarray]]:
    """Yield names and deformation gradients."""
    for s in (0.5, 1.5):
        yield f"uniaxial, {s}", stretched(poisson, s, 2)
        yield f"equibiaxial, {s}", stretched(poisson, s, 1)
        yield f"shear, {s}", np.array([[1, s, 0], [0, 1, 0], [0, 0, 1.0]])
    yield "confined, 0.7", np.diag([0.7, 1, 1])


@pytest.mark.parametrize("poisson", POISSON)
def test_the_forces_are_the_textbooks(poisson: float):
    """P n on the faces of a block, half of it at edges, and nothing inside."""
    h, cells = 0.125, (4, 3, 2)
    lattice = study.box(cells, h, poisson)
    sides = h * np.array(cells)
    for name, F in strains(poisson):
        force, exact = np.zeros((2, *lattice.nodes.shape))
        Elasticity(lattice).add_gradient(lattice.nodes @ F.T, force)
        P = textbook(F, poisson)
        for axis in range(3):
            rest, end = (np.delete(of, axis, axis=-1) for of in (lattice.nodes, sides))
            part = np.where(np.isclose(rest, 0) | np.isclose(rest, end), 0.5, 1).prod(axis=1)
            for sign, at in ((-1, 0), (1, sides[axis])):
                on = np.isclose(lattice.nodes[:, axis], at)
                exact[on] += sign * h**2 * part[on, None] * P[:, axis]
        assert np.abs(force - exact).max() < 1e-11 * np.abs(exact).max(), name
