"""Cells that resist being turned inside out, and the stiffening law as a whole."""

from dataclasses import replace

import numpy as np
import pytest
from block_scene import YOUNG
from lattices import block, cages_of
from mpi4py import MPI

from msmpetsc.elasticity.cell_volume import Cells, least_volumes
from msmpetsc.elasticity.energy import ONSET, RESISTANCE, Elasticity
from msmpetsc.errors import StepFailed
from msmpetsc.lattice.lattice import Lattice, build_lattice
from msmpetsc.lattice.material import edge_stiffness
from msmpetsc.scene.body import Material
from msmpetsc.solve.nonlinear.functional import StepProblem
from msmpetsc.solve.nonlinear.step import Stepper
from msmpetsc.solve.presets import PRESETS, find_preset

H, DENSITY, T = 0.1, 1000.0, 1 / 60
COMM = MPI.COMM_SELF
STIFFENING = 10.0


def lattice_of(*sides: int, stiffening: float = STIFFENING) -> Lattice:
    law = {"law": "stiffening", "stiffening": stiffening} if stiffening else {}
    return build_lattice(cages_of(block(*sides), H), Material(density=DENSITY, young_modulus=YOUNG, **law))


SMALL = lattice_of(2, 2, 1)
REST = SMALL.nodes - SMALL.nodes.mean(axis=0)
RNG = np.random.default_rng(7)
SHAKE, V = RNG.normal(size=REST.shape), RNG.normal(size=REST.shape)
SHAPES = {  # of a body whose corners resist: pressed flat, near the onset, shaken, and with J < 0
    "pressed": REST * [1, 1, 0.3] + 0.1 * H * SHAKE,
    "shaken": REST * 0.75 + 0.2 * H * SHAKE,
    "mirrored": REST * [1, 1, -1] + 0.1 * H * SHAKE,
    "mixed": REST + 0.7 * H * SHAKE,
}
shapes = pytest.mark.parametrize("q", SHAPES.values(), ids=SHAPES)
RESIST = Cells.of_lattice(SMALL, np.array([3.0, 1.0, 2.0, 5.0]), ONSET * H**3)  # K in J


def energy(q: np.ndarray) -> float:
    return RESIST.change(q, REST)


def gradient(q: np.ndarray) -> np.ndarray:
    total = np.zeros_like(q)
    RESIST.add_gradient(q, total)
    return total


def hessian_times(q: np.ndarray, v: np.ndarray, projected: bool = False) -> np.ndarray:
    product = np.zeros_like(q)
    RESIST.hessian_at(q, projected)(v, product)
    return product


# ---- volumes


def test_volumes_at_rest_and_mirrored():
    cells = SMALL.local_cells
    assert len(cells) == 4
    np.testing.assert_allclose(least_volumes(REST, cells), H**3, rtol=1e-12)
    for axis in range(3):
        np.testing.assert_allclose(least_volumes(REST * (1 - 2 * (np.arange(3) == axis)), cells), -(H**3), rtol=1e-12)
    stretch = np.array([[1.2, 0.3, 0], [0, 0.9, -0.2], [0.1, 0, 0.8]])  # the same in all corners: its determinant
    np.testing.assert_allclose(least_volumes(REST @ stretch.T, cells), np.linalg.det(stretch) * H**3, rtol=1e-12)


@pytest.mark.parametrize("corner", range(8))
def test_a_corner_pushed_through_its_cell_makes_its_volume_least(corner: int):
    """Unit cube, the corner moved inwards by s along all edges: its own edges are left 1 - s, less what they lean."""
    one = lattice_of(1, 1, 1)
    cell, q = one.local_cells[0], one.nodes / H
    inwards = 2 * q.mean(axis=0) - 2 * q[cell[corner]]
    q[cell[corner]] += 0.8 * inwards
    # the edges e_k = (unit_k - 0.8 (1, 1, 1)): det(I - 0.8 * ones) = 1 - 3 * 0.8
    np.testing.assert_allclose(least_volumes(q, one.local_cells), 1 - 2.4, rtol=1e-12)


# ---- energy and its derivatives


def test_nothing_resists_at_rest_nor_down_to_the_onset():
    for size in (1.0, 0.9, 0.8, 1.5):  # 0.8^3 = 0.512
        assert energy(size * REST) == 0
        np.testing.assert_array_equal(gradient(size * REST), 0)
        np.testing.assert_array_equal(hessian_times(size * REST, V), 0)
    for flat in (0.6, 0.51):
        assert energy(REST * [1, 1, flat]) == 0
    assert energy(REST * [1, 1, 0.49]) > 0


