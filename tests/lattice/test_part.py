"""Bodies of several materials: springs and masses, bars against closed forms, extreme ratios."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from block_scene import CELL, DENSITY, SIDES, YOUNG, block_scene, model_of, play, solid_of

from msmpetsc.build import Model
from msmpetsc.elasticity.energy import Elasticity
from msmpetsc.errors import InputError

T = 1 / 64
# the cells beyond the middle of the length
FAR = {"half_space": {"point": [0.25, 0, 0], "normal": [1, 0, 0]}}
BACK = {"half_space": {"point": [0, 0.25, 0], "normal": [0, 1, 0]}}
ALL = {"box": [[-1, -1, -1], [1, 1, 1]]}
ONCE = {"step": T, "duration": T}


def of_parts(folder: Path, *parts: dict, **tables) -> Model:
    return model_of(block_scene(folder, time=ONCE, part=list(parts), **tables))


# ---- material of a node and a spring


def test_each_cell_gives_its_own_mass_to_its_corners(tmp_path: Path):
    lattice = of_parts(tmp_path, {"region": FAR, "density": 3 * DENSITY}).lattice
    assert lattice.mass.sum() == pytest.approx(2 * DENSITY * SIDES.prod(), rel=1e-14)
    # mass of a layer of cells across the bar
    section = DENSITY * CELL * SIDES[1] * SIDES[2]
    for place, layers in {0: 1 / 2, 1: 1, 2: 1 / 2 + 3 / 2, 3: 3, 4: 3 / 2}.items():
        at = lattice.nodes[:, 0] == place * CELL
        assert lattice.mass[at].sum() == pytest.approx(layers * section, rel=1e-14)


def test_each_cell_gives_its_share_to_its_springs(tmp_path: Path):
    """A spring in a part is that of a body of this part; in an interface it takes half of each."""
    stiffer = {"young_modulus": 5 * YOUNG}
    lattice, soft, stiff = (
        of_parts(tmp_path, *parts).lattice
        for parts in ([{"region": FAR} | stiffer], [], [{"region": ALL} | stiffer])
    )
    x = lattice.nodes[lattice.springs][:, :, 0]
    between, beyond = (x == 0.25).all(axis=1), (x >= 0.25).all(axis=1)
    assert between.sum() > 20 and beyond.sum() > 100
    expected = np.where(beyond, stiff.stiffness, soft.stiffness)
    expected[between] = (soft.stiffness + stiff.stiffness)[between] / 2
    np.testing.assert_allclose(lattice.stiffness, expected, rtol=1e-14)


def test_each_cell_resists_as_its_own_material(tmp_path: Path):
    """Each cell of a mirrored solid has the same energy density, times E of the cell."""
    law = {"material": solid_of(YOUNG)}
    soft = of_parts(tmp_path, **law).lattice
    lattice = of_parts(tmp_path, {"region": FAR, "young_modulus": 5 * YOUNG}, **law).lattice
    energies = [Elasticity(one).energy(one.nodes * [1, 1, -1]) for one in (soft, lattice)]
    assert energies[1] == pytest.approx((1 + 5) / 2 * energies[0], rel=1e-12)


@pytest.mark.parametrize("sign", [1, -1])
def test_cut_cells_beside_a_part_keep_their_material(tmp_path: Path, sign: int):
    """A part that ends in a plane of the grid has no share in the cells behind the plane."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=2 * CELL)
    ball.export(tmp_path / "ball.ply")
    stiff = {"young_modulus": 1000 * YOUNG}
    part = {"region": {"half_space": {"point": [0, 0, 0], "normal": [0, 0, sign]}}} | stiff
    both, only = (
        of_parts(tmp_path, one, mesh={"source": "ball.ply"}, material=solid_of(YOUNG)).lattice
        for one in (part, {"region": ALL, "young_modulus": YOUNG})
    )
    above = sign * both.nodes[both.cells].mean(axis=1)[:, 2] > 0
    ratio = np.where(above, 1000.0, 1.0)
    np.testing.assert_allclose(both.cell_stiffness, ratio * only.cell_stiffness, rtol=1e-12)


def test_the_last_part_of_a_cell_wins_key_by_key(tmp_path: Path):
    one = {"region": ALL, "density": 500.0, "young_modulus": 7e5}
    lattice = of_parts(tmp_path, one, {"region": BACK, "density": 2000.0}).lattice
    assert lattice.mass.sum() == pytest.approx(1250 * SIDES.prod(), rel=1e-14)
    whole = of_parts(tmp_path, one | {"density": 1.0}).lattice
    np.testing.assert_array_equal(lattice.stiffness, whole.stiffness)


