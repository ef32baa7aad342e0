"""The order of the integrators in time, and their loss of energy in a free oscillation."""

from pathlib import Path

import numpy as np
import pytest
from block_scene import block_scene, play

# duration of about a period [s]
DURATION = 0.03
# released far from equilibrium
SWING = {"start": {"scale": [1.2, 1.0, 0.9]}, "output": {"surface": False, "every": 1000}}


def bar(folder: Path, **tables) -> Path:
    """Return two cells without fast modes, so that the motion is smooth at the steps tried."""
    return block_scene(folder, np.array([0.25, 0.125, 0.125]), **SWING | tables)


@pytest.fixture(scope="module")
def exact(tmp_path_factory: pytest.TempPathFactory) -> np.ndarray:
    """Return frames by explicit substeps, 60 to the shortest step; their error is of order 2."""
    time = {"step": DURATION / 8, "duration": DURATION}
    time |= {"integrator": "verlet", "substep": DURATION / 20000}
    return play(bar(tmp_path_factory.mktemp("exact"), time=time))[1][-1].position


ORDERS = [("implicit-euler", 1, (256, 512)), ("bdf2", 2, (128, 256)), ("verlet", 2, (64, 128))]


@pytest.mark.parametrize("integrator, order, parts", ORDERS)
def test_order_in_time(
    tmp_path: Path, exact: np.ndarray, integrator: str, order: int, parts: tuple[int, int]
):
    """The order is the slope of the error over the time step."""
    errors = []
    for part in parts:
        extra = {"substep": DURATION / part} if integrator == "verlet" else {}
        time = {"step": DURATION / part, "duration": DURATION, "integrator": integrator} | extra
        errors.append(np.linalg.norm(play(bar(tmp_path, time=time))[1][-1].position - exact))
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.1)


@pytest.mark.parametrize("steps", [4, 8, 16])
@pytest.mark.parametrize("integrator", ["implicit-euler", "bdf2"])
def test_energy_left_of_one_mode(tmp_path: Path, integrator: str, steps: int):
    """A mode of frequency w without spin loses energy as the roots of the scheme say.

    Implicit Euler loses 1 / (1 + w^2 t^2) per step. The mode is a cell that grows evenly. Its
    springs act in phase at small strain. The run's elastic energy 1/2 w^2 sum m |u|^2 gives w^2.
    """
    small = 1e-5
    scene = block_scene(
        tmp_path,
        np.full(3, 0.125),
        start={"scale": [1 + small] * 3},
        solver={"preset": "newton", "error": 1e-10},
    )
    model, frames = play(scene, "time={step=1e-6, duration=1e-6}")
    moved = model.start[0] - model.lattice.nodes
    w = np.sqrt(2 * frames[0].elastic / (model.lattice.mass @ (moved**2).sum(axis=1)))
    t = float(2 * np.pi / w / 32)
    _, frames = play(
        scene, f"time={{step={t!r}, duration={steps * t!r}, integrator='{integrator}'}}"
    )
    left = (frames[-1].elastic + frames[-1].kinetic) / frames[0].elastic
    assert left == pytest.approx(energy_left(integrator, w * t, steps), rel=1e-4)


def energy_left(integrator: str, wt: float, steps: int) -> float:
    """Return the energy left of x'' = -w^2 x from x = 1 and x' = 0, by the scheme itself.

    The scheme acts on z = x + i x' / w, whose rate is -i w z. BDF2 begins with an implicit Euler
    step of two thirds (solve.integrators.bdf2).
    """
    # matrix of t d/dt for (x, x' / w)
    matrix = wt * np.array([[0, 1], [-1, 0]])
    one = np.array([1.0, 0.0])
    if integrator == "implicit-euler":
        return float((1 + wt**2) ** -steps)
    begun = np.linalg.solve(np.eye(2) - 2 / 3 * matrix, one)
    # t x'' / w at the end of that step
    a = -wt * begun[0]
    before, now = np.array([one[0] - wt * one[1] + wt * a / 2, one[1] - a]), one
    for _ in range(steps):
        before, now = now, np.linalg.solve(np.eye(2) - 2 / 3 * matrix, (4 * now - before) / 3)
    return float(now @ now)
