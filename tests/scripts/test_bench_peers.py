"""What the programs of others are given, and the error that they are measured by."""

import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import bench_peers
import peers
import pytest
from conftest import ENVIRONMENT, ROOT


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory):
    """A beam of 4 x 2 x 2 cells and three frames of it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench_peers, "FOLDER", tmp_path_factory.mktemp("bench_peers"))
        yield bench_peers.set_up([4, 2, 2], 3, 100)


def test_the_beam_that_peers_get_is_that_of_the_run(small: bench_peers.Setup):
    given = peers.read_beam(small.reference)
    assert len(given.nodes) == 5 * 3 * 3 and given.pinned.sum() == 9
    assert given.corner.max(axis=0).tolist() == [4, 2, 2]
    assert given.mass.sum() == pytest.approx(1000 * 16 * bench_peers.CELL**3)


def test_the_error_of_verlet_s_trajectory_is_small(small: bench_peers.Setup):
    verlet = next(case for case in bench_peers.CASES if case.method.startswith("Verlet"))
    (row,) = bench_peers.rows([verlet], small)
    assert 1e-7 < row["trajectory error"] < 1e-2 and row["step error"] is None
    assert row["10%"] <= row["ms a frame"] <= row["90%"]


@pytest.mark.parametrize("peer", ["vbd", "euler", "xpbd"])
def test_a_peer_that_is_not_installed_names_the_extra(peer: str, small: bench_peers.Setup, tmp_path: Path):
    package = peers.PEERS[peer][0]
    if find_spec(package):
        pytest.skip(f"{package} is installed")
    command = [sys.executable, ROOT / "scripts" / "peers.py", peer, small.reference, tmp_path / "x.npz"]
    done = subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert done.stderr == f"{package} is not installed: pip install 'msmpetsc[peers]' brings it\n"
