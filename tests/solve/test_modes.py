"""Natural frequencies against dense eigenvalues and closed forms of bars, on any number of ranks.

scripts/yardstick.py compares published values.
"""

import json
from functools import partial
from pathlib import Path

import h5py
import numpy as np
import pytest
from block_scene import GRAVITY, block_scene, box_at, model_of, solid_of, write_scene
from conftest import result_on, run
from lattices import dense_hessian
from mpi4py import MPI
from one_process import answers_on, refusal_in
from scipy.linalg import eigh

from msmpetsc import open as open_result
from msmpetsc.build import build_model
from msmpetsc.elasticity.energy import Elasticity
from msmpetsc.results.checkpoint_reader import end_of_run
from msmpetsc.scene.reading import load_scene
from msmpetsc.solve.natural_modes import Modes, modes_of
from msmpetsc.view.drawable import drawable_of_result

COMM = MPI.COMM_SELF
YOUNG, DENSITY = 1e6, 1000.0
# speed of longitudinal waves in a bar [m/s]
SPEED = np.sqrt(YOUNG / DENSITY)
CLAMP = [{"region": {"half_space": {"point": [0.001, 0, 0], "normal": [-1, 0, 0]}}}]
ENDS = [*CLAMP, {"region": {"half_space": {"point": [0.999, 0, 0], "normal": [1, 0, 0]}}}]
ONCE = {"step": 0.01, "duration": 0.01}


def body(folder: Path, sides: list[float], h: float, poisson: float = 0.0, **tables) -> Path:
    material = solid_of(YOUNG, poisson)
    given = {"cages": {"cell_size": h}, "material": material, "time": ONCE}
    return block_scene(folder, np.array(sides), **given | tables)


def modes(path: Path, count: int) -> Modes:
    scene = load_scene(path)
    read_state = partial(end_of_run, COMM, scene.folder)
    return modes_of(COMM, scene, build_model(COMM, scene, None, read_state), count)


def dense_frequencies(path: Path, q: np.ndarray) -> np.ndarray:
    """Return all frequencies [Hz] about positions q (n, 3), by a dense eigensolver."""
    lattice = model_of(path).lattice
    free = ~lattice.fixed.ravel()
    stiffness = dense_hessian(Elasticity(lattice), q)[np.ix_(free, free)]
    squares = eigh(stiffness, np.diag(np.repeat(lattice.mass, 3)[free]), eigvals_only=True)
    return np.sign(squares) * np.sqrt(np.abs(squares)) / (2 * np.pi)


@pytest.mark.parametrize("law", ["neo-hookean", "linear"])
def test_modes_at_rest_are_those_of_dense_matrices(tmp_path: Path, law: str):
    """The block's surface cuts cells; it is free or clamped."""
    material = {"young_modulus": YOUNG, "density": DENSITY, "law": law}
    for tables in ({}, {"pin": CLAMP}):
        path = body(tmp_path, [0.5, 0.31, 0.2], 0.11, material=material, **tables)
        found = modes(path, 12)
        nodes = model_of(path).lattice.nodes
        expected = dense_frequencies(path, nodes)[:12]
        assert found.rigid == (0 if tables else 6)
        assert (found.frequencies[: found.rigid] == 0).all()
        rest = slice(found.rigid, None)
        np.testing.assert_allclose(found.frequencies[rest], expected[rest], rtol=1e-6)


@pytest.mark.parametrize(("fix", "ends", "rigid"), [("x", CLAMP, 3), ("yz", ENDS, 1)])
def test_a_bar_on_rollers_keeps_the_rigid_motions_they_leave(
    tmp_path: Path, fix: str, ends: list, rigid: int
):
    """Rollers hold an end along the bar, or both ends across the bar.

    With the first the bar moves along y and z and turns about x. It is half of a free bar of 2 m,
    whose longitudinal modes are exact. With the second it slides along x.
    """
    pins = [pin | {"fix": list(fix)} for pin in ends]
    path = body(tmp_path, [1, 0.25, 0.25], 0.125, pin=pins)
    found, lattice = modes(path, 8), model_of(path).lattice
    expected = dense_frequencies(path, lattice.nodes)[:8]
    assert found.rigid == rigid
    np.testing.assert_allclose(found.frequencies[rigid:], expected[rigid:], rtol=1e-6)
    assert lattice.fixed.any() and (found.shapes[:, lattice.fixed] == 0).all()
    of_free_bar = SPEED / (np.pi * 0.125) * np.sin(np.pi * 0.125 / 4)
    assert (np.abs(found.frequencies / of_free_bar - 1).min() < 1e-7) == (fix == "x")


