"""scripts/setup with stand-ins for Python and apt."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest
from conftest import ROOT

# what scripts/setup asks of a Python: petsc4py is there, a venv gets a copy, pip talks
PYTHON = """#!/bin/sh
case "$*" in
"-m venv"*) mkdir -p .venv/bin && cp "$0" .venv/bin/python ;;
*sysconfig*) echo .venv ;;
"-m pip"*) echo pip >>pip.log; echo "Collecting packages"; echo "a warning" >&2; exit "${PIP_STATUS:-0}" ;;
*) cat >/dev/null ;;
esac
"""


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    (tmp_path / "scripts").mkdir()
    shutil.copy(ROOT / "scripts" / "setup", tmp_path / "scripts")
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    for name, text in {"python": PYTHON, "ldconfig": "#!/bin/sh\necho libEGL_mesa\n"}.items():
        (tmp_path / "bin").mkdir(exist_ok=True)
        (tmp_path / "bin" / name).write_text(text)
        (tmp_path / "bin" / name).chmod(0o755)
    return tmp_path


def set_up(clone: Path, *extras: str, **variables: str) -> subprocess.CompletedProcess:
    environment = {
        "PATH": f"{clone / 'bin'}:{os.environ['PATH']}",
        "PYTHON": str(clone / "bin" / "python"),
        **variables,
    }
    command = [clone / "scripts" / "setup", *extras]
    return subprocess.run(
        command, env=environment, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=30
    )


def test_pip_is_silent_and_not_asked_twice(clone: Path):
    done = set_up(clone)
    assert (done.returncode, done.stdout, done.stderr) == (0, "setting up .venv\n", "")
    asked = (clone / "pip.log").read_text()
    again = set_up(clone)
    assert (again.returncode, again.stdout, again.stderr) == (0, "", "")
    assert (clone / "pip.log").read_text() == asked
    assert set_up(clone, "test").stdout == "setting up .venv\n"  # more is wanted
    (clone / "bin" / "python").rename(clone / "bin" / "python3.99")
    (clone / "bin" / "python").symlink_to("python3.99")
    assert set_up(clone).stdout == "setting up .venv\n"  # it is another Python
    assert set_up(clone).stdout == ""


def test_what_pip_says_is_shown_where_it_fails_and_the_next_start_tries_again(clone: Path):
    done = set_up(clone, PIP_STATUS="3")
    assert done.returncode == 1 and "Collecting packages\na warning\n" in done.stderr
    assert "this failed: .venv/bin/python -m pip install" in done.stderr
    assert set_up(clone).stdout == "setting up .venv\n"
