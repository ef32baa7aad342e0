"""Runs that go on from a checkpoint: exactly, on other ranks, with another scene, without room."""

import json
import multiprocessing
import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from subprocess import PIPE

import h5py
import numpy as np
import pytest
import tomli_w
from block_scene import CELL, block_scene, box_at, half_space, plane_at, solid_of
from conftest import ENVIRONMENT, WORKERS, run
from mpi4py import MPI
from one_process import command_error, status_of
from stopped_runs import (  # noqa: F401  # a fixture
    STEPS,
    assert_goes_on_exactly,
    assert_same,
    at_step,
    every_step_forgets,
    hanging,
    stopped_after,
)  # fmt: skip

from msmpetsc.app.resume import Resumed
from msmpetsc.build import build_model
from msmpetsc.errors import InputError
from msmpetsc.results.checkpoint_reader import Earlier
from msmpetsc.results.disk import Lock
from msmpetsc.results.untrusted_file import finished
from msmpetsc.scene.reading import load_scene
from msmpetsc.solve.multigrid import cycle
from msmpetsc.solve.nonlinear import preconditioning
from msmpetsc.solve.nonlinear.preconditioning import LatticePreconditioner
from msmpetsc.solve.presets import PRESETS
from msmpetsc.solve.simulate import TimeLoop

COMM = MPI.COMM_SELF
WORKER = WORKERS / "stop_worker.py"
GRAVITY = {"acceleration": [0.0, 1.0, -9.81]}
SIDE = [{"region": {"box": [[-0.01, -1.0, -1.0], [0.01, 1.0, 1.0]]}}]
FAR = {"box": [[0.49, -1, -1], [0.51, 1, 1]]}
LED = [{"region": FAR, "path": [{"time": 0.05, "by": [0.05, 0, 0.05]}], "stop": 0.08}]
# the anchor is released later
PUSHED = [{"region": {"box": [[0.24, -1, -1], [0.26, 1, 1]]}, "path": LED[0]["path"], "stop": 0.1}]
GROUND = plane_at()
PRESSING = [
    GROUND | {"response": "penalty", "friction": 0.5, "path": [{"time": 1.0, "by": [0, 0, 0.3]}]}
]
ALL = {"box": [[0, 0, 0], [1, 1, 1]], "relative": True}
# thinner than the way of a step
THIN = box_at([[-2, -2, -0.001], [2, 2, 0]])
SOFT = {"young_modulus": 1e4, "density": 1000.0}


def swing(**tables) -> dict:
    time = {"step": 0.02, "duration": 0.16}
    return {"gravity": GRAVITY, "pin": SIDE, "material": SOFT, "time": time} | tables


def fall(**tables) -> dict:
    time, start = {"step": 0.01, "duration": 0.16}, {"velocity": [1.0, 0.0, -1.5]}
    mesh = {"source": "scene.ply", "base": [0, 0, 0.01]}
    falls = {"gravity": GRAVITY, "mesh": mesh, "material": SOFT, "time": time, "start": start}
    return falls | tables


def by(integrator: str, scene: dict) -> dict:
    return scene | {"time": scene["time"] | {"integrator": integrator}}


def by_error(error: float, scene: dict) -> dict:
    return scene | {"time": scene["time"] | {"error": error}}


def solver(preset: str) -> dict:
    return {"preset": preset} if PRESETS[preset].iterations else {"preset": preset, "error": 1e-3}


