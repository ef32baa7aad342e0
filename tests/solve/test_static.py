"""Statics: equilibria against closed forms and against motions at rest; refusals; load steps."""

from pathlib import Path

import numpy as np
import pytest
from block_scene import YOUNG, G, block_scene, plane_at, play
from lattices import COMM, one_spring
from one_process import input_error

from msmpetsc.errors import InputError, StepFailed
from msmpetsc.scene.reading import load_scene
from msmpetsc.solve.integrators import static
from msmpetsc.solve.integrators.static import LoadPath
from msmpetsc.solve.nonlinear.functional import StepProblem
from msmpetsc.solve.nonlinear.step import Stepper, StepResult
from msmpetsc.solve.presets import find_preset
from msmpetsc.solve.recovery import Halving

# sides [m]: 2 x 2 x 16 cells
COLUMN = np.array([0.25, 0.25, 2.0])
TOP = {"box": [[-9, -9, 1.99], [9, 9, 9]]}
BOTTOM = {"box": [[-9, -9, -9], [9, 9, 0.01]]}
STATE = {"step": 1.0, "duration": 1.0, "integrator": "static"}
TIGHT = {"preset": "newton", "error": 1e-8}
BEAM = {"pin": [{"region": BOTTOM}], "gravity": {"acceleration": [0.0, 1.0, -0.5]}}
# force to one side, to the other side, and none
SWITCHED = [
    {"region": TOP, "total": [1.0, 0.0, 0.0], "stop": 3.0},
    {"region": TOP, "total": [-1.0, 0.0, 0.0], "start": 3.0, "stop": 5.0},
]
# buckling load of a clamped column [N]
EULER = np.pi**2 / 4 * YOUNG * COLUMN[0] ** 4 / 12 / COLUMN[2] ** 2


def column(folder: Path, time: dict = STATE, **tables) -> Path:
    return block_scene(folder, COLUMN, time=time, solver=TIGHT, **tables)


def moved(model, frame) -> np.ndarray:
    """Return the mean displacement (3,) [m] of the top."""
    top = model.lattice.nodes[:, 2] > COLUMN[2] - 0.01
    return (frame.position - model.lattice.nodes)[top].mean(axis=0)


@pytest.mark.parametrize("preset", ["newton", "newton-multigrid", "lbfgs", "fast-msm"])
def test_a_mass_hangs_on_a_spring(preset: str):
    """The mass hangs at r + m g / k; M has no influence."""
    m, k, r = 2.0, 300.0, 0.5
    stepper = Stepper(COMM, one_spring(m, k, r), 0.3, find_preset(preset), 1e-9, static=True)
    stepper.set_up()
    nodes = stepper.lattice.nodes
    load = np.array([[0.0, 0, 0], [0, 0, m * G]])
    end = stepper.step(StepProblem(nodes, nodes, load), nodes).position[1, 2]
    stepper.destroy()
    assert end == pytest.approx(r + m * G / k, rel=1e-9)


def test_states_under_forces_that_come_and_go(tmp_path: Path):
    """Each time has its state. States under the same loads are equal and take no iteration."""
    states = STATE | {"duration": 6.0}
    model, frames = play(column(tmp_path, states, pin=[{"region": BOTTOM}], force=SWITCHED))
    there, back, rest = (moved(model, frames[n]) for n in (1, 3, 5))
    assert there[0] > 0.05 and back * [1, 1, 1] == pytest.approx(there * [-1, 1, 1], abs=1e-7)
    assert np.abs(rest).max() < 1e-7
    for first, second in ((1, 2), (3, 4), (5, 6)):
        assert np.array_equal(frames[first].position, frames[second].position)
        assert frames[first].iterations > 0 == frames[second].iterations == frames[second].products


def test_anchors_lead_from_state_to_state_and_let_go(tmp_path: Path):
    anchor = {"region": TOP, "path": [{"time": 2.0, "by": [0.0, 0.8, -0.4]}], "stop": 3.0}
    states = STATE | {"duration": 3.0}
    model, frames = play(column(tmp_path, states, pin=[{"region": BOTTOM}], anchor=[anchor]))
    assert moved(model, frames[1]) == pytest.approx([0, 0.4, -0.2])
    assert moved(model, frames[2]) == pytest.approx([0, 0.8, -0.4])
    assert np.abs(frames[3].position - model.lattice.nodes).max() < 1e-6


