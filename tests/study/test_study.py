"""Studies and plans: what is run, how often, what goes wrong, and what stands in the table. The runs are stand-ins."""

import json
import os
import shlex
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from conftest import ENVIRONMENT, ROOT
from mpi4py import MPI
from study_stand_in import blank_frame

from msmpetsc.cli import plan
from msmpetsc.cli.main import main
from msmpetsc.comm import log
from msmpetsc.errors import InputError
from msmpetsc.output.writer import ResultFile
from msmpetsc.scene.reading import load_scene
from msmpetsc.study import case, measure
from msmpetsc.study.metrics import of_frames, together
from msmpetsc.study.plan import Method, Trial, cheapest, plan_step, plan_trajectory
from msmpetsc.study.process import environment
from msmpetsc.study.reading import load_study
from msmpetsc.study.runner import Part, list_study, run_study
from msmpetsc.study.scene_lines import overrides, put_into
from msmpetsc.study.sweep import cases
from msmpetsc.study.table import COLUMNS, read_table, write_table
from msmpetsc.study.trajectory import common_times, trajectory_error

STAND_IN = ROOT / "tests" / "helpers" / "study_stand_in.py"
SCENE = """
mesh = { source = "box.ply" }
cages = { count = 10 }
material = { young_modulus = 1e5, density = 1000 }
time = { step = 0.01, duration = 0.1 }
"""
ONE_SCENE = '[[scene]]\nname = "a"\nfile = "scene.toml"\n'


@pytest.fixture
def stand_in(monkeypatch):
    """Cases run the stand-in, not the program."""

    def stands_in(of: case.Case, result: Path, figures: Path) -> list[str]:
        words = case.command(of, result, figures)
        at = words.index("-m")
        return [*words[:at], str(STAND_IN), *words[at + 2 :]]

    monkeypatch.setattr(measure, "command", stands_in)
    for name, value in ENVIRONMENT.items():
        monkeypatch.setenv(name, value)


@pytest.fixture
def own_log():
    """The command line sets up the log for its own process: afterwards it is as it was."""
    before = log.handlers, log.level
    yield
    log.handlers, log.level = before


def study_file(folder: Path, text: str) -> Path:
    (folder / "scene.toml").write_text(SCENE)
    path = folder / "study.toml"
    path.write_text(text)
    return path


def carry_out(folder: Path, text: str, **options) -> list[dict]:
    """The rows of a study in this folder."""
    run_study(study_file(folder, text), folder / "out", None, **options)
    return read_table(folder / "out")


def calls(folder: Path) -> list[str]:
    path = folder / "out" / "calls.txt"
    return path.read_text().splitlines() if path.exists() else []


# The study file


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (ONE_SCENE + "[[sweep]]\nprests = []", ["sweep.0.prests", "'presets'", "(line 5)"]),
        (ONE_SCENE + '[[sweep]]\npresets = ["newtom"]', ["sweep.0.presets.0", "'newton'"]),
        (ONE_SCENE + '[[sweep]]\nscenes = ["b"]', ["sweep", "'b'"]),
        (ONE_SCENE + "[[sweep]]\nerrors = [2.0]", ["sweep.0.errors.0", "must be < 1"]),
        (ONE_SCENE + '[[sweep]]\noptions = ["-pc_type \'icc"]', ["sweep.0.options.0", "no closing quotation"]),
        (ONE_SCENE + '[[sweep]]\nintegrators = ["verlett"]', ["sweep.0.integrators.0", "'verlet'"]),
        (ONE_SCENE + 'reference = { integrator = "implicit-euler" }\n[[sweep]]', ["scene.0.reference", "needs step"]),
        (ONE_SCENE + "steps = 3\nduration = 0.5\n[[sweep]]", ["scene.0.duration", "beside steps"]),
        (ONE_SCENE + ONE_SCENE + "[[sweep]]", ["scene", "two scenes", "'a'"]),
        ("[[sweep]]", ["scene", "required"]),
        ("scene = [", ["is not TOML"]),
    ],
)
def test_a_mistake_in_a_study_file_is_one_line(tmp_path: Path, wrong: str, words: list[str]):
    with pytest.raises(InputError) as told:
        load_study(study_file(tmp_path, wrong), ["newton", "anderson"])
    assert len(str(told.value).splitlines()) == 1
    assert all(word in str(told.value) for word in words), str(told.value)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ('file = "gone.toml"', ["gone.toml", "no such scene"]),
        ('file = "scene.toml"\nset = ["cages.cuont=3"]', ["cages.cuont", "'count'"]),
        ('file = "scene.toml"\nreference = { integrator = "implicit-euler", step = 0.003 }', ["no multiple", "0.003"]),
    ],
)
def test_a_wrong_scene_is_told_before_anything_is_run(tmp_path: Path, stand_in, wrong: str, words: list[str]):
    with pytest.raises(InputError) as told:
        carry_out(tmp_path, f'[[scene]]\nname = "a"\n{wrong}\n[[sweep]]')
    assert len(str(told.value).splitlines()) == 1 and all(word in str(told.value) for word in words), str(told.value)
    assert not (tmp_path / "out").exists()


