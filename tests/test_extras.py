"""Results are read with the core dependencies alone.

Otherwise an error names the missing package and its extra in a line.
"""

import os
import re
import shutil
import subprocess
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
import small_result
from ball_result import write_ball
from conftest import ROOT, python

from msmpetsc.errors import EXTRAS

# the command of a Python without these packages
WITHOUT = """
import runpy, sys
class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {missing}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Missing())
sys.argv = ["msmpetsc", *{arguments}]
runpy.run_module("msmpetsc", run_name="__main__")
"""
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def without(missing: tuple[str, ...], *arguments: object) -> subprocess.CompletedProcess:
    """Return the finished command of a Python that lacks these packages."""
    code = WITHOUT.format(missing=set(missing), arguments=list(map(str, arguments)))
    return python("-c", code)


def name_of(requirement: str) -> str:
    return re.split(r"[\[<>=]", requirement)[0].lower()


@pytest.mark.parametrize("extra", EXTRAS)
def test_the_table_of_extras_is_that_of_the_project(extra: str):
    wanted = {name_of(requirement) for requirement in PROJECT["optional-dependencies"][extra]}
    installed = packages_distributions()
    for package in EXTRAS[extra]:
        known = {name.lower().replace("_", "-") for name in installed.get(package, [])}
        assert known & wanted or not known, (
            f"{package} is of {known}, the extra {extra} has {wanted}"
        )


# packages that pyvista needs
OF_RUNS = tuple(name for name in EXTRAS["run"] if name not in (*EXTRAS["render"], "pooch"))
EVERY = tuple(package for packages in EXTRAS.values() for package in packages)
DO_WITHOUT = [
    ("render x.h5 -o x.png", OF_RUNS),
    ("render x.h5 -o x.gif --frames 0:4:2", OF_RUNS),
    ("render x.h5 -o x.html --colour speed", OF_RUNS),
    ("export x.h5 -o x.glb --frames 0:5:2", EVERY),
    ("compare x.h5 x.h5", EVERY),
]


@pytest.mark.parametrize(("command", "missing"), DO_WITHOUT)
def test_reading_a_result_needs_no_more_than_it_must(
    command: str, missing: tuple[str, ...], tmp_path: Path, monkeypatch
):
    """Drawing needs neither MPI nor PETSc nor a compiler; exporting needs the core alone."""
    monkeypatch.chdir(tmp_path)
    write_ball(tmp_path / "x.h5")
    words = command.split()
    done = without(missing, *words)
    assert done.returncode == 0, done.stderr
    assert "-o" not in words or Path(words[3]).stat().st_size > 1000


def in_the_clean(python: Path, *words: object, folder: Path) -> subprocess.CompletedProcess:
    """Return the finished command of a Python that sees none of this Python's packages."""
    clean = {
        name: value
        for name, value in os.environ.items()
        if not name.startswith(("PYTHON", "OMPI_", "PMIX_"))
    }
    return subprocess.run(
        [python, *map(str, words)], cwd=folder, env=clean, capture_output=True, text=True
    )


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_an_environment_of_its_own_with_render_alone_draws(tmp_path: Path, ball: Path):
    hidden = shutil.ignore_patterns(
        ".*", "out", "tests", "build", "__pycache__", "*.egg-info", "*.png"
    )
    shutil.copytree(ROOT, tmp_path / "clone", symlinks=True, ignore=hidden)
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", tmp_path / "clean"], check=True)
    python = tmp_path / "clean" / "bin" / "python"
    pip = (sys.executable, "-m", "pip", "--python", python, "install", "--quiet", "--no-compile")
    done = subprocess.run([*pip, f"{tmp_path / 'clone'}[render]"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    write_ball(tmp_path / "ball.h5")
    absent = (
        f"from importlib.util import find_spec; print([name for name in {OF_RUNS} if "
        f"find_spec(name)])"
    )
    assert in_the_clean(python, "-c", absent, folder=tmp_path).stdout == "[]\n"
    for command in ("render ball.h5 -o x.png", "export ball.h5 -o x.glb --frames 0:9:3"):
        done = in_the_clean(python, "-m", "msmpetsc", *command.split(), folder=tmp_path)
        assert done.returncode == 0, f"{command}: {done.stderr}"
    read = "import msmpetsc; print(msmpetsc.open('ball.h5').frames.position[-1].shape[1])"
    assert in_the_clean(python, "-c", read, folder=tmp_path).stdout == "3\n"
    doctor = in_the_clean(python, "-m", "msmpetsc", "doctor", folder=tmp_path)
    assert doctor.returncode == 1 and "BROKEN" not in doctor.stdout
    assert "ok       extra render" in doctor.stdout
    refused = in_the_clean(python, "-m", "msmpetsc", "run", ball, folder=tmp_path)
    assert refused.returncode == 2 and "msmpetsc[run]" in refused.stderr


BEAM = ROOT / "scenes" / "studies" / "atlas" / "beam.toml"
# by missing package: the extra that installs it, and a command that needs it
NEEDED = {
    **{
        name: ("run", ["run", BEAM, "-o", "y.h5"])
        for name in ("mpi4py", "petsc4py", "numba", "trimesh", "igl")
    },
    "pydantic": ("render", ["render", "x.h5"]),
    "scipy": ("render", ["series", "x.h5"]),
    "pyvista": ("render", ["render", "x.h5", "-o", "x.png"]),
    "manifold3d": ("mesh", ["run", BEAM, "-o", "y.h5", "--set", 'mesh.prepare=["union"]']),
    "ipctk": ("contact", ["run", BEAM, "-o", "y.h5", "--set", "self_contact.distance=1e-3"]),
}


@pytest.mark.parametrize("package", NEEDED)
def test_what_needs_a_package_names_the_extra_that_brings_it(
    package: str, tmp_path: Path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    small_result.write(tmp_path / "x.h5")
    extra, command = NEEDED[package]
    done = without((package,), *command)
    assert done.returncode == 2 and done.stderr.count("error") == 1, done.stderr
    assert done.stderr.endswith(
        f"{package} is not installed: pip install 'msmpetsc[{extra}]' brings it\n"
    ), done.stderr
