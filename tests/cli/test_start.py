"""The start of a command: help and refusals import little, a command imports only its needs."""

import re
from pathlib import Path

import pytest
from block_scene import block_scene
from conftest import ENVIRONMENT, python, run

ALONE = {
    name: value
    for name, value in ENVIRONMENT.items()
    if not name.startswith(("OMPI_COMM", "PMI", "SLURM"))
}
SLOW = {
    "numba", "numpy", "scipy", "h5py", "mpi4py", "petsc4py", "pydantic", "trimesh", "meshio",
    "pyvista",
}  # fmt: skip
CHARTS = {"vl_convert", "pandas", "jinja2"}
COMMAND = """
import sys
from msmpetsc.cli.main import main
try:
    main(sys.argv[1:])
except SystemExit:
    pass
"""
# Python code, its arguments, and modules that it must not import
DOES_WITHOUT = [
    (COMMAND, "--help", SLOW),
    (COMMAND, "run --help", SLOW),
    (COMMAND, "--version", SLOW - {"numpy", "mpi4py", "petsc4py"}),
    (COMMAND, "run gone.toml", CHARTS | {"pyvista"}),
    ("import msmpetsc", "", SLOW | {"argparse"}),
    ("import msmpetsc; msmpetsc.run('scene.toml', 'x.h5', frames=1)", "", {"msmpetsc.cli"}),
    ("import msmpetsc.study.runner, msmpetsc.study.sizing.trials, msmpetsc.cli.main", "", CHARTS),
]


@pytest.mark.parametrize(("code", "words", "absent"), DOES_WITHOUT)
def test_nothing_is_imported_before_it_is_needed(
    tmp_path: Path, code: str, words: str, absent: set[str]
):
    block_scene(tmp_path, time={"step": 0.01, "duration": 0.01})
    done = python(
        "-c", f"{code}\nimport sys; print(*sys.modules)", *words.split(), env=ALONE, cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    assert absent & {*done.stdout.splitlines()[-1].split()} == set()


def test_the_version_names_petsc_and_mpi():
    shown = python("-m", "msmpetsc", "--version", env=ALONE).stdout
    assert re.fullmatch(
        r"msmpetsc [\d.]+ \(PETSc 3\.\d+\.\d+, .*MPI.* v?\d.*, Python 3[\d.]+\)\n", shown
    ), shown


def test_help_is_printed_once_whatever_the_number_of_ranks():
    done = run(3, "-m", "msmpetsc", "--help")
    assert done.returncode == 0 and done.stderr == ""
    assert done.stdout.count("usage: msmpetsc") == 1
