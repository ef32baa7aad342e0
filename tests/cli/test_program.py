"""Commands of the program: doctor, examples, quiet and verbose output, mistyped words."""

import json
import os
import shlex
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest
from block_scene import YOUNG, block_scene, solid_of
from conftest import ENVIRONMENT, python
from one_process import command_error, status_of

import msmpetsc
from msmpetsc.backend import kernel_cache
from msmpetsc.cli import main as program
from msmpetsc.cli.command_table import COMMANDS
from msmpetsc.cli.commands import doctor, render
from msmpetsc.cli.main import parsed
from msmpetsc.view import film, sheet

ONCE = {"step": 0.01, "duration": 0.01}


def test_every_command_has_examples_that_are_command_lines(capsys):
    for name, command in COMMANDS.items():
        for example in command.examples:
            words = shlex.split(example.partition(" > ")[0])
            assert words[0] == "msmpetsc" and parsed(words[1:]).command == name
        with pytest.raises(SystemExit):
            parsed([name, "--help"])
        shown = capsys.readouterr().out
        assert all(f"\n  {example}\n" in shown for example in command.examples), (
            "the lines are kept whole"
        )


def test_the_help_of_render_names_the_default_sizes(capsys):
    with pytest.raises(SystemExit):
        parsed(["render", "--help"])
    shown = capsys.readouterr().out
    sizes = [(film.LONGEST, film.LONGEST), sheet.PANEL, render.STILL]
    assert all(f"{width}x{height}" in shown for width, height in sizes)


def test_an_interrupt_is_not_lost_in_an_import(monkeypatch, capsys):
    """Building a class swallows it, as pydantic does."""

    def swallowing(_: str) -> None:
        with suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(program, "import_module", swallowing)
    # processes in the background may ignore SIGINT
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        assert program.main(["doctor"]) == 130
    finally:
        signal.signal(signal.SIGINT, before)
    assert "interrupted" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "expected"),
    [(["rnu", "scene.toml"], "invalid choice: 'rnu' (choose from"), ([], "required: COMMAND")],
)
def test_a_mistaken_command_is_told_all_commands(words: list[str], expected: str):
    assert expected in command_error(*words)


def test_a_mesh_for_a_scene_and_a_scene_for_a_study_name_the_command_that_takes_them(
    tmp_path: Path,
):
    """The commands quote names with blanks."""
    scene = block_scene(tmp_path, name="my scene")
    mesh, study = scene.with_suffix(".ply"), tmp_path / "my study.toml"
    study.write_text('[[scene]]\nname = "a"\nfile = "a.toml"\n[[sweep]]\npreset = ["newton"]\n')
    remedies = {
        ("run", mesh): f"is a mesh, no scene: msmpetsc new '{scene}' --mesh '{mesh}'",
        ("run", study): f"is a study, no scene: msmpetsc study '{study}'",
        ("study", scene): f"is a scene, no study: msmpetsc run '{scene}'",
    }
    for (command, path), remedy in remedies.items():
        assert f"{path}: {remedy}" in command_error(command, path)


def test_steps_longer_than_the_slowest_vibration_are_warned_of(tmp_path: Path, capsys):
    """A step longer than the slowest vibration gives a warning.

    A bar has sides of 0.5 and 0.25 m and c = 10 m/s. It bends with the period 6.19 L^2 / (d c) =
    0.62 s. A viscous bar that only creeps gives no warning if its steps resolve the creep.
    """
    cases = (
        (0.7, "bdf2", 0.0, 1), (0.5, "bdf2", 0.0, 0), (0.7, "verlet", 0.0, 0), (0.7, "bdf2", 2.0, 0)
    )  # fmt: skip
    for step, integrator, viscosity, said in cases:
        time = {"step": step, "duration": step, "integrator": integrator}
        material = solid_of(YOUNG, retardation_time=viscosity)
        scene = block_scene(
            tmp_path, time=time, material=material, gravity={"acceleration": [0, 0, -1]}
        )
        assert status_of("run", scene, "-o", tmp_path / "x.h5", "--overwrite") == 0
        assert (
            capsys.readouterr().err.count(
                "warning: time.step is 1.1 periods of the slowest vibration"
            )
            == said
        )


def test_quiet_says_nothing_and_verbose_when_and_where(tmp_path: Path, capsys):
    # a solid, because two cells of springs across would cause a warning
    solid = solid_of(YOUNG)
    scene = str(block_scene(tmp_path, time=ONCE, material=solid))
    assert status_of("run", scene, "-o", tmp_path / "q.h5", "--quiet") == 0
    assert capsys.readouterr() == ("", "")
    assert status_of("run", scene, "-o", tmp_path / "v.h5", "--verbose") == 0
    notes = [line for line in capsys.readouterr().err.splitlines() if "note" in line]
    assert notes and all(line.startswith("msmpetsc: note [") and " ms]: " in line for line in notes)
    assert status_of("run", scene, "-o", tmp_path / "v.h5", "--verbose") == 2
    shown = capsys.readouterr().err
    assert "Traceback" in shown and "InputError" in shown, "where the refusal arose"
    assert status_of("run", scene, "-o", tmp_path / "v.h5", "--quiet", "--verbose") == 2
    assert "not allowed with" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["schema", "--help", "keys"])
