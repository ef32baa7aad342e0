"""--device and -mat_type, on a machine that has no GPU or whose GPU is not asked for."""

from pathlib import Path
from unittest.mock import patch

import pytest
from block_scene import block_scene, play
from mpi4py import MPI
from one_process import errors
from petsc4py import PETSc

from msmpetsc.backend import cuda
from msmpetsc.errors import InputError
from msmpetsc.solve.petsc import device

FALL = {"time": {"step": 0.01, "duration": 0.02}, "gravity": {"acceleration": [0, 0, -9.81]}}


@pytest.fixture
def options():
    """PETSc's, as they were before."""
    database = PETSc.Options()
    before = database.getAll()
    yield database
    for name in database.getAll().keys() - before.keys():
        database.delValue(name)


@pytest.fixture
def no_gpu():
    """Or skipped where there is one."""
    if device.what_is_missing() is None:
        pytest.skip("there is a GPU here")


@pytest.mark.parametrize("words", [["--device", "cuda"], ["-mat_type", "aijcusparse"], ["-mat_type", "mpiaijcusparse"]])
@pytest.mark.parametrize("ranks", [1, 2])
def test_without_a_gpu_one_line_says_what_is_missing(tmp_path: Path, msmpetsc, words: list[str], ranks: int, no_gpu):
    path, out = block_scene(tmp_path, **FALL), tmp_path / "out.h5"
    done = msmpetsc(ranks, "run", path, "-o", out, *words)
    (line,) = errors(done.stderr)
    assert done.returncode == 2 and not out.exists()
    assert device.what_is_missing() in line and words[-1] in line
    assert "Traceback" not in done.stderr and "CAUGHT SIGNAL" not in done.stderr.upper()


def test_what_contradicts_itself_is_refused(tmp_path: Path, msmpetsc):
    done = msmpetsc(1, "run", block_scene(tmp_path, **FALL), "--device", "cuda", "-mat_type", "aij")
    assert done.returncode == 2 and "--device cuda and -mat_type aij contradict each other" in done.stderr


def test_a_package_that_is_not_there_is_named():
    with patch.dict("sys.modules", cupy=None):
        assert "msmpetsc[cuda]" in cuda.missing()


@pytest.mark.cuda
def test_a_solver_that_computes_elsewhere_than_the_run_is_refused(tmp_path: Path, options):
    """A prefix has a matrix type of its own, for the spare solver of a rescue or of the true error."""
    if device.what_is_missing():
        pytest.skip(device.what_is_missing())
    options["mat_type"] = "seqaijcusparse"
    device.sender(MPI.COMM_SELF)  # which tells PETSc whether MPI knows GPUs
    with (
        patch("msmpetsc.solve.simulate.sender", lambda comm: lambda array: array),
        pytest.raises(InputError, match="-mat_type seqaijcusparse: the run computes on the CPU"),
    ):
        play(block_scene(tmp_path, **FALL))
