"""How a command starts: help and refusals import little, and a command imports what it needs itself."""

import json
import re
import subprocess
import sys

import pytest
from conftest import ENVIRONMENT, run

SLOW = {"numba", "numpy", "scipy", "h5py", "mpi4py", "petsc4py", "pydantic", "trimesh", "meshio", "pyvista"}
IMPORTS = """
import json, sys
from msmpetsc.cli.main import main
try:
    main(sys.argv[1:])
except SystemExit:
    pass
print(json.dumps(sorted({name.partition(".")[0] for name in sys.modules})))
"""
ALONE = {name: value for name, value in ENVIRONMENT.items() if not name.startswith(("OMPI_COMM", "PMI", "SLURM"))}


def imports(code: str, *arguments: str) -> set[str]:
    """Packages that Python has imported after the code."""
    command = [sys.executable, "-c", code, *arguments]
    done = subprocess.run(command, env=ALONE, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    return set(json.loads(done.stdout.splitlines()[-1]))


@pytest.mark.parametrize("words", ["--help", "run --help"])
def test_help_starts_neither_mpi_nor_petsc_nor_a_compiler(words: str):
    assert imports(IMPORTS, *words.split()) & SLOW == set()


def test_the_version_names_petsc_and_mpi_and_loads_no_more_than_them():
    assert imports(IMPORTS, "--version") & (SLOW - {"numpy", "mpi4py", "petsc4py"}) == set()
    done = subprocess.run(
        [sys.executable, "-m", "msmpetsc", "--version"], env=ALONE, capture_output=True, text=True, timeout=60
    )
    assert re.fullmatch(r"msmpetsc [\d.]+ \(PETSc 3\.\d+\.\d+, .*MPI.* v?\d.*, Python 3[\d.]+\)\n", done.stdout), (
        done.stdout
    )


def test_the_package_itself_imports_nothing_slow():
    code = "import json, sys, msmpetsc\nprint(json.dumps([name.partition('.')[0] for name in sys.modules]))"
    assert imports(code) & SLOW == set()


def test_a_run_imports_neither_charts_nor_other_commands(tmp_path):
    assert imports(IMPORTS, "run", str(tmp_path / "gone.toml")) & {"vl_convert", "pyvista", "pandas", "jinja2"} == set()


def test_help_is_printed_once_whatever_the_number_of_ranks():
    done = run(3, "-m", "msmpetsc", "--help", timeout=60)
    assert done.returncode == 0 and done.stderr == ""
    assert done.stdout.count("usage: msmpetsc") == 1
