"""Stress of neo-Hookean solids against closed forms: uniform strain, a bar, a beam, a plate with a
hole."""

from pathlib import Path

import numpy as np
import pytest
import tomli_w
import trimesh
from block_scene import block_scene, play
from test_neo_hookean import YOUNG, H, solid

from msmpetsc.build import Model
from msmpetsc.elasticity.energy import Elasticity
from msmpetsc.elasticity.stress import StressField
from msmpetsc.errors import InputError
from msmpetsc.fields import STRESS, Frame

RNG = np.random.default_rng(31)
STATIC = {"time": {"integrator": "static"}, "output": {"surface": False, "stress": True}}


def of_law(poisson: float, young: float = 1e5) -> dict:
    return {
        "young_modulus": young,
        "density": 1000.0,
        "law": "neo-hookean",
        "poisson_ratio": poisson,
    }


def at_rest(path: Path, *overrides: str) -> tuple[Model, Frame]:
    model, frames = play(path, *overrides)
    return model, frames[-1]


def along_x(low: float, high: float) -> dict:
    """Region from low to high, across the whole body."""
    return {"box": [[low, -9, -9], [high, 9, 9]]}


@pytest.mark.parametrize(("poisson", "cut"), [(0.25, False), (0.45, True)])
def test_uniform_strain_has_the_textbooks_stress_in_cells_and_at_nodes(poisson: float, cut: bool):
    """J sigma = mu (F F^T - I) + lambda (J - 1) J I; the pressure is the tensor's, von Mises'
    stress its principal stresses'."""
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
    """The area is the area of the pulled bar."""
    scene = block_scene(
        tmp_path, np.array([1.0, 0.25, 0.25]), **STATIC, material=of_law(0.3),
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
    """Cells in the middle third of a cantilever: M z / I at their own middles, four through the
    depth."""
    length, depth, width, pull = 4.0, 0.5, 0.25, -0.1
    scene = block_scene(
        tmp_path, np.array([length, width, depth]), **STATIC, material=of_law(0.25),
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


def plate_with_a_hole(half: float, radius: float, thick: float) -> trimesh.Trimesh:
    """A square plate about the z axis, its hole of 96 corners."""
    angles = np.linspace(0, 2 * np.pi, 96, endpoint=False)
    circle = radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    square = half / np.abs(circle).max(axis=1, keepdims=True) * circle
    points = np.concatenate(
        [np.column_stack([ring, np.full(96, z)]) for z in (0, thick) for ring in (circle, square)]
    )
    i = np.arange(96)
    k = (i + 1) % 96
    # below, outside, above, inside
    quads = [(0, 96), (96, 288), (288, 192), (192, 0)]
    faces = [
        np.stack(t, 1) for a, b in quads for t in ((a + i, a + k, b + k), (a + i, b + k, b + i))
    ]
    mesh = trimesh.Trimesh(points, np.concatenate(faces))
    mesh.fix_normals()
    return mesh


def test_a_plate_with_a_hole_has_thrice_the_stress_at_its_edge(tmp_path):
    """Kirsch's  1/2 (2 + (a / r)^2 + 3 (a / r)^4)  beside the hole, as far out as its cells.

    The hole has 6 cells in radius. The stress does not depend on Poisson's ratio, which is 0, so
    that the clamp disturbs nothing. The plate is 10 radii wide: 3 to 5% more than an endless plate
    (Heywood: (2 + 0.8^3) / 0.8 = 3.14 for 3). Cut cells scatter by more than whole cells.
    """
    radius, cell, sigma = 1.0, 1 / 6, 10.0
    half, thick = 5.0, 1 / 6
    plate_with_a_hole(half, radius, thick).export(tmp_path / "plate.ply")
    scene = {
        "mesh": {"source": "plate.ply"}, "cages": {"cell_size": cell}, "material": of_law(0.0),
        "solver": {"error": 1e-6}, **STATIC, "pin": [{"region": along_x(-9, -half + 0.01)}],
        "force": [{"region": along_x(half - 0.01, 9), "total": [2 * half * thick * sigma, 0, 0]}],
    }  # fmt: skip
    (tmp_path / "plate.toml").write_text(tomli_w.dumps(scene))
    model, frame = at_rest(tmp_path / "plate.toml")
    x, y, _ = model.lattice.nodes[model.lattice.local_cells].mean(axis=1).T
    at_side = (
        (np.abs(x) < 0.51 * cell) & (np.abs(y) < 3 * radius) & (model.lattice.cell_fill > 0.99)
    )
    a_r = radius / np.hypot(x, y)[at_side]
    kirsch = 1.03 * sigma * (2 + a_r**2 + 3 * a_r**4) / 2
    assert np.abs(frame.cell_stress[at_side, 0] / kirsch - 1).max() < 0.06
    assert frame.cell_stress[:, 0].max() / sigma == pytest.approx(3.14, rel=0.12)


def test_springs_are_refused_in_one_line(tmp_path):
    scene = block_scene(tmp_path, time={"step": 0.01, "duration": 0.1}, output={"stress": True})
    with pytest.raises(InputError, match=r"output: .*springs have no stress") as refused:
        play(scene)
    assert "\n" not in str(refused.value)
