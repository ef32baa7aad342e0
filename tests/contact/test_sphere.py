"""Spheres as obstacles: as planes where they are flat, and as one point is turned back by a round one."""

from pathlib import Path

import numpy as np
import pytest
from block_scene import G, block_scene, play
from obstacles import sphere

from msmpetsc.contact.obstacles.reflection import Exchange, StepTaken

FLAT = 1e5  # [m]: over the block's 0.5 m it sinks by 3e-7 m, and a depth is rounded to 1e-11 m
PLANE = {"shape": "plane", "point": [0, 0, -0.02], "normal": [0, 0, 1]}
SPHERE = {"shape": "sphere", "center": [0.25, 0.25, -0.02 - FLAT], "radius": FLAT}
SLOPED = {"acceleration": [2.0, 0, -G]}  # it slides
ERROR = 1e-6  # of steps: the push is known to no more than a depth is
RESPONSES = [{"response": "reflect", "restitution": 0.5}, {"response": "penalty", "friction": 0.3}]


@pytest.mark.parametrize("response", RESPONSES, ids=lambda response: response["response"])
@pytest.mark.parametrize("integrator", ["implicit-euler", "bdf2", "verlet"])
def test_a_large_sphere_is_a_plane(tmp_path: Path, integrator: str, response: dict):
    time = {"step": 1 / 240, "duration": 0.15, "integrator": integrator}
    solver = {"preset": "newton", "error": ERROR}
    moved = []
    for obstacle in (PLANE, SPHERE):
        path = block_scene(tmp_path, time=time, gravity=SLOPED, obstacle=[{**obstacle, **response}], solver=solver)
        model, frames = play(path)
        moved.append(frames[-1].position - model.lattice.nodes)
    assert moved[0][:, 2].mean() > -0.06 and np.abs(moved[0]).max() > 0.01  # it has met the ground, and slid
    np.testing.assert_allclose(moved[1], moved[0], atol=5e-3 * np.abs(moved[0]).max())


def test_a_node_is_turned_back_along_the_radius():
    """What of its velocity goes to the centre becomes -e times itself; what goes along the sphere stays."""
    ball, q = sphere([1.0, 2.0, 3.0], 0.5), np.array([[1.0, 2.3, 3.3], [1.0, 2.5, 3.5], [1.0, 2.2, 3.1]])
    q_previous = q + np.array([[0.1, 0.2, 0.4], [0.1, 0.2, 0.4], [0, -0.1, -0.05]])  # in, outside, on its way out
    after, before = Exchange(ball, 0.5).exchanged(q, q_previous, StepTaken(1.0, 0.1))
    normal = np.array([0, 1, 1]) / np.sqrt(2)
    speed = (q - q_previous)[0] @ normal
    assert speed < 0
    np.testing.assert_allclose((after - before)[0], (q - q_previous)[0] - 1.5 * speed * normal, atol=1e-14)
    np.testing.assert_array_equal(after[1:], q[1:])
    np.testing.assert_array_equal(before[1:], q_previous[1:])
