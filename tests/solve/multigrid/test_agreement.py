"""Frames by multigrid agree with frames by Jacobi's preconditioner to the error asked for."""

from pathlib import Path

import numpy as np
import pytest
from block_scene import CELL, block_scene, plane_at, play

ERROR, STEPS, STEP = 1e-6, 6, 0.01
HELD = [{"region": {"box": [[0, 0, 0], [0.05, 1, 1]], "relative": True}}]
FAR = {"box": [[0.95, 0, 0], [1, 1, 1]], "relative": True}
LED = [{"region": FAR, "path": [{"time": 4 * STEP, "by": [0.05, 0, 0.05]}], "stop": 5 * STEP}]
FLOOR = plane_at(-0.01, response="penalty", friction=0.4)
FALLING = {"start": {"velocity": [0.5, 0, -1.5]}, "obstacle": [FLOOR]}
SOFT = {"young_modulus": 1e5, "density": 1000.0}
TIME = {"step": STEP, "duration": STEPS * STEP}
CASES = {
    "held": {"pin": HELD},
    "led and let go": {"pin": HELD, "anchor": LED},
    "touching": FALLING,
    "bdf2": {"pin": HELD, "time": TIME | {"integrator": "bdf2"}},
    "substep": FALLING | {"safety": {"on_failure": "substep"}},
    "fallback": FALLING | {"safety": {"on_failure": "fallback"}},
}


# each case takes about ten seconds
QUICK = {"touching"}


@pytest.mark.parametrize(
    "case",
    [case if case in QUICK else pytest.param(case, marks=pytest.mark.slow) for case in CASES],
)
def test_frames_are_those_by_jacobi(petsc_options, tmp_path: Path, case: str):
    """Frames agree with several coarse levels; errors of N steps sum to N (N + 1) / 2 errors."""
    base = {
        "sides": np.array([8, 3, 3]) * CELL,
        "material": SOFT,
        "time": TIME,
        "solver": {"error": ERROR},
    }
    path = block_scene(
        tmp_path, **base | {"gravity": {"acceleration": [0, 1.0, -9.81]}} | CASES[case]
    )

    def positions(preset: str, **options: str) -> np.ndarray:
        petsc_options(**options)
        _, frames = play(path, f'solver.preset="{preset}"')
        assert np.nanmax([frame.step_error for frame in frames]) <= ERROR
        return np.array([frame.position for frame in frames])

    by_jacobi = positions("newton", pc_type="jacobi")
    by_multigrid = positions("newton-multigrid", pc_type="mg", pc_mg_levels="3")
    far = np.abs(by_jacobi - by_jacobi[0]).max()
    assert far > 1e-3
    np.testing.assert_allclose(
        by_multigrid, by_jacobi, rtol=0, atol=ERROR * STEPS * (STEPS + 1) / 2 * far
    )
