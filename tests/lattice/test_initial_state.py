"""How a body starts: its places, its velocities, the same on any number of ranks."""

from pathlib import Path

import numpy as np
import pytest
from block_scene import CELL, DENSITY, SIDES, block_scene, play
from mpi4py import MPI

from msmpetsc.build import Model, build_model
from msmpetsc.errors import InputError
from msmpetsc.fields import Frame
from msmpetsc.scene.reading import load_scene
from msmpetsc.solve.simulate import TimeLoop

T = 1 / 128
MIDDLE, MASS = SIDES / 2, DENSITY * SIDES.prod()
NEAR = [{"region": {"box": [[-1, -1, -1], [0.01, 1, 1]]}}]  # the nodes at x = 0


def begin(folder: Path, start: dict, **tables) -> tuple[Model, list[Frame]]:
    """Its start and one step."""
    return play(block_scene(folder, time={"step": T, "duration": T}, start=start, **tables))


def at_start(folder: Path, start: dict) -> tuple[Model, Frame]:
    """Its start alone: what a step makes of a body that is a line is for rounding to say."""
    scene = load_scene(block_scene(folder, time={"step": T, "duration": T}, start=start))
    model = build_model(MPI.COMM_SELF, scene)
    with TimeLoop(MPI.COMM_SELF, scene, model) as simulation:
        return model, next(simulation.frames())


@pytest.mark.parametrize("scale", [[1, 1, 0.25], [1, 0, 0], [1, 1, 0], [-1, 1, 1], [-2, 0.5, 3]])
def test_scale_is_about_the_middle_of_the_box(tmp_path: Path, scale: list[float]):
    model, frame = at_start(tmp_path, {"scale": scale})
    np.testing.assert_array_equal(
        frame.position, MIDDLE + np.array(scale) * (model.lattice.nodes - MIDDLE)
    )
    assert frame.kinetic == 0


@pytest.mark.parametrize("more", [{}, {"velocity": [1, 0, 0]}])
def test_a_body_in_a_point_is_refused(tmp_path: Path, more: dict):
    """No spring has a direction there: what a step made of it was rounding's to say, or nothing."""
    with pytest.raises(InputError, match="start: scales the body to a point"):
        at_start(tmp_path, {"scale": [0, 0, 0]} | more)
    assert at_start(tmp_path, {"scale": [0, 0, 0], "scatter": 0.5} | more)[1].elastic > 0


def test_twist_about_a_slanted_axis_turns_all_in_planes_across_it(tmp_path: Path):
    """The angle by the cosine of what is across the axis; at the corners of the box, where it is 0
    and 30 degrees."""
    axis = np.array([1, 1, 1]) / np.sqrt(3)
    model, frames = begin(tmp_path, {"twist": {"axis": [1, 1, 1], "degrees": -30}})
    p, q = model.lattice.nodes - MIDDLE, frames[0].position - MIDDLE
    np.testing.assert_allclose(q @ axis, p @ axis, atol=1e-15)
    across, turned = (x - np.outer(x @ axis, axis) for x in (p, q))
    np.testing.assert_allclose(
        np.linalg.norm(turned, axis=1), np.linalg.norm(across, axis=1), atol=1e-15
    )
    sine = np.einsum("ij,ij->i", np.cross(across, turned), np.broadcast_to(axis, p.shape))
    angle = -np.radians(30) * (p @ axis / (SIDES.sum() / np.sqrt(3)) + 0.5)
    np.testing.assert_allclose(sine, (across**2).sum(axis=1) * np.sin(angle), atol=1e-15)


def test_scale_comes_before_twist_and_scatter_after_it(tmp_path: Path):
    """Collapsed to its axis, a twist changes nothing; and where all goes to its random place,
    nothing else is left."""
    line = begin(tmp_path, {"scale": [1, 0, 0], "twist": {"axis": [1, 0, 0], "degrees": 90}})[1][
        0
    ].position
    np.testing.assert_allclose(
        line, begin(tmp_path, {"scale": [1, 0, 0]})[1][0].position, atol=1e-16
    )
    half, whole, none = (
        begin(
            tmp_path,
            {"scale": [2, 2, 2], "twist": {"axis": [0, 0, 1], "degrees": 50}, "scatter": s},
        )[1][0].position
        for s in (0.5, 1.0, 0.0)
    )
    np.testing.assert_allclose(half, (whole + none) / 2, atol=1e-15)
    np.testing.assert_array_equal(whole, begin(tmp_path, {"scatter": 1.0})[1][0].position)


