"""README files and pages of the documentation: links, commands, scenes, studies and Python hold.

The program itself parses every command. Commands of README.md and of the pages in RUN are also run,
at the small size that SMALLER gives. ELSEWHERE lists programs that only other machines have. Tables
of a scene on a page are run together with the tables that they lack.
"""

import os
import re
import shlex
import shutil
import subprocess
import tomllib
from contextlib import chdir
from functools import cache
from pathlib import Path

import markdown
import pytest
import small_result
import tomli_w
import trimesh
from conftest import ROOT, python, run
from formulas import Formulas
from hooks import page_of_script
from obj_files import write_obj
from reference_tables import MARKER, TABLES, with_tables

from msmpetsc.app.request import OPTIONS, flag_of
from msmpetsc.cli.main import parsed
from msmpetsc.errors import InputError
from msmpetsc.fields import FIELDS
from msmpetsc.geometry.registry import locate
from msmpetsc.scene.reading import load_scene
from msmpetsc.scene.schema import BodyTable, SceneFile
from msmpetsc.solve.presets import PRESETS
from msmpetsc.study.cases import study_cases
from msmpetsc.study.study_file import load_study
from msmpetsc.study.table import COLUMNS

OUTSIDE = {".venv", "out", "build", ".petsc-cuda", ".pytest_cache", ".hypothesis"}
READMES = sorted(
    path for path in ROOT.rglob("README.md") if not OUTSIDE & set(path.relative_to(ROOT).parts)
)
PAGES = sorted((ROOT / "scripts" / "docs" / "pages").rglob("*.md"))
TEXTS = [*READMES, *PAGES]
START, HOW_TO, REFERENCE = (
    ROOT / "scripts" / "docs" / "pages" / name for name in ("get-started", "how-to", "reference")
)
ELSEWHERE = {
    "asv", "pip", "python", "module", "export", "./configure", "eval",
    "sbatch", "docker", "apptainer", "conda", "spack",
}  # fmt: skip
# words of a command -> words of the test
SMALLER = {
    "cages.count=3000": "cages.count=400 --frames 4 --overwrite",
    "bunny_fall.toml --overwrite": "bunny_fall.toml --overwrite --set cages.count=400 --frames 2",
    "new my.toml --mesh body.obj": "new my.toml --mesh body.obj --overwrite",
    "my.toml --picture": "my.toml --picture --overwrite --frames 2 --set cages.count=200",
    "run scene.toml --overwrite": "run scene.toml --overwrite --frames 2 --set cages.count=200",
    "render my.toml": "render my.toml --set cages.count=200",
    "scene.toml --ranks 512": "scene.toml --ranks 8 --set cages.count=500",
    "--frames 0,100,200": "--frames 0,2,4",
    "--count 12": "--count 3",
    "render scene.toml": "render scene.toml --set cages.count=200",
    "scene.toml --surface-error 1e-2": "scene.toml --surface-error 0.3 --cells 300 --frames 4",
    "scene.toml --resume": "scene.toml --set time.duration=0.03 --set cages.count=200 --resume",
    "--set time.duration=4": "--set time.duration=0.05",
}
RUN = (ROOT / "scripts" / "README.md", *sorted((*START.glob("*.md"), *HOW_TO.glob("*.md"))))
# exit statuses of the commands that were run
DIFFER = {"compare": (0, 1), "plan": (0, 3)}
PROGRAM = ("-m", "msmpetsc.cli.main")
# commands of RUN that are only parsed, not run
LONG = ("study", "--device cuda")
# commands that fork runs or start mpiexec, so they cannot run in a fork
STARTING = ("plan ", "check ", "doctor")


def name_of(path: Path) -> str:
    """Return the name of a README file or page in the names of tests."""
    short = path.relative_to(ROOT)
    return str(short.parent if short.name == "README.md" else Path(*short.parts[-2:]))


def blocks(path: Path, kind: str) -> list[str]:
    """Return the contents of the code blocks of this kind in a README or page."""
    return re.findall(rf"^```{kind}\n(.*?)^```", path.read_text(), re.M | re.S)


def commands(path: Path) -> list[str]:
    """Return the commands of a README, without comments."""
    lines = "\n".join(blocks(path, "sh")).replace("\\\n", " ").splitlines()
    return [command for line in lines if (command := re.sub(r"(^|\s)#.*", "", line).strip())]


ALL_COMMANDS = [
    pytest.param(command, id=f"{name_of(path)}: {command}")
    for path in TEXTS
    for command in commands(path)
]
WITH_PYTHON = [path for path in TEXTS if blocks(path, "python")]


