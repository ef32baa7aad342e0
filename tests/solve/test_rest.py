"""Runs that end when nothing moves any more (time.until = "rest"), and those that must not."""

from pathlib import Path

import numpy as np
import pytest
from block_scene import block_scene, play

from msmpetsc.cli.main import main
from msmpetsc.results.reader import Result

SIDES = np.array([0.25, 0.25, 1.0])  # [m]: 2 x 2 x 8 cells, which swing in about 2.5 s
HELD = {"pin": [{"region": {"box": [[-9, -9, -9], [9, 9, 0.01]]}}]}
TOP = {"box": [[-9, -9, 0.99], [9, 9, 9]]}
ASIDE = HELD | {"gravity": {"acceleration": [1.0, 0.0, 0.0]}}
DAMPED = {"step": 0.4, "duration": 80.0, "until": "rest"}
ERROR = 1e-4


def beam(folder: Path, time: dict, error: float = ERROR, **tables) -> Path:
    return block_scene(folder, SIDES, time=time, solver={"preset": "newton", "error": error}, **tables)


@pytest.mark.parametrize("integrator", ["implicit-euler", "bdf2"])
def test_a_damped_motion_ends_at_its_equilibrium(tmp_path: Path, integrator: str):
    """Near it by the error asked for, in the norm of M, and long before its time is over."""
    time = DAMPED | {"integrator": integrator}
    model, frames = play(beam(tmp_path, time, **ASIDE))
    state = {"step": 1.0, "duration": 1.0, "integrator": "static"}
    _, states = play(beam(tmp_path, state, error=1e-9, **ASIDE))
    end = states[-1].position
    ends = model.lattice.nodes, frames[-1].position
    farthest, away = (np.sqrt(model.lattice.mass @ ((end - q) ** 2).sum(axis=1)) for q in ends)
    assert 10 < len(frames) < 150
    assert away < 2 * ERROR * farthest


@pytest.mark.parametrize("integrator", ["verlet", "bdf2"])
def test_a_swing_does_not_end_where_it_turns(tmp_path: Path, integrator: str):
    """Steps are short, and the error so large that each half swing some move less."""
    time = {"step": 0.02, "duration": 6.0, "until": "rest", "integrator": integrator}
    _, frames = play(beam(tmp_path, time, error=0.05, **ASIDE))
    tip = [frame.position[:, 0].max() for frame in frames]
    turns = np.diff(np.sign(np.diff(tip))) != 0
    assert len(frames) == 301 and turns.sum() >= 4


def test_a_body_that_passes_its_equilibrium_is_not_at_rest(tmp_path: Path):
    """All forces balance there, and one step is far shorter than the error asked for."""
    start = {"velocity": [1.0, 0.0, 0.0]}
    time = {"step": 1e-4, "duration": 1e-2, "until": "rest", "integrator": "verlet"}
    assert len(play(beam(tmp_path, time, error=0.9, start=start, **HELD))[1]) == 101


def test_a_body_that_drifts_is_not_at_rest_and_one_that_lies_is(tmp_path: Path):
    drift = {"start": {"velocity": [0.1, 0.0, 0.0]}}
    time = {"step": 0.1, "duration": 2.0, "until": "rest"}
    assert len(play(beam(tmp_path, time, error=0.1, **drift))[1]) == 21
    assert len(play(beam(tmp_path, time))[1]) == 2


def test_what_is_yet_to_come_is_waited_for(tmp_path: Path):
    """A force that comes at 40 s, when all has long been at rest; one that comes after the end is none."""
    force = [{"region": TOP, "total": [1.0, 0.0, 0.0], "start": start} for start in (40.0, 90.0)]
    _, frames = play(beam(tmp_path, DAMPED, force=force, **HELD))
    assert 40.0 < frames[-1].time < 75.0
    assert frames[-1].position[:, 0].max() > SIDES[0] + 0.001


def test_a_run_at_rest_is_whole(tmp_path: Path, capsys: pytest.CaptureFixture):
    """One line says so, the file has no more frames, and to resume it is to be told so, unless it is to go on."""
    scene, path = str(beam(tmp_path, DAMPED, output={"surface": False, "every": 7}, **ASIDE)), str(tmp_path / "out.h5")
    assert main(["run", scene, "-o", path]) == 0
    assert len([line for line in capsys.readouterr().err.splitlines() if "at rest after step" in line]) == 1
    with Result(path) as result:
        count, times = len(result.frames.time), result.frames.time[:]
        assert result.frames.time.planned == (count,) and np.isfinite(times).all()
        assert times[-1] < 75
    assert main(["run", "--resume", path]) == 0
    assert "nothing left to do" in capsys.readouterr().err
    assert main(["run", "--resume", path, "--set", 'time.until="duration"', "--force"]) == 0
    with Result(path) as result:
        assert len(result.frames.time) == 1 + -(-200 // 7)
