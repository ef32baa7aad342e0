"""What the programs of others are given, and the error that they are measured by."""

import bench_peers
import pytest


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory):
    """A beam of 4 x 2 x 2 cells and three frames of it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench_peers, "FOLDER", tmp_path_factory.mktemp("bench_peers"))
        yield bench_peers.set_up([4, 2, 2], 3, 100)


def test_the_beam_that_peers_get_is_that_of_the_run(small: bench_peers.Setup):
    given = bench_peers.read_beam(small.reference)
    assert len(given.nodes) == 5 * 3 * 3 and given.pinned.sum() == 9
    assert given.corner.max(axis=0).tolist() == [4, 2, 2]
    assert given.mass.sum() == pytest.approx(1000 * 16 * bench_peers.CELL**3)


def test_the_error_of_verlet_s_trajectory_is_small(small: bench_peers.Setup):
    verlet = next(case for case in bench_peers.CASES if case.method.startswith("Verlet"))
    (row,) = bench_peers.rows([verlet], small)
    assert 1e-7 < row["trajectory error"] < 1e-2 and row["step error"] is None
    assert row["10%"] <= row["ms a frame"] <= row["90%"]