def test_the_command_line_refuses_with_status_2_and_one_line(tmp_path: Path):
    path = study_file(tmp_path, ONE_SCENE + "[[sweep]]\nerors = [0.1]")
    words = [sys.executable, "-m", "msmpetsc.cli.main", "study", str(path), "-o", str(tmp_path / "out")]
    done = subprocess.run(words, env=ENVIRONMENT, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert done.stderr.splitlines() == [
        f"msmpetsc: error: {path}: sweep.0.erors: unknown key, did you mean 'errors'? (line 5)"
    ]


def test_a_folder_that_cannot_be_is_one_line(tmp_path: Path, capsys, own_log):
    path = study_file(tmp_path, ONE_SCENE + "[[sweep]]")
    (tmp_path / "file").touch()
    (tmp_path / "taken" / "traces.json.part").mkdir(parents=True)
    for folder, said in {"file/out": "Not a directory", "taken": "Is a directory", "file": "not a folder"}.items():
        assert main(["study", str(path), "-o", str(tmp_path / folder)]) == 2
        told = capsys.readouterr().err.splitlines()
        assert len(told) == 1 and said in told[0] and str(tmp_path / folder) in told[0]


def all_cases(folder: Path, text: str, full: bool = False) -> list[case.Case]:
    path = study_file(folder, text)
    return cases(load_study(path), folder, full)


def test_a_sweep_is_a_product(tmp_path: Path):
    lists = {
        "presets": ["newton", "anderson"], "options": ["", "-pc_type icc"], "cells": [10, 20], "time_steps": [0.01, 0.02],
        "errors": [0.1, 0.01], "max_iterations": [5], "ranks": [1, 2],
    }  # fmt: skip
    text = ONE_SCENE + "[[sweep]]\n" + "\n".join(f"{name} = {json.dumps(values)}" for name, values in lists.items())
    found = all_cases(tmp_path, text)
    assert len(found) == 2 * 2 * 2 * 2 * (2 + 1) * 2  # an error or a budget, not both
    assert len({one.id for one in found}) == len(found)
    assert {one.label for one in found} == {
        "newton", "anderson", "newton -pc_type icc", "anderson -pc_type icc",
        "newton, 2 ranks", "anderson, 2 ranks", "newton -pc_type icc, 2 ranks", "anderson -pc_type icc, 2 ranks",
    }  # fmt: skip
    last = case.shown_command(found[-1])
    assert last.startswith("mpiexec -n 2 msmpetsc run ")
    assert last.endswith("-pc_type icc")
    for told in ("cages.count=20", 'preset = "anderson", max_iterations = 5', "step = 0.02, duration = 0.1"):
        assert told in last


def test_what_has_no_meaning_for_verlet_is_not_multiplied(tmp_path: Path):
    sweep = '[[sweep]]\nintegrators = ["verlet", "implicit-euler"]\npresets = ["newton", "anderson"]\nsubsteps = [1e-4, 1e-5]'
    found = all_cases(tmp_path, ONE_SCENE + sweep)
    assert [(one.integrator, one.preset, one.substep) for one in found] == [
        ("verlet", "", 1e-4), ("verlet", "", 1e-5), ("implicit-euler", "newton", None), ("implicit-euler", "anderson", None),
    ]  # fmt: skip


def test_nothing_is_measured_beyond_the_end_of_a_case(tmp_path: Path):
    """The scene's steps are of 0.01 s: 3 of them, or 1."""
    scene = ONE_SCENE + "duration = 0.03\ntrue_error = 2\ntrace = 3\n"
    sweep = "[[sweep]]\ntrace = true\ntime_steps = "
    study = load_study(study_file(tmp_path, scene + "[[sweep]]\ntime_steps = [0.01, 0.03]"))
    assert [case.true_error for case in cases(study, tmp_path, False)] == [2, 1]
    assert cases(load_study(study_file(tmp_path, scene + sweep + "[0.01]")), tmp_path, False)[0].trace == 3
    with pytest.raises(InputError, match="scene a: trace = 3, but newton takes 1 steps"):
        cases(load_study(study_file(tmp_path, scene + sweep + "[0.03]")), tmp_path, False)


def test_full_cases_are_for_full_studies_and_none_comes_twice(tmp_path: Path):
    text = ONE_SCENE + "[[sweep]]\nerrors = [0.1]\n[[sweep]]\nerrors = [0.1, 0.01]\nfull = true"
    assert [one.error for one in all_cases(tmp_path, text)] == [0.1]
    assert [one.error for one in all_cases(tmp_path, text, full=True)] == [0.1, 0.01]


def test_a_case_is_its_scene_its_mesh_and_its_options(tmp_path: Path):
    (tmp_path / "box.ply").write_text("a mesh")
    text = ONE_SCENE + "[[sweep]]"
    (before,) = all_cases(tmp_path, text)
    assert replace(before, label="x", timeout=1.0).id == before.id
    assert replace(before, options="-pc_type icc").id != before.id
    (tmp_path / "box.ply").write_text("another mesh")
    (after,) = all_cases(tmp_path, text)
    assert after.id != before.id


def test_the_studies_shipped_are_sound():
    presets = {
        "newton",
        "newton-multigrid",
        "anderson",
        "lbfgs",
        "chebyshev",
        "ngmres",
        "fast-msm",
        "paper",
        "fast-msm-kronecker",
    }
    for name in ("pareto", "figure6", "growth"):
        path = ROOT / "scenes" / "studies" / f"{name}.toml"
        few, many = (cases(load_study(path, presets), path.parent, full) for full in (False, True))
        assert 10 < len(few) < 130 and len(few) < len(many)


# What is run


def test_the_table_says_what_the_runs_said(tmp_path: Path, stand_in):
    text = "repeats = 3\n" + ONE_SCENE + 'frame = 0.02\nreference = { integrator = "implicit-euler", step = 0.001 }\n'
    text += 'trace = 2\n[[sweep]]\npresets = ["newton"]\nerrors = [0.1]\nranks = [2]\ntrace = true'
    (row,) = carry_out(tmp_path, text)
    assert set(row) == set(COLUMNS)
    # run 1 is the reference, 2, 3 and 4 are the repeats
    assert row["status"] == "ok" and row["ranks"] == 2 and row["repeats"] == 3
    assert (row["cells"], row["nodes"], row["frames"], row["steps"]) == (1, 8, 6, 10)
    assert row["time_setup"] == 3  # 2, 3 and 4
    assert row["time_frame"] == pytest.approx(0.01 * 3)
    assert row["fps"] == pytest.approx(1 / 0.03) and row["time_second"] == pytest.approx(3)
    assert (row["iterations"], row["ksp_its"]) == (3, 30)
    assert row["trajectory_error"] == pytest.approx(1.01 / 1.001 - 1)
    assert row["memory"] == 1000 - 4  # of the leanest run
    assert row["command"].startswith("mpiexec -n 2 msmpetsc run ")
    assert sum("--trace 2" in call for call in calls(tmp_path)) == 1  # in the first repeat alone
    (told,) = json.loads((tmp_path / "out" / "traces.json").read_text())
    assert (told["scene"], told["label"], told["trace"]["frame"]) == ("a", "newton", 2)
    with h5py.File(tmp_path / "out" / "table.h5") as file:
        assert file["label"].asstr()[:].tolist() == ["newton"]
        assert file["time_frame"][0] == row["time_frame"] and np.isnan(file["true_error"][0])
        assert file["ksp_its"].dims[0].keys() == ["row"]
    left = [path.name for path in (tmp_path / "out").rglob("*") if path.is_file() and "references" not in str(path)]
    assert sorted(left) == ["calls.txt", "study.toml", "table.csv", "table.h5", "traces.json"]


def test_finished_cases_are_not_run_again(tmp_path: Path, stand_in):
    text = ONE_SCENE + '[[sweep]]\npresets = ["newton"]\nerrors = '
    first = carry_out(tmp_path, text + "[0.1, 0.01]")
    assert len(calls(tmp_path)) == 2
    again = carry_out(tmp_path, text + "[0.2, 0.01]")  # one gone, one new, one kept
    assert len(calls(tmp_path)) == 3
    assert [row["error"] for row in again] == [0.2, 0.01] and again[1] == first[1]
    carry_out(tmp_path, text + "[0.2, 0.01]", restart=True)
    assert len(calls(tmp_path)) == 5


def test_parts_run_apart_and_are_joined(tmp_path: Path, stand_in):
    """Three cases in two parts of 1 and 2; one part is run twice, its cases once."""
    text = ONE_SCENE + '[[sweep]]\npresets = ["newton"]\nerrors = [0.3, 0.2, 0.1]'
    path, out = study_file(tmp_path, text), tmp_path / "out"
    found = {index: run_study(path, out, None, part=Part(index, 2)) for index in (2, 1, 2)}
    assert [[row["error"] for row in found[index]] for index in (1, 2)] == [[0.3], [0.2, 0.1]]
    assert not (out / "table.csv").exists() and [done for _, done in list_study(path, out, None)] == [True] * 3
    assert [len(log.read_text().splitlines()) for log in sorted(out.glob("parts/*/calls.txt"))] == [1, 2]
    rows = carry_out(tmp_path, text)
    assert [row["error"] for row in rows] == [0.3, 0.2, 0.1] and calls(tmp_path) == []
    assert rows == [row for part in ("1-of-2", "2-of-2") for row in read_table(out / "parts" / part)]


def test_what_a_part_lacks_the_whole_runs(tmp_path: Path, stand_in):
    text = ONE_SCENE + 'trace = 2\n[[sweep]]\ntrace = true\npresets = ["newton"]\nerrors = [0.2, 0.1]'
    path, out = study_file(tmp_path, text), tmp_path / "out"
    run_study(path, out, None, part=Part(2, 2))
    assert [done for _, done in list_study(path, out, None)] == [False, True]
    assert run_study(path, out, None, part=Part(9, 9))[0]["error"] == 0.1  # done by another part
    assert not (out / "parts" / "9-of-9" / "calls.txt").exists()
    assert run_study(path, out, None, part=Part(1, 9)) == []  # more parts than cases
    carry_out(tmp_path, text)
    assert len(calls(tmp_path)) == 1
    assert len(json.loads((out / "traces.json").read_text())) == 2


@pytest.mark.parametrize("part", ["3", "0/3", "4/3", "a/3", "1/", "-1/3"])
def test_a_part_that_is_none_is_refused(tmp_path: Path, capsys, own_log, part: str):
    path = study_file(tmp_path, ONE_SCENE + "[[sweep]]")
    assert main(["study", str(path), "-o", str(tmp_path / "out"), f"--part={part}"]) == 2
    assert capsys.readouterr().err == f"msmpetsc: error: --part must read I/N, 1 <= I <= N, not {part}\n"


def test_the_list_names_each_case_and_runs_none(tmp_path: Path, capsys, own_log):
    path = study_file(tmp_path, ONE_SCENE + '[[sweep]]\npresets = ["newton", "anderson"]')
    assert main(["study", str(path), "-o", str(tmp_path / "out"), "--list"]) == 0
    first, second, last = capsys.readouterr().out.splitlines()
    assert first.startswith("   1 open  a: newton  msmpetsc run ") and second.startswith("   2 open  a: anderson  ")
    assert last == "2 cases, 0 done" and not (tmp_path / "out").exists()


def test_a_case_that_fails_is_a_row_with_its_reason(tmp_path: Path, stand_in):
    rows = carry_out(
        tmp_path, "repeats = 2\n" + ONE_SCENE + '[[sweep]]\npresets = ["newton"]\noptions = ["-ksp_fail", ""]', jobs=2
    )
    assert [(row["status"], row["reason"]) for row in rows] == [("failed", "planted, with reason"), ("ok", "")]
    assert rows[0]["time_frame"] is None and rows[0]["options"] == "-ksp_fail"
    assert len(calls(tmp_path)) == 3  # what fails is not repeated


def alive(pid: int) -> bool:
    try:
        return "Z" not in Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="looks at Linux's processes")
