"""The lattice agrees with its definition by brute force."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lattices import DENSITY, E, H, block, cages_of

from msmpetsc.geometry.cages import Cages
from msmpetsc.geometry.grid import CORNERS
from msmpetsc.lattice.lattice import Lattice, build_lattice
from msmpetsc.scene.body import Material


def springs_by_definition(cells: np.ndarray) -> dict[frozenset, int]:
    """Return every pair of corners of a cell, with the number of cells that share the pair."""
    springs: dict[frozenset, int] = {}
    for cell in cells:
        corners = [tuple(corner) for corner in cell + CORNERS]
        for a in range(8):
            for b in range(a):
                pair = frozenset([corners[a], corners[b]])
                springs[pair] = springs.get(pair, 0) + 1
    return springs


def grid_index(lattice: Lattice, cages: Cages) -> list[tuple[int, ...]]:
    (grid,) = cages.grids.grids
    return [tuple(i) for i in np.rint((lattice.nodes - grid.origin) / grid.cell_size).astype(int)]


@settings(max_examples=30, deadline=None)
@given(st.sets(st.tuples(*[st.integers(0, 3)] * 3), min_size=1, max_size=20))
def test_springs_and_masses_follow_the_definition(cells: set):
    cells = np.array(sorted(cells))
    cages = cages_of(cells)
    lattice = build_lattice(cages, Material(density=DENSITY, young_modulus=E, law="linear"))
    place = grid_index(lattice, cages)
    wanted = springs_by_definition(cells)
    found = [frozenset([place[a], place[b]]) for a, b in lattice.springs]
    assert len(found) == len(set(found)) and set(found) == set(wanted)
    kind = np.array([sum((np.array(a) - b) ** 2) for a, b in map(tuple, found)])
    np.testing.assert_allclose(lattice.rest_length, H * np.sqrt(kind), rtol=1e-14)
    sharing = np.array([wanted[pair] for pair in found])
    # an edge inside a body has 4 cells around it, a face diagonal 2
    of_cell = 4 / 7 * E * H / 40 * np.array([0, 40 / 4, 16 / 2, 9])
    np.testing.assert_allclose(lattice.stiffness, of_cell[kind] * sharing, rtol=1e-14)
    assert lattice.mass.sum() == pytest.approx(DENSITY * H**3 * len(cells), rel=1e-13)
    corner = {tuple(c) for c in cells + 0}
    for node, mass in zip(place, lattice.mass, strict=True):
        around = sum(tuple(np.array(node) - offset) in corner for offset in CORNERS)
        assert mass == pytest.approx(DENSITY * H**3 / 8 * around, rel=1e-13)


@pytest.mark.parametrize("across, excess", [(2, 1 / 2), (4, 1 / 8), (8, 1 / 32)])
def test_the_inertia_of_a_turning_bar_is_too_large_by_two_over_n_squared(
    across: int, excess: float
):
    """The trapezoidal rule for x^2 over n cells of size h gives a^3 / 12 + a h^2 / 6."""
    bar = build_lattice(
        cages_of(block(3, across, across)), Material(density=DENSITY, young_modulus=E)
    )
    x = bar.nodes - bar.nodes.mean(axis=0)
    spin = np.cross([1.0, 0, 0], x)
    twice_energy = bar.mass @ (spin**2).sum(axis=1)
    exact = bar.mass.sum() * (across * H) ** 2 / 6
    assert twice_energy == pytest.approx((1 + excess) * exact, rel=1e-12)


def test_cells_name_their_corners_in_vtk_order():
    cages = cages_of(block(2, 3, 2))
    lattice = build_lattice(cages, Material(density=DENSITY, stiffness=7.0, law="linear"))
    place = np.array(grid_index(lattice, cages))
    np.testing.assert_array_equal(
        place[lattice.cells] - place[lattice.cells][:, :1], np.tile(CORNERS, (12, 1, 1))
    )
    np.testing.assert_array_equal(lattice.stiffness, 7.0)


def test_pins_are_kept_together():
    lattice = build_lattice(
        cages_of(block(2, 1, 1)), Material(density=DENSITY, stiffness=1.0, law="linear")
    )
    left, right = lattice.nodes[:, 0] < 1.1, lattice.nodes[:, 0] > 1.3
    np.testing.assert_array_equal(lattice.pin(left).pin(right).pinned, left | right)
    assert not lattice.pinned.any()
