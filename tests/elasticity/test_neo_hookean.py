"""The neo-Hookean solid in whole and cut cells, against closed forms and finite differences."""

from pathlib import Path

import numpy as np
import pytest
from block_scene import clamped_beam, play, solid_of
from lattices import COMM, block, cages_of, dense_hessian
from scipy.spatial.transform import Rotation

from msmpetsc.elasticity.cell_volume import least_volumes, volume_ratios
from msmpetsc.elasticity.energy import Elasticity
from msmpetsc.elasticity.locate import worst_inverted
from msmpetsc.elasticity.neo_hookean import ONSET, VOLUMETRIC
from msmpetsc.elasticity.solid import NeoHookean
from msmpetsc.elasticity.viscosity import Viscosity
from msmpetsc.lattice.cell_moments import SIGNS, forms_of, laplacians, slopes_and_modes
from msmpetsc.lattice.lattice import Lattice, build_lattice
from msmpetsc.lattice.material import lame_constants
from msmpetsc.scene.body import Material

RNG = np.random.default_rng(30)


@pytest.fixture(autouse=True)
def same_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reseed the noise before each test, so that it does not depend on earlier tests."""
    monkeypatch.setitem(globals(), "RNG", np.random.default_rng(30))


YOUNG, H = 3e4, 0.1


def points_inside(rng: np.random.Generator, n: int) -> np.ndarray:
    """Return points (k, 3) of a random part of a cell, relative to the cell's middle.

    The part is a half space, from a sliver to nearly the whole cell.
    """
    points = rng.random((n, 3)) - 0.5
    height = points @ rng.standard_normal(3)
    return points[height >= np.quantile(height, rng.uniform(0, 0.99))]


def moments(points: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return fills (8,) of corners and second moments (3,) of a part, by sums over its points."""
    return 8 * (0.5 + SIGNS * points[:, None]).prod(axis=2).sum(axis=0) / n, (points**2).sum(
        axis=0
    ) / n


def solid(*sides: int, poisson: float, cut: bool = False, volume: str = "quadratic") -> Lattice:
    """Return the lattice of a block of whole or of randomly cut cells."""
    material = Material(
        density=1000, young_modulus=YOUNG, law="neo-hookean", poisson_ratio=poisson, volume=volume
    )
    lattice = build_lattice(cages_of(block(*sides), H), material)
    if not cut:
        return lattice
    fills, second = map(
        np.array,
        zip(*(moments(points_inside(RNG, 400), 400) for _ in lattice.local_cells), strict=True),
    )
    cells = lattice.solid._replace(forms=forms_of(fills, second), volume=H**3 * fills.mean(axis=1))
    return Lattice(**(vars(lattice) | {"solid": cells}))


def gradient(elastic: Elasticity, q: np.ndarray) -> np.ndarray:
    g = np.zeros_like(q)
    elastic.add_gradient(q, g)
    return g


volumes = pytest.mark.parametrize("volume", VOLUMETRIC)
CASES = [(0.25, False), (0.0, True), (0.45, True), (0.49, False)]
cases = pytest.mark.parametrize(("poisson", "cut"), CASES)
kinds = pytest.mark.parametrize(
    ("poisson", "cut", "volume"),
    [(*case, "quadratic") for case in CASES]
    + [(*case, name) for case in CASES[2:] for name in ("log", "simo")],
)


@kinds
def test_gradient_and_hessian_are_slopes_of_the_energy(poisson: float, cut: bool, volume: str):
    """The derivatives hold in states from strained to inverted, on both branches of U."""
    lattice = solid(3, 2, 2, poisson=poisson, cut=cut, volume=volume)
    elastic = Elasticity(lattice)
    for strain in (0.05, 0.5):
        q = lattice.nodes + strain * H * RNG.standard_normal(lattice.nodes.shape)
        v, e = RNG.standard_normal(q.shape), 1e-6 * H
        slope = elastic.change(q + e * v, q - e * v) / (2 * e)
        assert slope == pytest.approx(np.vdot(gradient(elastic, q), v), rel=1e-6)
        curved = (gradient(elastic, q + e * v) - gradient(elastic, q - e * v)) / (2 * e)
        product = np.zeros_like(q)
        elastic.hessian_at(q).add_product(v, product)
        np.testing.assert_allclose(curved, product, rtol=1e-4, atol=1e-5 * np.abs(product).max())