def test_a_case_that_takes_too_long_is_ended_with_all_it_started(tmp_path: Path, stand_in):
    text = ONE_SCENE + '[[sweep]]\npresets = ["newton"]\noptions = ["-ksp_children -ksp_hang"]\n'
    begin = time.monotonic()
    (row,) = carry_out(tmp_path, "timeout = 2\n" + text)
    assert time.monotonic() - begin < 20
    assert (row["status"], row["reason"]) == ("timeout", "took longer than 2 s")
    assert not alive(int((tmp_path / "out" / "child").read_text()))
    carry_out(tmp_path, "timeout = 2\n" + text)
    assert len(calls(tmp_path)) == 1
    carry_out(tmp_path, "timeout = 3\n" + text)  # more time: another try
    assert len(calls(tmp_path)) == 2


STUDY_IN_ITS_OWN_PROCESS = """
import sys
from pathlib import Path
from msmpetsc.study import case, measure
from msmpetsc.study.runner import run_study
real = case.command
def stands_in(of, result, figures):
    words = real(of, result, figures)
    at = words.index("-m")
    return [*words[:at], sys.argv[1], *words[at + 2:]]
measure.command = stands_in
run_study(Path(sys.argv[2]), Path(sys.argv[3]), None)
"""


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="looks at Linux's processes")
def test_a_study_that_is_stopped_leaves_its_table_and_no_process(tmp_path: Path):
    text = ONE_SCENE + '[[sweep]]\npresets = ["newton"]\noptions = ["", "-ksp_children -ksp_hang", "-ksp_never"]'
    words = [
        sys.executable,
        "-c",
        STUDY_IN_ITS_OWN_PROCESS,
        str(STAND_IN),
        str(study_file(tmp_path, text)),
        str(tmp_path / "out"),
    ]
    heard = lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)  # noqa: E731 (what runs in the background ignores it)
    study = subprocess.Popen(words, env=ENVIRONMENT, stderr=subprocess.DEVNULL, preexec_fn=heard)
    child, deadline = tmp_path / "out" / "child", time.monotonic() + 60
    while not (child.is_file() and child.read_text()) and time.monotonic() < deadline:
        time.sleep(0.05)
    os.kill(study.pid, signal.SIGINT)
    assert study.wait(20) != 0
    assert [row["status"] for row in read_table(tmp_path / "out")] == ["ok"]
    assert not alive(int(child.read_text()))
    assert len(calls(tmp_path)) == 2


