"""Newton's iterations where nodes slip and come to stick."""

from pathlib import Path

import numpy as np
import pytest
from block_scene import CELL, block_scene
from mpi4py import MPI

from msmpetsc.build import build_model
from msmpetsc.contact.obstacles.penalty import Contact, Secants
from msmpetsc.scene.reading import load_scene
from msmpetsc.solve.nonlinear.jacobian import FrictionKinks
from msmpetsc.solve.simulate import Simulation

PRESSING = {
    "shape": "plane", "point": [0, 0, 0], "normal": [0, 0, 1], "response": "penalty", "friction": 0.8,
    "path": [{"time": 1.0, "by": [0, 0, 0.3]}],
}  # fmt: skip
SLIDES = {  # it falls on the ground, slides a little and is pressed
    "sides": np.array([6, 3, 3]) * CELL,
    "mesh": {"source": "scene.ply", "base": [0, 0, 0.01]},
    "start": {"velocity": [0.3, 0.0, -1.5]},
    "gravity": {"acceleration": [0.0, 0.0, -9.81]},
    "material": {"young_modulus": 1e5, "density": 1000.0},
    "time": {"step": 0.02, "duration": 0.2},
    "obstacle": [PRESSING],
    "solver": {"preset": "newton-multigrid", "error": 1e-6},
}


def iterations(path: Path) -> int:
    """Newton's, of all steps."""
    scene = load_scene(path)
    with Simulation(MPI.COMM_SELF, scene, build_model(MPI.COMM_SELF, scene)) as simulation:
        return sum(frame.iterations for frame in simulation.frames())


def no_secants(contact: Contact, *_: np.ndarray) -> Secants:
    return [None for _ in contact.states]


def test_secants_of_friction_save_iterations(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = block_scene(tmp_path, **SLIDES)
    with_secants = iterations(path)
    monkeypatch.setattr(Contact, "passes_kinks", Contact.all_secant)
    monkeypatch.setattr(FrictionKinks, "see", lambda *_: None)
    secants_alone = iterations(path)
    monkeypatch.setattr(Contact, "all_secant", no_secants)
    true_alone = iterations(path)
    assert with_secants < 0.95 * true_alone and with_secants < 0.5 * secants_alone