def test_scatter_is_anywhere_in_the_box(tmp_path: Path):
    """Mean and variance of an even spread, a 1/2 and 1/12 of a side, within four standard
    deviations of each."""
    q = begin(tmp_path, {"scatter": 1.0})[1][0].position / SIDES
    n = len(q)
    assert (q >= 0).all() and (q < 1).all() and len(np.unique(q)) == q.size
    assert np.abs(q.mean(axis=0) - 1 / 2).max() < 4 / np.sqrt(12 * n)
    assert np.abs(q.var(axis=0) - 1 / 12).max() < 4 / np.sqrt(180 * n)
    assert np.abs(np.corrcoef(q.T) - np.eye(3)).max() < 4 / np.sqrt(n)


def test_velocity_is_momentum_from_the_first_frame_on_and_free_flight_after(tmp_path: Path):
    velocity = np.array([1.0, -2.0, 0.5])
    model, frames = begin(tmp_path, {"velocity": velocity.tolist()})
    for frame in frames:
        np.testing.assert_allclose(frame.momentum, MASS * velocity, rtol=1e-12)
        assert frame.kinetic == pytest.approx(MASS * velocity @ velocity / 2, rel=1e-12)
    np.testing.assert_allclose(frames[1].position, model.lattice.nodes + T * velocity, atol=1e-13)


@pytest.mark.parametrize("integrator", ["implicit-euler", "verlet"])
def test_spin_has_the_angular_momentum_of_the_block(tmp_path: Path, integrator: str):
    """I_zz = m (a^2 + b^2) / 12 and, since a cell's mass sits at its corners, 2 m h^2 / 6 more."""
    spin = np.array([2.0, -1.0, 3.0])
    path = block_scene(
        tmp_path,
        time={"step": T, "duration": T, "integrator": integrator},
        start={"spin": spin.tolist(), "velocity": [0, 0, 1]},
    )
    model, frames = play(path)
    inertia = MASS * ((SIDES**2).sum() - SIDES**2) / 12 + MASS * CELL**2 / 3
    q, mass = model.lattice.nodes, model.lattice.mass
    start, velocity = model.start
    np.testing.assert_array_equal(start, q)
    momentum = (mass[:, None] * np.cross(q - MIDDLE, velocity)).sum(axis=0)
    np.testing.assert_allclose(momentum, inertia * spin, rtol=1e-12)
    assert frames[0].kinetic == pytest.approx(inertia @ spin**2 / 2 + MASS / 2, rel=1e-12)
    np.testing.assert_allclose(frames[0].momentum, [0, 0, MASS], atol=1e-11)


@pytest.mark.parametrize("what", ["pin", "anchor"])
def test_what_is_held_stays_where_it_is(tmp_path: Path, what: str):
    held = NEAR if what == "pin" else [NEAR[0] | {"path": [{"time": 1.0, "by": [0, 0, 1.0]}]}]
    start = {"scale": [2, 0, 1], "scatter": 0.3, "velocity": [1, 1, 1], "spin": [1, 0, 0]}
    model, frames = begin(tmp_path, start, **{what: held})
    nodes, (q, velocity) = model.lattice.nodes, model.start
    near = nodes[:, 0] == 0
    np.testing.assert_array_equal(q[near], nodes[near])
    np.testing.assert_array_equal(velocity[near], 0)
    assert (q[~near] != nodes[~near]).any(axis=1).all() and (velocity[~near] != 0).any(axis=1).all()
    moved = 0 if what == "pin" else T * np.array([0, 0, 1.0])
    np.testing.assert_allclose(frames[1].position[near], nodes[near] + moved, atol=1e-15)
