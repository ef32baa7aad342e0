"""Nodes and plates that would pass each other within a step, and nodes that begin in obstacles.

Energies are checked too.
"""

import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from block_scene import GRAVITY, STIFFEST, block_scene, box_at, plane_at, play
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from obstacles import box

from msmpetsc.contact.obstacles.node_obstacles import NodeObstacles
from msmpetsc.contact.obstacles.penalty import Penalty
from msmpetsc.contact.obstacles.reflection import Exchange, StepTaken
from msmpetsc.contact.step_contact import StepContact
from msmpetsc.errors import StepFailed

INTEGRATORS = ["implicit-euler", "bdf2", "verlet"]
CUBE = box([0, 0, 0], [1, 1, 1])
THIN = box([-5, -5, 0], [5, 5, 0.001])
# 1 + the faces of a box towards z and -z
TOP, BOTTOM = 6, 3
places = arrays(float, 3, elements=st.integers(-40, 40).map(lambda x: x / 16 + 0.511))


@settings(max_examples=300, deadline=None)
@given(places, places)
def test_the_side_is_the_face_that_a_way_first_goes_through(start: np.ndarray, end: np.ndarray):
    """The face agrees with 4001 points of the path, except at corners that the path grazes."""
    way = start + np.linspace(0, 1, 4001)[:, None] * (end - start)
    inside, face = CUBE.solid.depths(way)
    side = CUBE.sides(start[None], end[None], 1.0, 1.0)[0]
    if inside.max() < -1e-2:
        assert side == 0
    elif inside.max() > 1e-2:
        first = int(np.argmax(inside > 0))
        if first == 0:
            assert side == 1 + face[0]
        else:
            ahead = ((way[first - 1] - CUBE.solid.planes.points) * CUBE.solid.planes.normals).sum(
                axis=1
            )
            entered = np.flatnonzero(ahead >= 0)
            assert side - 1 in entered and (len(entered) > 1 or side == 1 + entered[0])


def test_a_side_is_kept_until_the_node_is_out_or_has_slid_off():
    def kept(x: list[float]) -> int:
        x = np.array([x], float)
        return THIN.sides(x, x, 1.0, 0.1, np.array([TOP], np.int8))[0]

    # the bottom is nearer, but the node entered through the top
    assert kept([0, 0, 0.0001]) == TOP
    # the node was pressed through the box
    assert kept([0, 0, -0.3]) == TOP
    assert kept([0, 0, 0.002]) == 0
    assert kept([6, 0, -0.3]) == 0


def test_what_appears_is_met_by_the_nearest_face_and_what_is_not_there_by_none():
    late = box([-5, -5, -1], [5, 5, 0], start=1.0)
    x, end = np.array([[0.0, 0, 0.5]]), np.array([[0.0, 0, -0.8]])
    assert [late.sides(x, end, time, 0.1)[0] for time in (0.9, 1.0, 1.2)] == [0, BOTTOM, TOP]


def test_beyond_the_far_face_a_penalty_pushes_back_with_the_whole_depth():
    q = np.array([[0, 0, -0.3], [0, 0, 0.0009], [0, 0, 0.0001], [0, 0, -0.3]])
    sides = np.array([TOP, TOP, TOP, 0], np.int8)
    contact = StepContact([Penalty(THIN, 50.0, 0.0, 1.0).during(q, 1.0, 0.1, sides)], len(q))
    push = np.zeros_like(q)
    contact.at(q).add_gradient(push)
    depth = np.array([0.301, 0.0001, 0.0009, 0])
    np.testing.assert_allclose(push, -50 * depth[:, None] * [0, 0, 1], atol=1e-12)
    assert contact.energy(q) == pytest.approx(25 * (depth**2).sum())
    deeper = q - [0, 0, 0.01]
    assert contact.at(deeper).change(contact.at(q)) == pytest.approx(
        contact.energy(deeper) - contact.energy(q)
    )
    assert contact.at(q).bound().tolist() == [50, 50, 50, 0]
    ((nodes, blocks),) = contact.at(q).hessian()
    assert nodes.tolist() == [0, 1, 2] and (blocks == 50 * np.diag([0, 0, 1])).all()


