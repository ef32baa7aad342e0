"""Pins and anchors of single components: halves of bodies, plane strain, uniaxial stress."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from block_scene import (
    CLAMP,
    EPS,
    GRAVITY,
    SIDES,
    block_scene,
    box_at,
    half_space,
    plane_at,
    play,
    roller,
    solid_of,
)
from one_process import command_error
from scipy.optimize import fsolve

SOLID = solid_of(1e5, 0.3)
MU, LAMBDA = 1e5 / 2.6, 3e4 / (1.3 * 0.4)
HALF = SIDES * [1, 0.5, 1]
MULTIGRID = {"preset": "newton-multigrid", "error": 1e-10}
JACOBI = {"preset": "newton", "error": 1e-10}


LIFT = {
    "region": half_space(0, 0.5 - EPS, 1),
    "fix": ["z"],
    "path": [{"time": 0.02, "by": [9, 9, 0.02]}],
    "stop": 0.03,
}
SYMMETRIC = {"pin": [CLAMP], "gravity": {"acceleration": [0.5, 0, -9.81]}, "material": SOLID}
CASES = {
    "static, multigrid": {"time": {"integrator": "static"}, "solver": MULTIGRID},
    "static, springs": {
        "time": {"integrator": "static"}, "solver": MULTIGRID,
        "material": {"young_modulus": 1e5, "density": 1000.0},
    },
    "led, Jacobi": {"time": {"step": 0.01, "duration": 0.05}, "solver": JACOBI, "anchor": [LIFT]},
    "led, BDF2": {
        "time": {"step": 0.01, "duration": 0.05, "integrator": "bdf2"},
        "solver": MULTIGRID, "anchor": [LIFT],
    },
    "led, Verlet": {
        "time": {"step": 0.01, "duration": 0.05, "integrator": "verlet"}, "anchor": [LIFT],
    },
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_half_a_body_is_half_of_the_whole(tmp_path: Path, case: str):
    """Half a body moves as the whole; its plane of symmetry is its upper side y = 0.25."""
    tables = SYMMETRIC | CASES[case]
    (model, frames), (of_half, ends) = (
        play(block_scene(tmp_path, sides, name, **tables | {"pin": [CLAMP, *more]}))
        for name, sides, more in (
            ("whole", SIDES, []), ("half", HALF, [roller(1, 0.25 - EPS, 1)])
        )
    )  # fmt: skip
    rest = model.lattice.nodes
    twins = np.linalg.norm(of_half.lattice.nodes[:, None] - rest, axis=2).argmin(axis=1)
    size = np.abs(frames[-1].position - rest).max()
    assert np.abs(frames[-1].position[twins] - ends[-1].position).max() < 1e-8 * size
    assert sum(f.ksp_its for f in ends) <= 1.1 * sum(f.ksp_its for f in frames) + 3
    for a, b in zip(frames[1:], ends[1:], strict=True):
        force, of_plane = a.reaction.sum(axis=0)[[0, 2]], b.reaction[1]
        half_of_it = b.reaction.sum(axis=0)[[0, 2]]
        np.testing.assert_allclose(2 * half_of_it, force, atol=1e-7 * np.abs(force).max())
        assert of_plane[1] != 0 and (of_plane[[0, 2]] == 0).all()


FLOOR = plane_at(-0.002)
DROP = {"gravity": GRAVITY, "start": {"velocity": [0.1, 0, -0.5]}}
MIDDLE = {"region": {"box": [[-1, 0.25 - EPS, -1], [1, 0.25 + EPS, 1]]}, "fix": ["y"]}


@pytest.mark.parametrize(
    ("integrator", "floor"),
    [
        ("implicit-euler", {"response": "penalty", "friction": 0.3}),
        ("bdf2", {"response": "reflect", "restitution": 0.5}),
        ("verlet", {"response": "penalty", "friction": 0.3}),
        ("verlet", {"response": "exchange"}),
    ],
)
def test_a_plane_of_symmetry_needs_no_roller(tmp_path: Path, integrator: str, floor: dict):
    """A symmetric block that lands on a floor moves alike with and without rollers."""
    (model, frames), (_, held) = (
        play(
            block_scene(
                tmp_path, material=SOLID, pin=pin, obstacle=[FLOOR | floor], **DROP,
                time={"step": 0.005, "duration": 0.03, "integrator": integrator},
                solver={"preset": "newton", "error": 1e-10},
            )
        )
        for pin in ([], [MIDDLE])
    )  # fmt: skip
    assert model.start[1].any()
    a, b = frames[-1].position, held[-1].position
    np.testing.assert_allclose(b, a, atol=1e-8)
    assert np.abs(a - model.lattice.nodes).max() > 1e-3
    assert np.abs(held[-1].reaction).max() < 1e-5


def test_forces_on_a_held_body_that_lies_on_a_barrier_add_up(tmp_path: Path):
    """For half a body on a floor, loads, reactions and pushes sum to the rate of momentum."""
    floor = box_at([[-1, -1, -0.2], [1, 2, -0.002]], response="barrier")
    scene = block_scene(
        tmp_path, HALF, material=SOLID, pin=[roller(1, 0.25 - EPS, 1)], obstacle=[floor], **DROP,
        time={"step": 0.01, "duration": 0.04}, solver={"preset": "newton", "error": 1e-9},
    )  # fmt: skip
    _, frames = play(scene)
    pushed = max(np.abs(frame.push).max() for frame in frames)
    assert pushed > 100
    for before, after in pairwise(frames):
        rate = (after.momentum - before.momentum) / 0.01
        total = after.load + after.reaction.sum(axis=0) + after.push.sum(axis=0)
        assert total == pytest.approx(rate, abs=1e-5 * pushed)


@pytest.mark.parametrize("solver", [MULTIGRID, JACOBI], ids=["multigrid", "Jacobi"])
def test_plane_strain_has_the_stretches_of_its_closed_form(tmp_path: Path, solver: dict):
    """A slab between two smooth walls, pulled along x by 20% of Young's modulus."""
    pull = 2e4
    force = {"region": half_space(0, 0.5 - EPS, 1), "total": [pull * 0.125, 0, 0]}
    scene = block_scene(
        tmp_path, material=SOLID, time={"integrator": "static"}, solver=solver, force=[force],
        pin=[roller(0), roller(1), roller(2, 1.0)],
    )  # fmt: skip
    model, frames = play(scene)

    def stress(x):
        a, b = x
        volumetric = LAMBDA * (a * b - 1)
        return MU * (a - 1 / a) + volumetric * b - pull, MU * (b - 1 / b) + volumetric * a

    along, across = fsolve(stress, (1.1, 0.9), xtol=1e-14)
    exact = model.lattice.nodes * [along, across, 1]
    np.testing.assert_allclose(frames[-1].position, exact, atol=1e-9)
    x, y, walls = frames[-1].reaction
    assert x == pytest.approx([-pull * 0.125, 0, 0], abs=1e-5)
    assert np.abs([y, walls]).max() < 1e-5


