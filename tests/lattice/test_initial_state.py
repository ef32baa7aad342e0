"""How a body starts: positions and velocities, the same on any number of ranks."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from block_scene import CELL, DENSITY, GRAVITY, SIDES, block_scene, loop_of, play, solid_of
from conftest import result_on, run
from mpi4py import MPI

from msmpetsc.build import Model, build_model
from msmpetsc.errors import InputError
from msmpetsc.fields import Frame
from msmpetsc.results.checkpoint_reader import end_of_run
from msmpetsc.scene.reading import load_scene

T = 1 / 128
MIDDLE, MASS = SIDES / 2, DENSITY * SIDES.prod()
# the nodes at x = 0
NEAR = [{"region": {"box": [[-1, -1, -1], [0.01, 1, 1]]}}]


def begin(folder: Path, start: dict, **tables) -> tuple[Model, list[Frame]]:
    """Return the model with its start, and the frames of one step."""
    return play(block_scene(folder, time={"step": T, "duration": T}, start=start, **tables))


def at_start(folder: Path, start: dict) -> tuple[Model, Frame]:
    """Return only the start, because rounding decides the step of a body that is a line."""
    path = block_scene(folder, time={"step": T, "duration": T}, start=start)
    with loop_of(path) as simulation:
        return simulation.model, next(simulation.frames())


@pytest.mark.parametrize("scale", [[1, 1, 0.25], [1, 0, 0], [1, 1, 0], [-1, 1, 1], [-2, 0.5, 3]])
def test_scale_is_about_the_middle_of_the_box(tmp_path: Path, scale: list[float]):
    model, frame = at_start(tmp_path, {"scale": scale})
    np.testing.assert_array_equal(
        frame.position, MIDDLE + np.array(scale) * (model.lattice.nodes - MIDDLE)
    )
    assert frame.kinetic == 0


@pytest.mark.parametrize("more", [{}, {"velocity": [1, 0, 0]}])
def test_a_body_in_a_point_is_refused(tmp_path: Path, more: dict):
    """No spring has a direction there, so rounding would decide a step."""
    with pytest.raises(InputError, match="start: scales the body to a point"):
        at_start(tmp_path, {"scale": [0, 0, 0]} | more)
    assert at_start(tmp_path, {"scale": [0, 0, 0], "scatter": 0.5} | more)[1].elastic > 0


def test_twist_about_a_slanted_axis_turns_all_in_planes_across_it(tmp_path: Path):
    """The angle follows from the cosine of the vectors across the axis.

    At the corners of the box it is 0 and 30 degrees.
    """
    axis = np.array([1, 1, 1]) / np.sqrt(3)
    model, frames = begin(tmp_path, {"twist": {"axis": [1, 1, 1], "degrees": -30}})
    p, q = model.lattice.nodes - MIDDLE, frames[0].position - MIDDLE
    np.testing.assert_allclose(q @ axis, p @ axis, atol=1e-15)
    across, turned = (x - np.outer(x @ axis, axis) for x in (p, q))
    np.testing.assert_allclose(
        np.linalg.norm(turned, axis=1), np.linalg.norm(across, axis=1), atol=1e-15
    )
    sine = np.einsum("ij,ij->i", np.cross(across, turned), np.broadcast_to(axis, p.shape))
    angle = -np.radians(30) * (p @ axis / (SIDES.sum() / np.sqrt(3)) + 0.5)
    np.testing.assert_allclose(sine, (across**2).sum(axis=1) * np.sin(angle), atol=1e-15)


def test_scale_comes_before_twist_and_scatter_after_it(tmp_path: Path):
    """A twist changes nothing after a collapse to its axis, and full scatter removes all else."""
    line = begin(tmp_path, {"scale": [1, 0, 0], "twist": {"axis": [1, 0, 0], "degrees": 90}})[1][
        0
    ].position
    np.testing.assert_allclose(
        line, begin(tmp_path, {"scale": [1, 0, 0]})[1][0].position, atol=1e-16
    )
    half, whole, none = (
        begin(
            tmp_path,
            {"scale": [2, 2, 2], "twist": {"axis": [0, 0, 1], "degrees": 50}, "scatter": s},
        )[1][0].position
        for s in (0.5, 1.0, 0.0)
    )
    np.testing.assert_allclose(half, (whole + none) / 2, atol=1e-15)
    np.testing.assert_array_equal(whole, begin(tmp_path, {"scatter": 1.0})[1][0].position)


def test_scatter_is_anywhere_in_the_box(tmp_path: Path):
    """Mean and variance are those of a uniform distribution: 1/2 and 1/12 of a side.

    Both are within four standard deviations.
    """
    q = begin(tmp_path, {"scatter": 1.0})[1][0].position / SIDES
    n = len(q)
    assert (q >= 0).all() and (q < 1).all() and len(np.unique(q)) == q.size
    assert np.abs(q.mean(axis=0) - 1 / 2).max() < 4 / np.sqrt(12 * n)
    assert np.abs(q.var(axis=0) - 1 / 12).max() < 4 / np.sqrt(180 * n)
    assert np.abs(np.corrcoef(q.T) - np.eye(3)).max() < 4 / np.sqrt(n)


def test_velocity_is_momentum_from_the_first_frame_on_and_free_flight_after(tmp_path: Path):
    velocity = np.array([1.0, -2.0, 0.5])
    model, frames = begin(tmp_path, {"velocity": velocity.tolist()})
    for frame in frames:
        np.testing.assert_allclose(frame.momentum, MASS * velocity, rtol=1e-12)
        assert frame.kinetic == pytest.approx(MASS * velocity @ velocity / 2, rel=1e-12)
    np.testing.assert_allclose(frames[1].position, model.lattice.nodes + T * velocity, atol=1e-13)


@pytest.mark.parametrize("integrator", ["implicit-euler", "verlet"])
def test_spin_has_the_angular_momentum_of_the_block(tmp_path: Path, integrator: str):
    """I_zz = m (a^2 + b^2) / 12, plus 2 m h^2 / 6 because a cell's mass is at its corners."""
    spin = np.array([2.0, -1.0, 3.0])
    path = block_scene(
        tmp_path,
        time={"step": T, "duration": T, "integrator": integrator},
        start={"spin": spin.tolist(), "velocity": [0, 0, 1]},
    )
    model, frames = play(path)
    inertia = MASS * ((SIDES**2).sum() - SIDES**2) / 12 + MASS * CELL**2 / 3
    q, mass = model.lattice.nodes, model.lattice.mass
    start, velocity = model.start
    np.testing.assert_array_equal(start, q)
    momentum = (mass[:, None] * np.cross(q - MIDDLE, velocity)).sum(axis=0)
    np.testing.assert_allclose(momentum, inertia * spin, rtol=1e-12)
    assert frames[0].kinetic == pytest.approx(inertia @ spin**2 / 2 + MASS / 2, rel=1e-12)
    np.testing.assert_allclose(frames[0].momentum, [0, 0, MASS], atol=1e-11)


