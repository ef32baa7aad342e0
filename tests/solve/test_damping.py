"""Damping by mass and by viscosity: free flight, a swing's energy, creep, a spinning solid."""

from pathlib import Path

import numpy as np
import pytest
from block_scene import block_scene, play, solid_of

from msmpetsc.errors import InputError

# damping rate [1/s] and time step [s]
ALPHA, STEP = 3.0, 1 / 64
FOOT = {"half_space": {"point": [0, 0, 0], "normal": [0, 0, -1]}}
SPEED = [0.5, 0.0, -1.0]


def damped(
    folder: Path, integrator: str, steps: int, alpha: float = ALPHA, step: float = STEP, **tables
) -> Path:
    time = {"step": step, "duration": steps * step, "integrator": integrator} | tables.pop(
        "time", {}
    )
    material = {"young_modulus": 1e5, "density": 1000.0, "damping": alpha}
    return block_scene(folder, time=time, material=material, **tables)


def velocities(path: Path) -> np.ndarray:
    """Return the mean velocities (frames, 3) [m/s]."""
    model, frames = play(path)
    return np.array([frame.momentum for frame in frames]) / model.lattice.mass.sum()


def test_free_flight_decays_by_each_schemes_own_formula(tmp_path: Path):
    n = np.arange(9)[:, None]
    start = {"start": {"velocity": SPEED}}
    euler = velocities(damped(tmp_path, "implicit-euler", 8, **start))
    np.testing.assert_allclose(
        euler, np.array(SPEED) * (1 + ALPHA * STEP) ** -n, rtol=1e-9, atol=1e-12
    )
    verlet = velocities(damped(tmp_path, "verlet", 8, **start))
    np.testing.assert_allclose(
        verlet, np.array(SPEED) * np.exp(-ALPHA * STEP * n), rtol=1e-9, atol=1e-12
    )


def test_a_flight_without_strain_ends_no_step_far_off(tmp_path: Path, caplog):
    """Rounding alone strains the body, and moves it beside its flight."""
    velocities(damped(tmp_path, "bdf2", 320, step=1 / 320, start={"velocity": SPEED}))
    assert "off its solution" not in caplog.text


@pytest.mark.parametrize("gravity", [0.0, -9.81], ids=["free", "falling"])
def test_bdf2_converges_to_the_exponential_with_second_order(tmp_path: Path, gravity: float):
    errors, limit = [], gravity / ALPHA
    exact = limit + (SPEED[2] - limit) * np.exp(-ALPHA * 0.25)
    tables = {"start": {"velocity": SPEED}, "gravity": {"acceleration": [0, 0, gravity]}}
    for count in (8, 16, 32):
        path = damped(tmp_path, "bdf2", count, step=0.25 / count, **tables)
        errors.append(abs(velocities(path)[-1][2] - exact))
    slopes = np.log2(np.array(errors[:-1]) / errors[1:])
    assert (slopes > 1.7).all() and errors[-1] < 1e-3, (errors, slopes)


@pytest.mark.parametrize("integrator", ["bdf2", "verlet"])
def test_a_swing_loses_its_energy_as_the_exponential(tmp_path: Path, integrator: str, caplog):
    swing = {"pin": [{"region": FOOT}], "start": {"velocity": [0.1, 0.0, 0.0]}}

    def energy(alpha: float) -> np.ndarray:
        _, frames = play(damped(tmp_path, integrator, 120, alpha=alpha, step=1 / 400, **swing))
        return np.array([frame.kinetic + frame.elastic for frame in frames])

    # several oscillations: damping acts on the kinetic energy, which is half of the
    # energy in the mean
    ratio = energy(ALPHA)[60:] / energy(0.0)[60:]
    expected = np.exp(-ALPHA * np.arange(60, 121) / 400)
    assert np.abs(ratio / expected - 1).max() < 0.1
    assert "nowhere" not in caplog.text


SOLID = solid_of(1e6)
# retardation time [s]
RETARDATION = 0.1


def viscous(
    folder: Path, integrator: str, step: float, duration: float, retardation: float, **tables
) -> Path:
    time = {"step": step, "duration": duration, "integrator": integrator}
    return block_scene(
        folder, time=time, material=SOLID | {"retardation_time": retardation}, **tables
    )


@pytest.mark.parametrize("integrator", ["implicit-euler", "bdf2"])
def test_a_solid_of_kelvin_and_voigt_creeps(tmp_path: Path, integrator: str):
    """Under a sudden force a solid yields as 1 - exp(-t / beta); inertia takes 1/70 of beta."""
    top = {"box": [[-1, -1, 0.24], [1, 1, 0.26]]}
    pulled = {"pin": [{"region": FOOT}], "force": [{"region": top, "total": [0, 0, 50.0]}]}
    model, frames = play(
        viscous(tmp_path, integrator, RETARDATION / 50, 3 * RETARDATION, RETARDATION, **pulled)
    )
    at_rest = play(block_scene(tmp_path, material=SOLID, time={"integrator": "static"}, **pulled))[
        1
    ][-1]
    moved = [
        model.lattice.mass @ (frame.position - model.lattice.nodes)[:, 2]
        for frame in (*frames, at_rest)
    ]
    given = np.array(moved[:-1]) / moved[-1]
    expected = 1 - np.exp(-np.array([frame.time for frame in frames]) / RETARDATION)
    assert np.abs(given - expected).max() < 0.03 and abs(given[-1] - expected[-1]) < 0.002


