"""The scripts run from a clone as their README writes them, with any Python found first.

scripts/setup and scripts/build_petsc_cuda call stand-ins of other programs.
"""

import os
import shutil
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest
from conftest import AS_ROOT, ROOT

SCRIPTS = sorted(
    path.stem for path in (ROOT / "scripts").glob("*.py") if path.stem not in ("clone", "lab")
)
# no environment is activated
HOME = {"PATH": "/usr/local/bin:/usr/bin:/bin", "HOME": "/nonexistent", **AS_ROOT}
# the Python that made the clone's .venv
SYSTEM_PYTHON = sys._base_executable


@pytest.mark.skipif(not (ROOT / ".venv").exists(), reason="the clone has no .venv")
def test_a_script_finds_its_python():
    command = [SYSTEM_PYTHON, ROOT / "scripts" / "house.py", "--help"]
    done = subprocess.run(command, env=HOME, capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.startswith("usage: "), done.stderr


@pytest.mark.parametrize("script", SCRIPTS)
def test_each_script_explains_itself(script: str, capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", [f"{script}.py", "--help"])
    with pytest.raises(SystemExit, match="0"):
        import_module(script).main()
    assert capsys.readouterr().out.startswith("usage: ")


def test_a_clone_that_is_not_set_up_says_so(tmp_path: Path):
    scripts = tmp_path / "scripts"
    scripts.mkdir()
    for name in ("clone.py", "lab.py"):
        (scripts / name).write_text((ROOT / "scripts" / name).read_text())
    code = "import sys; sys.path.insert(0, sys.argv[1]); import lab"
    # -S: without site-packages
    command = [SYSTEM_PYTHON, "-S", "-c", code, scripts]
    done = subprocess.run(command, env=HOME, capture_output=True, text=True)
    assert done.returncode == 1 and "run scripts/setup first" in done.stderr, done.stderr


def program(folder: Path, name: str, text: str) -> None:
    (folder / name).write_text(f"#!/usr/bin/env bash\n{text}\n")
    (folder / name).chmod(0o755)


# ---- scripts/setup

# a stand-in for Python in scripts/setup: petsc4py, a venv with a copy, a pip that
# prints
PYTHON = """case "$*" in
"-m venv"*) mkdir -p .venv/bin && cp "$0" .venv/bin/python ;;
*sysconfig*) echo .venv ;;
"-m pip"*)
    echo pip >>pip.log; echo "Collecting packages"; echo "a warning" >&2; exit "${PIP_STATUS:-0}" ;;
*) cat >/dev/null ;;
esac
"""


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    (tmp_path / "scripts").mkdir()
    shutil.copy(ROOT / "scripts" / "setup", tmp_path / "scripts")
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    (tmp_path / "bin").mkdir()
    program(tmp_path / "bin", "python", PYTHON)
    program(tmp_path / "bin", "ldconfig", "echo libEGL_mesa")
    return tmp_path


def set_up(clone: Path, *extras: str, **variables: str) -> subprocess.CompletedProcess:
    path = f"{clone / 'bin'}:{os.environ['PATH']}"
    environment = {"PATH": path, "PYTHON": str(clone / "bin" / "python"), **variables}
    command = [clone / "scripts" / "setup", *extras]
    quiet = dict(stdin=subprocess.DEVNULL, capture_output=True, text=True)
    return subprocess.run(command, env=environment, **quiet)


def test_pip_is_silent_and_not_asked_twice(clone: Path):
    done = set_up(clone)
    assert (done.returncode, done.stdout, done.stderr) == (0, "setting up .venv\n", "")
    asked = (clone / "pip.log").read_text()
    again = set_up(clone)
    assert (again.returncode, again.stdout, again.stderr) == (0, "", "")
    assert (clone / "pip.log").read_text() == asked
    # the extra test needs more packages
    assert set_up(clone, "test").stdout == "setting up .venv\n"
    (clone / "bin" / "python").rename(clone / "bin" / "python3.99")
    (clone / "bin" / "python").symlink_to("python3.99")
    # the interpreter is another Python
    assert set_up(clone).stdout == "setting up .venv\n"
    assert set_up(clone).stdout == ""


@pytest.mark.parametrize("word", ["-h", "--help"])
def test_setup_says_what_it_does_and_does_nothing(clone: Path, word: str):
    done = set_up(clone, "test", word)
    assert done.returncode == 0 and "scripts/setup [EXTRA...]" in done.stdout and done.stderr == ""
    assert "set " not in done.stdout and not (clone / ".venv").exists()


def test_what_pip_says_is_shown_where_it_fails_and_the_next_start_tries_again(clone: Path):
    done = set_up(clone, PIP_STATUS="3")
    assert done.returncode == 1 and "Collecting packages\na warning\n" in done.stderr
    assert "this failed: .venv/bin/python -m pip install" in done.stderr
    assert set_up(clone).stdout == "setting up .venv\n"


# ---- scripts/build_petsc_cuda, before it makes anything

BUILD = ROOT / "scripts" / "build_petsc_cuda"
TOOLS = ("bash", "cat", "dirname", "env", "ls", "mkdir", "nproc", "paste", "realpath", "sort")


@pytest.fixture
def bare(tmp_path: Path) -> Path:
    """Return a folder for PATH without apt-get, compilers and GPUs."""
    folder = tmp_path / "bin"
    folder.mkdir()
    for tool in TOOLS:
        (folder / tool).symlink_to(shutil.which(tool))
    return folder


def build(
    path: Path, prefix: Path, *arguments: str, **variables: str
) -> subprocess.CompletedProcess:
    """Run the script with this PATH and prefix."""
    command = ["bash", BUILD, "--prefix", prefix, *arguments]
    clean = {"PATH": str(path), "HOME": str(prefix), **variables}
    return subprocess.run(command, env=clean, capture_output=True, text=True)


@pytest.mark.parametrize(
    "arguments, said",
    [
        (("--arch",), "needs a value"),
        (("--arch", "sm_90"), "sm_90"),
        (("--arch", "90", "--jobs", "0"), "--jobs 0"),
        (("--march", "90"), "unknown option --march"),
        (("--arch", "90", "--", "--with-mumps=1"), "no C++ compiler"),
    ],
)
def test_what_is_missing_is_one_line(
    bare: Path, tmp_path: Path, arguments: tuple, said: str
) -> None:
    done = build(bare, tmp_path / "petsc", *arguments)
    assert done.returncode == 2 and said in done.stderr and done.stderr.count("\n") == 1, done
    assert done.stdout == "" and not (tmp_path / "petsc").exists()


def test_who_may_not_install_is_told_what_to_ask_for(bare: Path, tmp_path: Path) -> None:
    program(bare, "apt-get", "exit 1")
    program(bare, "dpkg-query", '[ "${@: -1}" = g++ ] && echo installed')
    program(bare, "id", "echo 1000")
    done = build(bare, tmp_path / "petsc", "--arch", "90")
    assert done.returncode == 2 and "libmumps-dev" in done.stderr and "g++" not in done.stderr, done
    assert done.stderr.count("\n") == 1 and not (tmp_path / "petsc").exists()


def test_a_folder_of_others_is_left_alone(bare: Path, tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("keep")
    done = build(bare, tmp_path, "--arch", "90")
    assert done.returncode == 2 and "holds something else" in done.stderr
    assert (tmp_path / "mine").exists()


def test_what_is_made_is_not_made_again(bare: Path, tmp_path: Path) -> None:
    """Two cards of one kind and a third card name the build.

    A second call only prints the exports.
    """
    program(bare, "nvidia-smi", "printf '9.0\\n8.0\\n9.0\\n'")
    prefix = tmp_path / "petsc"
    prefix.mkdir()
    (prefix / ".key").write_text("petsc 3.26.1, sm 80,90, options --with-x=1\n")
    (prefix / ".made").touch()
    (prefix / "env").write_text("export PETSC_DIR=there\n")
    done = build(bare, prefix, "--", "--with-x=1")
    assert (done.returncode, done.stdout) == (0, "export PETSC_DIR=there\n"), done
    # another build of PETSc, so the compilers are searched next
    assert build(bare, prefix, "--", "--with-x=2").returncode == 2