def test_gradient_stretches_and_turns_about_the_centre_or_a_point(tmp_path: Path):
    """The kinetic energy of diag(a, b, c) is m/2 (a^2 (A^2 / 12 + h^2 / 6) + ...).

    A cell's mass is at its corners. An antisymmetric gradient is a spin.
    """
    rates, about = np.array([2.0, -1.0, 3.0]), np.array([0.1, 0.2, -0.3])
    second = SIDES**2 / 12 + CELL**2 / 6
    energy = MASS / 2 * rates**2 @ second
    frame = at_start(tmp_path, {"gradient": np.diag(rates).tolist()})[1]
    assert frame.kinetic == pytest.approx(energy, rel=1e-12)
    frame = at_start(tmp_path, {"gradient": np.diag(rates).tolist(), "about": about.tolist()})[1]
    moved = energy + MASS / 2 * rates**2 @ (MIDDLE - about) ** 2
    assert frame.kinetic == pytest.approx(moved, rel=1e-12)
    np.testing.assert_allclose(frame.momentum, MASS * rates * (MIDDLE - about), rtol=1e-12)
    x, y, z = rates
    turning = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    for more in ({}, {"about": about.tolist()}):
        by_spin, by_gradient = (
            at_start(tmp_path, {name: value} | more)[0].start[1]
            for name, value in (("spin", rates.tolist()), ("gradient", turning))
        )
        np.testing.assert_allclose(by_gradient, by_spin, atol=1e-15)