def test_blocks_of_whole_cells_share_their_constants_wherever_cut_ones_lie():
    """Blocks share constants if every seventh of 96 cells is cut, with two materials."""
    lattice = solid(6, 4, 4, poisson=0.3)
    assert lattice.solid is not None
    cut, hard = (
        np.arange(96) % 7 == 0,
        lattice.nodes[lattice.local_cells].mean(axis=1)[:, 0] > 3 * H,
    )
    forms, shear = lattice.solid.forms.copy(), np.where(hard, 9.0, 1.0) * lattice.solid.shear
    forms[cut] *= RNG.uniform(0.5, 1.0, size=(cut.sum(), 1))
    of_cells = lattice.solid._replace(forms=forms, shear=shear)
    blocks = NeoHookean.of_lattice(Lattice(**(vars(lattice) | {"solid": of_cells}))).blocks
    # two blocks of whole cells, two of mixed cells, two of cut cells
    assert len(blocks.nodes) == 12 and len(blocks.constants) <= 2 + 2 + 2


@pytest.mark.parametrize("cut", [False, True])
def test_a_softened_solid_is_one_of_less_lambda_meanwhile(cut: bool):
    """A softened solid has lambda = mu instead of 49 mu, as for Poisson's ratio 1/4.

    In cells without bending, a Hessian with the pressures of the softer solid equals that of the
    softer solid. Otherwise it adds resistance to changes of the cell's volume and of three sums of
    its modes.
    """
    lattice = solid(2, 2, 1, poisson=0.49, cut=cut)
    assert lattice.solid is not None
    elastic = Elasticity(lattice)
    softer = Elasticity(
        Lattice(**(vars(lattice) | {"solid": lattice.solid._replace(lame=lattice.solid.shear)}))
    )
    q = lattice.nodes + 0.2 * H * RNG.standard_normal(lattice.nodes.shape)
    before, law = gradient(elastic, q), elastic.solid
    assert law is not None and law.stiffest == pytest.approx(49)
    with pytest.raises(KeyError), law.softened(1.0):
        assert elastic.energy(q) == pytest.approx(softer.energy(q), rel=1e-12)
        np.testing.assert_allclose(gradient(elastic, q), gradient(softer, q), rtol=1e-9, atol=1e-9)
        raise KeyError
    assert np.array_equal(gradient(elastic, q), before)
    q = lattice.nodes @ (np.eye(3) + 0.2 * RNG.standard_normal((3, 3))).T
    with law.softened(1.0):
        slopes = law.hessian_at(q, False).slopes
    hessian, columns = law.hessian_at(q, False), []
    hessian.slopes[:] = slopes
    for unit in np.eye(q.size):
        columns.append(np.zeros_like(q))
        hessian(unit.reshape(q.shape), columns[-1])
    added = np.reshape(columns, (q.size, q.size)) - dense_hessian(softer, q)
    values = np.linalg.eigvalsh(added)
    assert values[0] > -1e-9 * values[-1] and (values > 1e-9 * values[-1]).sum() <= 4 * len(
        lattice.local_cells
    )


@kinds
def test_energy_changes_by_what_it_was_and_small_changes_keep_their_digits(
    poisson: float, cut: bool, volume: str
):
    lattice = solid(3, 2, 2, poisson=poisson, cut=cut, volume=volume)
    elastic = Elasticity(lattice)
    q, v = (lattice.nodes + 0.3 * H * RNG.standard_normal(lattice.nodes.shape) for _ in range(2))
    assert elastic.change(q, v) == pytest.approx(elastic.energy(q) - elastic.energy(v), rel=1e-12)
    moved = q + 1e-12 * H * RNG.standard_normal(q.shape)
    assert elastic.change(moved, q) == pytest.approx(
        np.vdot(gradient(elastic, q), moved - q), rel=1e-8
    )


