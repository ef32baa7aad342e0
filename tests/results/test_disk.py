"""A disk that is full, or may not be written: one line, exit status 2, and the run goes on when there is room."""

import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import h5py
import pytest
from stopped_runs import assert_same, every_step_forgets, hanging  # noqa: F401  # a fixture

from msmpetsc.cli.main import main
from msmpetsc.results.reader import finished
from msmpetsc.solve.simulate import TimeLoop

STEPS, BEFORE = 12, 5  # steps; the one after which there is no room
FINE = {"cages": {"cell_size": 1 / 32}, "output": {"surface": False}}  # 2,601 nodes, 62 kB a frame
pytestmark = pytest.mark.timeout(100)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("whole")
    assert main(["run", str(hanging(folder, STEPS, **FINE)), "-o", str(folder / "whole.h5")]) == 0
    return folder / "whole.h5"


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 4 MB of its own."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=4m", "none", folder], capture_output=True, text=True)
    if mounted.returncode:
        pytest.skip(f"no file system can be mounted here: {mounted.stderr.strip()}")
    yield folder
    subprocess.run(["umount", folder], check=True)


def at_step(monkeypatch: pytest.MonkeyPatch, action) -> None:
    """`action` happens after step BEFORE."""
    advance = TimeLoop.advance

    def watched(simulation):
        for frame in advance(simulation):
            yield frame
            if simulation.step == BEFORE:
                action()

    monkeypatch.setattr(TimeLoop, "advance", watched)


def assert_stops_in_one_line(arguments: list[str], capsys, *words: str) -> None:
    assert main(arguments) == 2
    told = [line for line in capsys.readouterr().err.splitlines() if "error" in line and not line.startswith("frame")]
    assert len(told) == 1 and all(word in told[0] for word in words), told


def test_a_disk_that_fills_up(whole: Path, small_disk: Path, monkeypatch, capsys):
    path, ballast = small_disk / "x.h5", small_disk / "ballast"

    def fill() -> None:
        with open(ballast, "wb", buffering=0) as file:
            try:
                while True:
                    file.write(bytes(4096))
            except OSError:
                pass

    with monkeypatch.context() as patch:
        at_step(patch, fill)
        arguments = ["run", str(whole.parent / "scene.toml"), "-o", str(path), "--checkpoint-every", "1"]
        assert_stops_in_one_line(arguments, capsys, f"{path} cannot be written", "No space left")
    with h5py.File(path) as file:
        assert finished(file) == 1 + BEFORE and max(file["checkpoint/step"]) == BEFORE
    assert_stops_in_one_line(["run", "--resume", str(path)], capsys, "will need", "are free there")
    with h5py.File(path) as file:
        assert finished(file) == 1 + BEFORE
    ballast.unlink()
    assert main(["run", "--resume", str(path)]) == 0
    assert_same(path, whole)


def test_a_run_that_will_not_fit_is_refused(whole: Path, small_disk: Path, capsys):
    """72 frames of 62 kB; replacing a file gives its room back."""
    scene, path = whole.parent / "scene.toml", small_disk / "x.h5"
    longer = ["--set", "time.duration=0.72"]
    assert_stops_in_one_line(["run", str(scene), "-o", str(path), *longer], capsys, "will need", "are free there")
    assert os.listdir(small_disk) == []
    assert main(["run", str(scene), "-o", str(path)]) == 0
    assert_stops_in_one_line(["run", "--resume", str(path), *longer, "--force"], capsys, "will need")
    assert_same(path, whole)
    assert sorted(os.listdir(small_disk)) == ["x.h5", "x.xdmf"]


def test_a_folder_that_may_not_be_written(whole: Path, small_disk: Path, capsys):
    path = small_disk / "x.h5"
    path.write_bytes(whole.read_bytes())
    subprocess.run(["mount", "-o", "remount,ro", small_disk], check=True)
    scene = str(whole.parent / "scene.toml")
    assert_stops_in_one_line(["run", scene, "-o", str(small_disk / "y.h5")], capsys, "cannot be written: Read-only")
    longer = ["--set", "time.duration=0.14", "--force"]
    assert_stops_in_one_line(["run", "--resume", str(path), *longer], capsys, "cannot be written: Read-only")
    assert path.read_bytes() == whole.read_bytes()