@pytest.mark.parametrize(("pins", "rigid"), [(CLAMP, 0), ([], 6)])
def test_soft_bending_beside_stiff_parts_is_not_rigid(tmp_path: Path, pins: list, rigid: int):
    """A bar's frequencies do not depend on the stiffness of its ends, if these are far stiffer.

    The bar is clamped at an end or free.
    """
    stiff = [{"half_space": {"point": [x, 0, 0], "normal": [x - 0.5, 0, 0]}} for x in (0.3, 0.7)]
    frequencies = []
    for ratio in (1e3, 1e6):
        parts = [{"region": end, "young_modulus": ratio * YOUNG, "density": 1e4} for end in stiff]
        found = modes(body(tmp_path, [1, 0.1, 0.1], 0.05, part=parts, pin=pins), rigid + 3)
        assert found.rigid == rigid
        frequencies.append(found.frequencies[rigid:])
    np.testing.assert_allclose(*frequencies, rtol=0.01)


def test_modes_of_a_loaded_body_are_those_of_its_state(tmp_path: Path):
    """A sagging beam has the same modes from a static scene and from its file."""
    loaded = {"pin": CLAMP, "gravity": {"acceleration": [0, 0, -40.0]}}
    path = body(tmp_path, [1, 0.25, 0.25], 0.125, **loaded, time={"integrator": "static"})
    found = modes(path, 6).frequencies
    with result_on(1, path) as run_of:
        q = run_of["frames/position"][-1]
    expected = dense_frequencies(path, q)[:6]
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    other = body(
        tmp_path, [1, 0.25, 0.25], 0.125, **loaded, start={"from": "scene_1.h5"}, name="other"
    )
    np.testing.assert_allclose(modes(other, 6).frequencies, expected, rtol=1e-6)
    at_rest = body(tmp_path, [1, 0.25, 0.25], 0.125, pin=CLAMP)
    assert np.abs(modes(at_rest, 6).frequencies / expected - 1).max() > 0.01


def test_a_pressure_has_the_stiffness_of_an_equilibrium_about_its_state_from_a_file(tmp_path: Path):
    """Without it the compressed bar seemed to buckle."""
    region = {"box": [[-1, -1, -1], [2, 2, 2]]}
    loaded = {"pin": CLAMP, "pressure": [{"region": region, "value": 0.2 * YOUNG}]}
    path = body(tmp_path, [1, 0.25, 0.25], 0.125, **loaded, time={"integrator": "static"})
    expected = modes(path, 4).frequencies
    assert expected[0] > 0
    with result_on(1, path):
        other = body(
            tmp_path, [1, 0.25, 0.25], 0.125, **loaded, start={"from": "scene_1.h5"}, name="other"
        )
    np.testing.assert_allclose(modes(other, 4).frequencies, expected, rtol=1e-5)


def test_an_obstacle_that_is_pressed_holds_the_tip(tmp_path: Path):
    """A support near the free end raises the lowest bending frequency of a clamped bar.

    The values are (1.875 / L)^2 clamped and (3.927 / L)^2 supported at the end, which is 4.39 times
    as much. A support before the end gives more.
    """
    loaded = {"pin": CLAMP, "gravity": GRAVITY}
    loaded["time"] = {"integrator": "static"}
    plate = box_at([[0.9, -1, -0.5], [1.2, 1, -0.001]], response="penalty")
    upright = []
    for more in ({}, {"obstacle": [plate]}):
        found = modes(body(tmp_path, [1, 0.125, 0.125], 0.0625, **loaded, **more), 3)
        _, y, z = np.abs(found.shapes).max(axis=1).T
        upright.append(found.frequencies[z > y][0])
    assert 3 < upright[1] / upright[0] < 6