LOOSE = solver("newton")
SURFACE_LOADS = {
    "pressure": [
        {"region": ALL, "value": {"times": [0, 0.2], "values": [1e3, 5e3]}, "start": 0.02}
    ],
    "traction": [{"region": half_space(0, 0.49, 1), "value": [0, 0, 50], "stop": 0.1}],
}
SCATTERED = {
    "solver": solver("anderson"),
    "start": {"scatter": 0.9},
    "material": SOFT | {"young_modulus": 1e6},
}
CASES = {
    **{
        f"{preset}, {name}": fall(solver=solver(preset), obstacle=obstacle)
        for preset in PRESETS
        for name, obstacle in {"reflected": [GROUND], "pressed": PRESSING}.items()
        if preset in ("newton", "lbfgs") or name == "pressed"
        # anderson diverges there
        if preset != "anderson"
    },
    # the estimate at the start depends on the earlier preconditioner
    "loose, pressed": fall(
        solver={"preset": "newton", "error": 0.3},
        obstacle=PRESSING,
        time={"step": 0.01, "duration": 0.24},
    ),
    "anchor": swing(solver=LOOSE, anchor=LED, output={"surface": False, "every": 3}),
    "bdf2": by("bdf2", swing(solver=LOOSE)),
    "bdf2, surface loads": by("bdf2", swing(solver=LOOSE, **SURFACE_LOADS)),
    "static": by("static", swing(solver=LOOSE, anchor=[LED[0] | {"stop": 0.05}, *PUSHED])),
    "bdf2, pressed": by("bdf2", fall(solver=LOOSE, obstacle=PRESSING)),
    "a thin plate": fall(solver=LOOSE, obstacle=[THIN | {"response": "penalty", "friction": 0.5}]),
    "bdf2, a thin plate": by("bdf2", fall(solver=LOOSE, obstacle=[THIN | {"restitution": 0.5}])),
    "verlet, a thin plate": by("verlet", fall(obstacle=[THIN | {"response": "penalty"}])),
    "verlet": by("verlet", swing(output={"surface": False, "every": 3})),
    # the next step begins with pieces of an eighth or more
    "substep, scattered": swing(**SCATTERED, safety={"on_failure": "substep"}),
    "fallback, scattered": swing(**SCATTERED, safety={"on_failure": "fallback"}),
    "by error": by_error(0.1, by("bdf2", swing(solver=LOOSE, anchor=LED))),
    "by error, long steps": by_error(
        0.5, swing(solver=LOOSE, gravity={"acceleration": [0.0, 1e-3, -1e-2]})
    ),
    "by error, reflected": by_error(0.1, by("bdf2", fall(solver=LOOSE, obstacle=[GROUND]))),
    "by error, bdf2, pressed": by_error(0.1, by("bdf2", fall(solver=LOOSE, obstacle=PRESSING))),
}


@pytest.mark.parametrize("case", CASES)
def test_a_step_from_a_checkpoint_is_the_step_of_the_whole_run(tmp_path, case):
    frames = assert_goes_on_exactly(block_scene(tmp_path, **CASES[case]), every=2)
    if case.startswith(("substep", "fallback")):
        assert sum(frame.substeps + frame.fallbacks for frame in frames) > 0


BLOCK = {
    "sides": np.array([6, 3, 3]) * CELL,
    "material": {"young_modulus": 1e5, "density": 1000.0},
    "time": {"step": 0.02, "duration": 0.2},
    "solver": solver("newton-multigrid"),
}
TIP = {"box": [[0.74, -1, -1], [0.76, 1, 1]]}
TIP_LED = [{"region": TIP, "path": [{"time": 0.08, "by": [0.05, 0, 0.05]}], "stop": 0.1}]
# positions where hierarchies are built
MULTIGRID = {
    "solid, pressed": fall(**BLOCK | {"material": solid_of(1e5)}, obstacle=PRESSING),
    "bdf2, pressed": by("bdf2", fall(**BLOCK, obstacle=PRESSING)),
    "led and let go": swing(**BLOCK, anchor=TIP_LED),
    "fallback": fall(
        **BLOCK | {"solver": {"preset": "fast-msm", "error": 1e-6}},
        start={"velocity": [0.1, 0, -10.0]},
        safety={"on_failure": "fallback"},
        obstacle=PRESSING,
    ),
}
# each case takes some five seconds
QUICK = {"solid, pressed", "fallback"}


@pytest.mark.parametrize(
    "case",
    [case if case in QUICK else pytest.param(case, marks=pytest.mark.slow) for case in MULTIGRID],
)
def test_the_hierarchy_of_then_is_built_again(tmp_path, case: str, monkeypatch):
    """Resume runs that build hierarchies in some steps only: of several levels, or given up."""
    monkeypatch.setattr(cycle, "COARSEST", 10)
    monkeypatch.setattr(preconditioning, "WORTH", 1.0)
    built, build = [], LatticePreconditioner._build
    monkeypatch.setattr(
        LatticePreconditioner, "_build", lambda *given: (built.append(1), build(*given))[1]
    )
    frames = assert_goes_on_exactly(block_scene(tmp_path, **MULTIGRID[case]), every=3)
    assert len(built) > 1
    assert case != "fallback" or sum(frame.fallbacks for frame in frames) > 0


