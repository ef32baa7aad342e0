"""What the programs of others are given, and the errors that they are measured by."""

import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import bench_peers
import numpy as np
import peers
import pytest
from conftest import ENVIRONMENT, ROOT
from lattices import T, beam, swing


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> bench_peers.Setup:
    """A beam of 4 x 2 x 2 cells and three frames of it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench_peers, "FOLDER", tmp_path_factory.mktemp("bench_peers"))
        return bench_peers.set_up([4, 2, 2], 3, 100)


def test_the_beam_that_peers_get_is_that_of_the_run(small: bench_peers.Setup):
    given, lattice = peers.read_beam(small.reference), small.lattice
    for name in ("nodes", "mass", "springs", "rest_length", "stiffness", "pinned"):
        np.testing.assert_array_equal(getattr(given, name), getattr(lattice, name), err_msg=name)
    assert len(given.nodes) == 5 * 3 * 3 and given.pinned.sum() == 9
    assert given.corner.max(axis=0).tolist() == [4, 2, 2]


def test_no_spring_joins_nodes_of_a_color(small: bench_peers.Setup):
    given = peers.read_beam(small.reference)
    color = np.empty(len(given.nodes), int)
    for i, group in enumerate(peers.color_groups(given)):
        color[group] = i
    assert np.bincount(color).sum() == len(given.nodes)
    assert (color[given.springs[:, 0]] != color[given.springs[:, 1]]).all()


def test_the_step_error_of_a_solved_step_and_of_one_that_is_off():
    lattice = beam()
    last = np.array([step.position for step in swing("newton", 5, lattice, error=1e-9)][-3:])
    assert bench_peers.step_error(lattice, last, T) < 1e-4
    flight = 2 * last[1] - last[0]
    off = np.array([last[0], last[1], last[2] + 0.1 * (flight - last[2])])
    assert bench_peers.step_error(lattice, off, T) == pytest.approx(0.1, rel=1e-2)
    assert bench_peers.step_error(lattice, last * np.nan, T) is None


def test_the_error_of_verlet_s_trajectory_is_small(small: bench_peers.Setup, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(bench_peers, "FOLDER", small.reference.parent)
    verlet = next(case for case in bench_peers.CASES if case.method.startswith("Verlet"))
    row = next(bench_peers.measured([verlet], small))
    assert 1e-7 < row["trajectory error"] < 1e-2 and row["step error"] is None
    assert row["10%"] <= row["ms a frame"] <= row["90%"]


@pytest.mark.parametrize("peer", peers.PEERS)
def test_a_peer_that_is_not_installed_names_the_extra(peer: str, small: bench_peers.Setup, tmp_path: Path):
    package = peers.PEERS[peer][0]
    if find_spec(package):
        pytest.skip(f"{package} is installed")
    command = [sys.executable, ROOT / "scripts" / "peers.py", peer, small.reference, tmp_path / "x.npz"]
    done = subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert done.stderr == f"{package} is not installed: pip install 'msmpetsc[peers]' brings it\n"


def test_a_program_that_fails_or_hangs_is_one_line(small: bench_peers.Setup, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(bench_peers, "FOLDER", small.reference.parent)
    with pytest.raises(bench_peers.RunFailed, match=r"^ValueError: no$"):
        bench_peers.run(["-c", "raise ValueError('no')"], 60)
    with pytest.raises(bench_peers.RunFailed, match=r"not done after 0\.1 s"):
        bench_peers.run(["-c", "import time; time.sleep(60)"], 0.1)
