"""A narrow beam near lateral buckling: cells, quadratic hexahedra, a rod (results/solid.md).

The textbook's load, TEXTBOOK, is not the critical load of this beam:

- Its correction for the deflection before buckling assumes uniform bending. A rod bent by the
  load itself buckles at 1.0236 of TEXTBOOK.
- A clamp holds the warping. Hexahedra twist as if 0.383 m at the clamp did not. The rod then
  buckles at 1.071, the hexahedra at 1.072.

So 0.9 of TEXTBOOK is 0.84 of the critical load. There 1% of G J changes the sideways deflection by
2.3%.
"""

import narrow_beam as study
import pytest
from few_cells import torsion_error
from small_strain import NU
from solid_runs import box, held, run

LOAD = 0.9 * study.TEXTBOOK


def test_a_rod_whose_clamp_holds_the_warping_buckles_as_hexahedra():
    """The rod agrees with hexahedra if its clamp holds the warping and its load bends it."""
    assert study.rod_critical() / study.TEXTBOOK == pytest.approx(1.0236, abs=1e-3)
    rod = study.rod_critical(study.HELD) / study.TEXTBOOK
    assert rod == pytest.approx(study.CRITICAL, rel=0.003)
    assert study.rod_sideways(LOAD, study.HELD) == pytest.approx(study.SIDEWAYS, rel=0.01)


@pytest.mark.slow
def test_hexahedra_buckle_where_the_finest_do():
    """Two hexahedra across the width have a G J that is 0.3% too large."""
    beam = study.Hexahedra(2, 6, 0.125)
    assert study.shortening(beam) == pytest.approx(study.HELD, abs=0.005)
    assert study.critical(beam) / study.TEXTBOOK == pytest.approx(1.0018 * study.CRITICAL, rel=1e-3)


def test_a_lattice_buckles_late_by_its_torsion():
    """Two cells across buckle 2% late, because their G J is 3.5% too large.

    Cells bend exactly, but trilinear functions cannot represent the warping at the edges of a
    strip.
    """
    error = torsion_error(2, NU, 4)
    assert error == pytest.approx(0.035, abs=0.002)
    ratio = study.critical(study.LatticeBeam(2)) / study.TEXTBOOK / study.CRITICAL
    rod = study.rod_critical(study.HELD, study.TWIST * (1 + error)) / study.rod_critical(study.HELD)
    assert ratio == pytest.approx(rod, abs=0.004)
    assert 1.018 < ratio < 1.026


def test_a_run_near_buckling_goes_sideways_as_its_critical_load_says():
    """Near buckling an error of 2% in the critical load grows to 8% of the sideways deflection."""
    force = held(0, study.LENGTH, 1) | {"total": [0, study.ASIDE * LOAD, -LOAD]}
    end = run(
        box(study.LENGTH, study.WIDTH, study.HEIGHT),
        NU,
        cages={"cell_size": study.WIDTH / 2},
        pin=[held(0, 0, -1)],
        force=[force],
    ).moved(study.LENGTH)
    assert end[1] / study.SIDEWAYS - 1 == pytest.approx(-0.08, abs=0.01)
    assert end[1] == pytest.approx(study.sideways(study.LatticeBeam(2), LOAD), rel=0.003)