def test_an_obstacle_presses(tmp_path: Path):
    """The obstacle's forces k d sum to the force of a column that is only guided at the top."""
    plane = plane_at(0.01, response="penalty", stiffness=1e3)
    guide = [{"region": TOP, "path": [{"time": 1.0, "by": [0.0, 0.0, 0.0]}]}]
    model, frames = play(column(tmp_path, anchor=guide, obstacle=[plane]))
    bottom = model.lattice.nodes[:, 2] < 0.01
    depth = 0.01 - frames[-1].position[bottom, 2]
    # axial stiffness [N/m]
    along = YOUNG * COLUMN[0] ** 2 / COLUMN[2]
    assert (depth > 0).all()
    assert 1e3 * depth.sum() == pytest.approx(along * (0.01 - depth.mean()), rel=0.03)


POINT, EDGE = (
    {"pin": [{"region": {"box": [[-0.01, -0.01, -0.01], [0.01, 0.01, top]]}}]} for top in (0.01, 9)
)
ON_A_LINE = "held at a point or on a line"


@pytest.mark.parametrize(
    "tables, words", [({}, "held by nothing"), (POINT, ON_A_LINE), (EDGE, ON_A_LINE)]
)
def test_a_body_that_may_turn_or_move_is_refused(tmp_path: Path, tables: dict, words: str):
    scene = column(tmp_path, gravity={"acceleration": [0.0, 0.0, -0.1]}, **tables)
    assert words in input_error(lambda: play(scene))


PLANE = plane_at()
OF_MOTION = {
    "no velocity": {"start": {"velocity": [0.0, 0.0, 1.0]}},
    "gradient or swirl": {"start": {"gradient": [[0, 1, 0]] * 3}},
    "nothing strikes it": {"obstacle": [PLANE]},
    "no friction": {"obstacle": [PLANE | {"response": "penalty", "friction": 0.1}]},
}


@pytest.mark.parametrize("words", OF_MOTION)
def test_what_only_motion_has_is_refused(tmp_path: Path, words: str):
    with pytest.raises(InputError, match=words):
        load_scene(column(tmp_path, pin=[{"region": BOTTOM}], **OF_MOTION[words]))


@pytest.mark.parametrize("sideways", [0.0, 1e-3])
@pytest.mark.parametrize("share, buckles", [(0.8, False), (2.0, True)])
def test_a_column_buckles(tmp_path: Path, sideways: float, share: float, buckles: bool):
    """Beyond Euler's load the column leaves its straight state, also without a side force.

    That state is a saddle. Its own bending is stiffer by 169/140 (h/b)^2.
    """
    force = [{"region": TOP, "total": [sideways * EULER, 0.0, -share * EULER]}]
    model, frames = play(column(tmp_path, pin=[{"region": BOTTOM}], force=force))
    aside = np.hypot(*moved(model, frames[-1])[:2])
    assert (aside > 0.5) == buckles
    assert frames[-1].step_error < 1e-7


def test_a_load_comes_on_in_steps_and_ends_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Applied at once or in load steps, the load leads to the same equilibrium."""
    _, at_once = play(column(tmp_path, **BEAM))
    monkeypatch.setattr(static, "Halving", lambda: Halving(3))
    _, in_parts = play(column(tmp_path, **BEAM))
    assert np.abs(at_once[-1].position - in_parts[-1].position).max() < 1e-7
    assert in_parts[-1].iterations > at_once[-1].iterations


def test_shares_of_a_load():
    steps, tried = Halving(), []
    succeeds = iter((False, False, True, True, False, True, True))

    def take() -> None:
        tried.append(steps.end)
        if not next(succeeds):
            raise StepFailed("failed")

    steps.run(take)
    assert tried == [1.0, 0.5, 0.25, 0.75, 1.0, 0.875, 1.0]
    assert steps.reached == 1.0 and steps.count == 4


@pytest.mark.parametrize("on_failure", ["fallback", "substep"])
def test_a_state_that_fails_is_found_another_way(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, on_failure: str
):
    """The fallback preset finds the state, or substeps do, in which anchors move by parts."""
    anchor = [{"region": TOP, "path": [{"time": 1.0, "by": [0.0, 0.05, 0.0]}]}]
    tables = {"pin": [{"region": BOTTOM}], "anchor": anchor}
    _, usual = play(column(tmp_path, **tables))
    try_share = LoadPath.try_share

    def fails_at_first(path: LoadPath, steps: Halving) -> StepResult:
        if path.time_step == STATE["step"] and path.stepper.preset is find_preset("newton"):
            raise StepFailed("failed")
        return try_share(path, steps)

    monkeypatch.setattr(LoadPath, "try_share", fails_at_first)
    _, frames = play(column(tmp_path, **tables, safety={"on_failure": on_failure}))
    assert (frames[-1].fallbacks if on_failure == "fallback" else frames[-1].substeps) > 0
    assert np.abs(frames[-1].position - usual[-1].position).max() < 1e-7
    assert frames[-1].kinetic == 0
