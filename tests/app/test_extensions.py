"""Forces, obstacles and presets of the user: discrete formulas, energy balance, names, packages."""

import subprocess
from pathlib import Path

import numpy as np
import pytest
from block_scene import block_scene
from conftest import ENVIRONMENT, python
from one_process import input_error

import msmpetsc as msm
from msmpetsc.cli.main import main
from msmpetsc.errors import InputError
from msmpetsc.extensions import FORCES, PRESETS

STEP, SPEED, RATE = 0.01, 1.0, 8.0
ALL = {"half_space": {"point": [0, 0, -9], "normal": [0, 0, 1]}}


@pytest.fixture(autouse=True)
def nothing_stays():
    """Remove the names that a test has registered."""
    yield
    for extensions in (FORCES, PRESETS):
        extensions._registered.clear()


def flying(
    folder: Path, name: str, steps: int = 10, step: float = STEP, begin: float = 0.0, **tables
) -> Path:
    """Return the scene of a block that flies upwards under the named force, without gravity."""
    time = {"step": step, "duration": steps * step, **tables.pop("time", {})}
    own = [{"region": ALL, "function": name, "start": begin}]
    return block_scene(
        folder, time=time, force=own, **{"start": {"velocity": [0, 0, SPEED]}} | tables
    )


def heights(scene: Path) -> np.ndarray:
    """Return the height [m] of the block in each frame; these forces do not deform the block."""
    positions = np.array([frame.position for frame in msm.frames(scene)])
    assert np.ptp(positions - positions[0], axis=1).max() < 1e-9
    return (positions - positions[0]).mean(axis=1)[:, 2]


def test_drag_is_that_of_the_velocity_that_starts_a_step(tmp_path: Path):
    msm.register_force("drag", lambda x, v, t: -RATE * v)
    # v_(n+1) = v_n - t c v_n
    velocities = SPEED * (1 - RATE * STEP) ** np.arange(1, 11)
    assert np.allclose(
        heights(flying(tmp_path, "drag")), np.append(0, STEP * np.cumsum(velocities)), rtol=1e-9
    )


@pytest.mark.parametrize(
    ("integrator", "order"), [("implicit-euler", 1), ("bdf2", 2), ("verlet", 1)]
)
def test_order_in_the_step(tmp_path: Path, integrator: str, order: int):
    # below the ground, so that the force pulls from the start
    errors, below = [], np.array([0, 0, -0.1])
    for halvings in range(2):
        step, start = STEP / 2**halvings, {}
        msm.register_force(
            "spring", lambda x, v, t, at=start: RATE**2 * (at.setdefault("x", x.copy()) + below - x)
        )
        *_, last = heights(
            flying(tmp_path, "spring", 20 * 2**halvings, step, time={"integrator": integrator})
        )
        turn = RATE * 20 * STEP
        errors.append(abs(last - SPEED / RATE * np.sin(turn) + 0.1 * (1 - np.cos(turn))))
    assert 0.8 < np.log2(errors[0] / errors[1]) / order < 1.3


@pytest.mark.parametrize("integrator", ["implicit-euler", "bdf2"])
def test_steps_chosen_by_an_error_meet_it(tmp_path: Path, integrator: str):
    msm.register_force("drag", lambda x, v, t: -RATE * v)
    scene = flying(tmp_path, "drag", 4, 0.05, time={"integrator": integrator, "error": 1e-2})
    exact = SPEED / RATE * (1 - np.exp(-RATE * 0.2))
    error = heights(scene)[-1] / exact - 1
    assert abs(error) < 2e-2


