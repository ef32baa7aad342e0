"""What is written bears the name of its format, and commands for one process say so under mpiexec."""

import json
from pathlib import Path

import pytest
import small_result
from block_scene import block_scene
from conftest import run
from one_process import IN_ONE_PROCESS, errors

from msmpetsc.cli.main import main


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("names")
    block_scene(folder, time={"step": 0.01, "duration": 0.01})
    small_result.write(folder / "bar.h5")
    return folder


RESULT, PICTURE, JSON = "is named *.h5 or *.hdf5", "is named *.png", "is named *.json"
WRONG = [
    *[(["run", "scene.toml", "-o", name], RESULT)
      for name in ("x.vtk", "x.h5.gz", "x", "scene.toml")],
    (["run", "scene.toml", "-o", "scene.toml", "--overwrite"], RESULT),
    (["run", "scene.toml", "--resume", "x.vtk"], RESULT),
    (["run", "scene.toml", "--measure", "scene.toml"], JSON),
    *[(["render", "bar.h5", "-o", name], PICTURE) for name in ("x.vtk", "x", "bar.h5")],
    (["compare", "bar.h5", "bar.h5", "-o", "x.vtk"], "compare: unknown argument -o"),
]  # fmt: skip


@pytest.mark.parametrize(("arguments", "words"), WRONG, ids=[" ".join(arguments) for arguments, _ in WRONG])
def test_no_format_is_written_under_the_name_of_another(folder, monkeypatch, capsys, arguments, words):
    monkeypatch.chdir(folder)
    before = {path: path.read_bytes() for path in folder.iterdir()}
    assert main(arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("msmpetsc: error: ") and words in line
    assert {path: path.read_bytes() for path in folder.iterdir()} == before


ALONE = {
    "compare": (["bar.h5", "bar.h5"], "compare is started without mpiexec: it reads two files"),
    "plan": (["scene.toml", "--surface-error", "0.1"], "plan is started without mpiexec: it starts its runs"),
}


def test_what_is_for_one_process_says_why_under_mpiexec(folder, monkeypatch):
    monkeypatch.chdir(folder)
    before = sorted(folder.iterdir())
    done = run(2, "-c", IN_ONE_PROCESS, json.dumps([[name, *rest] for name, (rest, _) in ALONE.items()]))
    assert done.returncode == 0, done.stderr
    for (_, words), line in zip(ALONE.values(), done.stdout.splitlines(), strict=True):
        answers = json.loads(line)
        assert [status for status, _ in answers] == [2, 2] and answers[1][1] == ""
        (error,) = errors(answers[0][1])
        assert words in error
    assert sorted(folder.iterdir()) == before