def test_a_node_that_jumps_over_a_thin_plate_is_reflected_to_where_it_came_from():
    q, before = np.array([[0.1, 0, -0.4], [6.0, 0, -0.4]]), np.array([[0.0, 0, 0.1], [6.0, 0, 0.1]])
    step = StepTaken(1.0, 0.1, THIN.sides(before, q, 1.0, 0.1))
    after, after_before = Exchange(THIN, 0.5).struck(q, before, step)
    np.testing.assert_allclose(after, [[0.1, 0, 0.1], [6, 0, -0.4]])
    np.testing.assert_allclose(after - after_before, [[0.1, 0, 0.25], [0, 0, -0.5]])


# ---- bodies against plates

STEP = 0.004
BLOCK = np.array([0.25, 0.25, 0.25])
STIFF = {"young_modulus": 1e6, "density": 1000.0}


def against_a_plate(
    folder: Path, integrator: str, response: str, speed: float, moving: bool, **tables
) -> Path:
    """Return the scene of a block and a plate of a hundredth of a cell, 0.1 m below, that meet.

    The block falls or the plate rises. There is no gravity.
    """
    steps = 10 + int(np.ceil(0.4 / speed / STEP))
    plate = box_at([[-9, -9, -0.10125], [9, 9, -0.1]], response=response)
    start = {}
    if moving:
        plate["path"] = [{"time": 1.0, "by": [0, 0, speed]}]
    else:
        start = {"velocity": [0, 0, -speed]}
    time = {"step": STEP, "duration": steps * STEP, "integrator": integrator}
    tables = {"solver": {"preset": "newton", "error": 1e-3}, **tables}
    return block_scene(
        folder, BLOCK, time=time, start=start, obstacle=[plate], material=STIFF, **tables
    )


@pytest.mark.parametrize("moving", [False, True], ids=["the body moves", "the plate moves"])
@pytest.mark.parametrize("speed", [2.0, 100.0])
@pytest.mark.parametrize("response", ["penalty", "reflect"])
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_no_node_gets_past_a_thin_plate(
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    integrator: str,
    response: str,
    speed: float,
    moving: bool,
):
    """No node passes the plate. At 100 m/s the block folds; its energy gain is reported."""
    model, frames = play(against_a_plate(tmp_path, integrator, response, speed, moving))
    last, mass = frames[-1], model.lattice.mass
    top = -0.1 + (speed * last.time if moving else 0)
    assert last.position[:, 2].min() > top - 0.02
    leaves = last.momentum[2] / mass.sum() - (speed if moving else 0)
    # the block buckles: implicit Euler at 100 m/s leaves 9.5% of the speed with penalty
    assert leaves > 0.05 * speed
    if not moving:
        assert totals(frames).max() < 1.011 * totals(frames)[0] or told(caplog, "from nowhere")


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_to_and_from_a_moving_frame_nothing_changes(tmp_path: Path, integrator: str):
    """A moving plate with friction gives the same run as the plate at rest in its own frame.

    With Verlet the numbers of substeps differ.
    """
    tables = {"solver": {"preset": "newton", "error": 1e-10}}
    positions = []
    for moving in (False, True):
        path = against_a_plate(tmp_path, integrator, "penalty", 3.0, moving, **tables)
        _, frames = play(path, "obstacle.0.friction=0.4")
        positions.append([frame.position - [0, 0, 3.0 * frame.time * moving] for frame in frames])
    # the body is pressed
    assert np.ptp(np.array(positions[0])[:, :, 2], axis=1).min() < 0.245
    np.testing.assert_allclose(*positions, atol=5e-3 if integrator == "verlet" else 1e-6)


