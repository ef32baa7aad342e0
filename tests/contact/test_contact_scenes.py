"""Small scenes of bodies in contact: a slope, a stack, a chain, a twisted bar.

Nothing crosses, resting bodies hold, and sliding bodies obey Coulomb's law. Frames at rest are not
examined, because flat faces have coplanar triangles, which cross by rounding.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from block_scene import GRAVITY, ROUGH_GROUND, box_at, play, solid_of, write_scene
from crossings import crossings

from msmpetsc.build import Model
from msmpetsc.fields import Frame

G, SIDE = 9.81, 0.1


def write(folder: Path, **tables: Any) -> Path:
    """Write a scene file; ``tables`` replace or extend its tables."""
    scene = {
        "material": solid_of(1e6),
        "gravity": GRAVITY,
        "safety": {"on_failure": "substep"},
        "solver": {"preset": "newton", "error": 1e-3},
    }
    return write_scene(folder, **scene | tables)


def box(folder: Path, name: str, sides: list[float], splits: int = 2) -> dict[str, Any]:
    mesh = trimesh.creation.box(sides)
    for _ in range(splits):
        mesh = mesh.subdivide()
    mesh.export(folder / f"{name}.ply")
    return {"source": f"{name}.ply"}


def middles(model: Model, frames: list[Frame], bodies: np.ndarray) -> np.ndarray:
    """Return the centres of mass (frames, b, 3) [m] of bodies.

    bodies : (n,) number of the body of each node
    """
    mass = model.lattice.mass
    each = [
        mass * (bodies == number) / mass[bodies == number].sum()
        for number in range(bodies.max() + 1)
    ]
    return np.array([[own @ frame.position for own in each] for frame in frames])


def test_a_small_pile_takes_few_iterations_a_step_without_a_distance_given(tmp_path):
    """The median of the steps in contact is at most 20 iterations.

    With a distance of 3e-4 of the diagonal, 0.1 mm in cells of 80 mm, it was 60.
    """
    block = box(tmp_path, "block", [0.2] * 3)
    trimesh.creation.icosphere(subdivisions=2, radius=0.11).export(tmp_path / "ball.ply")
    meshes, places = [block, {"source": "ball.ply"}, block], [0.0, 0.05, -0.04]
    bodies = [
        {
            "mesh": mesh | {"base": [x, 0.3 * x, 0.03 + 0.25 * i]},
            "start": {"velocity": [0, 0, -2.0 - i]},
        }
        for i, (mesh, x) in enumerate(zip(meshes, places, strict=True))
    ]
    floor = box_at([[-1, -1, -0.2], [1, 1, 0]], response="barrier")
    scene = write(
        tmp_path,
        body=bodies,
        cages={"cell_size": 0.08},
        material=solid_of(1e5, 0.3),
        time={"step": 0.01, "duration": 0.08},
        self_contact={"friction": 0.3},
        obstacle=[floor],
    )
    model, frames = play(scene)
    hard = [frame.iterations for frame in frames if frame.self_contacts > 20]
    # 10 in a usual run
    assert len(hard) >= 6 and np.median(hard) <= 20
    assert crossings(model, frames[1:]) == 0


def test_bodies_side_by_side_are_not_thrown_apart_without_a_distance_given(tmp_path):
    """Nothing pushes at the start, although the gap of 0.4 mm is less than 1/24 of a cell."""
    gap, mesh = 0.4e-3, box(tmp_path, "block", [SIDE] * 3)
    scene = write(
        tmp_path,
        body=[{"mesh": mesh | {"base": [i * (SIDE + gap), 0, 0]}} for i in range(2)],
        cages={"cell_size": SIDE / 2},
        time={"step": 0.01, "duration": 0.01},
        gravity={"acceleration": [0, 0, 0]},
        self_contact={},
    )
    model, frames = play(scene)
    assert model.collision is not None
    assert model.collision.law.distance == pytest.approx(gap, rel=1e-3)
    assert frames[-1].self_contact < 1e-12 and frames[-1].kinetic < 1e-12


@pytest.mark.parametrize("beyond", [-1.0, 1.0])
def test_a_block_holds_on_a_slab_a_degree_below_the_angle_of_friction_and_slides_above_it(
    tmp_path, beyond: float
):
    """A block holds or slides on a slab.

    On a slab of 1.2 m it once slid by 2.3 mm, then crept at 6 to 9 mm/s.
    """
    angle = np.arctan(0.5) + np.radians(beyond)
    slab = box(tmp_path, "slab", [0.4, 0.2, 0.04]) | {"base": [0.1, 0, -0.04]}
    block = box(tmp_path, "block", [SIDE] * 3) | {"base": [0, 0, 0.001]}
    pin = [{"region": {"half_space": {"point": [0, 0, -0.03], "normal": [0, 0, -1]}}}]
    scene = write(
        tmp_path,
        body=[{"mesh": slab, "pin": pin}, {"mesh": block}],
        cages={"cell_size": SIDE / 3},
        gravity={"acceleration": [G * np.sin(angle), 0, -G * np.cos(angle)]},
        self_contact={"distance": 1e-3, "friction": 0.5},
        time={"step": 0.01, "duration": 0.4},
    )
    model, frames = play(scene)
    x = middles(model, frames, 1 * (model.lattice.nodes[:, 2] > -1e-9))[:, 1, 0]
    assert crossings(model, frames[1:]) == 0
    if beyond < 0:
        # speed [m/s] over 20 steps, in which the slip is reset once
        assert x[-1] - x[0] < 0.6e-3 and (x[40] - x[20]) / 0.2 < 1e-4
    else:
        mean = (x[40] - 2 * x[30] + x[20]) / 0.01
        assert mean == pytest.approx(G * (np.sin(angle) - 0.5 * np.cos(angle)), abs=0.02 * 0.5 * G)


def stack(folder: Path, duration: float, error: float) -> tuple[Model, list[Frame], np.ndarray]:
    """Return the frames of a stack of five cubes, and the cubes' centres (frames, 5, 3) [m]."""
    source = box(folder, "cube", [SIDE] * 3)
    aside = [[0, 0], [0.004, -0.003], [-0.003, 0.004], [0.005, 0], [0, 0.003]]
    bodies = [
        {"mesh": source | {"base": [*at, 0.0005 + 1.012 * n * SIDE]}} for n, at in enumerate(aside)
    ]
    scene = write(
        folder,
        body=bodies,
        cages={"cell_size": SIDE / 2},
        material=solid_of(1e6, damping=5.0),
        obstacle=[ROUGH_GROUND],
        self_contact={"distance": 1e-3, "friction": 0.5},
        time={"step": 0.01, "duration": duration},
        solver={"error": error},
    )
    model, frames = play(scene)
    numbers = np.clip(model.lattice.nodes[:, 2] / (1.012 * SIDE) + 0.01, 0, 4.9).astype(int)
    return model, frames, middles(model, frames, numbers)


