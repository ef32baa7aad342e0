"""PETSc's options of the cycle: obeyed, or refused in a line."""

from pathlib import Path

import numpy as np
import pytest
from block_scene import CELL, block_scene
from one_process import assert_one_line

SCENE = {
    "sides": np.array([8, 3, 3]) * CELL,
    "gravity": {"acceleration": [0, 0, -9.81]},
    "time": {"step": 0.02, "duration": 0.04},
    "pin": [{"region": {"box": [[0, 0, 0], [0.05, 1, 1]], "relative": True}}],
    "solver": {"preset": "newton-multigrid", "error": 1e-4},
}
# options that go together, and the effect that shows
OBEYED = {
    "-pc_mg_levels 2 -mg_levels_ksp_max_it 2 -mg_coarse_pc_type cholesky "
    "-ksp_view": "MULTIPLICATIVE, levels=2",
    "-pc_mg_levels 3 -pc_mg_cycle_type w -matptap_via scalable -pc_mg_log "
    "-log_view": "MGSmooth Level 1",
    "-pc_mg_type additive -mg_coarse_redundant_pc_type lu": "",
    "-pc_mg_type full -mg_levels_ksp_type richardson": "",
}
REFUSED = {
    "-pc_mg_levels 1": "nearest for this lattice is 2",
    "-pc_mg_levels 9": "nearest for this lattice is",
    "-pc_mg_galerkin both": "PETSc cannot set up the solver",
    "--preset anderson -pc_type mg": "newton's presets",
    "-mg_levels_ksp_typ cg": "no part of this run",
    "-mg_levels_pc_type nonsense": "nonsense",
    "-mg_levels_1_pc_type redistribute": "finest level",
}


@pytest.mark.slow
@pytest.mark.parametrize("ranks", [1, 2])
def test_options_of_the_cycle(msmpetsc, tmp_path: Path, ranks: int):
    path = block_scene(tmp_path, **SCENE)
    for options, shown in OBEYED.items():
        done = msmpetsc(
            ranks, "run", path, "-o", tmp_path / "o.h5", "--overwrite", *options.split(), status=0
        )
        assert not any(
            noise in done.stdout + done.stderr for noise in ("Traceback", "PETSC ERROR", "SEGV")
        ), options
        assert shown in done.stdout, options


@pytest.mark.parametrize("ranks", [1, pytest.param(2, marks=pytest.mark.slow)])
@pytest.mark.parametrize("options", REFUSED)
def test_options_that_cannot_be_are_one_line(msmpetsc, tmp_path: Path, options: str, ranks: int):
    path = block_scene(tmp_path, **SCENE)
    done = msmpetsc(ranks, "run", path, "-o", tmp_path / "o.h5", *options.split())
    assert_one_line(done, 2, REFUSED[options])