def test_a_checkpoint_has_no_more_than_the_run_needs(tmp_path):
    def rows(scene: dict) -> set[str]:
        read = load_scene(block_scene(tmp_path, **scene))
        with TimeLoop(COMM, read, build_model(COMM, read)) as simulation:
            return simulation.saved.rows.keys() - {"q", "q_previous"}

    # each implicit step is examined for a minimum
    followed = {"lowest_mode"}
    assert rows(swing(solver=LOOSE)) == followed
    assert rows(by("verlet", swing())) == set()
    history = {"history_q", "history_v"}
    assert rows(by("bdf2", fall(solver=LOOSE, obstacle=PRESSING))) == followed | history
    assert rows(by("verlet", fall(obstacle=[THIN]))) == {"sides"}


LONGER = "--set", "time.duration=0.56"


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a run that is never stopped; every third step is also solved to rounding."""
    folder = tmp_path_factory.mktemp("whole")
    assert status_of("run", hanging(folder), "-o", folder / "whole.h5", "--true-error", 3) == 0
    return folder / "whole.h5"


@pytest.fixture(scope="module")
def longer(whole: Path) -> Path:
    """Return the same run of 56 steps."""
    words = "-o", whole.with_name("longer.h5"), "--true-error", 3, *LONGER
    assert status_of("run", whole.with_name("scene.toml"), *words) == 0
    return whole.with_name("longer.h5")


@pytest.fixture(scope="module")
def after_ten(whole: Path) -> Path:
    """Return the same run stopped after ten steps."""
    words = "-o", whole.with_name("stopped.h5"), "--true-error", 3
    assert stopped_after(10, "run", whole.with_name("scene.toml"), *words) == 0
    return whole.with_name("stopped.h5")


@pytest.fixture
def stopped(after_ten: Path, tmp_path) -> Path:
    return Path(shutil.copy(after_ten, tmp_path))


def test_what_was_asked_for_beside_the_frames_is_there_after_going_on(whole: Path, stopped: Path):
    cost, picture = stopped.with_suffix(".json"), stopped.with_suffix(".png")
    pytest.importorskip("pyvista")
    assert status_of("run", "--resume", stopped, "--measure", cost, "--picture") == 0
    # the true errors are equal, too
    assert_same(stopped, whole)
    assert json.loads(cost.read_text())["time"]["stepping"] > 0 and picture.stat().st_size > 1000
    assert stopped.with_suffix(".xdmf").read_text().count("<Time") == 2 * finished(h5py.File(whole))


def test_frames_after_the_checkpoint_are_kept_as_they_are(whole: Path, tmp_path, monkeypatch):
    """Old frames are not written again if the only checkpoint is at the start."""
    path = tmp_path / "x.h5"

    def killed() -> None:
        raise InterruptedError

    with monkeypatch.context() as patch:
        at_step(patch, 21, killed)
        arguments = ["-o", path, "--true-error", 3, "--checkpoint-every", 1000]
        assert status_of("run", whole.with_name("scene.toml"), *arguments) == 1
    with h5py.File(path) as file:
        assert max(file["checkpoint/step"]) == 0 and finished(file) == 8
        times = file["frames/wall_time"][:8]
    assert status_of("run", "--resume", path) == 0
    assert_same(path, whole)
    with h5py.File(path) as file:
        assert np.array_equal(file["frames/wall_time"][:8], times)


@pytest.mark.parametrize(
    ("every", "steps"), [("1", {39, 40}), ("4", {24, 36, 40}), ("1000", {0, 40})]
)
def test_checkpoints_come_as_often_as_asked_and_at_the_end(whole: Path, tmp_path, every, steps):
    path = tmp_path / "x.h5"
    words = "-o", path, "--checkpoint-every", every
    assert status_of("run", whole.with_name("scene.toml"), *words) == 0
    with h5py.File(path) as file:
        assert set(file["checkpoint/step"]) <= steps and max(file["checkpoint/step"]) == STEPS


def test_nothing_is_left_to_do(whole: Path, capsys):
    before = whole.read_bytes()
    assert status_of("run", "--resume", whole) == 0
    assert "nothing left to do" in capsys.readouterr().err
    assert whole.read_bytes() == before


def test_another_scene_is_refused_with_its_keys(stopped: Path, capsys):
    scene = Path(h5py.File(stopped).attrs["scene_file"])
    before = stopped.read_bytes()
    given = ["--set", "time.duration=0.8", "--set", "material.density=900", "--preset", "anderson"]
    assert status_of("run", scene, "--resume", stopped, *given) == 2
    told = capsys.readouterr().err
    for earlier in ("time.duration: 0.4", "material.density: 1000.0", "solver.preset: newton"):
        assert f"{earlier} in {stopped}" in told
    assert status_of("run", "--resume", stopped, "--set", "time.step=0.005", "--force") == 2
    assert "time.step: 0.01 in" in capsys.readouterr().err
    assert stopped.read_bytes() == before


def test_other_options_of_petsc_are_refused_unless_they_only_tell(whole: Path):
    earlier, scene = Earlier.read(whole), load_scene(whole.with_name("scene.toml"))
    with pytest.raises(InputError, match=r"-ksp_rtol: none in .*whole\.h5, 1e-2 now"):
        Resumed(earlier, scene, {"ksp_rtol": "1e-2"}, force=False)
    silent = {"log_view": "", "snes_monitor": "", "use_gpu_aware_mpi": "0"}
    assert Resumed(earlier, scene, silent, force=False).differs == []
    assert Resumed(earlier, scene, {"ksp_rtol": "1e-2"}, force=True).is_done


def test_a_longer_run(whole: Path, stopped: Path, longer: Path, tmp_path):
    """A longer run continues from a stopped and from a finished file.

    The 40th step, the last, had a frame; in the longer run it has none.
    """
    for path in (stopped, shutil.copy(whole, tmp_path)):
        assert status_of("run", "--resume", path, *LONGER, "--force") == 0
        assert_same(path, longer)
        with h5py.File(path) as file:
            assert tomllib.loads(file.attrs["scene"])["time"]["duration"] == 0.56
            assert "(to step " in file.attrs["earlier"]
    # no temporary file is left
    assert sorted(path.suffix for path in tmp_path.glob(".*")) == []


def left_by_a_kill(
    monkeypatch: pytest.MonkeyPatch, step: int, path: Path, *arguments: object
) -> None:
    """Return the run's file as a kill after that step would leave it."""
    left: list[bytes] = []
    with monkeypatch.context() as patch:
        at_step(patch, step, lambda: left.append(path.read_bytes()))
        assert status_of(*arguments) == 0
    path.write_bytes(left[0])


