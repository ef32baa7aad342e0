"""Reactions balance forces, probes follow the body; `msmpetsc series` prints both."""

import csv
from itertools import pairwise

import numpy as np
import pytest
from block_scene import CELL, SIDES, block_scene, plane_at, play, solid_of
from conftest import run
from one_process import status_of

from msmpetsc.errors import InputError

G = [0.5, 1.0, -9.81]
BOTTOM = {"box": [[-1, -1, -0.01], [1, 1, 0.01]]}
TOP = {"box": [[-1, -1, 0.24], [1, 1, 0.26]]}
EDGE = {"box": [[-1, -1, -0.01], [0.01, 1, 0.01]]}
SOLID = solid_of(1e5, 0.3)
TIGHT = {"solver": {"error": 1e-12}, "gravity": {"acceleration": G}}
LIFT = [{"region": BOTTOM, "path": [{"time": 0.015, "by": [0, 0, 0.01]}]}]
PLATE = plane_at(0.252, -1, response="penalty", friction=0.3)


def totals(frame) -> np.ndarray:
    """Return the sum (3,) [N] of reactions, loads and pushes."""
    return frame.load + sum(
        rows.sum(axis=0) for rows in (frame.reaction, frame.push) if rows is not None
    )


@pytest.mark.parametrize(
    "material", [SOLID, {"young_modulus": 1e5, "density": 1000.0}], ids=["solid", "springs"]
)
def test_a_reaction_is_the_pull_to_rounding(tmp_path, material):
    """Two pins that share an edge hold a pull and the weight: the nodes of the edge count once."""
    scene = block_scene(
        tmp_path, **TIGHT, material=material, time={"integrator": "static"},
        pin=[{"region": BOTTOM}, {"region": EDGE}],
        force=[{"region": TOP, "total": [30.0, 0, 200.0]}],
    )  # fmt: skip
    *_, frame = play(scene)[1]
    pull = np.array([30.0, 0, 200.0]) + 1000 * SIDES.prod() * np.array(G)
    assert frame.load == pytest.approx(pull, rel=1e-12)
    assert frame.reaction[0] == pytest.approx(-pull, abs=1e-9 * np.abs(pull).max())
    # the first pin holds all nodes of the second
    assert (frame.reaction[1] == 0).all()


@pytest.mark.parametrize("integrator", ["implicit-euler", "bdf2"])
@pytest.mark.parametrize(("damping", "retardation_time"), [(0.0, 0.0), (3.0, 0.0), (3.0, 0.02)])
def test_forces_add_up_to_mass_times_acceleration(tmp_path, integrator, damping, retardation_time):
    """Reactions, loads and pushes equal the rate of momentum plus damping, with a rough plate."""
    scene = block_scene(
        tmp_path, **TIGHT, anchor=LIFT, obstacle=[PLATE],
        time={"step": 0.01, "duration": 0.03, "integrator": integrator},
        material=SOLID | {"damping": damping, "retardation_time": retardation_time},
    )  # fmt: skip
    _, frames = play(scene)
    p = [frame.momentum for frame in frames]
    pushed = max(np.abs(frame.push).max() for frame in frames)
    assert pushed > 100 and max(np.abs(frame.push[0, :2]).max() for frame in frames) > 1e-4 * pushed
    if integrator == "implicit-euler":
        rates = [(b - a) / 0.01 + damping * b for a, b in pairwise(p)]
    else:
        # the acceleration of BDF2's third step uses two earlier steps
        rates = [None, None, (3 * p[3] - 4 * p[2] + p[1]) / 0.02 + damping * p[3]]
    for frame, rate in zip(frames[1:], rates, strict=True):
        if rate is not None:
            assert totals(frame) == pytest.approx(rate, abs=1e-8 * pushed)


@pytest.mark.parametrize("integrator", ["implicit-euler", "bdf2"])
def test_forces_add_up_while_loads_change(tmp_path, integrator):
    """A force, a traction and a pressure begin, bend and end within steps, also on held nodes."""
    closed = {"box": [[-1, -1, -1], [1, 1, 1]]}
    bend = {"start": 0.004, "stop": 0.038}
    times = {"times": [0.0, 0.013, 0.04]}
    scene = block_scene(
        tmp_path, **TIGHT, material=SOLID, pin=[{"region": BOTTOM}],
        time={"step": 0.01, "duration": 0.04, "integrator": integrator},
        force=[{"region": closed,
                "total": times | {"values": [[0, 0, 0], [200, 0, 300], [0, 0, 0]]}} | bend],
        traction=[{"region": {"box": [[-1, -1, 0.24], [1, 1, 0.26]]},
                   "value": times | {"values": [[0, 0, 0], [0, 800, 0], [0, 0, 0]]}} | bend],
        pressure=[{"region": closed, "value": times | {"values": [0, 1e3, 0]}} | bend],
    )  # fmt: skip
    model, frames = play(scene)
    p = [frame.momentum for frame in frames]
    if integrator == "implicit-euler":
        rates = [(b - a) / 0.01 for a, b in pairwise(p)]
    else:
        # the acceleration of BDF2's third step uses two earlier steps
        rates = [None, None, *((3 * p[n] - 4 * p[n - 1] + p[n - 2]) / 0.02 for n in (3, 4))]
    for frame, rate in zip(frames[1:], rates, strict=True):
        if rate is not None:
            assert totals(frame) == pytest.approx(rate, abs=1e-6)
    # a closed pressure has no resultant
    weight = model.lattice.mass.sum() * np.array(G)
    ramp = frames[1].load - weight - frames[1].surface_load[0]
    # mean over the step of a ramp from 0.004 s on
    mean = 0.006 * (0.004 + 0.01) / 2 / 0.013 / 0.01
    assert ramp == pytest.approx(mean * np.array([200, 0, 300]), abs=1e-6)
    assert frames[1].surface_load[0] == pytest.approx([0, mean * 200, 0], abs=1e-6)


