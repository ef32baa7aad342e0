"""A ball rolls down a slope without slip: a = g sin(a) / (1 + I / (m R^2))."""

import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import trimesh
from block_scene import box_at, plane_at

import msmpetsc

# gravity [m/s^2], radius [m], tangent of the slope and of friction
G, R, SLOPE, FRICTION = 9.81, 0.1, 0.3, 0.5


class Rolled(NamedTuple):
    """Ratios of a run: path to the exact path, path to angle times R, lumped inertia to m R^2."""

    way: float
    radius: float
    inertia: float


def rolled(cells: int, response: str, step: float = 2.5e-3, duration: float = 0.5) -> Rolled:
    """Run a ball with ``cells`` cells per radius, in the frame of the slope; return its ratios."""
    ball = trimesh.creation.icosphere(4, R)
    ball.vertices *= (4 / 3 * np.pi * R**3 / ball.volume) ** (1 / 3)
    ball.vertices += [0, 0, -1e-5 - ball.vertices[:, 2].min()]
    slide = {"friction": FRICTION, "friction_speed": 1e-3}
    plane = plane_at(response="penalty")
    contact: dict = {"obstacle": [plane | slide]}
    if response == "barrier":
        board = box_at([[-0.5, -0.5, -0.2], [1.5, 0.5, -1e-4]])
        contact = {"obstacle": [board | {"response": "barrier"}]}
        contact["self_contact"] = slide | {"distance": 2e-4}
    angle = np.arctan(SLOPE)
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "ball.obj"
        ball.export(source, digits=17)
        scene = {
            "mesh": {"source": str(source)},
            "cages": {"cell_size": R / cells},
            "material": {"young_modulus": 1e7, "density": 1000.0, "poisson_ratio": 0.3},
            "time": {"integrator": "bdf2", "step": step, "duration": duration},
            "gravity": {"acceleration": [G * np.sin(angle), 0, -G * np.cos(angle)]},
            "solver": {"error": 1e-4},
            "output": {"surface": False},
        }
        simulation = msmpetsc.Simulation(msmpetsc.Scene.of(scene | contact))
        places = [frame.position for frame in simulation.frames()]
    assert simulation.model is not None
    mass = simulation.model.lattice.mass
    middles = np.average(places, axis=1, weights=mass)
    rest = places[0] - middles[0]
    inertia = (mass * (rest[:, 0] ** 2 + rest[:, 2] ** 2)).sum() / (mass.sum() * R**2)
    angles = []
    for place, middle in zip(places, middles, strict=True):
        spread = (mass[:, None] * rest).T @ (place - middle)
        angles.append(np.arctan2(spread[2, 0] - spread[0, 2], spread[0, 0] + spread[2, 2]))
    way = middles[-1, 0] - middles[0, 0]
    exact = G * np.sin(angle) / 1.4 * duration**2 / 2
    return Rolled(way / exact, way / (np.ptp(np.unwrap(angles)) * R), inertia)


@pytest.mark.slow
def test_a_ball_rolls_on_its_surface():
    """With a barrier the ball rolls on its surface with the lumped inertia of the lattice.

    Steps of 5 ms are 1% of the time, and the ball is dented by 0.2% of its radius.
    """
    ball = rolled(2, "barrier", step=5e-3)
    assert ball.radius == pytest.approx(1, abs=0.01)
    assert ball.way == pytest.approx(1.4 / (1 + ball.inertia), rel=0.02)
