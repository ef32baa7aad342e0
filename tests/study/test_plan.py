"""Plans: which trials are made, which is the answer, and how it is told and written."""

# ruff: noqa: F811 (fixtures are imported)
import os
import shlex
from pathlib import Path

import pytest
from block_scene import block_scene
from study_files import own_log  # noqa: F401 (fixtures)

from msmpetsc.cli.commands import plan
from msmpetsc.cli.main import main
from msmpetsc.scene.reading import load_scene
from msmpetsc.study.plan import Candidate, Trial, cheapest, plan_step, plan_trajectory
from msmpetsc.study.scene_lines import overrides, put_into


def attempt_with(model):
    """A stand-in for trials: cost and error by a formula."""
    return lambda method, done: Trial(method, *model(method))


def test_a_plan_takes_the_cheapest_that_meets_the_error():
    """First-order implicit steps of 0.1 s a step; anderson at half the cost, multigrid at twice."""
    factor = {"newton": 1.0, "anderson": 0.5, "newton-multigrid": 2.0}

    def model(method: Candidate):
        if method.integrator == "verlet":
            return 100.0, 1e-5
        return 0.1 * factor[method.preset] / method.time_step, 5 * method.time_step + 0.01 * method.step_error

    trials = plan_trajectory(
        attempt_with(model), 0.02, 0.03, verlet=True, methods=[("newton-multigrid", ""), ("anderson", "")]
    )
    best = cheapest(trials, 0.03)
    assert best.method.preset == "anderson" and best.method.time_step == 0.005  # 0.1 at 0.02 s, 0.025 at 0.005 s
    assert best.cost == min(trial.cost for trial in trials if trial.error <= 0.03)
    assert len(trials) <= 8


def test_a_plan_does_not_try_what_cannot_become_cheapest():
    """Verlet meets the error at a cost of 1; implicit steps cost 50 already where they are far off."""
    trials = plan_trajectory(
        attempt_with(lambda m: (1.0, 1e-5) if m.integrator == "verlet" else (50.0, 0.2)),
        0.02,
        1e-3,
        verlet=True,
        methods=[("anderson", "")],
    )
    assert len(trials) == 2 and cheapest(trials, 1e-3).method.integrator == "verlet"


def test_a_plan_that_cannot_meet_the_error_ends():
    trials = plan_trajectory(attempt_with(lambda m: (1.0, 0.5)), 0.02, 1e-3, verlet=False, methods=[("anderson", "")])
    assert cheapest(trials, 1e-3) is None and len(trials) <= 6
    failed = plan_trajectory(lambda m, _: Trial(m, None, None, "failed"), 0.02, 1e-3, verlet=True, methods=[])
    assert cheapest(failed, 1e-3) is None and len(failed) == 2


def test_a_plan_solves_the_steps_better_where_that_is_what_is_wrong():
    """The error is the steps' own: no shorter step helps, a tenth of the step error does."""
    trials = plan_trajectory(
        attempt_with(lambda m: (1 / m.time_step, 3 * m.step_error)), 0.02, 0.05, verlet=False, methods=[]
    )
    assert cheapest(trials, 0.05).method.step_error == pytest.approx(0.005)
    stubborn = plan_trajectory(
        attempt_with(lambda m: (1.0, 0.5 if m.time_step > 0.003 else 0.01)), 0.02, 0.05, verlet=False, methods=[]
    )
    assert cheapest(stubborn, 0.05).method.time_step < 0.003  # a better solution did not help: on to shorter steps


@pytest.mark.parametrize(("true", "goals"), [(0.9, [1e-3, 1e-3]), (1.2, [1e-3, 5e-4, 1e-3, 5e-4])])
def test_a_plan_for_the_step_error_takes_the_loosest_goal_that_will_do(true: float, goals: list[float]):
    """``true`` is the true error over the goal; a looser goal is cheaper."""
    trials = plan_step(attempt_with(lambda m: (1 / m.step_error, true * m.step_error)), 0.02, 1e-3, [("anderson", "")])
    assert [trial.method.step_error for trial in trials] == pytest.approx(goals)


def test_a_plan_does_not_tighten_what_is_dearer_already():
    """The true error is a little over that aimed at; anderson costs much more than newton does."""
    model = lambda m: ((20 if m.preset == "anderson" else 1) / m.step_error, 1.2 * m.step_error)  # noqa: E731
    trials = plan_step(attempt_with(model), 0.02, 1e-3, [("anderson", "")])
    assert [trial.method.preset for trial in trials] == ["newton", "newton", "anderson"]


COMMENTED = """# A scene of mine
title = "x"      # for the reader

[time]
step = 0.02      # [s]
duration = 1.0

[solver]         # how
preset = "anderson"
max_iterations = 5
"""


