"""A body that strikes an obstacle and leaps off gains no energy.

Both the energy balance and the sums of energies of the frames show this.
"""

from pathlib import Path

import numpy as np
import pytest
from block_scene import GRAVITY, block_scene, box_at, plane_at, play, solid_of
from test_tunnelling import ball, totals

from msmpetsc.contact.step_contact import StepContactAt

PLANE = plane_at(-0.55)
FALL = {"gravity": GRAVITY, "start": {"velocity": [0, 0, -2.0]}}


def rise(frames) -> float:
    """Return the greatest rise of the total energy over the greatest kinetic and elastic energy."""
    total = totals(frames)
    has = max(frame.kinetic + frame.elastic for frame in frames)
    return float((total - np.minimum.accumulate(total)).max() / has)


@pytest.mark.parametrize("restitution", [1.0, 0.5])
@pytest.mark.parametrize("integrator", ["implicit-euler", "bdf2", "verlet"])
def test_a_ball_gains_nothing(tmp_path: Path, integrator: str, restitution: float):
    """A ball gains no energy. Verlet's energy oscillates by 0.7% here, at its stability limit."""
    time = {"step": 0.004, "duration": 0.2, "integrator": integrator}
    _, frames = play(
        ball(tmp_path, time=time, obstacle=[PLANE | {"restitution": restitution}], **FALL)
    )
    share = 1e-2 if integrator == "verlet" else 1e-3
    assert rise(frames) < share
    # Verlet's balance also counts oscillations
    if integrator != "verlet":
        assert sum(frame.energy_gained for frame in frames) < share * frames[0].kinetic
    # the body leaves the ground
    assert frames[-1].momentum[2] > 0


@pytest.mark.parametrize(("cell", "speed"), [(0.2, 4.0), (0.25, 2.0)])
def test_light_nodes_leap_off_no_faster_than_they_came_by_verlet(
    tmp_path: Path, cell: float, speed: float
):
    """Near the stability limit the penalty pushes a node out faster than it came.

    The ball has cells that are nearly empty.
    """
    path = ball(
        tmp_path,
        cages={"cell_size": cell},
        material=solid_of(3e5, 0.3),
        time={"step": 0.0025, "duration": 0.1, "integrator": "verlet"},
        obstacle=[PLANE | {"restitution": 0.0}],
        gravity=GRAVITY,
        start={"velocity": [0, 0, -speed]},
    )
    _, frames = play(path)
    assert rise(frames) < 1e-3


# response -> obstacle 0.05 m below a plate
GROUNDS = {
    "penalty": plane_at(-0.05),
    "barrier": box_at([[-1, -1, -0.2], [1, 1, -0.05]]),
}


@pytest.mark.parametrize(
    ("response", "step", "speed", "size", "cells"),
    [
        # an obstacle presses at the end of the step that would gain energy
        ("penalty", 0.005, 2.5, [0.25, 0.125, 0.0125], 50),
        ("penalty", 0.0025, 2.5, [0.25, 0.125, 0.0125], 50),
        # the plate has left the ground by then
        ("penalty", 0.005, 3.0, [0.25, 0.125, 0.0125], 50),
        ("barrier", 0.005, 3.0, [0.3, 0.1, 0.01], 300),
    ],
)
def test_bdf2_does_not_give_back_what_the_impact_of_a_soft_plate_took(
    tmp_path: Path, response: str, step: float, speed: float, size: list[float], cells: int
):
    scene = block_scene(
        tmp_path,
        np.array(size),
        mesh={"source": "scene.ply", "prepare": [{"refine": 0.25}]},
        cages={"count": cells},
        material=solid_of(5e4, 0.1),
        obstacle=[GROUNDS[response] | {"response": response}],
        gravity=GRAVITY,
        start={"velocity": [0, 0, -speed]},
        time={"step": step, "duration": 0.08, "integrator": "bdf2"},
        solver={"preset": "newton", "error": 1e-4},
    )
    _, frames = play(scene)
    assert rise(frames) < 1e-2
    assert frames[-1].momentum[2] > 0


SOFT_PLATE = {
    "mesh": {"source": "scene.ply", "prepare": [{"refine": 0.25}]},
    "cages": {"count": 50},
    "material": solid_of(5e4, 0.1),
    "solver": {"preset": "newton", "error": 1e-8},
}
# sides [m], ground, velocity [m/s], time step [s], other tables
BOUNCES = {
    "stiff, exchange": (
        np.array([4, 2, 3]) / 8,
        plane_at(-0.05, restitution=0.4) | {"normal": [0.1, 0, 1]},
        [1, 0.2, 0],
        0.01,
        {"material": solid_of(1e5, 0.3)},
    ),
    "soft plate, penalty": (
        np.array([0.25, 0.125, 0.0125]),
        plane_at(-0.05, response="penalty"),
        [0, 0, -2.5],
        0.005,
        SOFT_PLATE,
    ),
}


@pytest.mark.parametrize("name", BOUNCES)
def test_bdf2_bounces_off_a_moving_ground_as_off_one_at_rest(tmp_path: Path, name: str):
    """The energy balance moves with the ground, so it shows the same gains as at rest."""
    flights, (sides, ground, velocity, step, tables) = [], BOUNCES[name]
    for wind in np.zeros(3), np.array([0.0, 0.0, -20.0]):
        scene = block_scene(
            tmp_path,
            sides,
            obstacle=[ground | {"path": [{"time": 1.0, "by": wind.tolist()}]}],
            gravity=GRAVITY,
            start={"velocity": (wind + velocity).tolist(), "spin": [1, 2, 3]},
            time={"step": step, "duration": 15 * step, "integrator": "bdf2"},
            **tables,
        )
        flights.append([frame.position - wind * frame.time for frame in play(scene)[1]])
    np.testing.assert_allclose(flights[1], flights[0], atol=1e-9)


def test_nodes_that_reach_the_ground_stop_together(tmp_path: Path, monkeypatch):
    """If nodes stop one by one, iterations double or triple."""

    def iterations() -> int:
        fall = FALL | {
            "start": {"velocity": [0, 0, -4.0]},
            "time": {"step": 0.01, "duration": 0.1},
        }
        material = solid_of(1e4)
        ground = PLANE | {"point": [0, 0, -0.505]}
        scene = ball(tmp_path, material=material, obstacle=[ground], cages={"count": 500}, **fall)
        _, frames = play(scene)
        return sum(frame.iterations for frame in frames)

    together = iterations()
    monkeypatch.setattr(StepContactAt, "stopped", lambda *_: None)
    assert together < 0.7 * iterations()
