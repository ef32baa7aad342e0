"""The scripts run from a clone as their README writes them, whatever Python is found first."""

import subprocess
import sys
from importlib import import_module
from pathlib import Path

import house
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


def planted(folder: Path, **files: str) -> Path:
    """Return a tree whose package has these modules."""
    package = folder / "msmpetsc"
    for name, text in files.items():
        path = package / f"{name.replace('__', '/')}.py"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return folder


def test_planted_faults_are_measured(tmp_path: Path):
    long = 'def f():\n    """Text.\n\n    More.\n    """\n' + "    x = 1\n" * 36
    folder = planted(
        tmp_path,
        model__a=f"from msmpetsc.model import b\n{long}",
        model__b="from msmpetsc.solve.step import Stepper\n\n\ndef f():\n    from msmpetsc.model.a import f\n",
        solve__step="class Stepper:\n    pass\nHALF, PAIR = 0.5, 2\nNAME = 'x'\n",
        solve__b="class Stepper:\n    pass\ndef f(a, b, c, d, e, f, scene: Scene): return a if b else c\n",
    )
    rows = house.measures(folder, quick=True)
    assert rows["class names that stand twice"] == "1 Stepper" and rows["file names that stand twice"] == "1 b.py"
    assert rows["functions over 35 lines"] == "1 model.a.f" and rows["functions over 6 arguments"] == 1
    assert rows["functions, modules on the walk of scene"] == "1, 1" and rows["imports inside functions"] == 1
    assert rows["files with one user"] == 3 and rows["tuned module constants"] == 1
    assert rows["lines/files by room"] == "model 47/2, solve 7/2"
    assert rows["conditional expressions: all, in 1,000 lines"].startswith("1, ")
    assert rows["tuple assignments: all, in 1,000 lines"].startswith("1, ")
