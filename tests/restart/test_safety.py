"""Faults that a run detects in its steps, and its response to a failed step."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from block_scene import CELL, CLAMP, GRAVITY, block_scene, clamped_beam, plane_at, play
from failing_steps import Failing

from msmpetsc.errors import StepFailed
from msmpetsc.fields import Frame
from msmpetsc.solve import recovery
from msmpetsc.solve.nonlinear.functional import StepProblem
from msmpetsc.solve.nonlinear.step import Stepper

STEP, STEPS = 1 / 60, 6
TIME = {"step": STEP, "duration": STEPS * STEP}


def beam(folder: Path, **tables) -> Path:
    return clamped_beam(folder, **{"time": TIME} | tables)


def of(frames: list[Frame], name: str) -> np.ndarray:
    return np.array([getattr(frame, name) for frame in frames])


@pytest.mark.parametrize("integrator", ["implicit-euler", "bdf2", "verlet"])
def test_a_swing_gains_nothing(tmp_path: Path, integrator: str):
    """Implicit Euler only loses energy.

    With explicit substeps and BDF2 the energy varies by a few percent.
    """
    _, frames = play(beam(tmp_path, time=TIME | {"integrator": integrator}))
    # energy from the weight [J]
    worked = of(frames, "potential")[0] - of(frames, "potential").min()
    assert worked > 0
    assert (
        of(frames, "energy_gained").sum()
        <= (1e-9 if integrator == "implicit-euler" else 0.2) * worked
    )


@pytest.mark.parametrize("integrator, share", [("implicit-euler", 1e-6), ("bdf2", 0.01)])
def test_a_led_and_dragged_body_gains_nothing(tmp_path: Path, integrator: str, share: float):
    """The work of anchors and obstacles counts: a rough plate is pressed in and pulled away."""
    time = TIME | {"integrator": integrator, "step": STEP / 4 if integrator == "bdf2" else STEP}
    floor = plane_at(response="penalty", friction=0.8)
    floor |= {"path": [{"time": 0.05, "by": [0, 0, 0.01]}, {"time": 0.1, "by": [0.4, 0, 0.01]}]}
    lead = {"region": CLAMP["region"], "path": [{"time": 0.1, "by": [0.1, 0, 0]}]}
    for more in ({"obstacle": [floor], "gravity": GRAVITY}, {"anchor": [lead]}):
        _, frames = play(block_scene(tmp_path, time=time, **more))
        assert of(frames, "elastic").max() > 1e-4
        assert of(frames, "energy_gained").sum() <= share * of(frames, "elastic").max()


class Overshooting:
    """Solver whose steps overshoot by a share from the first step on, so that the error grows."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, share: float):
        step = Stepper.step

        def overshooting(stepper: Stepper, problem: StepProblem, *given, **named):
            result = step(stepper, problem, *given, **named)
            if stepper.options.prefix or not np.isclose(stepper.functional.t2, STEP**2):
                return result
            return replace(result, position=result.position + share * (result.position - problem.y))

        monkeypatch.setattr(Stepper, "step", overshooting)