@pytest.mark.parametrize("integrator", ["implicit-euler", "bdf2"])
@pytest.mark.parametrize("loss", [{"retardation_time": 0.01}, {"damping": 1000.0}])
def test_a_start_that_losses_stop_at_once_gives_no_energy(
    tmp_path: Path, integrator: str, loss: dict[str, float]
):
    """BDF2 led a held body half a step's way on, to six times the energy of its start."""
    scene = block_scene(
        tmp_path,
        time={"step": 0.01, "duration": 0.03, "integrator": integrator},
        material=solid_of(1e7) | loss,
        pin=[{"region": FOOT}],
        start={"velocity": [1.0, 0.0, 0.0]},
    )
    energy = [frame.kinetic + frame.elastic for frame in play(scene)[1]]
    assert (np.diff(energy) < 0).all()


def test_viscosity_does_not_brake_a_spin(tmp_path: Path):
    """A spin of 20 / s stretches the body, and viscosity does not brake it.

    With rates in fixed axes, viscosity took 87% of the spin.
    """
    model, frames = play(
        viscous(tmp_path, "bdf2", 1 / 400, 0.25, RETARDATION, start={"spin": [0, 0, 20.0]})
    )

    def angular(k: int) -> float:
        v = (3 * frames[k].position - 4 * frames[k - 1].position + frames[k - 2].position) / (
            2 / 400
        )
        x = frames[k].position - np.average(frames[k].position, axis=0, weights=model.lattice.mass)
        return model.lattice.mass @ np.cross(x, v)[:, 2]

    assert angular(len(frames) - 1) == pytest.approx(angular(2), rel=5e-3)
    # the body creeps without oscillation
    assert (np.diff([frame.elastic for frame in frames[2:]]) > 0).all()


@pytest.mark.parametrize("integrator", ["implicit-euler", "bdf2"])
def test_a_viscous_body_bends_alike_at_rest_and_in_uniform_motion(tmp_path: Path, integrator: str):
    """An anchor and the body move at 8 m/s, a whole cell in a step, or stay in place."""
    ends = []
    for speed in (0.0, 8.0):
        moving = {
            "start": {"velocity": [0, 0, speed], "spin": [0, 3.0, 0]},
            "anchor": [
                {"region": {"box": [[-1, -1, -1], [0.01, 1, 1]]}}
                | {"path": [{"time": 1.0, "by": [0, 0, speed]}]}
            ],
        }
        _, frames = play(viscous(tmp_path, integrator, STEP, 5 * STEP, RETARDATION, **moving))
        ends.append(frames[-1].position - [0, 0, speed * frames[-1].time])
    np.testing.assert_allclose(*ends, atol=1e-9)


@pytest.mark.parametrize("integrator", ["implicit-euler", "bdf2"])
def test_a_body_that_an_anchor_leads_as_it_flies_is_not_strained(tmp_path: Path, integrator: str):
    """Anchored nodes move as the body flies.

    In BDF2's first step they once had 1.9 times the velocity of their path.
    """
    start = {"start": {"velocity": SPEED}}
    path = [{"time": 1.0, "by": SPEED}]
    led = {"anchor": [{"region": {"box": [[-1, -1, -1], [0.01, 1, 1]]}, "path": path}]}
    scene = viscous(tmp_path, integrator, STEP, 3 * STEP, RETARDATION, **start, **led)
    model, frames = play(scene)
    for frame in frames:
        moved = frame.position - model.lattice.nodes - np.array(SPEED) * frame.time
        np.testing.assert_allclose(moved, 0, atol=1e-9)
    for frame in frames[1:]:
        np.testing.assert_allclose(frame.momentum, np.array(SPEED) * model.lattice.mass.sum())


@pytest.mark.parametrize("integrator", ["verlet", "static"])
def test_viscosity_is_of_implicit_steps(tmp_path: Path, integrator: str):
    with pytest.raises(InputError, match=r"retardation_time"):
        play(viscous(tmp_path, integrator, 0.01, 0.01, RETARDATION))


def test_a_bent_solid_that_is_let_go_creeps_back_and_gains_nothing(tmp_path: Path, caplog):
    """Viscosity is so high that inertia is negligible. The work of the anchor counts."""
    top = {"box": [[-1, -1, 0.49], [1, 1, 0.51]]}
    anchor = {"region": top, "path": [{"time": 0.05, "by": [0.1, 0, 0]}], "stop": 0.1}
    scene = viscous(
        tmp_path,
        "implicit-euler",
        0.01,
        0.4,
        2.0,
        sides=[0.25, 0.25, 0.5],
        pin=[{"region": FOOT}],
        anchor=[anchor],
    )
    _, frames = play(scene)
    elastic = np.array([frame.elastic for frame in frames[10:]])
    assert elastic[1] < 0.99 * elastic[0]
    assert (np.diff(elastic) < 0).all() and max(
        frame.kinetic for frame in frames[10:]
    ) < 0.01 * elastic[0]
    assert "nowhere" not in caplog.text