def code_of(text: str) -> list[str]:
    """Return the lines of a program without indentation, empty lines and comment lines."""
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
    assert len((ROOT / "README.md").read_text().splitlines()) <= 100


@pytest.mark.parametrize("path", TEXTS, ids=name_of)
def test_links_and_files_exist(path: Path):
    text = path.read_text()
    for target in re.findall(r"\]\(([^)]+)\)", text):
        file, _, anchor = target.partition("#")
        linked = (path.parent / file) if file else path
        assert linked.exists(), target
        titles = re.findall(r"^#+ (.*)", linked.read_text(), re.M) if anchor else []
        anchors = [re.sub(r"[^\w -]", "", title).lower().replace(" ", "-") for title in titles]
        made_by_mkdocstrings = anchor.startswith("msmpetsc.")
        assert not anchor or made_by_mkdocstrings or anchor in anchors, target
    for name in set(re.findall(r"`((?:[\w.-]+/)+[\w.-]+\.(?:py|png|sbatch))", text)):
        folders = (ROOT, ROOT / "msmpetsc", path.parent)
        assert name.startswith("out/") or any((folder / name).exists() for folder in folders), name


@cache
def help_of(script: Path) -> str:
    """Return the help text of a script."""
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
        except SystemExit as done:
            # --help prints and ends
            assert done.code == 0
        return
    script = ROOT / program
    assert program.startswith("scripts/") and os.access(script, os.X_OK), command
    own = [word for word in arguments if word.startswith("--")] if script.suffix == ".py" else []
    assert all(word in help_of(script) for word in own), command


def carried_out(command: str, folder: Path) -> subprocess.CompletedProcess:
    """Return the finished command, run in this folder at a small size."""
    for words, small in SMALLER.items():
        command = command.replace(words, small)
    launcher, _, arguments = command.rpartition("msmpetsc ")
    words = [*PROGRAM, *shlex.split(arguments)]
    if arguments.startswith(STARTING):
        return python(*words, cwd=folder)
    with chdir(folder):
        return run(2 if launcher.startswith("mpirun -n 2 ") else 1, *words)


def carry_out(path: Path, folder: Path) -> None:
    """Run the commands of a README in turn."""
    for command in commands(path):
        if "msmpetsc " not in command or any(f" {word}" in command for word in LONG):
            continue
        done = carried_out(command, folder)
        status = next((known for word, known in DIFFER.items() if f" {word} " in command), (0,))
        assert done.returncode in status, f"{command}\n{done.stdout}{done.stderr}"


def write_own_scene(folder: Path) -> None:
    """Write the scene of the page on own meshes, and its body with one end as the group tip."""
    (folder / "scene.toml").write_text(blocks(START / "own-mesh.md", "toml")[0])
    box = trimesh.creation.box(bounds=[[0, 0, 0], [1, 0.5, 0.5]])
    at_end = (box.vertices[box.faces, 0] == 1).all(axis=1)
    write_obj(folder / "body.obj", box, {"side": ~at_end, "tip": at_end})


