"""The README files are right: their links, files, commands, scenes, studies and Python.

Every command is parsed by the program itself. Those of README.md and of RUN are also run, at the small size that
SMALLER makes of them; what only another machine could run (pip, modules, apt) is listed in ELSEWHERE.
"""

import os
import re
import shlex
import subprocess
import tomllib
from contextlib import chdir
from functools import cache
from pathlib import Path

import pytest
import small_result
import trimesh
from conftest import ROOT, python, run

from msmpetsc.cli.main import parsed
from msmpetsc.errors import InputError
from msmpetsc.geometry.registry import locate
from msmpetsc.scene.reading import load_scene
from msmpetsc.scene.schema import BodyTable, SceneFile
from msmpetsc.study.study_file import load_study

OUTSIDE = {".venv", "out", "build", ".petsc-cuda", ".pytest_cache", ".hypothesis"}
READMES = sorted(
    path for path in ROOT.rglob("README.md") if not OUTSIDE & set(path.relative_to(ROOT).parts)
)
ELSEWHERE = {"asv", "pip", "python", "module", "export", "./configure", "eval"}
SMALLER = {  # a command's words -> those of the test
    "cages.count=3000": "cages.count=400 --frames 4",
    "run scenes/bunny_fall.toml --overwrite": "run scenes/bunny_fall.toml --overwrite --set cages.count=400 --frames 2",
    "my.toml --picture": "my.toml --picture --frames 2 --set cages.count=200",
    "scene.toml --ranks 512": "scene.toml --ranks 8 --set cages.count=500",
    "--frames 0,100,200": "--frames 0,2,4",
    "--count 12": "--count 3",
    "render scene.toml": "render scene.toml --set cages.count=200",
    "scene.toml --surface-error 1e-2": "scene.toml --surface-error 0.3 --cells 300 --frames 4",
    "scene.toml --resume out/x.h5": "scene.toml --resume out/x.h5 --set time.duration=0.03 --set cages.count=200",
    "--set time.duration=4": "--set time.duration=0.05",
}
RUN = (
    *(
        f"scripts/docs/pages/{name}.md"
        for name in ("forces-and-stress", "pictures", "comparing", "resuming")
    ),
    "scripts/README.md",
    "scenes/studies/README.md",
)
DIFFER = {"compare": (0, 1), "plan": (0, 3)}  # exit statuses of commands that were carried out
PROGRAM = ("-m", "msmpetsc.cli.main")
LONG = ("study", "--device cuda")  # of RUN's commands, parsed only


def blocks(path: Path, kind: str) -> list[str]:
    """Return the contents of the blocks of a README that are marked as of this kind."""
    return re.findall(rf"^```{kind}\n(.*?)^```", path.read_text(), re.M | re.S)


def commands(path: Path) -> list[str]:
    """Return the commands of a README, without comments."""
    lines = "\n".join(blocks(path, "sh")).replace("\\\n", " ").splitlines()
    return [command for line in lines if (command := re.sub(r"(^|\s)#.*", "", line).strip())]


ALL_COMMANDS = [
    pytest.param(command, id=f"{path.relative_to(ROOT).parent}: {command}")
    for path in READMES
    for command in commands(path)
]
WITH_PYTHON = [path for path in READMES if blocks(path, "python")]


def code_of(text: str) -> list[str]:
    """Return the lines of a program without indentation, empty lines and comments of their own."""
    lines = [line.strip() for line in text.splitlines()]
    return [line for line in lines if line and not line.startswith("#")]


def test_the_loops_of_a_step_are_printed_as_they_stand_in_the_files():
    folder = ROOT / "msmpetsc" / "solve"
    files = "\n".join(path.read_text() for path in (folder / "nonlinear").glob("*.py"))
    files = "\n".join(code_of(files))
    printed = re.findall(r"^```\n(.*?)^```", (folder / "README.md").read_text(), re.M | re.S)
    loops = [block for block in printed if "while not" in block]
    assert len(loops) == 2
    for loop in loops:
        assert "\n".join(code_of(loop)) in files


def test_the_front_door_is_short():
    assert len((ROOT / "README.md").read_text().splitlines()) <= 200


