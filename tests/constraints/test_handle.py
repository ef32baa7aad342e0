"""Anchors that turn: the positions of their nodes, and the torque that they report."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from block_scene import SIDES, block_scene, play, solid_of

from msmpetsc.errors import InputError

T = 0.01
SOLID = solid_of(1e5, 0.3)
LEFT = {"box": [[-1, -1, -1], [0.01, 1, 1]]}
RIGHT = {"box": [[0.49, -1, -1], [1, 1, 1]]}


def turned(x: np.ndarray, axis: list[float], angle: float, center: np.ndarray) -> np.ndarray:
    """Return points turned by trimesh's matrix, which is made from a quaternion."""
    return trimesh.transform_points(x, trimesh.transformations.rotation_matrix(angle, axis, center))


@pytest.mark.parametrize("integrator", ["implicit-euler", "bdf2", "verlet"])
def test_nodes_turn_about_an_axis_at_a_steady_speed_and_go_on_as_they_were_let_go(
    tmp_path: Path, integrator: str
):
    axis, center = np.array([2.0, 1.0, 2.0]) / 3, [0.1, 0.2, 0.3]
    path = [{"time": 0.05, "by": [0.05, 0, 0], "turn": list(450 * axis)}]
    time = {"step": T, "duration": 4 * T, "integrator": integrator}
    handle = {"region": RIGHT, "path": path, "center": center, "stop": 3.5 * T}
    model, frames = play(block_scene(tmp_path, time=time, material=SOLID, anchor=[handle]))
    rest = model.lattice.nodes
    anchored = rest[:, 0] > 0.49
    for frame in frames[:4]:
        share = frame.time / 0.05
        expected = turned(rest[anchored], axis, share * 2.5 * np.pi, center) + share * np.array(
            [0.05, 0, 0]
        )
        np.testing.assert_allclose(frame.position[anchored], expected, atol=1e-14)
    share = frames[4].time / 0.05
    gone_on = turned(rest[anchored], axis, share * 2.5 * np.pi, center) + share * np.array(
        [0.05, 0, 0]
    )
    # the released nodes leave the path
    assert np.linalg.norm(frames[4].position[anchored] - gone_on, axis=1).min() > 1e-4


def test_without_a_center_nodes_turn_about_their_centre_of_mass(tmp_path: Path):
    path = [{"time": T, "turn": [90, 0, 0]}, {"time": 2 * T, "turn": [90, 0, 0]}]
    anchors = [{"region": RIGHT, "path": path}]
    model, frames = play(block_scene(tmp_path, time={"step": T, "duration": 2 * T}, anchor=anchors))
    rest = model.lattice.nodes
    anchored = rest[:, 0] > 0.49
    center = np.average(rest[anchored], axis=0, weights=model.lattice.mass[anchored])
    assert center == pytest.approx([0.5, *SIDES[1:] / 2])
    for frame in frames[1:]:
        np.testing.assert_allclose(
            frame.position[anchored],
            turned(rest[anchored], [1, 0, 0], np.pi / 2, center),
            atol=1e-15,
        )


def bar(folder: Path, cells: int, turn: float, **tables) -> Path:
    """Return the scene of a bar along x, clamped on the left; its right end turns about x."""
    path = [{"time": 1.0, "turn": [turn, 0, 0]}]
    return block_scene(
        folder, sides=np.array([5.0, 1.0, 1.0]), **{"solver": {"error": 1e-12}} | tables,
        material=SOLID,
        cages={"cell_size": 1 / cells}, time={"integrator": "static", "step": 1.0, "duration": 1.0},
        pin=[{"region": LEFT}],
        anchor=[{"region": {"box": [[4.99, -1, -1], [6, 2, 2]]}, "path": path}],
    )  # fmt: skip


def test_forces_and_torques_of_a_body_in_balance_add_up(tmp_path: Path):
    """The moments of weight, pin and anchor on a twisted bar sum to zero about any point."""
    gravity = np.array([0.3, -0.5, -2.0])
    scene = bar(tmp_path, 4, 120.0, gravity={"acceleration": gravity.tolist()})
    text = scene.read_text().replace("time = 1.0", "time = 1.0\nby = [-0.3, 0.2, -0.4]")
    scene.write_text(text)
    model, (_, frame) = play(scene)
    mass, q = model.lattice.mass, frame.position
    points = np.array([[0.0, 0.5, 0.5], [5 - 0.3, 0.7, 0.1]])
    pull = mass[:, None] * gravity
    moment = (
        frame.torque.sum(axis=0)
        + np.cross(points, frame.reaction).sum(axis=0)
        + np.cross(q, pull).sum(axis=0)
    )
    assert moment == pytest.approx(0, abs=1e-6 * np.abs(frame.torque).max())
    assert frame.reaction.sum(axis=0) + pull.sum(axis=0) == pytest.approx(
        0, abs=1e-6 * np.abs(frame.reaction).max()
    )


def test_what_is_no_turn_is_told_by_its_key(tmp_path: Path):
    path = [{"time": 1.0, "turn": 90}]
    with pytest.raises(InputError, match=r"anchor\.0\.path\.0\.turn"):
        play(
            block_scene(
                tmp_path, time={"step": T, "duration": T}, anchor=[{"region": LEFT, "path": path}]
            )
        )