@pytest.mark.parametrize("integrator", ["implicit-euler", "bdf2"])
def test_frames_within_a_chosen_step_have_no_inertia_of_its_end(tmp_path, integrator):
    """A body that flies along with its anchor needs no force, also in frames within long steps."""
    flight = [0.0, 0.0, 2.0]
    scene = block_scene(
        tmp_path, material=SOLID,
        anchor=[{"region": BOTTOM, "path": [{"time": 1.0, "by": flight}]}],
        time={"step": 0.01, "duration": 0.3, "integrator": integrator, "error": 0.01},
        start={"velocity": flight},
    )  # fmt: skip
    _, frames = play(scene)
    assert sum(frame.steps == 0 for frame in frames[1:]) > 5
    # in the first step the anchor accelerates its nodes from rest
    for frame in frames[2:]:
        np.testing.assert_allclose(frame.reaction, 0, atol=1e-6)


def test_explicit_steps_hang_from_their_pin_with_their_weight_in_the_mean(tmp_path):
    """Over whole oscillations the mean reaction is minus the weight.

    Within an oscillation it also changes the momentum.
    """
    scene = block_scene(
        tmp_path, **TIGHT, material=SOLID, pin=[{"region": BOTTOM}],
        time={"step": 1e-4, "duration": 3e-3, "integrator": "verlet"},
    )  # fmt: skip
    _, frames = play(scene)
    p = np.array([frame.momentum for frame in frames])
    forces = np.array([totals(frame) for frame in frames])
    middle = (p[2:] - p[:-2]) / 2e-4
    assert np.abs(forces[1:-1] - middle).max() < 0.02 * np.abs(forces).max()


def test_series_prints_what_the_file_has_and_replaces_nothing_unasked(tmp_path, capsys):
    scene = block_scene(
        tmp_path, **TIGHT, material=SOLID, pin=[{"region": BOTTOM}], obstacle=[PLATE],
        time={"step": 0.01, "duration": 0.02},
        output={"surface": False, "stress": True,
        "probe": [{"name": "top, middle", "point": [0.25, 0.3, 0.2]}]},
    )  # fmt: skip
    tables = []
    for ranks in (1, 2):
        path = tmp_path / f"{ranks}.h5"
        run(ranks, "-m", "msmpetsc", "run", scene, "-o", path, "--quiet", status=0)
        assert status_of("series", path, "-o", path.with_suffix(".csv")) == 0
        with path.with_suffix(".csv").open() as file:
            head, *rows = csv.reader(file)
        tables.append(np.array(rows, float))
    _, frames = play(scene)
    one, two = tables
    np.testing.assert_allclose(one, two, atol=1e-8 * np.abs(one).max())
    column = {name: one[:, number] for number, name in enumerate(head)}
    assert head[0] == "time [s]" and "push obstacle.0 z [N]" in head
    assert column["reaction pin.0 z [N]"][2] == pytest.approx(frames[2].reaction[0, 2], rel=1e-9)
    assert [column[f"probe top, middle {axis} [m]"][0] for axis in "xyz"] == pytest.approx(
        [0.25, 0.3, 0.2]
    )
    assert column["probe top, middle z [m]"][2] == pytest.approx(frames[2].probe[0, 2], rel=1e-12)
    capsys.readouterr()
    assert status_of("series", tmp_path / "1.h5", "-o", tmp_path / "1.csv") == 2
    assert "exists: --overwrite replaces it" in capsys.readouterr().err


def test_a_probe_goes_with_its_cell(tmp_path):
    scene = block_scene(
        tmp_path, **TIGHT, material=SOLID, anchor=LIFT, time={"step": 0.01, "duration": 0.01},
        output={"surface": False, "probe": [{"name": "edge", "point": [CELL, 0.1, 0.0]}]},
    )  # fmt: skip
    _, frames = play(scene)
    # the probe lies on a held face, so it follows the anchor
    assert frames[1].probe == pytest.approx(np.array([[CELL, 0.1, 0.02 / 3]]), abs=1e-12)
    with pytest.raises(InputError, match=r"output\.probe\.0\.point: \(9, 0, 0\) m lies in no cell"):
        play(scene, 'output.probe=[{name="far", point=[9, 0, 0]}]')
