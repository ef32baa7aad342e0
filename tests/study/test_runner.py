"""Runs of a study: which runs, how often, and failures. The runs are stand-ins."""

# ruff: noqa: F811 (fixtures are imported)
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import chain
from pathlib import Path

import pytest
from conftest import ENVIRONMENT
from one_process import command_error
from study_files import (  # noqa: F401 (fixtures)
    ONE_SCENE,
    alive,
    all_cases,
    calls,
    carry_out,
    own_log,
    stand_in,
    study_file,
)

from msmpetsc.cli.main import main
from msmpetsc.errors import InputError
from msmpetsc.study import table
from msmpetsc.study.runner import list_study, run_study
from msmpetsc.study.table import COLUMNS, read_table, records, write_table


def test_the_table_says_what_the_runs_said(tmp_path: Path, stand_in):
    text = f'repeats = 3\n{ONE_SCENE}set = ["time.step=0.02"]\n'
    text += 'reference = { integrator = "implicit-euler", step = 0.001 }\n'
    text += '[[sweep]]\npresets = ["newton"]\ntime_steps = [0.01]\nerrors = [0.1]\nranks = [2]'
    (row,) = carry_out(tmp_path, text)
    assert set(row) == set(COLUMNS)
    # run 1 is the reference, 2, 3 and 4 are the repeats
    assert row["status"] == "ok" and row["ranks"] == 2 and row["repeats"] == 3
    assert (row["cells"], row["nodes"], row["frames"], row["steps"]) == (1, 8, 6, 10)
    # median of 2, 3 and 4
    assert row["time_setup"] == 3
    assert row["time_frame"] == pytest.approx(0.01 * 3)
    assert row["fps"] == pytest.approx(1 / 0.03) and row["time_second"] == pytest.approx(3)
    assert (row["iterations"], row["ksp_its"]) == (3, 30)
    assert row["trajectory_error"] == pytest.approx(1.01 / 1.001 - 1)
    # least memory of the three repeats
    assert row["memory"] == 1000 - 4
    assert row["command"].startswith("mpiexec -n 2 msmpetsc run ")
    left = {path.name for path in (tmp_path / "out").iterdir()}
    assert left == {"calls.txt", "references", "study.toml", "table.csv"}


def test_finished_cases_are_not_run_again(tmp_path: Path, stand_in):
    text = ONE_SCENE + '[[sweep]]\npresets = ["newton"]\nerrors = '
    first = carry_out(tmp_path, text + "[0.1, 0.01]")
    assert len(calls(tmp_path)) == 2
    # an old case is gone, a new case was added, a case is kept
    again = carry_out(tmp_path, text + "[0.2, 0.01]")
    assert len(calls(tmp_path)) == 3
    assert [row["error"] for row in again] == [0.2, 0.01] and again[1] == first[1]
    carry_out(tmp_path, text + "[0.2, 0.01]", restart=True)
    assert len(calls(tmp_path)) == 5


def test_parts_run_apart_and_are_joined(tmp_path: Path, stand_in):
    """Three cases run in parts of 2 cases and 1. A part is run twice, its cases once."""
    text = ONE_SCENE + '[[sweep]]\npresets = ["newton"]\nerrors = [0.3, 0.2, 0.1]'
    path, out = study_file(tmp_path, text), tmp_path / "out"
    found = {index: run_study(path, out, part=(index, 2)) for index in (2, 1, 2)}
    assert [[row["error"] for row in found[index]] for index in (1, 2)] == [[0.3, 0.2], [0.1]]
    assert not (out / "table.csv").exists()
    assert [done for _, done in list_study(path, out)] == [True] * 3
    logs = sorted(out.glob("parts/*/calls.txt"))
    assert [len(log.read_text().splitlines()) for log in logs] == [2, 1]
    rows = carry_out(tmp_path, text)
    assert [row["error"] for row in rows] == [0.3, 0.2, 0.1] and calls(tmp_path) == []
    parts = (records(read_table(out / "parts" / part)) for part in ("1-of-2", "2-of-2"))
    assert rows == [*chain.from_iterable(parts)]


def test_cases_of_another_study_are_not_dropped(tmp_path: Path, stand_in):
    text = ONE_SCENE + '[[sweep]]\npresets = ["newton"]\nerrors = '
    (row,) = carry_out(tmp_path, text + "[0.1]")
    other = study_file(tmp_path, text + "[0.2]").rename(tmp_path / "other.toml")
    words = f"table.csv has cases of the study {row['study']}: name another folder by -o"
    assert words in command_error("study", other, "-o", tmp_path / "out")
    assert records(read_table(tmp_path / "out")) == [row]
    # a study that has a new name and the same cases goes on
    other.write_text(text + "[0.1, 0.2]")
    assert run_study(other, tmp_path / "out")[0] == row


@contextmanager
def another_run_writes(path: Path) -> Iterator[None]:
    """Let another process hold the lock of this file during the block."""
    holder = "import sys; from pathlib import Path; from msmpetsc.results.disk import Lock\n"
    holder += "lock = Lock(Path(sys.argv[1])); print(flush=True); input(); lock.close()"
    words = [sys.executable, "-c", holder, str(path)]
    pipe = subprocess.PIPE
    with subprocess.Popen(words, env=ENVIRONMENT, stdin=pipe, stdout=pipe) as other:
        other.stdout.readline()
        yield
        other.communicate(b"\n")