@pytest.mark.parametrize("path", READMES, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_and_files_exist(path: Path):
    text = path.read_text()
    for target in re.findall(r"\]\(([^)]+)\)", text):
        file, _, anchor = target.partition("#")
        linked = (path.parent / file) if file else path
        assert linked.exists(), target
        titles = re.findall(r"^#+ (.*)", linked.read_text(), re.M) if anchor else []
        anchors = [re.sub(r"[^\w -]", "", title).lower().replace(" ", "-") for title in titles]
        assert not anchor or anchor in anchors, target
    for name in set(re.findall(r"`((?:[\w.-]+/)+[\w.-]+\.(?:py|png|sbatch))", text)):
        folders = (ROOT, ROOT / "msmpetsc", path.parent)
        assert name.startswith("out/") or any((folder / name).exists() for folder in folders), name


@cache
def help_of(script: Path) -> str:
    """Return what a script says of itself."""
    return python(script, "--help").stdout


@pytest.mark.parametrize("command", ALL_COMMANDS)
def test_commands_are_known(command: str):
    words = shlex.split(re.sub(r"^mpirun -n \d+ ", "", command))
    program, arguments = words[0].removeprefix(".venv/bin/"), words[1:]
    if program in ELSEWHERE:
        return
    if program == "msmpetsc":
        try:
            assert parsed(arguments).command == arguments[0]
        except SystemExit as done:  # of what prints and ends
            assert done.code == 0
        return
    script = ROOT / program
    assert program.startswith("scripts/") and os.access(script, os.X_OK), command
    own = [word for word in arguments if word.startswith("--")] if script.suffix == ".py" else []
    assert all(word in help_of(script) for word in own), command


def carried_out(command: str, folder: Path) -> subprocess.CompletedProcess:
    """Return the finished command, in this folder and small."""
    for words, small in SMALLER.items():
        command = command.replace(words, small)
    launcher, _, arguments = command.rpartition("msmpetsc ")
    words = [*PROGRAM, *shlex.split(arguments)]
    if arguments.startswith("plan "):  # whose runs are forked: no fork of a test's may do that
        return python(*words, cwd=folder)
    with chdir(folder):
        return run(2 if launcher.startswith("mpirun -n 2 ") else 1, *words)


def carry_out(path: Path, folder: Path) -> None:
    """Run the commands of a README, one after another."""
    for command in commands(path):
        if "msmpetsc " not in command or any(f" {word}" in command for word in LONG):
            continue
        done = carried_out(command, folder)
        status = next((known for word, known in DIFFER.items() if f" {word} " in command), (0,))
        assert done.returncode in status, f"{command}\n{done.stdout}{done.stderr}"


def write_own_scene(folder: Path) -> None:
    """Write the front door's scene of one's own, and its body."""
    (folder / "scene.toml").write_text(blocks(ROOT / "README.md", "toml")[0])
    trimesh.creation.box(extents=[1, 0.5, 0.5]).export(folder / "body.obj")


@pytest.fixture(scope="module")
def clone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the clone's scenes, a scene of one's own and its body, and what the front door's commands leave."""
    try:
        locate("bunny_scan", str(ROOT))
    except InputError as error:
        pytest.skip(str(error))
    folder = tmp_path_factory.mktemp("clone")
    (folder / "scenes").symlink_to(ROOT / "scenes")
    write_own_scene(folder)
    carry_out(ROOT / "README.md", folder)
    return folder


@pytest.mark.slow
def test_commands_of_the_front_door_run(clone: Path):
    names = {path.name for path in (clone / "out").iterdir()}
    assert {
        "coarse.h5",
        "coarse.xdmf",
        "coarse.png",
        "loose.h5",
        "my.h5",
        "my.png",
        "bunny_fall.h5",
    } <= names


@pytest.mark.slow
@pytest.mark.parametrize("name", RUN)
def test_commands_run(name: str, clone: Path):
    carry_out(ROOT / name, clone)


@pytest.mark.parametrize("path", WITH_PYTHON, ids=lambda path: path.parent.name)
def test_python_runs(path: Path, tmp_path: Path):
    (tmp_path / "out").mkdir()
    small_result.write(tmp_path / "out" / "bunny_fall.h5")
    write_own_scene(tmp_path)
    for block in blocks(path, "python"):
        done = python("-c", block, cwd=tmp_path)
        assert done.returncode == 0, f"{block}\n{done.stderr}"


def test_the_scene_with_every_table_is_one(tmp_path: Path):
    one, several = blocks(ROOT / "scenes" / "README.md", "toml")
    assert set(tomllib.loads(one)) == set(SceneFile.model_fields) - {"body"}
    assert set(tomllib.loads(several)["body"][1]) == set(BodyTable.model_fields)
    for text in (one, several):
        (tmp_path / "scene.toml").write_text(text)
        assert load_scene(tmp_path / "scene.toml").text == text


def test_the_study_files_are_some(tmp_path: Path):
    path = tmp_path / "study.toml"
    for text in blocks(ROOT / "scenes" / "studies" / "README.md", "toml"):
        path.write_text(text)
        study = load_study(path)
        assert study.sweep or study.map


def test_the_tests_of_cases_are_there():
    """Those that its table names, of which it gives how they begin or all but `test_`."""
    named = re.findall(
        r"\| `([\w/]+\.py)`: (.*) \|$", (ROOT / "tests" / "cases" / "README.md").read_text(), re.M
    )
    assert len(named) > 30
    for file, names in named:
        text = (ROOT / file).read_text()
        for name in re.findall(r"(?:^|, )(\w+)", names):
            assert re.search(rf"def test_{name}", text), f"{file}: {name}"