@kinds
def test_projected_hessian_is_semidefinite_and_the_other_no_less_than_minus_its_concavity(
    poisson: float, cut: bool, volume: str
):
    lattice = solid(2, 2, 1, poisson=poisson, cut=cut, volume=volume)
    elastic, worst = Elasticity(lattice), 0.0
    shapes = [
        np.diag([0.6, 1.2, 1.2]),
        np.diag([1.4, 1.4, 0.9]),
        np.diag([0.1, 0.1, -0.02]),
        np.diag([0.9, 0.9, -0.5]),
        # U'' < 0 of the logarithm
        np.diag([1.6, 1.6, 1.6]),
    ]
    for f in (np.eye(3), *shapes, *RNG.normal(size=(8, 3, 3))):
        for noise in (0.0, 0.3):
            q = lattice.nodes @ f.T + noise * H * RNG.standard_normal(lattice.nodes.shape)
            size = np.abs(dense_hessian(elastic, q)).max()
            assert (
                np.linalg.eigvalsh(dense_hessian(elastic, q, projected=True)).min() > -1e-12 * size
            )
            concavity = np.repeat(elastic.concavity(q), 3)
            lowest = np.linalg.eigvalsh(dense_hessian(elastic, q) + np.diag(concavity)).min()
            assert lowest > -1e-12 * size
            worst = max(worst, -np.linalg.eigvalsh(dense_hessian(elastic, q)).min())
    # some cells test the bound
    assert worst > 0.1 * YOUNG * H * lattice.solid.volume.mean() / H**3
    assert elastic.concavity(lattice.nodes).max() < 1e-9 * YOUNG * H


def test_ten_thousand_cut_cells_are_semidefinite_at_rest():
    """The Laplacian of a cell is semidefinite, also less the square of the mean slope (Jensen)."""
    count, n = 10_000, 60
    fills, second = map(
        np.array, zip(*(moments(points_inside(RNG, n), n) for _ in range(count)), strict=True)
    )
    forms, volume = forms_of(fills, second), fills.mean(axis=1)
    slopes, _ = slopes_and_modes(forms)
    k = laplacians(forms, volume)
    lowest = np.linalg.eigvalsh(k)[:, 0] / np.trace(k, axis1=1, axis2=2)
    assert lowest.min() > -1e-14
    jensen = np.linalg.eigvalsh(
        k - (volume / 16)[:, None, None] * slopes.transpose(0, 2, 1) @ slopes
    )[:, 0]
    assert (jensen / np.trace(k, axis1=1, axis2=2)).min() > -1e-14


def test_whole_cells_have_springs_on_face_and_space_diagonals_alone():
    """Only diagonals have springs, as K of a trilinear cell times 2 mu + 3 lambda = 1."""
    lattice = build_lattice(
        cages_of(block(1, 1, 1), H), Material(density=1000, young_modulus=2.5, law="neo-hookean")
    ).with_springs()
    kind = np.rint((lattice.rest_length / H) ** 2).astype(int)
    np.testing.assert_allclose(lattice.stiffness, np.array([0, 0, 5, 5])[kind] * H / 12, atol=1e-17)


# u(J) and u'(J) in closed form (Bonet and Wood 2008, chapter 6; Simo and Taylor 1982)
U = {
    "quadratic": (lambda j: (j - 1) ** 2 / 2, lambda j: j - 1),
    "log": (lambda j: np.log(j) ** 2 / 2, lambda j: np.log(j) / j),
    "simo": (lambda j: (j**2 - 1 - 2 * np.log(j)) / 4, lambda j: (j - 1 / j) / 2),
}


@volumes
def test_uniform_strain_has_the_energy_and_the_forces_of_its_law(volume: str):
    """Corner forces are P N_i, with the derivatives of trilinear functions in a whole cell."""
    lattice = solid(1, 1, 1, poisson=0.4, volume=volume)
    shear, lame = lame_constants(YOUNG, 0.4)
    elastic, (u, slope) = Elasticity(lattice), U[volume]
    outward = 2 * (lattice.nodes - lattice.nodes.mean(axis=0)) / H
    for f in (
        np.diag([0.7, 0.8, 0.9]),
        np.diag([3.0, 0.5, 1.1]),
        np.eye(3) + 0.2 * RNG.normal(size=(3, 3)),
    ):
        j = np.linalg.det(f)
        energy = shear / 2 * (np.sum(f**2) - 3) - shear * np.log(j) + lame * u(j)
        assert elastic.energy(lattice.nodes @ f.T) == pytest.approx(H**3 * energy, rel=1e-12)
        stress = shear * f + (lame * slope(j) - shear / j) * j * np.linalg.inv(f).T
        forces = H**2 / 4 * outward @ stress.T
        np.testing.assert_allclose(
            gradient(elastic, lattice.nodes @ f.T), forces, atol=1e-12 * np.abs(forces).max()
        )