@pytest.mark.parametrize("killed", [11, 13, 25])
def test_a_longer_run_after_a_stop_between_frames_and_a_kill(
    stopped: Path, longer: Path, monkeypatch, killed
):
    """Costs since the frame before the checkpoint count, whatever frames came later."""
    words = "run", "--resume", stopped, "--checkpoint-every", 1000
    left_by_a_kill(monkeypatch, killed, stopped, *words)
    with h5py.File(stopped) as file:
        assert max(file["checkpoint/step"]) == 10 and finished(file) == 1 + killed // 3
    assert status_of("run", "--resume", stopped, *LONGER, "--force") == 0
    assert_same(stopped, longer)


def test_numbers_of_another_version_are_not_written_over(stopped: Path, capsys):
    with h5py.File(stopped, "r+") as file:
        file["checkpoint/numbers"].attrs["names"] += "_of_old"
    assert status_of("run", "--resume", stopped) == 2
    assert "has no room for checkpoint/numbers as it is now: --force" in capsys.readouterr().err


def rewritten(path: Path, name: str, **layout) -> bytes:
    """Lay out a dataset anew, as h5repack does; return the bytes of the file."""
    with h5py.File(path, "r+") as file:
        values, units = file[name][...], file[name].attrs["units"]
        del file[name]
        file.create_dataset(name, data=values, **layout).attrs["units"] = units
    return path.read_bytes()


@pytest.mark.parametrize("name", ["frames/position", "frames/momentum"])
@pytest.mark.parametrize("layout", [{"compression": "gzip"}, {}])
def test_a_compressed_copy_is_written_anew_only(
    whole: Path, stopped: Path, capsys, name: str, layout: dict
):
    """Raw numbers in compressed chunks would destroy all finished frames."""
    if layout:
        with h5py.File(stopped) as file:
            layout = layout | {"chunks": file[name].chunks}
    before = rewritten(stopped, name, **layout)
    assert status_of("run", "--resume", stopped) == 2
    assert f"has no room for {name} as it is now: --force" in capsys.readouterr().err
    assert stopped.read_bytes() == before
    assert status_of("run", "--resume", stopped, "--force") == 0
    assert_same(stopped, whole)