class NumberOfNumPy2(float):
    def __repr__(self) -> str:
        return f"np.float64({float(self)!r})"


def test_a_number_shows_no_type_in_a_table(tmp_path: Path):
    row = {"case": "1", "time_step": NumberOfNumPy2(1e-3)}
    write_table(tmp_path, [row | {name: 1 for name, column in COLUMNS.items() if column.kind is int}])
    assert ",0.001," in (tmp_path / "table.csv").read_text()


RUNS_WITHIN_A_RUN = """
import subprocess, sys
from mpi4py import MPI
from msmpetsc.study.process import environment
for alone, launcher in ((True, []), (False, ["mpiexec", "-n", "2"])):
    command = [*launcher, sys.executable, "-c", "from mpi4py import MPI; print(MPI.COMM_WORLD.size)"]
    subprocess.run(command, env=environment(alone), check=True)
"""


def test_a_study_may_be_one_rank_of_mpiexec(on_ranks):
    done = on_ranks(1, "-c", RUNS_WITHIN_A_RUN, timeout=60)
    assert done.returncode == 0 and done.stdout.split() == ["1", "2", "2"], done.stderr


def test_a_case_may_have_more_ranks_than_cores(monkeypatch):
    for name, value in ENVIRONMENT.items():
        monkeypatch.setenv(name, value)
    command = ["mpiexec", "-n", str(os.cpu_count() + 1), "true"]
    done = subprocess.run(command, env=environment(), capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr


def test_a_table_read_and_written_again_is_the_same_text(tmp_path: Path):
    row = {"case": "1", "cells": 1009, "steps": 8, "time_step": 1e-3, "fps": 121.25, "memory": 4e8, "error": None}
    row |= {name: 1 for name, column in COLUMNS.items() if column.kind is int}
    write_table(tmp_path, [row])
    once = (tmp_path / "table.csv").read_text()
    write_table(tmp_path, read_table(tmp_path))
    assert (tmp_path / "table.csv").read_text() == once and ",1009," in once


def test_a_table_that_is_none_is_one_line(tmp_path: Path, stand_in):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "table.csv").write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match="--restart begins anew"):
        carry_out(tmp_path, ONE_SCENE + "[[sweep]]")


