"""Volumes of cells, and cells that are inside out, which a neo-Hookean solid turns back."""

import numpy as np
import pytest
from block_scene import YOUNG
from lattices import COMM, DENSITY, T, block, cages_of

from msmpetsc.elasticity.cell_volume import least_volumes
from msmpetsc.lattice.lattice import Lattice, build_lattice
from msmpetsc.scene.body import Material
from msmpetsc.solve.nonlinear.functional import StepProblem
from msmpetsc.solve.nonlinear.step import Stepper
from msmpetsc.solve.presets import PRESETS, find_preset

H = 0.1


def lattice_of(*sides: int, law: str = "neo-hookean") -> Lattice:
    return build_lattice(
        cages_of(block(*sides), H), Material(density=DENSITY, young_modulus=YOUNG, law=law)
    )


def test_volumes_at_rest_and_mirrored():
    lattice = lattice_of(2, 2, 1)
    cells, rest = lattice.local_cells, lattice.nodes
    assert len(cells) == 4
    np.testing.assert_allclose(least_volumes(rest, cells), H**3, rtol=1e-12)
    for axis in range(3):
        np.testing.assert_allclose(
            least_volumes(rest * (1 - 2 * (np.arange(3) == axis)), cells), -(H**3), rtol=1e-12
        )
    # The corners of a stretched cell all have the same volume: the determinant.
    stretch = np.array([[1.2, 0.3, 0], [0, 0.9, -0.2], [0.1, 0, 0.8]])
    np.testing.assert_allclose(
        least_volumes(rest @ stretch.T, cells), np.linalg.det(stretch) * H**3, rtol=1e-12
    )


@pytest.mark.parametrize("corner", range(8))
def test_a_corner_pushed_through_its_cell_makes_its_volume_least(corner: int):
    """A corner moved inwards by s along all edges makes the least volume, at this corner.

    The edges at the corner become e_k = unit_k - s (1, 1, 1).
    """
    one = lattice_of(1, 1, 1)
    cell, q = one.local_cells[0], one.nodes / H
    inwards = 2 * q.mean(axis=0) - 2 * q[cell[corner]]
    q[cell[corner]] += 0.8 * inwards
    # det(I - 0.8 * ones) = 1 - 3 * 0.8
    np.testing.assert_allclose(least_volumes(q, one.local_cells), 1 - 2.4, rtol=1e-12)


def after_many_steps(lattice: Lattice, start: np.ndarray) -> np.ndarray:
    """Return the positions (n, 3) [m] after 150 damped steps from rest at ``start``."""
    stepper = Stepper(COMM, lattice, T, find_preset("newton"), error=1e-4)
    q = before = start
    try:
        for _ in range(150):
            q, before = stepper.step(StepProblem(q, 2 * q - before, np.zeros_like(q))).position, q
    finally:
        stepper.destroy()
    return q


def test_a_cell_folded_into_its_neighbour_comes_back_as_a_solid_and_stays_as_springs():
    """A cell folded into its neighbour unfolds as a solid and stays folded as springs.

    The end of a bar is pushed through the last cell's inner face. The mirrored cell has all its
    springs at rest length, so Hooke's law resists nothing.
    """
    bar = lattice_of(3, 1, 1)
    start = bar.nodes + 0.02 * H * np.random.default_rng(7).normal(size=bar.nodes.shape)
    start[np.isclose(bar.nodes[:, 0], bar.nodes[:, 0].min()), 0] += 1.5 * H
    assert least_volumes(start, bar.local_cells).min() < 0
    back = after_many_steps(bar, start)
    stuck = after_many_steps(lattice_of(3, 1, 1, law="linear"), start)
    np.testing.assert_allclose(least_volumes(back, bar.local_cells), H**3, rtol=1e-3)
    np.testing.assert_allclose(
        np.sort(least_volumes(stuck, bar.local_cells)), [-(H**3), H**3, H**3], rtol=1e-3
    )


@pytest.mark.parametrize("seed", range(2))
def test_a_mirrored_cell_unfolds_without_a_step_that_fails(seed: int):
    """The Hessian of the cell is indefinite, so newton must leave the projected Hessian."""
    one = lattice_of(1, 1, 1)
    start = one.nodes * [1, 1, -1] + 0.05 * H * np.random.default_rng(seed).normal(
        size=one.nodes.shape
    )
    end = after_many_steps(one, start)
    assert (
        least_volumes(start, one.local_cells).max() < 0 < least_volumes(end, one.local_cells).min()
    )


def squeezed_step(
    preset: str, height: float, error: float
) -> tuple[np.ndarray, float, Lattice, np.ndarray]:
    """Step a block from rest at a share of its height; return x, stated error, block and q_n."""
    lattice = lattice_of(3, 3, 3)
    shake = 0.02 * H * np.random.default_rng(9).normal(size=lattice.nodes.shape)
    q = (lattice.nodes - lattice.nodes.mean(axis=0)) * [1, 1, height] + shake
    stepper = Stepper(COMM, lattice, T, find_preset(preset), error)
    try:
        result = stepper.step(StepProblem(q, q, np.zeros_like(q)))
    finally:
        stepper.destroy()
    return result.position, result.cost.step_error, lattice, q


@pytest.mark.parametrize(
    ("preset", "height"),
    [("newton", 0.45), ("anderson", 0.45), *((preset, 0.85) for preset in PRESETS)],
)
def test_every_preset_steps_a_squeezed_solid_to_the_error_it_declares(preset: str, height: float):
    x, error, lattice, q = squeezed_step(preset, height, 1e-3)
    exact = squeezed_step("newton", height, 1e-10)[0]
    norm = lambda v: np.sqrt((v**2).sum(axis=1) @ lattice.mass)  # noqa: E731
    assert error <= 1e-3 and norm(x - exact) <= 1.5 * error * norm(exact - q)
