"""Results are read with the core dependencies alone; a package that is missing is named in one line with its extra."""

import re
import subprocess
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
import small_result
from conftest import ENVIRONMENT, ROOT

from msmpetsc.errors import EXTRAS

# a Python in which these packages are not installed
WITHOUT = """
import runpy, sys
class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {missing}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Missing())
sys.argv = ["msmpetsc", *{arguments}]
{statement}
"""
COMMAND = "runpy.run_module('msmpetsc', run_name='__main__')"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def without(missing: tuple[str, ...], *arguments: object, statement: str = COMMAND) -> subprocess.CompletedProcess:
    """Return the finished command of a Python that lacks these packages."""
    code = WITHOUT.format(missing=set(missing), arguments=list(map(str, arguments)), statement=statement)
    return subprocess.run([sys.executable, "-c", code], env=ENVIRONMENT, capture_output=True, text=True, timeout=100)


def name_of(requirement: str) -> str:
    return re.split(r"[\[<>=]", requirement)[0].lower()


@pytest.mark.parametrize("extra", EXTRAS)
def test_the_table_of_extras_is_that_of_the_project(extra: str):
    wanted = {name_of(requirement) for requirement in PROJECT["optional-dependencies"][extra]}
    installed = packages_distributions()
    for package in EXTRAS[extra]:
        known = {name.lower().replace("_", "-") for name in installed.get(package, [])}
        assert known & wanted or not known, f"{package} is of {known}, the extra {extra} has {wanted}"


def test_results_are_read_with_the_core_alone(tmp_path: Path):
    small_result.write(tmp_path / "x.h5")
    read = "import msmpetsc\nwith msmpetsc.open(sys.argv[1]) as run:\n"
    read += "    print(run.frames.position[-1].shape, run.lattice.nodes.shape, run.scene['time'])"
    every = tuple(package for packages in EXTRAS.values() for package in packages)
    done = without(every, tmp_path / "x.h5", statement=read)
    assert done.stdout == "(12, 3) (12, 3) {'step': 0.01}\n", done.stderr


@pytest.mark.parametrize("package", ["mpi4py", "petsc4py", "numba", "trimesh"])
def test_a_run_without_what_it_needs_names_the_extra(package: str, tmp_path: Path):
    done = without((package,), "run", ROOT / "scenes" / "studies" / "beam_soft.toml", "-o", tmp_path / "x.h5")
    assert done.returncode == 2, done.stderr
    assert done.stderr == f"msmpetsc: error: {package} is not installed: pip install 'msmpetsc[run]' brings it\n"


def test_a_picture_without_its_packages_names_the_extra(tmp_path: Path):
    small_result.write(tmp_path / "x.h5")
    done = without(("pyvista",), "render", tmp_path / "x.h5", "-o", tmp_path / "x.png")
    assert done.returncode == 2 and done.stderr.startswith("msmpetsc: error: pyvista"), done.stderr
    assert done.stderr.count("\n") == 1 and "msmpetsc[render]" in done.stderr


def test_a_mesh_without_its_package_names_the_extra(tmp_path: Path):
    beam = ROOT / "scenes" / "studies" / "atlas" / "beam.toml"
    done = without(("manifold3d",), "run", beam, "-o", tmp_path / "x.h5", "--set", 'mesh.prepare=["union"]')
    assert done.returncode == 2 and "manifold3d is not installed" in done.stderr, done.stderr
    assert "msmpetsc[mesh]" in done.stderr


def test_self_contact_without_its_package_names_the_extra(tmp_path: Path):
    beam, touching = ROOT / "scenes" / "studies" / "atlas" / "beam.toml", ("--set", "self_contact.distance=1e-3")
    done = without(("ipctk",), "run", beam, "-o", tmp_path / "x.h5", *touching)
    assert done.returncode == 2, done.stderr
    assert done.stderr.endswith("ipctk is not installed: pip install 'msmpetsc[contact]' brings it\n"), done.stderr
    assert without(("ipctk",), "run", beam, "-o", tmp_path / "x.h5", "--frames", "1").returncode == 0