@pytest.mark.parametrize("h", [1 / 2, 1 / 4])
def test_swirl_of_the_twisting_column(tmp_path: Path, h: float):
    """A column of 1 x 6 x 1 m and 1100 kg/m^3 that turns by 105 sin(pi y / 12) has 3.031875 MJ.

    With lumped masses, sums of x^2 are larger by h^2 / 6. Sums of the sine follow the trapezoidal
    rule. It is exact for sine^2 and gives h/2 cot(pi h / 24) for the sine.
    """
    y = np.arange(0, 6 + h / 2, h)
    rates = 105 * np.sin(np.pi * y / 12)
    swirl = {"axis": [0, 2, 0], "distances": y.tolist(), "rates": rates.tolist()}
    path = block_scene(
        tmp_path,
        np.array([1, 6, 1]),
        cages={"cell_size": h},
        material={"young_modulus": 17e6, "density": 1100.0, "law": "neo-hookean"},
        start={"about": [0.5, 0, 0.5], "swirl": swirl},
        time={"step": 1e-4, "duration": 1e-4},
    )
    with loop_of(path) as simulation:
        model, frame = simulation.model, next(simulation.frames())
    assert frame.kinetic == pytest.approx(3.031875e6 * (1 + 2 * h**2), rel=1e-12)
    q, velocity = model.start
    momentum = model.lattice.mass @ np.cross(q - [0.5, 0, 0.5], velocity)
    exact = 1100 * 105 * (1 / 6 + h**2 / 3) * h / 2 / np.tan(np.pi * h / 24)
    np.testing.assert_allclose(momentum[1], exact, rtol=1e-12)
    np.testing.assert_allclose(frame.momentum, 0, atol=1e-6)


def test_a_swirl_is_constant_beyond_its_table(tmp_path: Path):
    swirl = {"axis": [0, 0, 1], "distances": [-0.01, 0.01], "rates": [-3, 3]}
    model, _ = at_start(tmp_path, {"swirl": swirl})
    r = model.lattice.nodes - MIDDLE
    expected = 3 * np.sign(r[:, 2])[:, None] * np.cross([0, 0, 1], r)
    np.testing.assert_allclose(model.start[1], expected, atol=1e-15)


def hung(folder: Path, name: str, **tables) -> Path:
    """Return the scene of a block that hangs by its side."""
    tables = {"pin": NEAR, "material": solid_of(2e4), "gravity": GRAVITY} | tables
    return block_scene(folder, name=name, **tables)


def test_a_state_of_equilibrium_stays_at_rest_on_any_number_of_ranks(tmp_path: Path):
    """It stays to the errors of its solves, 1e-9; pinned nodes keep their positions in the file."""
    at_rest = result_on(1, hung(tmp_path, "rest", time={"integrator": "static"}))
    nodes, found = at_rest["lattice/nodes"][:], at_rest["frames/position"][-1]
    sag = np.abs(found - nodes).max()
    going_on = hung(
        tmp_path,
        "going_on",
        start={"from": "rest_1.h5"},
        time={"step": T, "duration": 8 * T, "integrator": "bdf2"},
    )
    for ranks in (1, 3):
        frames = result_on(ranks, going_on)["frames/position"][:]
        np.testing.assert_array_equal(frames[0], found)
        np.testing.assert_allclose(frames, np.broadcast_to(found, frames.shape), atol=1e-7 * sag)
    assert sag > 0.1 * SIDES[0]