def test_an_anchor_of_a_component_leaves_the_others_free(tmp_path: Path):
    """A block pulled along z between smooth grips is under uniaxial stress."""
    lift = {
        "region": half_space(2, 0.25 - EPS, 1),
        "fix": ["z"],
        "path": [{"time": 1, "by": [5, 5, 0.1]}],
    }
    scene = block_scene(
        tmp_path, material=SOLID, solver=MULTIGRID, anchor=[lift],
        time={"integrator": "static", "step": 1.0, "duration": 1.0},
        pin=[roller(0), roller(1), roller(2)],
    )  # fmt: skip
    model, frames = play(scene)
    along = 1.4
    across = fsolve(lambda b: MU * (b - 1 / b) + LAMBDA * (along * b**2 - 1) * along * b, 0.9)[0]
    exact = model.lattice.nodes * [across, across, along]
    np.testing.assert_allclose(frames[-1].position, exact, atol=1e-9)
    force = 0.25 * (MU * (along - 1 / along) + LAMBDA * (along * across**2 - 1) * across**2)
    np.testing.assert_allclose(frames[-1].reaction[[2, 3], 2], [-force, force], rtol=1e-8)
    assert np.abs(frames[-1].reaction[3, :2]).max() == 0


def test_a_slab_between_walls_falls_freely(tmp_path: Path):
    """A slab held along y alone falls as a free body does by implicit Euler."""
    scene = block_scene(
        tmp_path, material=SOLID, pin=[roller(1, 1.0)], solver=MULTIGRID | {"error": 1e-6},
        time={"step": 0.1, "duration": 0.3}, gravity={"acceleration": [1, 2, -9]},
        start={"velocity": [0.5, 7, 0], "scale": [1.1, 1.0, 1.0]},
    )  # fmt: skip
    model, frames = play(scene)
    mass, q = model.lattice.mass, np.array([frame.position for frame in frames])
    moved = np.einsum("n,tnc->tc", mass, q - q[0]) / mass.sum()
    steps = np.arange(4)
    fall = 0.1**2 * steps * (steps + 1) / 2
    exact = np.outer(fall, [1, 0, -9]) + np.outer(0.1 * steps, [0.5, 0, 0])
    np.testing.assert_allclose(moved, exact, atol=1e-9)
    assert (q[..., 1] == q[0, :, 1]).all()


@pytest.mark.parametrize(
    ("pin", "time", "message"),
    [
        ({"fix": ["w"]}, {}, "pin.0.fix.0: must be 'x', 'y' or 'z'"),
        ({"fix": []}, {}, "pin.0.fix: must name one to three components"),
        ({"fix": ["x", "z"]}, {"integrator": "static"}, "the body is held by nothing along y"),
    ],
)
def test_bad_input_is_one_line(tmp_path: Path, pin: dict, time: dict, message: str):
    scene = block_scene(
        tmp_path, material=SOLID, pin=[CLAMP | pin],
        time=time or {"step": 0.01, "duration": 0.01},
    )  # fmt: skip
    assert message in command_error("run", scene)


def test_the_matrix_of_whole_nodes_is_refused(tmp_path: Path):
    scene = block_scene(tmp_path, pin=[roller(0)], time={"step": 0.01, "duration": 0.01})
    said = command_error("run", scene, "--set", 'solver.preset="fast-msm"')
    assert "pin.0.fix: single components need one of newton's presets, not fast-msm" in said


def test_a_plane_strain_body_on_rollers_alone_comes_to_rest_at_once(tmp_path: Path):
    """The solver finds no mode without stiffness, because rollers hold the translation along z."""
    press = {"region": {"box": [[0.5 - EPS, -9, -9], [9, 9, 9]]}, "value": [-2e4, 0.0, 0.0]}
    path = block_scene(
        tmp_path, SIDES,
        pin=[roller(2, 9.0), roller(0), roller(1)], traction=[press], material=SOLID,
        time={"integrator": "static"}, solver={"error": 1e-6},
    )  # fmt: skip
    _, frames = play(path)
    assert frames[-1].iterations < 20 and frames[-1].ksp_its < 200