@volumes
def test_a_folded_bar_comes_to_an_end_without_cells_inside_out(tmp_path: Path, volume: str):
    path = clamped_beam(
        tmp_path,
        material=solid_of(1e6, volume=volume),
        start={"scale": [0.5, 1, -0.3]},
        time={"integrator": "static"},
    )
    model, frames = play(path)
    lattice = model.lattice
    assert (
        volume_ratios(
            frames[0].position, lattice.local_cells, lattice.solid.forms, lattice.cell_size
        ).min()
        < 0
    )
    assert worst_inverted(COMM, lattice, frames[-1].position)[0] == 0


@volumes
def test_below_the_onset_the_volume_energy_goes_on_smoothly(volume: str):
    lattice = solid(1, 1, 1, poisson=0.3, volume=volume)
    elastic = Elasticity(lattice)
    above, below = (lattice.nodes * [1, 1, ONSET + e] for e in (1e-9, -1e-9))
    np.testing.assert_allclose(
        gradient(elastic, above), gradient(elastic, below), rtol=1e-6, atol=1e-6 * YOUNG * H**2
    )
    np.testing.assert_allclose(
        dense_hessian(elastic, above), dense_hessian(elastic, below), atol=1e-6 * YOUNG * H
    )


def test_a_cell_is_inside_out_where_what_is_inside_of_it_is():
    """The mean deformation gradient of the part inside decides; a sliver's far corner may fold."""
    lattice = solid(1, 1, 1, poisson=0.45)
    points = 0.02 * RNG.random((100, 3)) - 0.5
    fills, second = moments(points, 10**8)
    cells = lattice.solid._replace(
        forms=forms_of(fills[None], second[None]), volume=H**3 * fills.mean(keepdims=True)
    )
    sliver = Lattice(**(vars(lattice) | {"solid": cells}))
    folded, turn = (
        lattice.nodes.copy(),
        1.3 * np.array([[0.9, 0.2, 0], [0.1, 1, 0.3], [0, -0.4, 0.8]]),
    )
    folded[np.argmax(folded.sum(axis=1))] -= 1.2 * H
    assert least_volumes(folded, lattice.local_cells)[0] < 0
    assert worst_inverted(COMM, sliver, folded) == (0, "")
    assert worst_inverted(COMM, sliver, folded * [1, 1, -1])[0] == 1
    moved = lattice.nodes @ turn.T
    for each in (sliver, lattice):
        ratio = volume_ratios(moved, lattice.local_cells, each.solid.forms, H)
        np.testing.assert_allclose(ratio, np.linalg.det(turn), rtol=1e-13)


def test_viscosity_turns_with_its_cells_and_is_semidefinite_where_they_are_inside_out():
    """A rate of rotation costs nothing.

    A stretch of turned cells costs as much as at rest: 2 mu |eps|^2 + lambda (tr eps)^2.
    """
    lattice = solid(3, 2, 2, poisson=0.45)
    viscosity = Viscosity(NeoHookean.of_lattice(lattice), 3.0, lattice.owned, lattice.nodes)
    turn, rest = Rotation.from_rotvec([0.3, -2.0, 1.0]).as_matrix(), lattice.nodes
    viscosity.begin(rest @ turn.T, rest @ turn.T)
    spin, strain = np.cross([1.0, 2.0, 3.0], rest @ turn.T), RNG.normal(size=(3, 3))
    strain += strain.T
    shear, lame = lame_constants(YOUNG, 0.45)
    density = shear * (strain**2).sum() + lame / 2 * np.trace(strain) ** 2
    volume = 12 * H**3
    assert abs(viscosity.energy(rest @ turn.T + spin)) < 1e-12 * shear * volume
    stretched = rest @ turn.T + rest @ strain @ turn.T
    assert viscosity.energy(stretched) == pytest.approx(3 * volume * density, rel=1e-12)
    viscosity.begin(rest, rest + 2 * H * RNG.normal(size=rest.shape))
    assert all(viscosity.energy(rest + RNG.normal(size=rest.shape)) > 0 for _ in range(20))