# Figures


def result(path: Path, times: list[float], positions: list[np.ndarray], mass: list[float], **series) -> Path:
    """A result file; positions (n, 3) of each time, the first at rest."""
    with ResultFile(path, MPI.COMM_SELF, {"scene": ""}) as file:
        file.write("lattice/nodes", positions[0])
        file.write("lattice/mass", np.array(mass, float))
        file.start_frames(len(times), len(mass))
        for index, now in enumerate(times):
            values = {name: column[index] for name, column in series.items()}
            file.append(blank_frame(index=index, time=now, position=positions[index], **values))
    return path


def test_the_trajectory_error_of_a_motion_by_hand(tmp_path: Path):
    """Two nodes of 1 and 4 kg: node 0 moves by 3 and 0 at the two common times, node 1 by 0 and 2; node 1 is off by 1
    once, node 0 by 2 once: sqrt((4 * 1 + 1 * 4) / (1 * 9 + 4 * 4)) = sqrt(8 / 25)."""
    rest = np.array([[0.0, 0, 0], [1, 0, 0]])
    x, z = np.array([[1.0, 0, 0], [0, 0, 0]]), np.array([[0.0, 0, 0], [0, 0, 1]])
    reference = result(tmp_path / "r.h5", [0, 0.1, 0.2], [rest, rest + 3 * x, rest + 2 * z], [1, 4])
    times = [0, 0.05, 0.1 + 1e-12, 0.15, 0.2]
    positions = [rest, rest + 99, rest + 3 * x + z, rest - 99, rest + 2 * z + 2 * x]
    run = result(tmp_path / "x.h5", times, positions, [1, 4])
    assert trajectory_error(run, reference) == pytest.approx(np.sqrt(8 / 25))
    assert trajectory_error(reference, reference) == 0


