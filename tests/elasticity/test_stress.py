"""Stress of neo-Hookean solids against closed forms: uniform strain, a bar, a beam."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from block_scene import CELL, block_scene, play, solid_of
from test_neo_hookean import YOUNG, H, solid

from msmpetsc.build import Model
from msmpetsc.elasticity.energy import Elasticity
from msmpetsc.elasticity.stress import StressField
from msmpetsc.errors import InputError
from msmpetsc.fields import STRESS, Frame

RNG = np.random.default_rng(31)
STATIC = {"time": {"integrator": "static"}, "output": {"surface": False, "stress": True}}


def at_rest(path: Path, *overrides: str) -> tuple[Model, Frame]:
    model, frames = play(path, *overrides)
    return model, frames[-1]


def along_x(low: float, high: float) -> dict:
    """Return the region between two planes across the whole body."""
    return {"box": [[low, -9, -9], [high, 9, 9]]}


@pytest.mark.parametrize(("poisson", "cut"), [(0.25, False), (0.45, True)])
def test_uniform_strain_has_the_textbooks_stress_in_cells_and_at_nodes(poisson: float, cut: bool):
    """J sigma = mu (F F^T - I) + lambda (J - 1) J I, in cells and at nodes.

    The pressure is that of the tensor, von Mises' stress that of the principal stresses.
    """
    lattice = solid(3, 2, 2, poisson=poisson, cut=cut)
    mu, lame = YOUNG / 2 / (1 + poisson), YOUNG * poisson / (1 + poisson) / (1 - 2 * poisson)
    elastic = Elasticity(lattice)
    field = StressField(lattice, elastic.solid)
    for f in (
        np.eye(3),
        np.diag([1.3, 0.9, 0.9]),
        np.array([[1, 0.4, 0.1], [0, 1.1, 0], [0.2, 0, 0.8]]),
    ):
        j, q = np.linalg.det(f), lattice.nodes @ f.T
        sigma = (mu * (f @ f.T - np.eye(3)) + lame * (j - 1) * j * np.eye(3)) / j
        found, (a, b, c) = field(q), np.linalg.eigvalsh(sigma)
        near = {"rtol": 1e-9, "atol": 1e-9 * YOUNG}
        for whose in ("", "cell_"):
            np.testing.assert_allclose(
                found[f"{whose}stress"] - sigma.ravel()[[0, 4, 8, 1, 5, 2]], 0, **near
            )
            np.testing.assert_allclose(found[f"{whose}pressure"], -np.trace(sigma) / 3, **near)
            von_mises = np.sqrt(((a - b) ** 2 + (b - c) ** 2 + (c - a) ** 2) / 2)
            np.testing.assert_allclose(found[f"{whose}von_mises"], von_mises, **near)
        assert found["cell_strain_energy"] @ lattice.solid.volume == pytest.approx(
            elastic.energy(q), abs=1e-9
        )
        assert set(found) == set(STRESS)


def test_the_mean_at_a_node_is_by_volume():
    lattice = solid(3, 2, 2, poisson=0.25, cut=True)
    elastic = Elasticity(lattice)
    found = StressField(lattice, elastic.solid)(
        lattice.nodes + 0.1 * H * RNG.standard_normal(lattice.nodes.shape)
    )
    volume, cells = lattice.solid.volume, lattice.local_cells
    for node in (0, 17, len(lattice.nodes) - 1):
        around = (cells == node).any(axis=1)
        mean = volume[around] @ found["cell_stress"][around] / volume[around].sum()
        np.testing.assert_allclose(found["stress"][node], mean, rtol=1e-9)


def test_the_stress_of_a_collapsed_cell_is_finite():
    lattice = solid(2, 1, 1, poisson=0.25)
    field = StressField(lattice, Elasticity(lattice).solid)
    for size in (0.0, -1.0):
        assert all(np.isfinite(rows).all() for rows in field(lattice.nodes * [1, 1, size]).values())


def test_a_bar_in_tension_has_force_over_area(tmp_path):
    """The stress of a bar in tension is the force over the deformed area."""
    scene = block_scene(
        tmp_path, np.array([1.0, 0.25, 0.25]), **STATIC, material=solid_of(1e5, 0.3),
        pin=[{"region": along_x(-0.01, 0.01)}],
        force=[{"region": along_x(0.99, 1.01), "total": [1000.0, 0, 0]}],
    )  # fmt: skip
    model, frame = at_rest(scene)
    middle = np.abs(model.lattice.nodes[:, 0] - 0.5) < 0.01
    area = np.prod(np.ptp(frame.position[middle][:, 1:], axis=0))
    # the cross-section shrinks
    assert 0.8 < area / 0.25**2 < 0.95
    assert frame.stress[middle, 0] == pytest.approx(1000 / area, rel=2e-3)
    assert np.abs(frame.stress[middle, 1:]).max() < 0.01 * 1000 / area
    assert frame.von_mises[middle] == pytest.approx(frame.stress[middle, 0], rel=0.01)
    assert frame.pressure[middle] == pytest.approx(-frame.stress[middle, 0] / 3, rel=0.02)


def test_a_beam_in_bending_has_the_moment_times_the_height_over_i(tmp_path):
    """Stresses in the middle third of a cantilever are M z / I at the cells' middles."""
    length, depth, width, pull = 4.0, 0.5, 0.25, -0.1
    scene = block_scene(
        tmp_path, np.array([length, width, depth]), **STATIC, material=solid_of(1e5, 0.25),
        pin=[{"region": along_x(-0.01, 0.01)}],
        force=[{"region": along_x(3.99, 4.01), "total": [0, 0, pull]}],
    )  # fmt: skip
    model, frame = at_rest(scene)
    x, _, z = model.lattice.nodes[model.lattice.local_cells].mean(axis=1).T
    inside = np.abs(x - length / 2) < length / 6
    expected = pull * (length - x) * -(z - depth / 2) / (width * depth**3 / 12)
    assert (
        np.abs(frame.cell_stress[inside, 0] - expected[inside]).max()
        < 0.03 * np.abs(expected[inside]).max()
    )


def test_springs_are_refused_in_one_line(tmp_path):
    scene = block_scene(tmp_path, time={"step": 0.01, "duration": 0.1}, output={"stress": True})
    with pytest.raises(InputError, match=r"output: .*springs have no stress") as refused:
        play(scene)
    assert "\n" not in str(refused.value)


def test_both_sides_of_a_slit_have_their_own_stress(tmp_path):
    """The two copies of a cell at the closed end of a slit have different stresses."""
    bar, gap = trimesh.creation.box(bounds=[[0, 0, 0], [8, 2, 5]]), [[2, -1, 2.3], [9, 3, 2.5]]
    slit = trimesh.creation.box(bounds=gap)
    fork = trimesh.boolean.difference([bar, slit], engine="manifold").apply_scale(CELL)
    scene = block_scene(
        tmp_path, **STATIC, material=solid_of(1e5, 0.3), pin=[{"region": along_x(-0.01, 0.01)}],
        force=[{"region": {"box": [[0.9, -1, 0.4], [2, 1, 1]]}, "total": [0, 0, 0.5]}],
    )  # fmt: skip
    fork.export(tmp_path / "scene.ply")
    model, frame = at_rest(scene)
    cells = model.lattice.local_cells
    assert len(np.unique(cells[:, 0])) < len(cells)
    energy = frame.cell_strain_energy @ model.lattice.solid.volume
    assert energy == pytest.approx(frame.elastic, rel=1e-6)
