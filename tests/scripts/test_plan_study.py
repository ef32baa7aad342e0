"""The study of plans: what a choice is held against."""

import plan_study
import pytest


@pytest.mark.parametrize(
    ("integrator", "error", "limit", "cells"),
    [("verlet", None, 1e9, [3200, 1500]), ("bdf2", 1e-2, 1e9, [3200, 1500]), ("bdf2", 1e-2, 70, [1500])],
)
def test_a_finer_run_steps_shorter_and_within_the_limit(integrator: str, error: float, limit: float, cells: list[int]):
    """Of a choice of a second: 15 times the cells in a quarter of the step take 60. A trial had 1,200 cells."""
    method = {"integrator": integrator, "time_step": 0.02, "preset": "newton", "step_error": error}
    plan = plan_study.Planned("bunny_fall", 10, method, 100, {"tried": [{"cells": 1200.0}]})
    ways = list(plan.finer(1.0, limit))
    assert [count for count, _ in ways] == cells
    assert ways[0][1]["time_step"] == (0.02 if integrator == "verlet" else 0.005)
    assert ways[0][1]["step_error"] == (None if integrator == "verlet" else 1e-3)
