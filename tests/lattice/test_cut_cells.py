"""Mass and stiffness of cells that the surface cuts, and oblique bodies against elasticity."""

from functools import cache

import numpy as np
import pytest
import small_strain as study
import trimesh
from strains import elastic_constant, uniform_strains
from surfaces import body_of

from msmpetsc.geometry.cages import fill
from msmpetsc.lattice.cut_cells import CORNERS, mass_fractions, spring_fractions
from msmpetsc.lattice.nearest_points import nearest_of_body
from msmpetsc.lattice.topology import topology_of

bar_errors = cache(lambda name, size: study.bar_errors(*BARS[name], size * study.RADIUS, "fill")[1])
BARS = {
    "round": (study.round_bar(), study.ROUND_SAG),
    "turned": (study.turned_bar(), study.SQUARE_SAG),
}


def tilted_box() -> trimesh.Trimesh:
    box = trimesh.creation.box((0.5, 0.35, 0.2))
    return box.apply_transform(trimesh.transformations.rotation_matrix(1.1, [3, 2, 1]))


def test_springs_have_the_mean_fill_of_the_corners_that_agree_with_both_ends():
    fills = np.random.default_rng(0).random((5, 8))
    of_pairs = spring_fractions(fills)
    a, b = 0, int(np.flatnonzero((CORNERS == [1, 0, 0]).all(axis=1))[0])
    np.testing.assert_allclose(of_pairs[:, a, b], fills[:, [a, b]].mean(axis=1))
    diagonal = int(np.flatnonzero((CORNERS == [1, 0, 1]).all(axis=1))[0])
    np.testing.assert_allclose(of_pairs[:, a, diagonal], fills[:, CORNERS[:, 1] == 0].mean(axis=1))
    opposite = int(np.flatnonzero((CORNERS == [1, 1, 1]).all(axis=1))[0])
    np.testing.assert_allclose(of_pairs[:, a, opposite], fills.mean(axis=1))
    np.testing.assert_allclose(mass_fractions(of_pairs).sum(axis=1), fills.sum(axis=1))


def test_uniform_strain_costs_the_energy_of_the_volume_inside():
    """For a box askew in the grid, u^T H u = C volume of any uniform strain.

    Only the least fill of corners causes a difference.
    """
    box = tilted_box()
    lattice = study.lattice_of(box, 0.06, "fill")
    assert lattice.mass.sum() == pytest.approx(study.DENSITY * box.volume, rel=1e-3)
    for _, G, other, exact in uniform_strains():
        assert elastic_constant(lattice, G, other) == pytest.approx(exact, rel=1e-10)


def test_every_node_has_the_mass_that_its_springs_diagonal_says():
    """Masses are proportional to stiffnesses, so explicit steps have the limit of a whole cell.

    CG then also adds no net force.
    """
    lattice = study.lattice_of(tilted_box(), 0.06, "fill")
    assert lattice.mass.min() < 0.01 * lattice.mass.max()
    diagonal = np.bincount(lattice.springs.ravel(), np.repeat(lattice.stiffness, 2))
    np.testing.assert_allclose(diagonal / lattice.mass, diagonal[0] / lattice.mass[0], rtol=1e-12)


# ---- against elasticity


@pytest.mark.slow
@pytest.mark.parametrize("name", BARS)
def test_bars_across_the_grid_sag_as_timoshenkos(name: str):
    """The error is a fifth of the error of whole cells, whose mass is a third too large.

    The bars are nearly as accurate as beams along the grid.
    """
    errors = np.array([bar_errors(name, size) for size in (0.4, 0.25)])
    assert (errors < 0).all() and errors[0].mean() > -0.105 and errors[1].mean() > -0.055
    # the error hardly depends on the place of the grid
    assert np.ptp(errors, axis=1).max() < 0.015
    order = np.polyfit(np.log([0.4, 0.25]), np.log(-errors.mean(axis=1)), 1)[0]
    assert order > 1.4
    whole = study.bar_errors(*BARS[name], 0.4 * study.RADIUS, "whole")
    assert whole[1].mean() < 3 * errors[0].mean() and whole[2].mean() > 0.3


# ---- how far nodes protrude


def test_nodes_stick_out_of_a_ball_by_their_distance_and_meet_a_plane_when_it_does():
    body = body_of(BALL)
    cages = fill([body], 0.2)
    nodes = cages.grids.node_positions(topology_of(cages).ijk)
    outside = np.linalg.norm(
        nodes - nearest_of_body([body], cages, topology_of(cages)).points, axis=1
    )
    np.testing.assert_allclose(outside, np.maximum(np.linalg.norm(nodes, axis=1) - 1, 0), atol=2e-3)
    for normal in np.random.default_rng(0).standard_normal((50, 3)):
        normal /= np.linalg.norm(normal)
        # the first contact with any plane of this normal
        first = (nodes @ normal + outside).min()
        assert -1 - 1e-12 < first < -1 + 0.15 * 0.2


BALL = trimesh.creation.icosphere(4)