@pytest.fixture(scope="module")
def clone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the clone's scenes, an own scene and body, and results of the README.

    Other pages draw and compare the results of the first page, so that page is carried out too.
    """
    try:
        locate("bunny_scan", str(ROOT))
    except InputError as error:
        pytest.skip(str(error))
    folder = tmp_path_factory.mktemp("clone")
    (folder / "scenes").symlink_to(ROOT / "scenes")
    write_own_scene(folder)
    carry_out(ROOT / "README.md", folder)
    carry_out(START / "first-body.md", folder)
    return folder


@pytest.mark.slow
def test_commands_of_the_front_door_run(clone: Path):
    names = {path.name for path in (clone / "out").iterdir()}
    assert {"coarse.h5", "coarse.xdmf", "coarse.png", "loose.h5"} <= names
    assert {"my.h5", "my.png", "my.mp4"} <= names


@pytest.mark.slow
@pytest.mark.parametrize("path", RUN, ids=name_of)
def test_commands_run(path: Path, clone: Path):
    # an earlier page may have written another integrator into the scene
    write_own_scene(clone)
    carry_out(path, clone)


@pytest.mark.parametrize("path", WITH_PYTHON, ids=name_of)
def test_python_runs(path: Path, tmp_path: Path):
    (tmp_path / "out").mkdir()
    for name in ("bunny_fall", "coarse"):
        small_result.write(tmp_path / "out" / f"{name}.h5")
    write_own_scene(tmp_path)
    for block in blocks(path, "python"):
        done = python("-c", block, cwd=tmp_path)
        assert done.returncode == 0, f"{block}\n{done.stderr}"


def test_the_scene_with_every_table_is_one(tmp_path: Path):
    (one,) = blocks(REFERENCE / "every-table.md", "toml")
    (several,) = blocks(HOW_TO / "several-bodies.md", "toml")
    assert set(tomllib.loads(one)) == set(SceneFile.model_fields) - {"body"}
    assert set(tomllib.loads(several)["body"][1]) == set(BodyTable.model_fields)
    for text in (one, several):
        (tmp_path / "scene.toml").write_text(text)
        assert load_scene(tmp_path / "scene.toml").text == text


STUDIES = HOW_TO / "study.md"
WITH_TABLES = [path for path in PAGES if blocks(path, "toml") and path != STUDIES]
# this page names meshes that would be downloaded
WITH_TABLES.remove(REFERENCE / "every-table.md")
# tables of the scene that a page's tables extend
LACKED = {
    "mesh": {"source": "body.obj"},
    "cages": {"count": 200},
    "material": {"young_modulus": 1e6, "density": 1000},
    "time": {"step": 0.01, "duration": 0.02},
}


@pytest.mark.parametrize("path", WITH_TABLES, ids=name_of)
def test_tables_on_pages_run(path: Path, tmp_path: Path):
    write_own_scene(tmp_path)
    for number, text in enumerate(blocks(path, "toml")):
        tables = tomllib.loads(text)
        scene = LACKED | tables
        scene["material"] = LACKED["material"] | tables.get("material", {})
        scene["cages"] = LACKED["cages"]
        if "body" in tables:
            del scene["mesh"]
        steps = [] if scene["time"].get("integrator") == "static" else ["--frames", "2"]
        file = tmp_path / f"{number}.toml"
        file.write_text(tomli_w.dumps(scene))
        run(1, *PROGRAM, "run", file, "-o", file.with_suffix(".h5"), *steps, status=0)
        # for a scene that starts from another run of the same lattice
        shutil.copy(file.with_suffix(".h5"), tmp_path / "rest.h5")


def test_the_study_files_are_some(tmp_path: Path):
    path = tmp_path / "study.toml"
    for text in blocks(STUDIES, "toml"):
        path.write_text(text)
        assert study_cases(load_study(path), ROOT / "scenes" / "studies", full=True)


def test_the_page_of_the_study_table_has_each_column():
    named = set(re.findall(r"`(\w+)`", (REFERENCE / "study-table.md").read_text()))
    assert set(COLUMNS) <= named


def test_pages_have_the_tables_that_are_generated():
    marked = [name for path in PAGES for name in MARKER.findall(path.read_text())]
    assert sorted(marked) == sorted(TABLES)
    text = with_tables("".join(f"<!-- table: {name} -->\n" for name in TABLES))
    assert "<!--" not in text
    expected = [*FIELDS, *PRESETS, *map(flag_of, OPTIONS), "cages.cell_size", "region.half_space"]
    expected = [
        name for name in expected if name not in ("--scene", "--petsc-options", "--on-frame")
    ]
    assert [name for name in expected if name not in text] == []


def test_each_page_is_in_the_navigation():
    navigation = (ROOT / "scripts" / "docs" / "mkdocs.yml").read_text()
    folder = START.parent
    tutorials = [path.with_suffix(".md") for path in folder.glob("tutorials/*.py")]
    for path in (*PAGES, *tutorials):
        assert f": {path.relative_to(folder)}\n" in navigation


def test_a_script_of_cells_becomes_a_page():
    script = "# %% [markdown]\n# # Title\n#\n# Text\n\n# %%\nx = 1  # one\n"
    assert page_of_script(script) == "# Title\n\nText\n\n```python\nx = 1  # one\n```\n"


def test_underscores_of_symbols_become_subscripts():
    text = "q_n, |x|_M, a_long_name, `x_y`\n\n    v_(n+1) = |F|²_H\n"
    html = markdown.markdown(text, extensions=[Formulas()])
    assert "q<sub>n</sub>, |x|<sub>M</sub>, a_long_name, <code>x_y</code>" in html
    assert '<div class="formula">v<sub>n+1</sub> = |F|²<sub>H</sub></div>' in html


def test_the_tests_of_cases_are_there():
    """Each test that the table names exists.

    The table gives a prefix of the name without ``test_``.
    """
    named = re.findall(
        r"\| `([\w/]+\.py)`: (.*) \|$", (ROOT / "tests" / "cases" / "README.md").read_text(), re.M
    )
    assert len(named) > 30
    for file, names in named:
        text = (ROOT / file).read_text()
        for name in re.findall(r"(?:^|, )(\w+)", names):
            assert re.search(rf"def test_{name}", text), f"{file}: {name}"
