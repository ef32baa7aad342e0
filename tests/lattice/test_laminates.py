"""Cells that an interface between parts cuts: bars of layers, shares of volume, groups askew."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from block_scene import CELL, DENSITY, SIDES, YOUNG, block_scene, model_of
from laminates import COATS, THREE, Bar, error
from obj_files import write_parts
from small_strain import SPRINGS

from msmpetsc.lattice.lattice import Lattice
from msmpetsc.lattice.material import edge_stiffness

SKIN = Bar((0.0, *COATS), 10, bends=True)
PLY = Bar((0.0, *THREE), 10, bends=False)


def lattice_of(folder: Path, **tables) -> Lattice:
    scene = block_scene(folder, time={"step": 0.01, "duration": 0.01}, **tables)
    return model_of(scene).lattice


def test_coats_of_a_fifth_of_a_cell_bend_a_bar():
    """Coats of a fifth of a cell give a bar its bending stiffness.

    With a single material per cell, by its middle, the bar would be 81% too soft. With means but
    without moments of stiffness it would be 38% too soft.
    """
    assert abs(error(SKIN, 0, 2)) < 0.06
    # a uniform bar is 12% too stiff at 20 degrees with two cells across
    assert abs(error(SKIN, 20, 2)) < 0.12


def test_layers_that_lie_askew_in_the_grid_are_pulled():
    """With a single material per cell, by its middle, the bars would be 20 and 8% too soft."""
    for across, within in ((2, 0.06), (4, 0.03)):
        assert abs(error(PLY, 20, across)) < within


def test_springs_of_cut_cells_bend_and_are_pulled():
    """A uniform bar of springs is 31 and 8% too stiff with two and four cells across."""
    assert abs(error(PLY, 20, 4, SPRINGS)) < 0.06
    assert abs(error(SKIN, 0, 4, SPRINGS)) < 0.1


@pytest.mark.parametrize("place", [0.1, 0.25, 0.31])
@pytest.mark.parametrize("law", ["neo-hookean", "linear"])
def test_mass_is_that_of_the_volumes(tmp_path: Path, place: float, law: str):
    """An interface along the grid, anywhere in a cell: the shares err by at most 1/128."""
    region = {"half_space": {"point": [place, 0, 0], "normal": [1, 0, 0]}}
    part = {"region": region, "density": 3 * DENSITY, "young_modulus": 7 * YOUNG}
    material = {"young_modulus": YOUNG, "density": DENSITY, "law": law}
    lattice = lattice_of(tmp_path, part=[part], material=material)
    section = SIDES[1] * SIDES[2]
    exact = DENSITY * section * (SIDES[0] + 2 * (SIDES[0] - place))
    within = 2 * DENSITY * section * CELL / 128
    assert lattice.mass.sum() == pytest.approx(exact, abs=1.001 * within)


def test_closed_groups_askew_have_their_volumes(tmp_path: Path):
    """Two blocks fill a body that the grid cuts; samples outside the body count for neither."""
    bounds = {"near": [[0, 0, 0], SIDES * [0.4, 1, 1]], "far": [SIDES * [0.4, 0, 0], SIDES]}
    boxes = {name: trimesh.creation.box(bounds=corners) for name, corners in bounds.items()}
    write_parts(tmp_path / "two.obj", boxes)
    turn = {"rotate": {"axis": [1.0, 2.0, 3.0], "degrees": 50.0}}
    parts = [
        {"region": {"group": "near"}, "density": 2 * DENSITY, "young_modulus": 3 * YOUNG},
        {"region": {"group": "far"}, "density": 5 * DENSITY, "young_modulus": 3 * YOUNG},
    ]
    mesh = {"source": "two.obj", "prepare": ["union", turn]}
    lattice = lattice_of(tmp_path, mesh=mesh, part=parts)
    exact = (0.4 * 2 + 0.6 * 5) * DENSITY * SIDES.prod()
    assert lattice.mass.sum() == pytest.approx(exact, rel=3e-3)
    # a negligible volume is of the scene's own material
    stiffness = lattice.cell_stiffness[: lattice.cells_owned].sum()
    exact = edge_stiffness(3 * YOUNG, CELL) * lattice.cell_fill.sum()
    assert stiffness == pytest.approx(exact, rel=1e-3)


def test_a_part_of_other_density_alone_leaves_the_stiffness(tmp_path: Path):
    region = {"half_space": {"point": [0.3, 0, 0], "normal": [1, 0.2, 0.3]}}
    plain, heavy = (
        lattice_of(tmp_path, part=[{"region": region, "density": factor * DENSITY}])
        for factor in (1.0, 3.0)
    )
    np.testing.assert_array_equal(plain.stiffness, heavy.stiffness)
    assert heavy.mass.sum() > 1.5 * plain.mass.sum()
