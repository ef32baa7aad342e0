"""A full or write-protected disk gives a line and exit status 2; with room the run continues."""

import subprocess
from collections.abc import Iterator
from pathlib import Path

import h5py
import pytest
from one_process import command_error, status_of
from stopped_runs import assert_same, at_step, every_step_forgets, hanging  # noqa: F401  # a fixture

from msmpetsc.results.untrusted_file import finished

# number of steps, and the step after which the disk is full
STEPS, BEFORE = 12, 5
# 2,601 nodes, 62 kB a frame
FINE = {"cages": {"cell_size": 1 / 32}, "output": {"surface": False}}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("whole")
    assert status_of("run", hanging(folder, STEPS, **FINE), "-o", folder / "whole.h5") == 0
    return folder / "whole.h5"


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """Yield a file system of 4 MB of its own."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=4m", "none", folder], capture_output=True, text=True
    )
    if mounted.returncode:
        pytest.skip(f"no file system can be mounted here: {mounted.stderr.strip()}")
    yield folder
    subprocess.run(["umount", folder], check=True)


def test_a_disk_that_fills_up(whole: Path, small_disk: Path, monkeypatch):
    path, ballast = small_disk / "x.h5", small_disk / "ballast"

    def fill() -> None:
        with open(ballast, "wb", buffering=0) as file:
            try:
                while True:
                    file.write(bytes(4096))
            except OSError:
                pass

    with monkeypatch.context() as patch:
        at_step(patch, BEFORE, fill)
        text = command_error(
            "run", whole.parent / "scene.toml", "-o", path, "--checkpoint-every", "1"
        )
        assert f"{path} cannot be written" in text and "No space left" in text
    with h5py.File(path) as file:
        assert finished(file) == 1 + BEFORE and max(file["checkpoint/step"]) == BEFORE
    assert "are free there" in command_error("run", "--resume", path)
    with h5py.File(path) as file:
        assert finished(file) == 1 + BEFORE
    ballast.unlink()
    assert status_of("run", "--resume", path) == 0
    assert_same(path, whole)


def test_a_folder_that_may_not_be_written(whole: Path, small_disk: Path):
    path = small_disk / "x.h5"
    path.write_bytes(whole.read_bytes())
    subprocess.run(["mount", "-o", "remount,ro", small_disk], check=True)
    longer = ["--resume", path, "--set", "time.duration=0.14", "--force"]
    for words in ([whole.parent / "scene.toml", "-o", small_disk / "y.h5"], longer):
        assert "cannot be written: Read-only" in command_error("run", *words)
    assert path.read_bytes() == whole.read_bytes()