@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    ("duration", "farthest", "error"),
    [
        (0.12, 2e-3, 1e-3),
        pytest.param(10.0, 1e-4, 1e-3, marks=pytest.mark.slow),
        pytest.param(1.0, 2e-3, 1e-5, marks=pytest.mark.slow),
    ],
)
def test_a_stack_of_five_cubes_stands(tmp_path, duration: float, farthest: float, error: float):
    """The stack settles, and sways for two seconds.

    With cubes of 0.2 MPa the stack would buckle under its own weight.
    """
    model, frames, places = stack(tmp_path, duration, error)
    assert crossings(model, frames[1:]) == 0
    drift = np.linalg.norm((places[-1] - places[round(0.3 * len(frames))])[:, :2], axis=1)
    assert drift.max() < farthest


@pytest.mark.slow
def test_links_of_a_chain_hang_in_each_other(tmp_path):
    for name, axis in {"a": [1, 0, 0], "b": [0, 1, 0]}.items():
        link = trimesh.creation.torus(0.0503, 0.0117, major_sections=28, minor_sections=18)
        link.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, axis)).export(
            tmp_path / f"{name}.ply"
        )
    bodies = [
        {"mesh": {"source": f"{name}.ply", "base": [0, 0, -0.07 * n]}}
        for n, name in enumerate("aba")
    ]
    bodies[0]["pin"] = [{"region": {"box": [[0, 0, 0.8], [1, 1, 1]], "relative": True}}]
    scene = write(
        tmp_path,
        body=bodies,
        cages={"cell_size": 0.008},
        material=solid_of(2e5, damping=2.0),
        self_contact={"distance": 5e-4, "friction": 0.3},
        time={"step": 0.01, "duration": 0.4},
    )
    model, frames = play(scene)
    assert crossings(model, frames[1:]) == 0
    lowest = [frame.surface[:, 2].min() for frame in (frames[0], frames[-1])]
    # in free fall it would be 0.8 m
    assert -0.1 < lowest[1] - lowest[0] < -0.005


@pytest.mark.parametrize("turns", [0.5, pytest.param(2.5, marks=pytest.mark.slow)])
def test_a_bar_that_an_anchor_twists_does_not_cross_itself(tmp_path, turns: float):
    trimesh.creation.box([0.5, SIDE, SIDE]).subdivide_to_size(0.036).export(tmp_path / "bar.ply")
    ends = [
        {"half_space": {"point": [0.249 * side, 0, 0], "normal": [side, 0, 0]}} for side in (-1, 1)
    ]
    path = [{"time": turns, "by": [-0.024 * turns, 0, 0], "turn": [360.0 * turns, 0, 0]}]
    scene = write(
        tmp_path,
        mesh={"source": "bar.ply"},
        cages={"cell_size": 0.025},
        material=solid_of(1e5, damping=2.0),
        gravity={"acceleration": [0, 0, 0]},
        pin=[{"region": ends[0]}],
        anchor=[{"region": ends[1], "path": path, "center": [0, 0, 0]}],
        self_contact={"distance": 1e-3, "friction": 0.3},
        time={"step": 0.025, "duration": turns},
    )
    model, frames = play(scene)
    assert crossings(model, frames[1:]) == 0
    # beyond 1.5 turns the sides of the bar touch
    assert np.isfinite(frames[-1].self_distance) or turns < 1
    matrix = trimesh.transformations.rotation_matrix(2 * np.pi * turns, [1, 0, 0])
    matrix[0, 3] = -0.024 * turns
    held = model.surface.points[:, 0] > 0.2499
    turned = trimesh.transform_points(model.surface.points[held], matrix)
    np.testing.assert_allclose(frames[-1].surface[held], turned, atol=1e-9)