def test_a_body_rests_on_a_plate_thinner_than_its_push_is_deep(tmp_path: Path):
    """Every node at the bottom stays below the far face of the plate."""
    floor = box_at([[-9, -9, -1e-6], [9, 9, 0]], response="penalty", friction=0.5)
    time = {"step": 0.05, "duration": 2.0}
    _, frames = play(block_scene(tmp_path, BLOCK, time=time, gravity=GRAVITY, obstacle=[floor]))
    depth = np.maximum(-frames[-1].position[:, 2], 0)
    assert depth.max() > 1e-4
    assert 10 * STIFFEST * depth.sum() == pytest.approx(1000 * BLOCK.prod() * 9.81, rel=1e-4)


def test_ranks_tell_nodes_that_begin_inside_once_and_not_on_going_on(msmpetsc, tmp_path: Path):
    inside = box_at([[0.2, -1, -1], [2, 0.05, 0.05]])
    # up to a checkpoint
    time = {"step": 0.002, "duration": 0.04}
    path, out = block_scene(tmp_path, BLOCK, time=time, obstacle=[inside]), tmp_path / "o.h5"
    done = msmpetsc(2, "run", path, "-o", out, status=0)
    assert done.stderr.count("1 node inside obstacle.0") == 1
    done = msmpetsc(2, "run", "--resume", out, "--set", "time.duration=0.044", "--force", status=0)
    assert "inside obstacle" not in done.stderr