def test_a_run_cannot_end_before_its_checkpoint(stopped: Path, capsys):
    before = stopped.read_bytes()
    refused = "has come to step 10 already: it cannot end at step 10"
    for duration, status, words in (
        (0.1, 2, refused),
        (0.096, 2, refused),
        (0.094, 0, "nothing left to do"),
    ):
        shorter = "--set", f"time.duration={duration}", "--force"
        assert status_of("run", "--resume", stopped, *shorter) == status
        assert words in capsys.readouterr().err
        assert stopped.read_bytes() == before


def test_another_start_takes_no_frame_of_before_the_first_checkpoint(
    whole: Path, tmp_path, monkeypatch
):
    """The run was killed between frame 0 and the first checkpoint."""
    path, other = tmp_path / "x.h5", ["--set", "start.velocity=[1.0, 0.0, 0.0]"]
    scene = whole.with_name("scene.toml")
    left_by_a_kill(monkeypatch, 0, path, "run", scene, "-o", path, "--frames", 3)
    with h5py.File(path, "r+") as file:
        file["checkpoint/step"][...] = -1
        assert finished(file) == 1
    assert status_of("run", "--resume", path, *other, "--force") == 0
    assert status_of("run", scene, "-o", tmp_path / "other.h5", "--frames", "3", *other) == 0
    assert_same(path, tmp_path / "other.h5")


def test_another_mesh_is_refused_in_one_line(stopped: Path, tmp_path):
    block_scene(tmp_path, sides=np.array([0.5, 0.5, 0.375]), name="other")
    with h5py.File(stopped, "r+") as file:
        scene = tomllib.loads(file.attrs["scene"])
        other = scene["mesh"]["source"] = str(tmp_path / "other.ply")
        file.attrs["scene"] = tomli_w.dumps(scene)
    assert "the mesh has changed" in command_error(
        "run", "--resume", stopped, "--set", f"mesh.source={other}"
    )
    with h5py.File(stopped) as file:
        assert finished(file) == 4 and max(file["checkpoint/step"]) == 10


def test_other_painted_points_are_refused_in_one_line(tmp_path):
    path, points = tmp_path / "x.h5", tmp_path / "points.txt"
    points.write_text("0 1 2 3")
    scene = hanging(tmp_path, pin=[{"region": {"painted": points.name}}])
    assert stopped_after(10, "run", scene, "-o", path) == 0
    points.write_text("4 5 6 7")
    assert "a file that a pin names has changed" in command_error("run", "--resume", path)
    points.write_text("0 1 2 3")
    assert status_of("run", "--resume", path) == 0


@pytest.mark.parametrize(("step", "value"), [(9, 1e160), (10, 1e8)])
@pytest.mark.parametrize("name", ["q", "q_previous"])
def test_positions_that_no_frame_knows_are_refused(whole: Path, tmp_path, name, step, value):
    """Resume after step 9, which has a frame, and after step 10, which has none."""
    path = tmp_path / "x.h5"
    assert stopped_after(step, "run", whole.with_name("scene.toml"), "-o", path) == 0
    with h5py.File(path, "r+") as file:
        assert max(file["checkpoint/step"]) == step
        file[f"checkpoint/{name}"][...] = value
    before = path.read_bytes()
    assert "damaged" in command_error("run", "--resume", path) and path.read_bytes() == before


@pytest.mark.parametrize("lies_there", ["mesh", "mesh and another scene"])
def test_a_file_cannot_name_meshes_of_another_folder(
    whole: Path, stopped: Path, tmp_path, lies_there: str
):
    """The folder that the file names must contain the scene that names the mesh."""
    other = tmp_path / "other"
    other.mkdir()
    shutil.copy(whole.parent / "scene.ply", other / "scene.ply")
    if lies_there != "mesh":
        shutil.copy(other / "scene.ply", other / "its.ply")
        text = (whole.with_name("scene.toml")).read_text()
        (other / "scene.toml").write_text(text.replace("scene.ply", "its.ply"))
    with h5py.File(stopped, "r+") as file:
        file.attrs["scene_file"] = str(other / "scene.toml")
    for force in ([], ["--force"]):
        assert "name the SCENE too" in command_error("run", "--resume", stopped, *force)
    assert status_of("run", whole.with_name("scene.toml"), "--resume", stopped) == 0