def test_a_compressed_bar_grows_sideways_to_both_sides(tmp_path: Path):
    """A bar shortened by 5% is beyond its first buckling load and short of its second.

    Euler's load between two clamps, 4 pi^2 EI / L^2, has the strain pi^2 / 3 (t / L)^2 = 3.3%. The
    second load is 2.05 times as much.
    """
    shape = [1, 0.1, 0.1]
    start = {"scale": [0.95, 1, 1]}
    result_on(
        1,
        body(
            tmp_path, shape, 0.05, start=start, name="short", time={"step": 1e-9, "duration": 1e-9}
        ),
    )
    path = body(tmp_path, shape, 0.05, pin=ENDS, start={"from": "short_1.h5"})
    found = modes(path, 4).frequencies
    assert (found[:2] < 0).all() and found[0] == pytest.approx(found[1], rel=1e-6)
    assert (found[2:] > 0).all()


def test_shapes_are_orthonormal_and_two_bodies_have_twelve_rigid(tmp_path: Path):
    path = body(tmp_path, [0.5, 0.25, 0.25], 0.125)
    scene = {"cages": {"cell_size": 0.125}, "time": ONCE, "output": {"surface": False}}
    scene["material"] = {"young_modulus": YOUNG, "density": DENSITY}
    scene["body"] = [{"mesh": {"source": "scene.ply", "base": [x, 0, 0]}} for x in (0, 2)]
    path = write_scene(tmp_path, **scene)
    found = modes(path, 15)
    assert found.rigid == 12 and (found.frequencies[12:] > 0).all()
    mass = model_of(path).lattice.mass
    shapes = found.shapes.reshape(15, -1)
    np.testing.assert_allclose(shapes * np.repeat(mass, 3) @ shapes.T, np.eye(15), atol=1e-6)


def test_ranks_agree_and_other_commands_read_the_shapes(tmp_path: Path):
    """The modes of a square bar come in pairs."""
    path = body(tmp_path, [1, 0.1, 0.1], 1 / 40, 0.3, output={"surface": True})
    files, printed = [], []
    for ranks in (1, 3):
        files.append(tmp_path / f"modes_{ranks}.h5")
        words = ["modes", path, "--count", 10, "--json", "-o", files[-1]]
        done = run(ranks, "-m", "msmpetsc.cli.main", *words, status=0)
        printed.append(json.loads(done.stdout))
    np.testing.assert_allclose(printed[0]["frequencies"], printed[1]["frequencies"], rtol=1e-7)
    assert printed[0]["rigid"] == printed[1]["rigid"] == 6
    with h5py.File(files[0]) as one, h5py.File(files[1]) as other:
        q, rest = one["frames/position"][:], one["lattice/nodes"][:]
        np.testing.assert_allclose(other["frames/position"][:], q, atol=1e-4)
        np.testing.assert_array_equal(one["frames/time"], np.arange(11))
        np.testing.assert_array_equal(q[0], rest)
        np.testing.assert_allclose(np.linalg.norm(q[1:] - rest, axis=2).max(axis=1), 0.1)
    with open_result(files[0]) as result:
        captions = [drawable_of_result(result).moment(index) for index in (0, 7)]
    assert captions == ["t = 0.000 s", f"mode 7: {printed[0]['frequencies'][6]:.4g} Hz"]
    last = tmp_path / "last.obj"
    run(1, "-m", "msmpetsc.cli.main", "export", files[0], "-o", last, "--frames", 7, status=0)
    assert last.read_text().count("\nv ") > 3


def test_bad_input_is_refused_on_all_ranks(tmp_path: Path):
    path, file = body(tmp_path, [0.5, 0.5, 0.5], 0.125), tmp_path / "modes.h5"
    run(1, "-m", "msmpetsc.cli.main", "modes", path, "-o", file, "--count", 6, status=0)
    commands = {
        "125 free nodes show 121 modes at most": ["modes", path, "--count", 122],
        "exists: --overwrite replaces it": ["modes", path, "-o", file],
        "must be named *.h5": ["modes", path, "-o", tmp_path / "modes.png"],
        "--count must be at least 1": ["modes", path, "--count", 0],
        "has the modes of a body": ["run", "--resume", file],
    }
    for words, answers in zip(commands, answers_on(2, [*commands.values()]), strict=True):
        assert words in refusal_in(answers)
