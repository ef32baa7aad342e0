"""A force gives a free body its time integral, wherever it starts and stops within steps."""

from pathlib import Path

import numpy as np
import pytest
from block_scene import block_scene, play

import msmpetsc as msm

# time step [s]
STEP = 1 / 60
HALF = {"half_space": {"point": [0.25, 0, 0], "normal": [1, 0, 0]}}
# force [N]
PULL = np.array([20.0, 0.0, -40.0])
TABLE = {
    "times": [1.2 * STEP, 3.7 * STEP, 5.1 * STEP],
    "values": [[0, 0, 0], [8, 0, -40], [8, 4, 0]],
}
# name -> force, and its integral over time [N s]
FORCES = {
    "a third of a step": (
        {"total": PULL.tolist(), "start": 2.3 * STEP, "stop": (2.3 + 1 / 3) * STEP},
        PULL * STEP / 3,
    ),
    "a single step": (
        {"total": PULL.tolist(), "start": 2 * STEP, "stop": 3 * STEP},
        PULL * STEP,
    ),
    # 2.5 and 1.4 steps of linear change, then 0.9 steps of the last value
    "a table": (
        {"total": TABLE, "stop": 6 * STEP},
        STEP
        * (2.5 * np.array([4, 0, -20]) + 1.4 * np.array([8, 2, -20]) + 0.9 * np.array([8, 4, 0])),
    ),
}
TIMES = {
    "implicit-euler": {"integrator": "implicit-euler"},
    "bdf2": {"integrator": "bdf2"},
    "verlet": {"integrator": "verlet"},
    "implicit-euler, chosen steps": {"integrator": "implicit-euler", "error": 0.03},
    "bdf2, chosen steps": {"integrator": "bdf2", "error": 0.003},
}


@pytest.mark.parametrize("force", FORCES)
@pytest.mark.parametrize("time", TIMES)
def test_a_free_body_gets_the_integral_and_no_energy_from_nowhere(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, time: str, force: str
):
    """A pull on half of the nodes makes the body oscillate and turn; its energy is explained."""
    table, integral = FORCES[force]
    scene = block_scene(
        tmp_path,
        force=[{"region": HALF} | table],
        time={"step": STEP, "duration": 8 * STEP} | TIMES[time],
    )
    _, frames = play(scene)
    # Velocities are differences of positions over a step, and chosen steps may be as
    # short as a thousandth.
    rounding = 1e-9 if "chosen" in time else 1e-11
    for frame in frames[6:]:
        np.testing.assert_allclose(frame.momentum, integral, atol=rounding * np.abs(integral).max())
    if "chosen" in time:
        assert len({frame.steps for frame in frames}) > 1
    assert "nowhere" not in caplog.text
    # Verlet's energy oscillates, which the warning allows for.
    if time != "verlet":
        most = max(frame.kinetic + frame.elastic for frame in frames)
        assert sum(frame.energy_gained for frame in frames) < 1e-3 * most


@pytest.mark.parametrize("integrator", ["implicit-euler", "bdf2", "verlet"])
def test_a_users_force_acts_for_its_share_of_a_step(tmp_path: Path, integrator: str):
    msm.register_force("steady", lambda x, v, t: np.full_like(x, 2.0))
    scene = block_scene(
        tmp_path,
        force=[{"region": HALF, "function": "steady", "start": 1.5 * STEP, "stop": 3.25 * STEP}],
        time={"step": STEP, "duration": 6 * STEP, "integrator": integrator},
    )
    model, frames = play(scene)
    mass = model.own_forces[0].mass.sum()
    # up to the step error
    np.testing.assert_allclose(frames[-1].momentum, 2.0 * 1.75 * STEP * mass, rtol=1e-9)
