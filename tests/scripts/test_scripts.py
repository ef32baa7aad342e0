"""The scripts run from a clone as their README writes them, whatever Python is found first."""

import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest
from conftest import AS_ROOT, ROOT

SCRIPTS = sorted(path.stem for path in (ROOT / "scripts").glob("*.py") if path.stem not in ("clone", "lab"))
HOME = {"PATH": "/usr/local/bin:/usr/bin:/bin", "HOME": "/nonexistent", **AS_ROOT}  # nothing is activated
SYSTEM_PYTHON = sys._base_executable  # what the clone's .venv was made with


@pytest.mark.skipif(not (ROOT / ".venv").exists(), reason="the clone has no .venv")
def test_a_script_finds_its_python():
    script = ROOT / "scripts" / "house.py"
    done = subprocess.run([SYSTEM_PYTHON, script, "--help"], env=HOME, capture_output=True, text=True, timeout=60)
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
    command = [SYSTEM_PYTHON, "-S", "-c", code, scripts]  # -S: without site-packages
    done = subprocess.run(command, env=HOME, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1 and "run scripts/setup first" in done.stderr, done.stderr
