"""The coarse grids, and interpolation between them."""

import numpy as np
import pytest
from conftest import WORKERS, run
from hierarchies import CELL, COMM, LATTICES, ORIGIN, at, build, hierarchy
from lattices import block
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from msmpetsc.geometry.morton import decode_morton, encode_morton
from msmpetsc.solve.multigrid.coarse_copies import CoarseCopies
from msmpetsc.solve.multigrid.grids import grids


@pytest.mark.parametrize("pins", [False, True])
@pytest.mark.parametrize("name", LATTICES)
def test_interpolation_reproduces_what_is_linear(name: str, pins: bool):
    """Each level reproduces linear functions and constants, so the weights of a node sum to 1."""
    slopes, at_origin = np.array([[2.0, -3, 5], [0.5, 7, 1], [-1, 1, 4]]), np.array([11.0, -2, 3])
    with hierarchy(COMM, build(COMM, LATTICES[name], pins=pins), coarsest=2) as case:
        nodes, free = case.lattice.nodes, case.unknowns.free
        fine = np.rint((nodes - ORIGIN) / CELL).astype(int)
        # each body has coarse nodes of its own
        keys = encode_morton(fine)
        fine = decode_morton(keys + case.multigrid.bodies.offsets(COMM, keys))[free]
        for level, coarse in enumerate(case.multigrid.levels):
            p = case.interpolation(level)
            assert p.shape == (3 * len(fine), 3 * coarse.grid.table.total)
            assert p.min() >= 0 and set(np.unique(p)) <= {0, 1 / 8, 1 / 4, 1 / 2, 1}
            np.testing.assert_allclose(p.sum(axis=1), 1, rtol=1e-15)
            ijk = decode_morton(coarse.grid.table.keys)
            values = 2 * ijk @ slopes + at_origin
            np.testing.assert_allclose(
                (p @ values.ravel()).reshape(-1, 3), fine @ slopes + at_origin, rtol=1e-12
            )
            # each coarse node has fine nodes
            assert (p != 0).any(axis=0).all()
            fine = ijk


@pytest.mark.parametrize(
    ("name", "coarsest", "count"),
    [("block", 800, 1), ("block", 10, 3), ("thin sheet", 800, 1), ("rod", 10, 4)],
)
def test_grids_have_the_neighbours_of_half_an_index_until_one_is_small(
    name: str, coarsest: int, count: int
):
    corners = np.argwhere(np.ones((2, 2, 2)))
    with hierarchy(COMM, build(COMM, LATTICES[name]), coarsest=coarsest) as case:
        ijk = decode_morton(case.lattice.table.keys)
        for level in case.multigrid.levels:
            ijk = np.unique(((ijk[:, None] + corners) // 2).reshape(-1, 3), axis=0)
            found = decode_morton(level.grid.table.keys)
            np.testing.assert_array_equal(np.unique(found, axis=0), ijk)
            assert len(found) == len(ijk)
        assert len(case.multigrid.levels) == count


def test_a_grid_that_is_not_much_smaller_is_none():
    """Bodies far from each other keep all their corners on any coarse grid."""
    lattice = build(COMM, 64 * np.argwhere(np.ones((3, 3, 3))))
    keys = lattice.table.keys
    copies = CoarseCopies(lattice, keys, np.zeros_like(keys))
    far = keys, copies, np.arange(216), 216
    assert [grid.table.total for grid in grids(COMM, *far, coarsest=1)] == [216]
    # there always is a coarse level
    assert len(grids(COMM, *far, coarsest=800)) == 1


@pytest.mark.parametrize("name", LATTICES)
def test_no_coarse_node_spans_a_gap(name: str):
    """Cells connect the fine nodes of each coarse node."""
    with hierarchy(COMM, build(COMM, LATTICES[name])) as case:
        p = case.interpolation(0)[::3, ::3] > 0
        corners = case.lattice.cells.ravel()
        begin = np.arange(0, len(corners) + 1, 8)
        cells = csr_array((np.ones(len(corners)), corners, begin))
        shares = (cells.T @ cells).toarray() > 0
        for nodes in p.T:
            assert connected_components(shares[np.ix_(nodes, nodes)])[0] == 1


@pytest.mark.parametrize(("side", "sizes"), [(10, [216]), (16, [729, 125])])
def test_the_coarsest_grid_grows_with_the_root_of_the_lattice(side: int, sizes: list[int]):
    with hierarchy(COMM, build(COMM, block(side, side, side)), coarsest=None) as case:
        assert [level.grid.table.total for level in case.multigrid.levels] == sizes


@pytest.mark.parametrize("gap", [1, 2, 3, 4, 6])
def test_gaps_cost_no_iterations(gap: int):
    """If coarse grids join two prongs clamped at their root, iterations quadruple."""
    prong = block(40, 5, 5)
    fork = np.concatenate([prong, at(prong, 0, 5 + gap, 0), block(1, 10 + gap, 5)])
    with hierarchy(COMM, build(COMM, np.unique(fork, axis=0), pins=True), time_step=1e3) as case:
        several = case.iterations(1e-6, rough=False)
    with hierarchy(COMM, build(COMM, prong, pins=True), time_step=1e3) as case:
        single = case.iterations(1e-6, rough=False)
    assert several <= single + 2


def test_hierarchies_of_several_ranks_are_those_of_one():
    """Compare numbers of coarse nodes, P, the matrices of all levels, and the cycle itself."""
    done = run(3, WORKERS / "multigrid_worker.py")
    assert done.returncode == 0 and done.stdout.count("same") == 3, done.stdout + done.stderr