@pytest.mark.parametrize(
    "option", ["-pc_type python -pc_python_type os.system", "-options_file x", "-log_view :x.py"]
)
def test_a_file_cannot_make_a_run_do_more_than_solve(
    stopped: Path, tmp_path, monkeypatch, option: str
):
    """Options without effect on results are dropped; options that choose no solver are refused."""
    monkeypatch.chdir(tmp_path)
    with h5py.File(stopped, "r+") as file:
        file.attrs["petsc_options"] = option
    if option.startswith("-log_view"):
        assert status_of("run", "--resume", stopped) == 0 and not list(tmp_path.glob("x*"))
    else:
        assert "is not taken from a file" in command_error("run", "--resume", stopped)


HOLDER = """
import pathlib, sys
from msmpetsc.results.disk import Lock
lock = Lock(pathlib.Path(sys.argv[1]))
print(flush=True)
sys.stdin.read()
"""


def test_a_file_that_is_being_written_is_left_alone(stopped: Path):
    command = [sys.executable, "-c", HOLDER, stopped]
    with subprocess.Popen(command, env=ENVIRONMENT, stdin=PIPE, stdout=PIPE) as holder:
        holder.stdout.readline()
        assert "is being written by another run" in command_error("run", "--resume", stopped)
    assert status_of("run", "--resume", stopped) == 0


def take_and_free(path: Path, times: int, twice) -> None:
    """Take and release a lock many times; a file written by its holder reveals a second holder."""
    for _ in range(times):
        try:
            lock = Lock(path)
        except InputError:
            continue
        try:
            os.close(os.open(path, os.O_CREAT | os.O_EXCL))
            os.unlink(path)
        except FileExistsError:
            twice.value += 1
        lock.close()
    os._exit(0)


def test_no_two_hold_a_lock(tmp_path):
    context = multiprocessing.get_context("fork")
    twice = context.Value("i", 0)
    four = [
        context.Process(target=take_and_free, args=(tmp_path / "x", 2000, twice)) for _ in range(4)
    ]
    for process in four:
        process.start()
    for process in four:
        process.join(60)
    assert [process.exitcode for process in four] == [0] * 4 and twice.value == 0


@pytest.mark.parametrize(
    "given", [[], ["--resume", "none.h5"], ["--resume", "none.h5", "-o", "other.h5"]]
)
def test_what_cannot_be_resumed_is_told(given, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert command_error("run", *given)


def stopped_and_whole(ranks: int, step: int, scene: Path, *words: object) -> list[Path]:
    """Return the results of a run that is stopped after a step, and of the whole run."""
    paths = [scene.with_name("x.h5"), scene.with_name("whole.h5")]
    for at, path in zip((step, -1), paths, strict=True):
        run(ranks, WORKER, at, "run", scene, "-o", path, *words, status=0)
    return paths


def test_on_two_ranks_exactly_and_on_another_number_closely(tmp_path):
    """A run stopped on two ranks after its fifth step resumes on two ranks and on a single rank."""
    scene = hanging(tmp_path, 12, solver={"preset": "newton", "error": 1e-10})
    path, whole = stopped_and_whole(2, 5, scene)
    other = shutil.copy(path, tmp_path / "y.h5")
    run(2, WORKER, -1, "run", "--resume", path, status=0)
    assert_same(path, whole)
    assert status_of("run", "--resume", other) == 0
    assert_same(other, whole, rtol=1e-8)


@pytest.mark.parametrize("ranks", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_on_several_coarse_levels_exactly(tmp_path, ranks: int):
    tables = BLOCK | {"material": {"young_modulus": 1e9, "density": 1000.0}, "solver": LOOSE}
    scene = block_scene(tmp_path, **swing(**tables, anchor=TIP_LED))
    path, whole = stopped_and_whole(ranks, 6, scene, "-pc_mg_levels", 3)
    run(ranks, WORKER, -1, "run", "--resume", path, status=0)
    assert_same(path, whole)