def test_a_step_whose_nodes_cannot_be_settled_fails_in_words(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(NodeObstacles, "same_push", lambda *_: False)
    with pytest.raises(StepFailed, match="has nodes that pass through"):
        play(against_a_plate(tmp_path, "implicit-euler", "penalty", 20.0, False))


def test_nodes_that_come_in_by_another_face_each_time_a_step_is_solved_settle(tmp_path: Path):
    """A plate that comes edge first meets the corner of a fast body, a case from random boxes."""
    plate = box_at([[-1.481, 2.832, 0.2023], [1.519, 5.832, 0.2523]], response="penalty")
    plate["path"] = [{"time": 0.05, "by": [0.89, -7.54, 0.155]}]
    around = box_at([[-1.75, -1.46, 0.1771], [1.249, 1.54, 0.4771]], start=0.01, stop=0.03)
    time = {"step": 0.005, "duration": 0.05, "integrator": "bdf2"}
    tables = {
        "material": STIFF | {"young_modulus": 3.5e6},
        "solver": {"preset": "newton", "error": 1e-3},
    }
    start = {"velocity": [21.37, -5.853, 2.545]}
    _, frames = play(
        block_scene(tmp_path, BLOCK, time=time, start=start, obstacle=[plate, around], **tables)
    )
    assert len(frames) == 11 and max(frame.contact for frame in frames) > 0


def ball(folder: Path, **tables) -> Path:
    trimesh.creation.icosphere(2, 0.5).export(folder / "ball.ply")
    tables = {
        "mesh": {"source": "ball.ply"},
        "cages": {"count": 100},
        "material": {"young_modulus": 1e6, "density": 1000.0},
        "solver": {"preset": "newton", "error": 1e-3},
    } | tables
    return block_scene(folder, **tables)


def totals(frames) -> np.ndarray:
    """Return the total energy [J] of each frame."""
    return np.array(
        [frame.kinetic + frame.elastic + frame.potential + frame.contact for frame in frames]
    )


def test_bdf2_does_not_sink_into_what_gives_nothing_back(tmp_path: Path):
    floor = plane_at(restitution=0)
    time = {"step": 0.005, "duration": 1.0, "integrator": "bdf2"}
    _, frames = play(block_scene(tmp_path, BLOCK, time=time, gravity=GRAVITY, obstacle=[floor]))
    lowest = [frame.position[:, 2].min() for frame in frames]
    assert min(lowest) > -0.005 and abs(lowest[-1] - lowest[100]) < 1e-3


@pytest.mark.parametrize("response", ["reflect", "penalty"])
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_the_work_of_a_moving_obstacle_is_counted(tmp_path: Path, integrator: str, response: str):
    """A plane strikes a ball at rest, and the energy balance counts the work of the plane.

    Verlet with ``reflect`` once ended at once, because it took this work for a gain.
    """
    floor = plane_at(-0.53, response=response)
    floor["path"] = [{"time": 1.0, "by": [0, 0, 20.0]}]
    time = {"step": 0.001, "duration": 0.08, "integrator": integrator}
    _, frames = play(ball(tmp_path, time=time, obstacle=[floor]))
    total = totals(frames)
    assert total[-1] > 100 * 20.0**2
    gained = sum(frame.energy_gained for frame in frames)
    assert gained < 0.02 * total.max()


def told(caplog: pytest.LogCaptureFixture, what: str) -> list[str]:
    return [record.getMessage() for record in caplog.records if what in record.getMessage()]


def test_energy_from_nowhere_is_told_once_with_its_frame(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    """The paper's exchange moves nodes back against their springs, which adds energy.

    It adds 4% of a ball's energy at steps of 1 ms. The report is relative to the body's energy, not
    to the exchanged energy.
    """
    floor = plane_at(-0.6, response="exchange")
    scene = {
        "start": {"velocity": [0, 0, -10.0]},
        "obstacle": [floor],
        "cages": {"count": 100, "boundary": "whole"},
    }
    _, frames = play(ball(tmp_path, time={"step": 0.001, "duration": 0.03}, **scene))
    first, last = told(caplog, "nowhere")
    assert float(re.search(r"of ([\d.e+]+) J", first)[1]) == pytest.approx(
        frames[0].kinetic, rel=0.05
    )
    assert first.startswith("frame 2") and 'try response = "reflect"' in first and "frames" in last
    caplog.clear()
    reflecting = scene | {"obstacle": [floor | {"response": "reflect"}]}
    play(ball(tmp_path, time={"step": 0.001, "duration": 0.03}, **reflecting))
    assert not told(caplog, "nowhere")
    play(ball(tmp_path, time={"step": 0.0001, "duration": 0.03}, **scene))
    assert not told(caplog, "nowhere")


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_swings_and_loose_steps_are_no_gain(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, integrator: str
):
    """A body released at a strain of 0.1 gains nothing, also at a step error of 0.1."""
    time = {"step": 0.01, "duration": 0.3, "integrator": integrator}
    solver = {"preset": "newton", "error": 0.1}
    play(block_scene(tmp_path, time=time, start={"scale": [1.1, 1, 1]}, solver=solver))
    assert not told(caplog, "nowhere")


def test_nodes_that_begin_inside_are_told_with_number_depth_and_place(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    """Half of a block of 3 x 3 x 3 nodes is under the ground; nodes of pins do not count."""
    ground = plane_at(0.2, response="exchange")
    high = box_at([[-1, -1, 9], [1, 1, 10]], response="penalty")
    late = box_at([[-1, -1, -1], [0.1, 1, 1]], response="penalty", start=0.02)
    pin = [{"region": {"sphere": {"center": [0, 0, 0], "radius": 0.01}}}]
    time = {"step": 0.01, "duration": 0.04}
    path = block_scene(tmp_path, BLOCK, time=time, obstacle=[high, ground, late], pin=pin)
    play(path)
    now, later = told(caplog, "inside obstacle")
    assert now.startswith(
        "frame 0 (t = 0 s): 17 nodes inside obstacle.1, up to 0.2 m (1.6 cells) deep: node "
    )
    assert later.startswith("frame 2 (t = 0.02 s): 8 nodes inside obstacle.2, up to 0.1 m")
    caplog.clear()
    play(path, "obstacle.1.point=[0, 0, 0]", "obstacle.2.start=9")
    assert not told(caplog, "inside obstacle")
