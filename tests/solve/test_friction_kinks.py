"""Newton's iterations where nodes slip and come to stick."""

from pathlib import Path

import numpy as np
import pytest
from block_scene import CELL, block_scene, play

from msmpetsc.contact.obstacles.penalty import Contact
from msmpetsc.solve.nonlinear.jacobian import FrictionKinks

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
    return sum(frame.iterations for frame in play(path)[1])


def test_secants_of_friction_save_iterations(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = block_scene(tmp_path, **SLIDES)
    with_secants = iterations(path)
    monkeypatch.setattr(Contact, "passes_kinks", Contact.all_secant)
    monkeypatch.setattr(FrictionKinks, "see", lambda *_: None)
    secants_alone = iterations(path)
    monkeypatch.setattr(Contact, "all_secant", lambda contact, *_: [None for _ in contact.states])
    true_alone = iterations(path)
    assert with_secants < 0.95 * true_alone and with_secants < 0.5 * secants_alone