@pytest.mark.parametrize("share", [0.25, 0.0, -1.0])
def test_the_energy_of_a_cell_pressed_to_a_share_of_its_volume(share: float):
    """K (1 - J / J_0)^3 in each of the 8 corners of 4 cells, K = 3, 1, 2 and 5 J."""
    assert energy(REST * [1, 1, share]) == pytest.approx(11.0 * 8 * (1 - share / 0.5) ** 3, rel=1e-12)


@shapes
def test_the_gradient_is_the_slope_of_the_energy(q: np.ndarray):
    assert energy(q) > 0
    step = 1e-7
    slope = (energy(q + step * V) - energy(q - step * V)) / (2 * step)
    assert (gradient(q) * V).sum() == pytest.approx(slope, rel=1e-6)


@shapes
def test_a_change_of_energy_keeps_its_digits(q: np.ndarray):
    """Against the first and second derivative: a plain difference of energies has no digit left here."""
    moved = q + 1e-12 * V
    v = moved - q  # q + v is rounded
    change = RESIST.change(moved, q)
    assert change == pytest.approx((gradient(q) * v).sum() + 0.5 * (hessian_times(q, v) * v).sum(), rel=1e-9, abs=0)
    for far in (REST, 0.7 * REST, 0.5 * q + 0.1, REST * [1, -0.5, 1]):
        assert RESIST.change(far, q) == pytest.approx(energy(far) - energy(q), rel=1e-9)


@shapes
def test_the_hessian_is_the_slope_of_the_gradient(q: np.ndarray):
    step = 1e-7
    slope = (gradient(q + step * V) - gradient(q - step * V)) / (2 * step)
    np.testing.assert_allclose(hessian_times(q, V), slope, atol=1e-6 * np.abs(slope).max())


@shapes
def test_the_projected_hessian_is_positive_where_the_true_one_is_not(q: np.ndarray):
    def dense(projected: bool) -> np.ndarray:
        return np.array([hessian_times(q, unit.reshape(q.shape), projected).ravel() for unit in np.eye(q.size)])

    true, projected = dense(False), dense(True)
    np.testing.assert_allclose(true, true.T, atol=1e-12 * np.abs(true).max())
    np.testing.assert_allclose(projected, projected.T, atol=1e-12 * np.abs(projected).max())
    rounding = 1e-12 * np.abs(true).max()
    assert np.linalg.eigvalsh(true)[0] < -1e3 * rounding
    assert np.linalg.eigvalsh(projected)[0] > -rounding


@shapes
def test_there_is_no_net_force_and_no_net_torque(q: np.ndarray):
    force = gradient(q)
    assert np.abs(force.sum(axis=0)).max() < 1e-12 * np.abs(force).sum()
    assert np.abs(np.cross(q, force).sum(axis=0)).max() < 1e-12 * np.abs(force).sum()


def test_a_mirrored_lattice_has_no_energy_in_its_springs_but_in_its_cells():
    """K a share of k1 h^2, of an edge inside; (1 - (-1) / 0.5)^3 = 27 in each of 32 corners."""
    mirrored = REST * [1, 1, -1]
    assert Elasticity(lattice_of(2, 2, 1, stiffening=0.0)).energy(mirrored) == pytest.approx(0, abs=1e-20)
    K = RESISTANCE * edge_stiffness(YOUNG, H) * H**2
    elasticity = Elasticity(SMALL)
    assert elasticity.energy(mirrored) == pytest.approx(32 * 27 * K, rel=1e-9)
    assert elasticity.change(mirrored, REST) == pytest.approx(32 * 27 * K, rel=1e-9)


# ---- the law as a whole


@shapes
def test_only_cells_that_resist_are_looked_at(q: np.ndarray):
    cells = Elasticity(SMALL).cells
    assert len(cells.resisting(REST).cells) == 0 < len(cells.resisting(q).cells)