def test_runs_without_common_times_or_nodes_have_no_trajectory_error(tmp_path: Path):
    rest = np.zeros((1, 3))
    reference = result(tmp_path / "r.h5", [0, 0.1], [rest, rest + 1], [1])
    with pytest.raises(InputError, match="1 times in common"):
        trajectory_error(result(tmp_path / "a.h5", [0, 0.03], [rest, rest], [1]), reference)
    with pytest.raises(InputError, match="different lattices"):
        trajectory_error(result(tmp_path / "b.h5", [0, 0.1], [np.zeros((2, 3))] * 2, [1, 1]), reference)
    with pytest.raises(InputError, match="different lattices"):
        trajectory_error(result(tmp_path / "d.h5", [0, 0.1], [rest + 1, rest], [1]), reference)
    with pytest.raises(InputError, match="nothing moves"):
        trajectory_error(reference, result(tmp_path / "c.h5", [0, 0.1], [rest, rest], [1]))


@pytest.mark.parametrize(
    ("times", "others", "pairs"),
    [
        ([0, 1, 2], [0, 2, 4], [[0, 0], [2, 1]]),
        ([0, 0.3], [0, 0.1, 0.2, 0.1 + 0.2], [[0, 0], [1, 3]]),
        ([0], [0], [[0, 0]]),
        ([], [0], []),
        ([5], [0, 1], []),
    ],
)
def test_common_times(times: list, others: list, pairs: list):
    assert common_times(np.array(times, float), np.array(others, float)).tolist() == pairs