def test_painted_cells_are_a_part(tmp_path: Path):
    """Each of the eight corners of the surface lies in its own cell."""
    lattice = of_parts(
        tmp_path, {"region": {"painted": [0, 1, 2, 3, 4, 5, 6, 7]}, "density": 9 * DENSITY}
    ).lattice
    assert lattice.mass.sum() == pytest.approx(
        DENSITY * (SIDES.prod() + 8 * 8 * CELL**3), rel=1e-14
    )
    corner = (np.isin(lattice.nodes, [0, *SIDES])).all(axis=1) & (lattice.nodes != 0.25)[:, :2].all(
        axis=1
    )
    corner &= np.isin(lattice.nodes[:, 2], [0, SIDES[2]])
    assert corner.sum() == 8
    np.testing.assert_allclose(lattice.mass[corner], 9 * DENSITY * CELL**3 / 8, rtol=1e-14)


# ---- bars against their closed form


def forces(model: Model, displacement: np.ndarray) -> np.ndarray:
    """Return the forces (n, 3) [N] of the springs."""
    force = np.zeros_like(displacement)
    Elasticity(model.lattice).add_gradient(model.lattice.nodes + displacement, force)
    return force


@pytest.mark.parametrize("ratio", [0.1, 4.0, 1e3])
@pytest.mark.parametrize("sign", [1, -1])
def test_halves_one_behind_the_other_are_springs_in_series(tmp_path: Path, ratio: float, sign: int):
    """With held sides C11 = 6/5 E counts: stresses are equal, strains go as 1 / E.

    No net force acts on the nodes in between.
    """
    model = of_parts(tmp_path, {"region": FAR, "young_modulus": ratio * YOUNG})
    x, strain = model.lattice.nodes[:, 0], sign * 1e-6
    moved = np.zeros_like(model.lattice.nodes)
    moved[:, 0] = strain * np.where(x <= 0.25, x, 0.25 + (x - 0.25) / ratio)
    along, stress = forces(model, moved)[:, 0], 6 / 5 * YOUNG * strain
    area = SIDES[1] * SIDES[2]
    assert along[x == SIDES[0]].sum() == pytest.approx(stress * area, rel=1e-5)
    assert along[x == 0].sum() == pytest.approx(-stress * area, rel=1e-5)
    for inner in (1, 2, 3):
        assert np.abs(along[x == inner * CELL]).max() < 1e-5 * abs(stress) * CELL**2
    energy = Elasticity(model.lattice).energy(model.lattice.nodes + moved)
    assert energy == pytest.approx(stress * strain / 2 * area * 0.25 * (1 + 1 / ratio), rel=1e-5)


@pytest.mark.parametrize("ratio", [0.1, 1e6])
def test_halves_side_by_side_are_springs_in_parallel(tmp_path: Path, ratio: float):
    """Both halves narrow by 1/4 of the strain, so no force acts across, and E is the mean."""
    model = of_parts(tmp_path, {"region": BACK, "young_modulus": ratio * YOUNG})
    nodes, strain = model.lattice.nodes, 1e-7
    force = forces(model, strain * nodes * [1, -1 / 4, -1 / 4])
    pull, most = (
        YOUNG * strain * (1 + ratio) / 2 * SIDES[1] * SIDES[2],
        YOUNG * strain * max(ratio, 1) * CELL**2,
    )
    far, near = nodes[:, 0] == SIDES[0], nodes[:, 0] == 0
    assert force[far, 0].sum() == pytest.approx(pull, rel=1e-5)
    assert (
        np.abs(force[~far & ~near]).max() < 1e-5 * most and np.abs(force[:, 1:]).max() < 1e-5 * most
    )


# ---- in motion


def test_a_part_heavier_by_a_million_keeps_its_way_and_the_light_one_follows(tmp_path: Path):
    """The heavy half, thrown, has nearly all of the momentum.

    Steps are so long that the light half does not oscillate any more.
    """
    path = block_scene(
        tmp_path,
        part=[{"region": FAR, "density": 1e6 * DENSITY}],
        time={"step": 0.1, "duration": 2.0},
        start={"velocity": [0, 0, 1.0]},
        gravity={"acceleration": [0, 0, -1.0]},
    )
    model, frames = play(path)
    mass, last = model.lattice.mass, frames[-1]
    np.testing.assert_allclose(frames[0].momentum, [0, 0, mass.sum()], rtol=1e-12, atol=1e-3)
    # implicit Euler falls by n (n + 1) / 2 steps
    fallen = 2.0 - 0.5 * 2.0 * (2.0 + 0.1)
    np.testing.assert_allclose(
        last.position - model.lattice.nodes, np.tile([0, 0, fallen], (len(mass), 1)), atol=1e-6
    )


# ---- mistakes


def test_a_part_of_no_cell_is_refused(tmp_path: Path):
    # the box has a node, but no sample of a cell
    corner = {"box": [[0, 0, 0], [5e-4, 5e-4, 5e-4]]}
    with pytest.raises(
        InputError, match=r"^part\.0\.region holds no part of a cell: the body is from .* m$"
    ):
        of_parts(tmp_path, {"region": corner, "density": 1.0})