def test_two_studies_do_not_share_a_folder_at_a_time(tmp_path: Path, stand_in):
    path, out = (
        study_file(tmp_path, ONE_SCENE + '[[sweep]]\npresets = ["newton"]'),
        tmp_path / "out",
    )
    out.mkdir()
    with another_run_writes(out / "table.csv"):
        with pytest.raises(InputError, match=r"table\.csv is being written by another run"):
            run_study(path, out, restart=True)
        assert not (out / "study.toml").exists()
    assert len(run_study(path, out)) == 1 and not list(out.glob(".*"))


REFERENCE = 'reference = { integrator = "implicit-euler", step = 0.01 }\n'


@pytest.mark.parametrize("file", ["runs/{0}.h5", "references/{1}.part.h5"])
def test_a_case_whose_file_cannot_be_written_is_run_again(tmp_path: Path, stand_in, file: str):
    text = ONE_SCENE + REFERENCE + '[[sweep]]\npresets = ["newton"]\ntime_steps = [0.005]'
    (case,) = all_cases(tmp_path, text)
    path = tmp_path / "out" / file.format(case.id, case.reference.id)
    path.parent.mkdir(parents=True)
    with another_run_writes(path):
        (row,) = carry_out(tmp_path, text)
    assert "is being written by another run" in row["reason"] and row["trajectory_error"] is None
    (row,) = carry_out(tmp_path, text)
    assert (row["status"], row["reason"]) == ("ok", "") and row["trajectory_error"] > 0
    carry_out(tmp_path, text)
    assert len(calls(tmp_path)) == 4 - file.startswith("runs")


@pytest.mark.parametrize("part", ["3", "0/3", "4/3", "a/3"])
def test_a_part_that_is_none_is_refused(tmp_path: Path, own_log, part: str):
    path = study_file(tmp_path, ONE_SCENE + "[[sweep]]")
    assert f"not {part}" in command_error("study", path, "-o", tmp_path / "out", f"--part={part}")


def test_the_list_names_each_case_and_runs_none(tmp_path: Path, capsys, own_log):
    path = study_file(tmp_path, ONE_SCENE + '[[sweep]]\npresets = ["newton", "anderson"]')
    assert main(["study", str(path), "-o", str(tmp_path / "out"), "--list"]) == 0
    first, second, last = capsys.readouterr().out.splitlines()
    assert first.startswith("   1 open  a: newton  msmpetsc run ")
    assert second.startswith("   2 open  a: anderson  ")
    assert last == "2 cases, 0 done" and not (tmp_path / "out").exists()


def test_a_case_that_fails_is_a_row_with_its_reason(tmp_path: Path, stand_in):
    sweep = '[[sweep]]\npresets = ["newton"]\noptions = ["-ksp_fail", ""]'
    rows = carry_out(tmp_path, f"repeats = 2\n{ONE_SCENE}{sweep}", jobs=2)
    ends = [(row["status"], row["reason"]) for row in rows]
    assert ends == [("failed", "planted, with reason"), ("ok", "")]
    assert rows[0]["time_frame"] is None and rows[0]["options"] == "-ksp_fail"
    # a failed case is not repeated
    assert len(calls(tmp_path)) == 3


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
    # a longer timeout causes another attempt
    carry_out(tmp_path, "timeout = 3\n" + text)
    assert len(calls(tmp_path)) == 2


STUDY_IN_ITS_OWN_PROCESS = """
import sys
from pathlib import Path
from study_stand_in import stands_in
from msmpetsc.study import runner
runner.command = stands_in
runner.run_study(Path(sys.argv[1]), Path(sys.argv[2]))
"""


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="looks at Linux's processes")
def test_a_study_that_is_stopped_leaves_its_table_and_no_process(tmp_path: Path):
    sweep = '[[sweep]]\npresets = ["newton"]\n'
    sweep += 'options = ["", "-ksp_children -ksp_hang", "-ksp_never"]'
    paths = (study_file(tmp_path, ONE_SCENE + sweep), tmp_path / "out")
    words = [sys.executable, "-c", STUDY_IN_ITS_OWN_PROCESS, *map(str, paths)]
    heard = lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)  # noqa: E731 (what runs in the background ignores it)
    study = subprocess.Popen(words, env=ENVIRONMENT, stderr=subprocess.DEVNULL, preexec_fn=heard)
    child = tmp_path / "out" / "child"
    while not (child.is_file() and child.read_text()):
        assert study.poll() is None
        time.sleep(0.05)
    os.kill(study.pid, signal.SIGINT)
    assert study.wait() != 0
    assert list(read_table(tmp_path / "out")["status"]) == ["ok"]
    assert not alive(int(child.read_text()))
    assert len(calls(tmp_path)) == 2


def test_a_package_that_is_missing_is_told_before_anything_is_run(
    tmp_path: Path, stand_in, monkeypatch
):
    monkeypatch.setattr(table, "find_spec", lambda name: None if name == "pandas" else name)
    with pytest.raises(InputError, match="pandas is not installed"):
        carry_out(tmp_path, ONE_SCENE + "[[sweep]]")
    assert not (tmp_path / "out").exists()


def test_a_table_read_and_written_again_is_the_same_text(tmp_path: Path):
    row = {"case": "1", "cells": 1009, "steps": 8, "time_step": 1e-3, "fps": 121.25}
    row |= {"memory": 4e8, "error": None, "ranks": 1, "repeats": 1}
    write_table(tmp_path, [row])
    once = (tmp_path / "table.csv").read_text()
    write_table(tmp_path, records(read_table(tmp_path)))
    assert (tmp_path / "table.csv").read_text() == once and ",1009," in once


def test_a_table_that_is_none_is_one_line(tmp_path: Path, stand_in):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "table.csv").write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match="--restart begins anew"):
        carry_out(tmp_path, ONE_SCENE + "[[sweep]]")
