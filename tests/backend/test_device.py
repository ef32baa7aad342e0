"""--device and -mat_type on a machine without a GPU, or with a GPU that the run does not use."""

from pathlib import Path
from unittest.mock import patch

import pytest
from block_scene import GRAVITY, block_scene, play
from mpi4py import MPI
from one_process import assert_one_line

from msmpetsc.errors import InputError
from msmpetsc.solve.petsc import device

FALL = {"time": {"step": 0.01, "duration": 0.02}, "gravity": GRAVITY}


@pytest.fixture
def no_gpu():
    """Skip the test on a machine with a GPU."""
    if device.what_is_missing() is None:
        pytest.skip("there is a GPU here")


@pytest.mark.parametrize(
    "words", [["--device", "cuda"], ["-mat_type", "aijcusparse"], ["-mat_type", "mpiaijcusparse"]]
)
@pytest.mark.parametrize("ranks", [1, 2])
def test_without_a_gpu_one_line_says_what_is_missing(
    tmp_path: Path, msmpetsc, words: list[str], ranks: int, no_gpu
):
    path, out = block_scene(tmp_path, **FALL), tmp_path / "out.h5"
    done = msmpetsc(ranks, "run", path, "-o", out, *words)
    assert_one_line(done, 2, device.what_is_missing(), words[-1])
    assert not out.exists()


def test_what_contradicts_itself_is_refused(tmp_path: Path, msmpetsc):
    done = msmpetsc(1, "run", block_scene(tmp_path, **FALL), "--device", "cuda", "-mat_type", "aij")
    assert (
        done.returncode == 2
        and "--device cuda and -mat_type aij contradict each other" in done.stderr
    )


def test_a_package_that_is_not_there_is_named():
    with patch.dict("sys.modules", cupy=None):
        assert "msmpetsc[cuda]" in device.what_is_missing()


@pytest.mark.cuda
def test_a_solver_that_computes_elsewhere_than_the_run_is_refused(tmp_path: Path, petsc_options):
    """Refuse a -mat_type with a prefix: a spare solver would compute on another device."""
    if device.what_is_missing():
        pytest.skip(device.what_is_missing())
    petsc_options(mat_type="seqaijcusparse")
    # device.sender tells PETSc whether MPI is GPU-aware
    device.sender(MPI.COMM_SELF)
    with (
        patch("msmpetsc.solve.simulate.sender", lambda comm: lambda array: array),
        pytest.raises(InputError, match="-mat_type seqaijcusparse: the run computes on the CPU"),
    ):
        play(block_scene(tmp_path, **FALL))