def test_held_components_keep_their_places_in_the_file(tmp_path: Path):
    """A grip lifts the far side; then rollers hold its height, and the side slides and falls."""
    far = {"region": {"half_space": {"point": [0.499, 0, 0], "normal": [1, 0, 0]}}, "fix": ["z"]}
    lift = [far | {"path": [{"time": 4 * T, "by": [0, 0, 0.02]}]}]
    time = {"step": T, "duration": 4 * T}
    lifted = result_on(1, hung(tmp_path, "lifted", anchor=lift, time=time))["frames/position"][-1]
    rolls = hung(tmp_path, "rolls", pin=[*NEAR, far], start={"from": "lifted_1.h5"}, time=time)
    rest = result_on(1, rolls)
    nodes, frames = rest["lattice/nodes"][:], rest["frames/position"][:]
    held = nodes[:, 0] == SIDES[0]
    np.testing.assert_allclose(lifted[held, 2], nodes[held, 2] + 0.02, atol=1e-12)
    np.testing.assert_array_equal(frames[0], lifted)
    assert (frames[:, held, 2] == lifted[held, 2]).all()
    assert np.ptp(frames[:, held, 0], axis=0).min() > 1e-5


def test_a_run_from_a_moving_state_is_the_rest_of_a_longer_run(tmp_path: Path):
    """Implicit Euler needs only positions and velocities; a velocity of the table is added."""
    time = {"step": T, "duration": 12 * T}
    whole = result_on(1, hung(tmp_path, "whole", time=time))["frames/position"][:]
    result_on(1, hung(tmp_path, "half", time=time), "--frames", 5)
    start = {"from": "half_1.h5"}
    rest = hung(tmp_path, "rest", time={"step": T, "duration": 7 * T}, start=start)
    frames = result_on(1, rest)["frames/position"][:]
    np.testing.assert_allclose(frames, whole[5:], atol=1e-8 * np.ptp(whole))
    faster = {"step": T / 2, "duration": T}
    scene = load_scene(hung(tmp_path, "faster", time=faster, start=start | {"velocity": [1, 0, 0]}))
    read = partial(end_of_run, MPI.COMM_SELF, tmp_path)
    model = build_model(MPI.COMM_SELF, scene, None, read)
    free = ~model.lattice.pinned
    expected = (whole[5] - whole[4]) / T + [1, 0, 0]
    np.testing.assert_allclose(model.start[1][free], expected[free], atol=1e-6)
    np.testing.assert_array_equal(model.start[1][~free], 0)


def test_a_state_that_does_not_fit_is_refused_on_all_ranks(tmp_path: Path):
    """Another lattice, a missing file, a file that is no result, and a scale are refused."""
    result_on(1, hung(tmp_path, "rest", time={"integrator": "static"}))
    path = hung(tmp_path, "go", start={"from": "rest_1.h5"}, time={"step": T, "duration": T})
    for words, ranks, change in (
        ("start.from: it is of another lattice", 3, "cages.cell_size=0.1"),
        ("no such file", 1, "start.from=none.h5"),
        ("is not an HDF5 file", 1, "start.from=go.toml"),
        ("may not be scaled", 1, "start.scale=[1,1,2]"),
    ):
        done = run(ranks, "-m", "msmpetsc", "run", path, "--set", change, status=2)
        lines = [line for line in done.stderr.splitlines() if "error:" in line]
        assert len(lines) == 1 and words in lines[0]


@pytest.mark.parametrize("what", ["pin", "anchor"])
def test_what_is_held_stays_where_it_is(tmp_path: Path, what: str):
    held = NEAR if what == "pin" else [NEAR[0] | {"path": [{"time": 1.0, "by": [0, 0, 1.0]}]}]
    start = {"scale": [2, 0, 1], "scatter": 0.3, "velocity": [1, 1, 1], "spin": [1, 0, 0]}
    model, frames = begin(tmp_path, start, **{what: held})
    nodes, (q, velocity) = model.lattice.nodes, model.start
    near = nodes[:, 0] == 0
    np.testing.assert_array_equal(q[near], nodes[near])
    np.testing.assert_array_equal(velocity[near], 0)
    assert (q[~near] != nodes[~near]).any(axis=1).all() and (velocity[~near] != 0).any(axis=1).all()
    moved = 0 if what == "pin" else T * np.array([0, 0, 1.0])
    np.testing.assert_allclose(frames[1].position[near], nodes[near] + moved, atol=1e-15)
