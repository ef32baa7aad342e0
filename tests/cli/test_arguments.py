"""Paths on the command line that are missing, are no files, or have the name of another format.

Each ends with a line and status 2, and so do commands for a single process under mpiexec.
"""

import os
import shutil
import subprocess
from pathlib import Path

import pytest
import small_result
from bad_input import limits
from block_scene import block_scene
from one_process import answers_on, command_error, refusal_in

from msmpetsc.cli.main import main

ONCE = {"step": 0.01, "duration": 0.01}
COMMANDS = [
    ["run", "scene.toml", "-o", "{}"],
    ["run", "scene.toml", "-o", "{}", "--overwrite"],
    ["run", "scene.toml", "--resume", "{}"],
    ["run", "--resume", "{}"],
    ["run", "{}"],
    ["run", "scene.toml", "--measure", "{}"],
    ["run", "scene.toml", "--set", "mesh.source={}"],
    ["inspect", "{}"],
    ["compare", "{}", "good.h5"],
    ["compare", "good.h5", "{}"],
    ["render", "{}"],
    ["render", "good.h5", "-o", "{}"],
    ["study", "{}"],
    ["study", "study.toml", "-o", "{}"],
    ["plan", "{}", "--surface-error", "0.1"],
    ["fetch", "{}"],
    ["new", "{}", "--mesh", "good.h5"],
    ["new", "new.toml", "--mesh", "{}"],
    ["check", "--update", "{}"],
    ["check", "{}"],
]
PATHS = [
    "", ".", "..", "/", "folder", "folder/", "x" * 300 + ".h5", "a\nb.h5", "\udcff.h5", "device",
    "pipe", "scene.toml/x.h5", "a\x1b[31m.h5", "loop.h5", "\u2028.h5",
]  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("paths")
    block_scene(folder, time=ONCE)
    small_result.write(folder / "good.h5")
    (folder / "study.toml").write_text(
        '[[scene]]\nname = "a"\nfile = "nowhere.toml"\n[[sweep]]\npreset = ["newton"]\n'
    )
    (folder / "folder").mkdir()
    (folder / "loop.h5").symlink_to("loop.h5")
    os.mkfifo(folder / "pipe")
    try:
        # a device like /dev/null
        os.mknod(folder / "device", 0o20666, os.makedev(1, 3))
    except PermissionError:
        os.mkfifo(folder / "device")
    return folder


@pytest.mark.parametrize("path", PATHS)
def test_a_path_that_cannot_be_used_is_refused_in_one_line(folder, monkeypatch, capsys, path):
    monkeypatch.chdir(folder)
    before = {
        name: (folder / name).lstat().st_mtime_ns for name in os.listdir(folder) if name != "out"
    }
    for command in COMMANDS:
        if (
            command[0] == "study"
            and "-o" in command
            and path in (".", "..", "/", "folder", "folder/")
        ):
            # a study writes a folder instead
            continue
        status = main([word.format(path) for word in command])
        told = capsys.readouterr().err.splitlines()
        assert status == 2 and len(told) == 1 and told[0].startswith("msmpetsc: error: "), (
            command,
            told,
        )
    assert {
        name: (folder / name).lstat().st_mtime_ns for name in os.listdir(folder) if name != "out"
    } == before


@pytest.mark.parametrize("suffix", ["obj", "vtu"])
def test_a_pipe_that_a_scene_or_a_study_names_is_refused(folder, capsys, suffix):
    os.mkfifo(pipe := folder / f"pipe.{suffix}")
    scene, study = folder / "scene.toml", folder / "of_pipe.toml"
    study.write_text(f'[[scene]]\nname = "a"\nfile = "{pipe.name}"\n[[sweep]]\n')
    for command in (["run", scene, "--set", f"mesh.source={pipe}"], ["study", study, "--list"]):
        assert main([*map(str, command)]) == 2
        assert "is a pipe or a device" in capsys.readouterr().err


TOO_MUCH = {
    "ranks": (
        ["inspect", "scene.toml", "--ranks", "9999999999"],
        "--ranks must be at most 1000000",
    ),
    "ranks of trials": (
        ["plan", "scene.toml", "--ranks", "9999999999"],
        "--ranks must be at most 1000000",
    ),
    "ranks of a check": (
        ["check", "scene.toml", "--ranks", "9999999999"],
        "--ranks must be at most 1000000",
    ),
    "part": (["study", "study.toml", "--part", "1/" + "9" * 5000], "--part must read I/N"),
    "listed part": (["study", "study.toml", "--list", "--part", "1/2"], "leave out --part"),
    "frames": (
        ["run", "scene.toml", "--checkpoint-every", "9" * 5000],
        "--checkpoint-every: invalid int value",
    ),
    "true error": (
        ["run", "scene.toml", "--true-error", "9" * 20],
        "--true-error must be at most",
    ),
}


@pytest.mark.parametrize("what", TOO_MUCH)
def test_what_no_machine_holds_is_refused_before_it_is_made(folder, monkeypatch, what):
    monkeypatch.chdir(folder)
    command, words = TOO_MUCH[what]
    with limits():
        assert words in command_error(*command)


RESULT, PICTURE, JSON = "be named *.h5 or *.hdf5", "be named *.png", "be named *.json"
WRONG = [
    *[(["run", "scene.toml", "-o", name], RESULT)
      for name in ("x.vtk", "x.h5.gz", "x", "scene.toml")],
    (["run", "scene.toml", "-o", "scene.toml", "--overwrite"], RESULT),
    (["run", "scene.toml", "--resume", "x.vtk"], RESULT),
    (["run", "scene.toml", "--measure", "scene.toml"], JSON),
    *[(["render", "good.h5", "-o", name], PICTURE) for name in ("x.vtk", "x", "good.h5")],
    (["compare", "good.h5", "good.h5", "-o", "x.vtk"], "compare: unknown argument -o"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("arguments", "words"), WRONG, ids=[" ".join(arguments) for arguments, _ in WRONG]
)
def test_no_format_is_written_under_the_name_of_another(folder, monkeypatch, arguments, words):
    monkeypatch.chdir(folder)
    before = {path: path.read_bytes() for path in folder.iterdir() if path.is_file()}
    assert words in command_error(*arguments)
    assert {path: path.read_bytes() for path in folder.iterdir() if path.is_file()} == before


def test_a_cost_that_cannot_be_written_is_refused_before_the_run(folder: Path, tmp_path: Path):
    """Nobody can write to a program that runs, not even root."""
    cost = shutil.copy(shutil.which("sleep"), tmp_path / "cost.json")
    command = "run", folder / "scene.toml", "-o", tmp_path / "x.h5", "--measure", cost
    with subprocess.Popen([cost, "60"]) as program:
        try:
            assert f"{cost} cannot be written" in command_error(*command)
        finally:
            program.kill()
    assert not (tmp_path / "x.h5").exists()


ALONE = [["compare", "good.h5", "good.h5"], ["plan", "scene.toml", "--surface-error", "0.1"]]


def test_what_is_for_one_process_says_why_under_mpiexec(folder, monkeypatch):
    monkeypatch.chdir(folder)
    before = sorted(folder.iterdir())
    for answers in answers_on(2, ALONE):
        assert "is for one process: start it without mpiexec" in refusal_in(answers)
    assert sorted(folder.iterdir()) == before