def test_small_strains_do_not_tell_the_laws_apart():
    """The Hessian at rest is the same; at a strain s the force differs by b s^2 of itself at most."""
    linear = replace(SMALL, stiffening=0.0)
    products = []
    for lattice in (linear, SMALL):
        product = np.zeros_like(V)
        Elasticity(lattice).hessian_at(SMALL.nodes).add_product(V, product)
        products.append(product)
    np.testing.assert_allclose(products[1], products[0], atol=1e-12 * np.abs(products[0]).max())
    strain, forces = 1e-3, []
    stretched = SMALL.nodes * (1 + strain)
    for lattice in (linear, SMALL):
        force = np.zeros_like(V)
        Elasticity(lattice).add_gradient(stretched, force)
        forces.append(force)
    np.testing.assert_allclose(forces[1], forces[0] * (1 + STIFFENING * strain**2), rtol=1e-9, atol=1e-10)


def after_many_steps(lattice: Lattice, start: np.ndarray, steps: int = 150) -> np.ndarray:
    """Let go from rest at ``start``; implicit Euler damps. (n, 3) [m]"""
    stepper = Stepper(COMM, lattice, T, find_preset("newton"), error=1e-4)
    q = before = start
    try:
        for _ in range(steps):
            q, before = stepper.step(StepProblem(q, 2 * q - before, np.zeros_like(q))).position, q
    finally:
        stepper.destroy()
    return q


def test_a_cell_folded_into_its_neighbour_comes_back_with_the_stiffening_law_and_stays_with_the_linear():
    """The end of a bar, pushed through the face that its last cell shares with the next: mirrored there, all springs of
    that cell have their lengths, so to Hooke's law it is at rest."""
    bar = lattice_of(3, 1, 1)
    start = bar.nodes + 0.02 * H * RNG.normal(size=bar.nodes.shape)
    start[np.isclose(bar.nodes[:, 0], bar.nodes[:, 0].min()), 0] += 1.5 * H
    assert least_volumes(start, bar.local_cells).min() < 0
    back, stuck = after_many_steps(bar, start), after_many_steps(replace(bar, stiffening=0.0), start)
    np.testing.assert_allclose(least_volumes(back, bar.local_cells), H**3, rtol=1e-3)
    np.testing.assert_allclose(np.sort(least_volumes(stuck, bar.local_cells)), [-(H**3), H**3, H**3], rtol=1e-3)
    for q in (back, stuck):
        assert Elasticity(replace(bar, stiffening=0.0)).energy(q) < 1e-6 * bar.stiffness.max() * H**2


def squeezed_step(preset: str, height: float, error: float) -> tuple[np.ndarray, float, Lattice, np.ndarray]:
    """A step of a block from rest at a share of its height: x, the error declared, the block, q_n."""
    lattice = lattice_of(3, 3, 3)
    shake = 0.02 * H * np.random.default_rng(9).normal(size=lattice.nodes.shape)
    q = (lattice.nodes - lattice.nodes.mean(axis=0)) * [1, 1, height] + shake
    stepper = Stepper(COMM, lattice, T, find_preset(preset), error)
    try:
        result = stepper.step(StepProblem(q, q, np.zeros_like(q)))
    finally:
        stepper.destroy()
    return result.position, result.cost.step_error, lattice, q


@pytest.mark.parametrize("seed", range(2))
def test_a_mirrored_cell_unfolds_without_a_step_that_fails(seed: int):
    """Its Hessian is indefinite; newton that kept to the projected one gained 5% an iteration and gave up."""
    one = lattice_of(1, 1, 1)
    start = one.nodes * [1, 1, -1] + 0.05 * H * np.random.default_rng(seed).normal(size=one.nodes.shape)
    end = after_many_steps(one, start)
    assert least_volumes(start, one.local_cells).max() < 0 < least_volumes(end, one.local_cells).min()


@pytest.mark.parametrize(
    ("preset", "height"), [("newton", 0.45), ("anderson", 0.45), *((preset, 0.85) for preset in PRESETS)]
)
def test_every_preset_steps_the_stiffening_law_to_the_error_it_declares(preset: str, height: float):
    """The plain ones only as far as A keeps up with the tangent k (1 + 3 b s^2): it is 1.7 k at 15%."""
    x, error, lattice, q = squeezed_step(preset, height, 1e-3)
    exact = squeezed_step("newton", height, 1e-10)[0]
    norm = lambda v: np.sqrt((v**2).sum(axis=1) @ lattice.mass)  # noqa: E731
    assert error <= 1e-3 and norm(x - exact) <= 1.5 * error * norm(exact - q)


@pytest.mark.parametrize("preset", ["fast-msm", "paper"])
def test_beyond_that_the_plain_presets_fail_and_say_so(preset: str):
    with pytest.raises(StepFailed, match=r"did not converge: .* try .*another preset"):
        squeezed_step(preset, 0.45, 1e-3)