def test_means_are_of_steps_and_leave_the_first_frame_out(tmp_path: Path):
    """Frames of 2 steps: 9 s, 2 s and 4 s of computing; the first does not count."""
    positions = [np.zeros((1, 3))] * 4
    file = result(
        tmp_path / "x.h5", [0, 0.2, 0.4, 0.6], positions, [1], wall_time=[0, 9.0, 2.0, 4.0], iterations=[0, 50, 4, 8],
        ksp_its=[0, 0, 40, 0], step_error=[0, 0.3, 0.4, 0.0],
    )  # fmt: skip
    row = of_frames(file, 0.1)
    assert (row["frames"], row["steps"]) == (4, 6)
    assert row["time_frame"] == pytest.approx(6 / 4)
    assert (row["iterations"], row["ksp_its"]) == (3, 10)
    assert row["estimated_error"] == pytest.approx(np.sqrt((0.09 + 0.16) / 3))


def test_repeats_become_medians():
    runs = [
        {"time_ksp": t, "memory": m, "true_error": e} for t, m, e in ((1.0, 9, 0.1), (5.0, 7, None), (2.0, 8, None))
    ]
    assert together(runs) == {"time_ksp": 2.0, "memory": 7, "true_error": 0.1}


def test_the_range_of_the_repeats_is_kept_and_a_single_run_has_none():
    runs = [{"time_frame": t} for t in (0.3, 0.1, 0.2)]
    assert together(runs) == {"time_frame": 0.2, "time_frame_min": 0.1, "time_frame_max": 0.3}
    assert together(runs[:1]) == {"time_frame": 0.3}
    assert together([*runs[:2], {}]) == {"time_frame": 0.2, "time_frame_min": 0.1, "time_frame_max": 0.3}


# Plans


def attempt_with(model):
    """A stand-in for trials: cost and error by a formula."""
    return lambda method, done: Trial(method, *model(method))