def test_its_work_is_no_energy_from_nowhere(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    msm.register_force("motor", lambda x, v, t: RATE * v)
    frames = list(msm.frames(flying(tmp_path, "motor", 20)))
    # (1 + 0.08)^40 = 21.7 in theory
    assert frames[-1].kinetic > 15 * frames[0].kinetic
    assert max(frame.energy_gained for frame in frames) < 1e-6 * frames[-1].kinetic
    assert all(frame.potential == 0 for frame in frames)
    assert "nowhere" not in caplog.text


def test_bdf2_counts_the_work_of_a_force_through_its_steps(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    """A block starts at the centre of a spring and oscillates once."""
    start: dict[str, np.ndarray] = {}
    msm.register_force("spring", lambda x, v, t: RATE**2 * (start.setdefault("x", x.copy()) - x))
    time = {"integrator": "bdf2"}
    frames = list(msm.frames(flying(tmp_path, "spring", 158, STEP / 2, time=time)))
    energy = frames[0].kinetic
    assert min(frame.kinetic for frame in frames) < 1e-3 * energy
    assert frames[-1].kinetic == pytest.approx(energy, rel=0.05)
    assert sum(frame.energy_gained for frame in frames) < 5e-3 * energy
    assert "nowhere" not in caplog.text


def test_it_acts_on_its_region_and_in_its_time(tmp_path: Path):
    seen = []

    def force(x: np.ndarray, v: np.ndarray, t: float) -> np.ndarray:
        seen.append((len(x), x[:, 0].max(), round(t, 6)))
        return np.zeros_like(x)

    msm.register_force("eye", force)
    region = {"box": [[-1, -1, -1], [0.2, 2, 2]]}
    scene = flying(tmp_path, "eye", 3)
    list(msm.frames(scene, set={"force.0.region": region}))
    # the function is called once a step
    assert seen == [(2 * 5 * 3, 0.125, 0.0), (30, 0.125, 0.01), (30, 0.125, 0.02)]
    msm.register_force("late", lambda x, v, t: [0, 0, 1.0])
    # the force acts in the steps that begin at or after its start
    late = heights(flying(tmp_path, "late", 4, begin=0.02))
    assert np.allclose(np.diff(late), STEP * (SPEED + STEP * np.array([0, 0, 1, 2])))


WRONG = {
    "no force 'drga' is registered, or installed under msmpetsc.forces, did you mean 'drag'?": {
        "function": "drga"
    },
    "force.0.function: returned numbers of shape (2,), not (75, 3)": {"function": "flat"},
    "force.0.function: returned 'abc', no array of real numbers": {"function": "text"},
    "force.0.function: returned [[1], [1, 2]], no array of real numbers": {"function": "ragged"},
    "force.0.function: returned 1j, no array of real numbers": {"function": "complex"},
    "force.0.function: returned numbers that are not finite (t = 0 s)": {"function": "nan"},
    "must give exactly one of total, function; has total and function": {
        "function": "drag",
        "total": [0, 0, 1.0],
    },
}


@pytest.mark.parametrize("words", WRONG)
def test_what_is_no_force_is_said_in_one_line(tmp_path: Path, words: str):
    msm.register_force("drag", lambda x, v, t: -v)
    msm.register_force("flat", lambda x, v, t: np.zeros(2))
    msm.register_force("text", lambda x, v, t: "abc")
    msm.register_force("ragged", lambda x, v, t: [[1], [1, 2]])
    msm.register_force("complex", lambda x, v, t: 1j)
    msm.register_force("nan", lambda x, v, t: np.full_like(x, np.nan))
    scene = flying(tmp_path, "drag")
    assert words in input_error(
        lambda: list(msm.frames(scene, set={"force": [{"region": ALL, **WRONG[words]}]}))
    )


def test_presets_of_ones_own(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    msm.register_preset("tight", {"ksp_rtol": 1e-8, "ksp_max_it": 400}, about="a narrow one")
    # the force bends the block
    msm.register_force("drag", lambda x, v, t: -RATE * v * x[:, :1])
    scene = flying(tmp_path, "drag", 2)
    tight, usual = (
        [frame for frame in msm.frames(scene, set={"solver.preset": name})]
        for name in ("tight", "newton")
    )
    assert np.allclose(tight[-1].position, usual[-1].position, atol=1e-8)
    # the option of the preset has an effect
    assert tight[-1].ksp_its > usual[-1].ksp_its
    path = msm.run(scene, tmp_path / "x.h5", preset="tight", quiet=True)
    with msm.open(path) as result:
        assert result.scene["solver"]["preset"] == "tight"
    with pytest.raises(SystemExit):
        main(["run", "--list-presets"])
    assert "tight" in (listed := capsys.readouterr().out) and "a narrow one" in listed
    msm.register_preset("wrong", {}, based_on="none")
    with pytest.raises(InputError, match="the preset 'wrong' is no table of"):
        list(msm.frames(scene, set={"solver.preset": "wrong"}))


def test_a_preset_with_another_type_of_solver_drops_the_norm_of_the_old_type(tmp_path: Path):
    """PETSc refused the preset, because minres lacks CG's natural norm."""
    msm.register_preset("minres", {"ksp_type": "minres"})
    scene = block_scene(
        tmp_path,
        time={"step": STEP, "duration": STEP},
        start={"velocity": [0, 0, SPEED], "scale": [1.1, 1, 1]},
        solver={"preset": "minres"},
    )
    assert [frame.ksp_its > 0 for frame in msm.frames(scene)] == [False, True]


PLUGIN = """
RIBBON = {"options": {"ksp_rtol": 1e-7}, "based_on": "newton", "about": "installed"}
def drag(x, v, t):
    return -8.0 * v
"""
POINTS = """
[msmpetsc.forces]
installed_drag = plugin:drag
broken = plugin:none
[msmpetsc.presets]
ribbon = plugin:RIBBON
"""


def test_a_scene_file_names_what_is_installed(tmp_path: Path):
    (tmp_path / "plugin.py").write_text(PLUGIN)
    installed = tmp_path / "plugin-1.0.dist-info"
    installed.mkdir()
    (installed / "METADATA").write_text("Metadata-Version: 2.1\nName: plugin\nVersion: 1.0\n")
    (installed / "entry_points.txt").write_text(POINTS)
    scene = flying(tmp_path, "installed_drag", solver={"preset": "ribbon", "error": 1e-9})
    environment = ENVIRONMENT | {"PYTHONPATH": f"{tmp_path}:{ENVIRONMENT['PYTHONPATH']}"}

    def command(*words: object) -> subprocess.CompletedProcess:
        return python(
            "-m", "msmpetsc", "run", scene, "-o", tmp_path / "x.h5", *words, env=environment
        )

    assert (done := command()).returncode == 0, done.stderr
    with msm.open(tmp_path / "x.h5") as result:
        positions = result.frames.position[:]
    velocity = np.diff((positions - positions[0])[:, 0, 2]) / STEP
    assert np.allclose(velocity, SPEED * (1 - RATE * STEP) ** np.arange(1, 11), rtol=1e-9)
    broken = command("--overwrite", "--set", "force.0.function=broken")
    assert broken.returncode == 2
    assert "the force 'broken' that is installed cannot be imported" in broken.stderr
    assert broken.stderr.count("\n") == 1