def test_what_is_written_into_a_scene_keeps_its_comments(tmp_path: Path):
    path = tmp_path / "scene.toml"
    path.write_bytes(COMMENTED.replace("\n", "\r\n").encode())
    put_into(path, Candidate("implicit-euler", 0.005, "newton", "", 1e-2))
    expected = COMMENTED.replace("step = 0.02 ", "step = 0.005 ").replace("anderson", "newton")
    expected = expected.replace("max_iterations = 5", "error = 0.01").replace("\n", "\r\n")
    assert path.read_bytes().decode() == expected
    put_into(path, Candidate("verlet", 0.02))
    told = path.read_text()
    assert 'integrator = "verlet"' in told and "# A scene of mine" in told and "# how" in told


@pytest.mark.parametrize(("errors", "status"), [([0.2, 0.01], 0), ([0.2, 0.1], 3)])
def test_the_command_tells_the_answer_and_writes_it(
    tmp_path: Path, monkeypatch, capsys, own_log, errors: list, status: int
):
    methods = [Candidate("implicit-euler", step, "newton", "-pc_type icc", 0.01) for step in (0.02, 0.005)]
    trials = [Trial(method, 1 / method.time_step, error) for method, error in zip(methods, errors, strict=True)]
    monkeypatch.setattr(plan, "try_all", lambda *_: trials)
    path = tmp_path / "scene.toml"
    path.write_text(COMMENTED)
    assert main(["plan", str(path), "--error", "0.05", "--write"]) == status
    told = capsys.readouterr().out
    if status == 0:
        assert "step = 0.005 " in path.read_text() and "# how" in path.read_text()
        command = next(line for line in told.splitlines() if line.startswith("msmpetsc run "))
        assert shlex.split(command)[:3] == ["msmpetsc", "run", str(path)] and command.endswith(" -pc_type icc")
        assert "--set time.step=0.005 " in command and 'preset = "newton"' in told
    else:
        assert path.read_text() == COMMENTED
        assert "nothing tried meets 0.05" in told and "1.0e-01" in told


BEFORE = {
    "bare": "time = { step = 0.02, duration = 1.0 }",
    "implicit": "time = { step = 0.02, duration = 1.0, integrator = 'implicit-euler' }\n"
    "solver = { preset = 'anderson', max_iterations = 5 }",
    "verlet": "time = { step = 0.02, duration = 1.0, integrator = 'verlet', substep = 1e-4 }\nsolver.error = 0.1",
}


@pytest.mark.parametrize(
    "method",
    [Candidate("verlet", 0.02), Candidate("implicit-euler", 0.005, "lbfgs", "", 1e-5)],
    ids=["explicit", "implicit"],
)
@pytest.mark.parametrize("given", BEFORE)
def test_the_command_of_a_plan_says_what_its_lines_say(tmp_path: Path, given: str, method: Candidate):
    """Run with these changes the scene is the same as with the answer written into it."""
    mesh = 'mesh.source = "beam.obj"\ncages.count = 10\nmaterial = { density = 1, young_modulus = 1 }\n'
    path = tmp_path / "scene.toml"
    path.write_text(mesh + BEFORE[given])
    changed = load_scene(path, overrides(path, method))
    put_into(path, method)
    written = load_scene(path)
    assert (changed.time, changed.solver) == (written.time, written.solver)
    assert changed.time.step == method.time_step and changed.time.integrator == method.integrator


def test_an_answer_that_cannot_be_written_is_told_all_the_same(tmp_path: Path, monkeypatch, capsys, own_log):
    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(plan, "try_all", lambda *_: [Trial(Candidate("verlet", 0.02), 1.0, 0.01)])
    path = tmp_path / "scene.toml"
    path.write_text(COMMENTED)
    monkeypatch.setattr(os, "fsync", full)
    assert main(["plan", str(path), "--error", "0.05", "--write"]) == 2
    told = capsys.readouterr()
    assert 'integrator = "verlet"' in told.out and path.read_text() == COMMENTED
    assert told.err == f"msmpetsc: error: {path} cannot be written: No space left on device\n"


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--error", "2"], "between 0 and 1"),
        ([], "--error --step-error"),
        (["--error", "0.1", "--frames", "0"], "--frames must be at least 1"),
        (["--error", "0.1"], "no such scene"),
    ],
)
def test_a_plan_refuses_with_status_2_and_one_line(tmp_path: Path, capsys, own_log, options: list[str], words: str):
    assert main(["plan", str(tmp_path / "gone.toml"), *options]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("msmpetsc: error: ") and words in line


def test_a_plan_of_statics_is_for_an_error_of_the_surface(tmp_path: Path, capsys, own_log):
    path = block_scene(tmp_path, time={"step": 1.0, "duration": 1.0, "integrator": "static"})
    assert main(["plan", str(path), "--error", "0.1"]) == 2
    assert "--surface-error plans its cells" in capsys.readouterr().err
