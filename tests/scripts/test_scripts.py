"""The scripts run from a clone as their README writes them, whatever Python is found first."""

import subprocess
import sys
from pathlib import Path

import house
import pytest
from conftest import AS_ROOT, ROOT

SCRIPTS = sorted(path for path in (ROOT / "scripts").glob("*.py") if path.stem != "clone")
HOME = {"PATH": "/usr/local/bin:/usr/bin:/bin", "HOME": "/nonexistent", **AS_ROOT}  # nothing is activated
SYSTEM_PYTHON = sys._base_executable  # what the clone's .venv was made with
needs_venv = pytest.mark.skipif(not (ROOT / ".venv").exists(), reason="the clone has no .venv")


@needs_venv
@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_each_script_finds_its_python(script: Path):
    done = subprocess.run([SYSTEM_PYTHON, script, "--help"], env=HOME, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0 and done.stdout.startswith("usage: "), done.stderr


def test_a_clone_that_is_not_set_up_says_so(tmp_path: Path):
    scripts = tmp_path / "scripts"
    scripts.mkdir()
    for name in ("clone.py", "table1.py"):
        (scripts / name).write_text((ROOT / "scripts" / name).read_text())
    code = "import sys; sys.path.insert(0, sys.argv[1]); import clone"
    command = [SYSTEM_PYTHON, "-S", "-c", code, scripts]  # -S: without site-packages
    done = subprocess.run(command, env=HOME, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1 and "run scripts/setup first" in done.stderr, done.stderr


def planted(folder: Path, **files: str) -> Path:
    """Return a tree whose package has these modules."""
    package = folder / "msmpetsc"
    for name, text in files.items():
        path = package / f"{name.replace('__', '/')}.py"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    (folder / "README.md").write_text("# A title\n\nthree more words\n")
    return folder


def test_planted_faults_are_measured(tmp_path: Path):
    step = "class Stepper:\n    late: int\n    def __init__(self):\n        self.a = self.b = 1\n"
    step += "    def step(self):\n        self.c = 2\n        self.a = 3\n"
    long = 'def f():\n    """Text.\n\n    More.\n    """\n' + "    x = 1\n" * 35
    folder = planted(
        tmp_path,
        model__a=f"from msmpetsc.model import b\n{long}",
        model__b="from msmpetsc.solve.step import Stepper\n\n\ndef f():\n    from msmpetsc.model.a import f\n",
        solve__step=step,
        solve__other="class Stepper:\n    pass\n",
    )
    rows = house.measures(folder, quick=True)
    assert rows["attributes of Stepper (born late)"] == "Stepper 4 (1)"
    assert rows["classes whose name stands twice"] == "1 Stepper"
    assert rows["import circles"] == "1 model.a - model.b"
    assert rows["upward imports"] == "1 model.b > solve.step"
    assert rows["functions over 35 lines"] == "1 model.a.f 36"
    assert rows["README.md: lines, words"] == "3, 6"
