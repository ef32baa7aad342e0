"""Hard cases of surfaces that meet themselves (scenes/studies/stability.toml): none crosses, whatever else comes."""

import tomllib

import numpy as np
import pytest
from conftest import ROOT
from crossings import count_crossings
from mpi4py import MPI

from msmpetsc.build import build_model
from msmpetsc.scene.reading import load_scene
from msmpetsc.solve.simulate import TimeLoop

STUDIES = ROOT / "scenes" / "studies"
MAPS = tomllib.loads((STUDIES / "stability.toml").read_text())["map"]
CASES = {case["name"]: case for of in MAPS if of["name"] == "touching" for case in of["case"]}

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("name", CASES)
def test_none_crosses(name: str):
    case = CASES[name]
    scene = load_scene(STUDIES / case["file"], [*case.get("set", ()), "output.surface=true"])
    model = build_model(MPI.COMM_SELF, scene)
    with TimeLoop(MPI.COMM_SELF, scene, model) as simulation:
        frames = list(simulation.frames())
    assert len(frames) == 1 + scene.time.steps and np.isfinite(frames[-1].position).all()
    assert max(frame.self_contacts for frame in frames) > 5
    assert sum(count_crossings(frame.surface, model.surface.triangles) for frame in frames) == 0
    if name.startswith("tips"):  # nothing acts on them from outside: it stays what it was, none, to the steps' error
        speed = scene.body[0].start.velocity[2]
        assert np.abs(frames[-1].momentum).max() < scene.solver.error * model.lattice.mass.sum() * speed