def test_a_plan_takes_the_cheapest_that_meets_the_error():
    """First-order implicit steps of 0.1 s a step; anderson at half the cost, multigrid at twice."""
    factor = {"newton": 1.0, "anderson": 0.5, "newton-multigrid": 2.0}

    def model(method: Method):
        if method.integrator == "verlet":
            return 100.0, 1e-5
        return 0.1 * factor[method.preset] / method.time_step, 5 * method.time_step + 0.01 * method.step_error

    trials = plan_trajectory(attempt_with(model), 0.02, 0.03, True, [("newton-multigrid", ""), ("anderson", "")])
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
        True,
        [("anderson", "")],
    )
    assert len(trials) == 2 and cheapest(trials, 1e-3).method.integrator == "verlet"


def test_a_plan_that_cannot_meet_the_error_ends():
    trials = plan_trajectory(attempt_with(lambda m: (1.0, 0.5)), 0.02, 1e-3, False, [("anderson", "")])
    assert cheapest(trials, 1e-3) is None and len(trials) <= 6
    failed = plan_trajectory(lambda m, _: Trial(m, None, None, "failed"), 0.02, 1e-3, True, [])
    assert cheapest(failed, 1e-3) is None and len(failed) == 2


def test_a_plan_solves_the_steps_better_where_that_is_what_is_wrong():
    """The error is the steps' own: no shorter step helps, a tenth of the step error does."""
    trials = plan_trajectory(attempt_with(lambda m: (1 / m.time_step, 3 * m.step_error)), 0.02, 0.05, False, [])
    assert cheapest(trials, 0.05).method.step_error == pytest.approx(0.005)
    stubborn = plan_trajectory(
        attempt_with(lambda m: (1.0, 0.5 if m.time_step > 0.003 else 0.01)), 0.02, 0.05, False, []
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
    put_into(path, Method("implicit-euler", 0.005, "newton", "", 1e-2))
    expected = COMMENTED.replace("step = 0.02 ", "step = 0.005 ").replace("anderson", "newton")
    expected = expected.replace("max_iterations = 5", "error = 0.01").replace("\n", "\r\n")
    assert path.read_bytes().decode() == expected
    put_into(path, Method("verlet", 0.02))
    told = path.read_text()
    assert 'integrator = "verlet"' in told and "# A scene of mine" in told and "# how" in told


@pytest.mark.parametrize(("errors", "status"), [([0.2, 0.01], 0), ([0.2, 0.1], 3)])
def test_the_command_tells_the_answer_and_writes_it(
    tmp_path: Path, monkeypatch, capsys, own_log, errors: list, status: int
):
    methods = [Method("implicit-euler", step, "newton", "-pc_type icc", 0.01) for step in (0.02, 0.005)]
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
    "implicit": "time = { step = 0.02, duration = 1.0, integrator = 'implicit-euler' }\nsolver = { preset = 'anderson', max_iterations = 5 }",
    "verlet": "time = { step = 0.02, duration = 1.0, integrator = 'verlet', substep = 1e-4 }\nsolver.error = 0.1",
}


@pytest.mark.parametrize(
    "method", [Method("verlet", 0.02), Method("implicit-euler", 0.005, "lbfgs", "", 1e-5)], ids=["explicit", "implicit"]
)
@pytest.mark.parametrize("given", BEFORE)
def test_the_command_of_a_plan_says_what_its_lines_say(tmp_path: Path, given: str, method: Method):
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
    monkeypatch.setattr(plan, "try_all", lambda *_: [Trial(Method("verlet", 0.02), 1.0, 0.01)])
    path = tmp_path / "scene.toml"
    path.write_text(COMMENTED)
    (tmp_path / "scene.toml.part").mkdir()
    assert main(["plan", str(path), "--error", "0.05", "--write"]) == 2
    told = capsys.readouterr()
    assert 'integrator = "verlet"' in told.out and path.read_text() == COMMENTED
    assert told.err == f"msmpetsc: error: {path}: cannot be written: Is a directory\n"


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
