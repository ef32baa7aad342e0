"""The neo-Hookean solid as the product runs it, against theory (msmpetsc/elasticity/README.md has the tables)."""

import numpy as np
import pytest
import solid_study as study


@pytest.mark.parametrize("poisson", study.POISSON)
def test_a_cantilever_two_cells_thick_bends_as_timoshenkos(poisson: float):
    """Whatever Poisson's ratio: springs are 24% off."""
    assert study.sag_error(2, poisson) == pytest.approx(0, abs=0.04)


@pytest.mark.parametrize(("poisson", "iterations"), [(0.25, 40), (0.49, 100)])
def test_an_elastica_two_cells_thick_ends_where_it_should(poisson: float, iterations: int):
    """P L^2 / (E I) = 5: the tip is 0.71379 L down, 0.38763 L back; springs are 9% of the length off. All at once."""
    of = study.elastica(2, poisson)
    back, _, down = -of.moved(study.LENGTH) / study.LENGTH
    assert np.hypot(down - study.DOWN, back - study.BACK) < 0.015 and of.iterations < iterations


@pytest.mark.parametrize("poisson", [0.25, 0.49])
def test_a_bar_pressed_to_30_percent_comes_back(poisson: float):
    cages, pin = {"cell_size": 1 / 2}, [study.held(0, 0, -1)]
    of = study.run(study.box(4, 1, 1), poisson, cages=cages, pin=pin, start={"scale": [0.3, 1, 1]})
    assert np.abs(of.frames[-1].position - of.lattice.nodes).max() < 1e-5
    assert of.iterations < 60 and of.frames[-1].inverted == 0
