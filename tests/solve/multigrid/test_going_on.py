"""Runs with multigrid go on from a checkpoint to the last bit: the hierarchy of then is built
again."""

from pathlib import Path

import numpy as np
import pytest
from block_scene import CELL, block_scene
from conftest import WORKERS, run
from stopped_runs import assert_goes_on_exactly, assert_same

from msmpetsc.solve.multigrid import cycle
from msmpetsc.solve.nonlinear import preconditioning
from msmpetsc.solve.nonlinear.preconditioning import LatticePreconditioner

STEPS = 10
GRAVITY = {"acceleration": [0.0, 1.0, -9.81]}
HELD = [{"region": {"box": [[-0.01, -1.0, -1.0], [0.01, 1.0, 1.0]]}}]
FAR = {"box": [[0.74, -1, -1], [0.76, 1, 1]]}
LED = [{"region": FAR, "path": [{"time": 0.08, "by": [0.05, 0, 0.05]}], "stop": 0.1}]
GROUND = {"shape": "plane", "point": [0, 0, 0], "normal": [0, 0, 1]}
PRESSING = [
    GROUND | {"response": "penalty", "friction": 0.5, "path": [{"time": 1.0, "by": [0, 0, 0.3]}]}
]
SOFT = {"young_modulus": 1e5, "density": 1000.0}


def scene(preset: str, **tables) -> dict:
    time = {"step": 0.02, "duration": 0.02 * STEPS}
    solver = {"preset": preset, "error": 1e-3}
    sides = np.array([6, 3, 3]) * CELL
    return {
        "sides": sides,
        "gravity": GRAVITY,
        "material": SOFT,
        "time": time,
        "solver": solver,
    } | tables


def pressed(preset: str, **tables) -> dict:
    """It falls on the ground, slides there and is pressed."""
    mesh, start = {"source": "scene.ply", "base": [0, 0, 0.01]}, {"velocity": [1.0, 0.0, -1.5]}
    return scene(preset, mesh=mesh, start=start, obstacle=PRESSING) | tables


BDF2 = {"step": 0.02, "duration": 0.02 * STEPS, "integrator": "bdf2"}
CASES = {
    "solid, pressed": pressed("newton-multigrid", material=SOFT | {"law": "neo-hookean"}),
    "bdf2, pressed": pressed("newton-multigrid", time=BDF2),
    "led and let go": scene("newton-multigrid", pin=HELD, anchor=LED),
    "fallback": pressed(
        "fast-msm", safety={"on_failure": "fallback"}, start={"velocity": [0.1, 0, -10.0]},
        solver={"preset": "fast-msm", "error": 1e-6},
    ),
}  # fmt: skip


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Several coarse levels; hierarchies that are given up soon."""
    monkeypatch.setattr(cycle, "COARSEST", 10)
    monkeypatch.setattr(preconditioning, "WORTH", 1.0)


# each case takes some five seconds
QUICK = {"solid, pressed", "fallback"}


@pytest.mark.parametrize(
    "case",
    [case if case in QUICK else pytest.param(case, marks=pytest.mark.slow) for case in CASES],
)
def test_a_step_from_a_checkpoint_is_the_step_of_the_whole_run(
    tmp_path: Path, case: str, monkeypatch
):
    """Runs that build hierarchies in some steps only."""
    built, build = [], LatticePreconditioner._build
    monkeypatch.setattr(
        LatticePreconditioner, "_build", lambda *given: (built.append(1), build(*given))[1]
    )
    frames = assert_goes_on_exactly(block_scene(tmp_path, **CASES[case]), every=3)
    assert len(built) > 1
    assert case != "fallback" or sum(frame.fallbacks for frame in frames) > 0


@pytest.mark.parametrize("ranks", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_a_run_that_was_stopped_goes_on_exactly(tmp_path: Path, ranks: int):
    """By the command line, on several coarse levels."""
    stiff = {"young_modulus": 1e9, "density": 1000.0}
    path = block_scene(tmp_path, **scene("newton", pin=HELD, anchor=LED, material=stiff))
    for step, file in ((6, "x.h5"), (-1, "whole.h5")):
        run(
            ranks,
            WORKERS / "stop_worker.py",
            step,
            "run",
            path,
            "-o",
            tmp_path / file,
            "-pc_mg_levels",
            3,
            status=0,
        )
    assert (
        run(ranks, WORKERS / "stop_worker.py", -1, "run", "--resume", tmp_path / "x.h5").returncode
        == 0
    )
    assert_same(tmp_path / "x.h5", tmp_path / "whole.h5")