def test_a_run_that_gains_energy_without_end_is_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Forces act three times as long as they should, in steps far beyond the explicit limit."""
    Overshooting(monkeypatch, 2.0)
    told = (
        r"frame \d+ \(.* gained .* J from nowhere, of .* J that were there: worst at node \d+, "
        r"at rest at \("
    )
    with pytest.raises(StepFailed, match=told) as caught:
        play(beam(tmp_path, time={"step": STEP, "duration": 1.0}))
    assert caught.value.kind == "energy" and 1 < caught.value.frame < 60


@pytest.mark.parametrize("way", ["fallback", "substep"])
def test_rescue_carries_such_a_run_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, way: str):
    """Steps that gained too much energy are repeated, and the beam stays together."""
    Overshooting(monkeypatch, 2.0)
    _, frames = play(
        beam(tmp_path, time={"step": STEP, "duration": 0.5}), f"safety.on_failure={way}"
    )
    assert len(frames) == 31 and of(frames, f"{way}s").sum() > 0
    # the beam is 1 m long
    assert np.abs(frames[-1].position).max() < 1.5


def test_a_step_that_is_not_finite_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    step = Stepper.step
    monkeypatch.setattr(
        Stepper,
        "step",
        lambda *given: replace(step(*given), position=step(*given).position * np.nan),
    )
    with pytest.raises(StepFailed, match="not finite"):
        play(beam(tmp_path))


def test_inverted_cells_are_counted_and_told_with_their_place(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    """All 32 cells of a mirrored block stay inverted, which a warning says once."""
    scene = block_scene(tmp_path, time=TIME, start={"scale": [-1.0, 1.0, 1.0]})
    _, frames = play(scene)
    assert of(frames, "inverted").tolist() == [32] * (STEPS + 1)
    first, last = (
        record.getMessage() for record in caplog.records if "inside out" in record.getMessage()
    )
    assert first.startswith("frame 0 ") and "32 cells" in first and "neo-hookean" in first
    assert "in 7 frames" in last
    caplog.clear()
    solid = {"young_modulus": 1e5, "density": 1e3, "law": "neo-hookean"}
    play(block_scene(tmp_path, time=TIME, start={"scale": [-1.0, 1.0, 1.0]}, material=solid))
    # no step has turned the cells
    assert "[start] puts them so" in caplog.text and "time.step" not in caplog.text


def test_only_the_cell_that_is_turned_is_counted(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    """A corner of a block is moved through its cell beyond the opposite corner."""
    corner = {"region": {"sphere": {"center": [0, 0, 0], "radius": 0.01}}}
    corner["path"] = [{"time": STEP, "by": [1.2 * CELL] * 3}]
    _, frames = play(
        block_scene(
            tmp_path, time=TIME, anchor=[corner], material={"young_modulus": 1e5, "density": 1e6}
        )
    )
    assert frames[0].inverted == 0 and frames[1].inverted == 1
    place = ", ".join(f"{CELL / 2:.4g}" for _ in range(3))
    assert any(
        f"1 cell is inside out, the worst at rest at ({place}) m" in r.getMessage()
        for r in caplog.records
    )


def test_a_budget_that_ends_far_off_is_told_once_and_summed_up(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    scene = beam(tmp_path, material={"young_modulus": 1e8, "density": 1000.0})
    _, frames = play(scene, "solver={preset='fast-msm', max_iterations=1}")
    far = [frame.index for frame in frames if frame.step_error > 0.3]
    first, last = (
        record.getMessage() for record in caplog.records if "off " in record.getMessage()
    )
    assert len(far) >= 2 and first.startswith(f"frame {far[0]} (")
    assert f"in {len(far)} frames" in last


def test_stop_is_the_default(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    Failing(monkeypatch, {3})
    with pytest.raises(StepFailed, match=r"frame 3 \(t = 0.05 s\) did not converge") as caught:
        play(beam(tmp_path))
    assert (caught.value.kind, caught.value.frame) == ("line search", 3)


def test_a_failed_step_is_halved_and_whole_steps_follow(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Step 3 fails as a whole and as a half, then succeeds in two quarters and a half.

    Call 3 is the whole step, call 4 its first half, call 5 the first quarter. Step 4 is taken in
    halves, then steps are whole again.
    """
    failing = Failing(monkeypatch, {3, 4})
    _, frames = play(beam(tmp_path), "safety.on_failure=substep")
    assert of(frames, "substeps").tolist() == [0, 0, 0, 3, 2, 0, 0]
    assert not of(frames, "fallbacks").any()
    assert failing.count == 2 + 1 + 1 + 3 + 2 + 1 + 1


def test_steps_in_halves_are_those_of_half_the_time_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """A rescued first step equals two steps of t / 2 in position and velocity."""
    scene = beam(tmp_path)
    _, half = play(scene, f"time.step={STEP / 2}")
    Failing(monkeypatch, {1})
    _, frames = play(scene, "safety.on_failure=substep")
    moved = np.abs(half[2].position - half[0].position).max()
    np.testing.assert_allclose(frames[1].position, half[2].position, atol=1e-8 * moved)
    assert frames[1].kinetic == pytest.approx(half[2].kinetic, rel=1e-7)


def test_the_robust_method_finds_the_same_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    scene = beam(tmp_path)
    _, usual = play(scene)
    failing = Failing(monkeypatch, {3})
    _, frames = play(scene, "safety.on_failure=fallback")
    assert of(frames, "fallbacks").tolist() == [0, 0, 0, 1, 0, 0, 0]
    assert failing.prefixes[3] == recovery.PREFIX and set(failing.prefixes[4:]) == {""}
    moved = np.abs(usual[-1].position - usual[0].position).max()
    np.testing.assert_allclose(frames[-1].position, usual[-1].position, atol=1e-7 * moved)


def test_what_no_halving_mends_stops_with_the_number_of_pieces(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    Failing(monkeypatch, set(range(2, 100)))
    with pytest.raises(StepFailed, match=r"frame 2 .*\(and failed in 1024 pieces\)"):
        play(beam(tmp_path), "safety.on_failure=substep")


def test_a_rescued_explicit_or_bdf2_step_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """BDF2 begins anew after the step, so the error is still that of a first-order step."""
    scene = beam(tmp_path, time=TIME | {"integrator": "bdf2"})
    _, usual = play(scene)
    Failing(monkeypatch, {4})
    _, frames = play(scene, "safety.on_failure=substep")
    assert of(frames, "substeps").sum() == 2
    moved = np.abs(usual[-1].position - usual[0].position).max()
    assert 1e-6 * moved < np.abs(frames[-1].position - usual[-1].position).max() < 0.1 * moved