def test_who_stops_reading_ends_the_command_quietly(command: str):
    reader, writer = os.pipe()
    os.close(reader)
    words = [sys.executable, "-m", "msmpetsc", command]
    done = subprocess.run(words, env=ENVIRONMENT, stdout=writer, stderr=subprocess.PIPE)
    os.close(writer)
    assert done.stderr == b"" and done.returncode == 128 + signal.SIGPIPE


@pytest.mark.parametrize("closed", [">&-", "2>&-", "<&- >&- 2>&-"])
def test_a_run_needs_no_stream(tmp_path: Path, closed: str):
    """No file of a run gets the descriptor of a standard stream that a service has closed."""
    scene = block_scene(tmp_path, time=ONCE)
    words = [sys.executable, "-m", "msmpetsc", "run", str(scene), "-o", str(tmp_path / "x.h5")]
    done = subprocess.run(
        f"{shlex.join(words)} -ksp_view {closed}",
        shell=True, env=ENVIRONMENT, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0 and "Traceback" not in done.stdout + done.stderr
    with msmpetsc.open(tmp_path / "x.h5") as result:
        assert len(result.frames) == 2


def test_doctor_finds_a_sound_installation_sound():
    done = python("-m", "msmpetsc", "doctor")
    states = {line[9:26].strip(): line[:8].strip() for line in done.stdout.splitlines()}
    assert done.returncode == 0, done.stdout + done.stderr
    assert {"PETSc", "MPI", "GPU", "HDF5"} <= set(states)
    assert f"kept in {kernel_cache.writable()}" in done.stdout
    needed = ("PETSc", "MPI", "HDF5", "kernels", "extra run")
    assert all(states[name] == "ok" for name in needed) and "BROKEN" not in done.stdout


def test_doctor_tells_what_is_missing_from_what_is_broken(tmp_path: Path):
    hook = """
import importlib.util, sys
absent, find = ("petsc4py", "numba"), importlib.util.find_spec
importlib.util.find_spec = lambda name: None if name in absent else find(name)
class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in absent:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Missing())
"""
    # the hook also acts in processes that the command starts
    (tmp_path / "sitecustomize.py").write_text(hook)
    (tmp_path / "h5py.py").write_text(
        'raise ImportError("libold.so: cannot open shared object file")'
    )
    environment = ENVIRONMENT | {"PYTHONPATH": f"{tmp_path}:{ENVIRONMENT['PYTHONPATH']}"}
    done = python("-m", "msmpetsc", "doctor", env=environment)
    lines = {line[9:26].strip(): line for line in done.stdout.splitlines()}
    assert lines["PETSc"].startswith("missing") and "msmpetsc[run]" in lines["PETSc"], lines[
        "PETSc"
    ]
    assert lines["HDF5"].startswith("BROKEN")
    assert "ImportError: libold.so" in lines["HDF5"] and "numba" in lines["extra run"]
    assert lines["extra mesh"].startswith("ok") and done.returncode == 1


def test_a_probe_that_dies_is_broken_in_one_line():
    found = doctor.probed(
        "import os, sys; print('cannot load libpetsc', file=sys.stderr); os.abort()"
    )
    assert found == (doctor.BROKEN, "cannot load libpetsc")


def test_what_a_program_reads_is_one_json_object(tmp_path: Path, capsys):
    time, gravity = {"step": 0.01, "duration": 0.02}, {"acceleration": [0, 0, -1]}
    scene = str(block_scene(tmp_path, time=time, gravity=gravity))
    files = [str(tmp_path / f"{name}.h5") for name in "ab"]
    for file, frames in zip(files, "21", strict=True):
        assert status_of("run", scene, "-o", file, "--frames", frames, "--quiet") == 0
    assert status_of("compare", files[0], files[0], "--json") == 0
    same = json.loads(capsys.readouterr().out)
    assert same["agree"] and same["frames"] == 3 and same["fields"]["position"]["error"] == 0
    assert status_of("compare", *files, "--json") == 1
    assert json.loads(capsys.readouterr().out)["agree"] is False, "one lacks a frame"
    assert status_of("inspect", scene, "--ranks", "2", "--json") == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["counts"]["cells"]["all"] == 32 and shown["counts"]["cells"]["mean"] == 16
    assert 2 * 0.29e9 < shown["memory"]["all"] < 2 * 0.31e9
