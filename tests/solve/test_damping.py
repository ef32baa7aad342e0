"""Damping by the mass: decay in free flight, the speed of a fall, a swing's energy, the equation of a step."""

from pathlib import Path

import numpy as np
import pytest
from block_scene import block_scene, play

ALPHA, STEP = 3.0, 1 / 64  # [1/s], [s]
FOOT = {"half_space": {"point": [0, 0, 0], "normal": [0, 0, -1]}}
SPEED = [0.5, 0.0, -1.0]


def damped(folder: Path, integrator: str, steps: int, alpha: float = ALPHA, step: float = STEP, **tables) -> Path:
    time = {"step": step, "duration": steps * step, "integrator": integrator} | tables.pop("time", {})
    material = {"young_modulus": 1e5, "density": 1000.0, "damping": alpha}
    return block_scene(folder, time=time, material=material, **tables)


def velocities(path: Path) -> np.ndarray:
    """Mean velocity (frames, 3) [m/s]."""
    model, frames = play(path)
    return np.array([frame.momentum for frame in frames]) / model.lattice.mass.sum()


def test_free_flight_decays_by_each_schemes_own_formula(tmp_path: Path):
    n = np.arange(9)[:, None]
    start = {"start": {"velocity": SPEED}}
    euler = velocities(damped(tmp_path, "implicit-euler", 8, **start))
    np.testing.assert_allclose(euler, np.array(SPEED) * (1 + ALPHA * STEP) ** -n, rtol=1e-9, atol=1e-12)
    verlet = velocities(damped(tmp_path, "verlet", 8, **start))
    np.testing.assert_allclose(verlet, np.array(SPEED) * np.exp(-ALPHA * STEP * n), rtol=1e-9, atol=1e-12)


def test_bdf2_converges_to_the_exponential_with_second_order(tmp_path: Path):
    errors = []
    for count in (8, 16, 32):
        path = damped(tmp_path, "bdf2", count, step=0.25 / count, start={"velocity": SPEED})
        errors.append(abs(velocities(path)[-1][2] + np.exp(-ALPHA * 0.25)))
    slopes = np.log2(np.array(errors[:-1]) / errors[1:])
    assert (slopes > 1.7).all() and errors[-1] < 1e-3, (errors, slopes)


@pytest.mark.parametrize("integrator", ["bdf2", "verlet"])
def test_a_swing_loses_its_energy_as_the_exponential(tmp_path: Path, integrator: str, caplog):
    swing = {"pin": [{"region": FOOT}], "start": {"velocity": [0.1, 0.0, 0.0]}}

    def energy(alpha: float) -> np.ndarray:
        _, frames = play(damped(tmp_path, integrator, 120, alpha=alpha, step=1 / 400, **swing))
        return np.array([frame.kinetic + frame.elastic for frame in frames])

    ratio = energy(ALPHA)[60:] / energy(0.0)[60:]  # over several swings: kinetic energy alone is lost, half of the time
    expected = np.exp(-ALPHA * np.arange(60, 121) / 400)
    assert np.abs(ratio / expected - 1).max() < 0.1
    assert "nowhere" not in caplog.text
