"""Runs that go on from a checkpoint: exactly, on other ranks, with another scene, in a file that
has no room."""

import json
import multiprocessing
import os
import shutil
import signal
import tomllib
from pathlib import Path

import h5py
import numpy as np
import pytest
import tomli_w
from block_scene import block_scene
from conftest import WORKERS, run
from mpi4py import MPI
from one_process import command_error
from stopped_runs import (  # noqa: F401  # a fixture
    STEPS,
    assert_goes_on_exactly,
    assert_same,
    at_step,
    every_step_forgets,
    hanging,
    signal_after,
)  # fmt: skip

from msmpetsc.app.resume import Resumed
from msmpetsc.build import build_model
from msmpetsc.cli.main import main
from msmpetsc.errors import InputError
from msmpetsc.results.checkpoint_reader import Earlier
from msmpetsc.results.untrusted_file import finished
from msmpetsc.scene.reading import load_scene
from msmpetsc.solve.presets import PRESETS
from msmpetsc.solve.simulate import TimeLoop

COMM = MPI.COMM_SELF
GRAVITY = {"acceleration": [0.0, 1.0, -9.81]}
SIDE = [{"region": {"box": [[-0.01, -1.0, -1.0], [0.01, 1.0, 1.0]]}}]
FAR = {"box": [[0.49, -1, -1], [0.51, 1, 1]]}
LED = [{"region": FAR, "path": [{"time": 0.05, "by": [0.05, 0, 0.05]}], "stop": 0.08}]
# the anchor is released later
PUSHED = [{"region": {"box": [[0.24, -1, -1], [0.26, 1, 1]]}, "path": LED[0]["path"], "stop": 0.1}]
GROUND = {"shape": "plane", "point": [0, 0, 0], "normal": [0, 0, 1]}
PRESSING = [
    GROUND | {"response": "penalty", "friction": 0.5, "path": [{"time": 1.0, "by": [0, 0, 0.3]}]}
]
# thinner than the way of a step
THIN = {"shape": "box", "box": [[-2, -2, -0.001], [2, 2, 0]]}
SOFT = {"young_modulus": 1e4, "density": 1000.0}


def swing(**tables) -> dict:
    return {
        "gravity": GRAVITY,
        "pin": SIDE,
        "material": SOFT,
        "time": {"step": 0.02, "duration": 0.16},
    } | tables


def fall(**tables) -> dict:
    time, start = {"step": 0.01, "duration": 0.16}, {"velocity": [1.0, 0.0, -1.5]}
    mesh = {"source": "scene.ply", "base": [0, 0, 0.01]}
    return {
        "gravity": GRAVITY,
        "mesh": mesh,
        "material": SOFT,
        "time": time,
        "start": start,
    } | tables


def by(integrator: str, scene: dict) -> dict:
    return scene | {"time": scene["time"] | {"integrator": integrator}}


def by_error(error: float, scene: dict) -> dict:
    return scene | {"time": scene["time"] | {"error": error}}


def solver(preset: str) -> dict:
    return {"preset": preset} if PRESETS[preset].iterations else {"preset": preset, "error": 1e-3}


LOOSE = solver("newton")
CASES = {
    **{
        f"{preset}, {name}": fall(solver=solver(preset), obstacle=obstacle)
        for preset in PRESETS
        for name, obstacle in {"reflected": [GROUND], "pressed": PRESSING}.items()
        if preset in ("newton", "lbfgs") or name == "pressed"
        # anderson diverges there
        if preset != "anderson"
    },
    # the estimate at a start depends on the earlier preconditioner
    "loose, pressed": fall(
        solver={"preset": "newton", "error": 0.3},
        obstacle=PRESSING,
        time={"step": 0.01, "duration": 0.24},
    ),
    "anchor": swing(solver=LOOSE, anchor=LED, output={"surface": False, "every": 3}),
    "bdf2": by("bdf2", swing(solver=LOOSE)),
    "static": by("static", swing(solver=LOOSE, anchor=[LED[0] | {"stop": 0.05}, *PUSHED])),
    "bdf2, pressed": by("bdf2", fall(solver=LOOSE, obstacle=PRESSING)),
    "a thin plate": fall(solver=LOOSE, obstacle=[THIN | {"response": "penalty", "friction": 0.5}]),
    "bdf2, a thin plate": by("bdf2", fall(solver=LOOSE, obstacle=[THIN | {"restitution": 0.5}])),
    "verlet, a thin plate": by("verlet", fall(obstacle=[THIN | {"response": "penalty"}])),
    "verlet": by("verlet", swing(output={"surface": False, "every": 3})),
    "substep, scattered": swing(
        solver=solver("anderson"),
        start={"scatter": 0.9},
        safety={"on_failure": "substep"},
        # pieces of an eighth and more, with which the next step begins
        material=SOFT | {"young_modulus": 1e6},
    ),
    "fallback, scattered": swing(
        solver=solver("anderson"),
        start={"scatter": 0.9},
        safety={"on_failure": "fallback"},
        material=SOFT | {"young_modulus": 1e6},
    ),
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


def test_a_checkpoint_has_no_more_than_the_run_needs(tmp_path):
    def rows(scene: dict) -> set[str]:
        read = load_scene(block_scene(tmp_path, **scene))
        with TimeLoop(COMM, read, build_model(COMM, read)) as simulation:
            return simulation.saved.rows.keys() - {"q", "q_previous"}

    # each implicit step is examined for a minimum
    followed = {"lowest_mode"}
    assert rows(swing(solver=LOOSE)) == followed
    assert rows(by("verlet", swing())) == set()
    assert rows(by("bdf2", fall(solver=LOOSE, obstacle=PRESSING))) == followed | {
        "history_q",
        "history_v",
    }
    assert rows(by("verlet", fall(obstacle=[THIN]))) == {"sides"}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Never stopped; every third step also solved to rounding."""
    folder = tmp_path_factory.mktemp("whole")
    assert (
        main(["run", str(hanging(folder)), "-o", str(folder / "whole.h5"), "--true-error", "3"])
        == 0
    )
    return folder / "whole.h5"


@pytest.fixture
def stopped(whole: Path, tmp_path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The same, stopped after ten steps."""
    path = tmp_path / "stopped.h5"
    with monkeypatch.context() as patch:
        signal_after(patch, 10, signal.SIGUSR1)
        assert (
            main(["run", str(whole.parent / "scene.toml"), "-o", str(path), "--true-error", "3"])
            == 0
        )
    return path


def test_what_was_asked_for_beside_the_frames_is_there_after_going_on(whole: Path, stopped: Path):
    cost, picture = stopped.with_suffix(".json"), stopped.with_suffix(".png")
    pytest.importorskip("pyvista")
    assert main(["run", "--resume", str(stopped), "--measure", str(cost), "--picture"]) == 0
    # the true errors are equal, too
    assert_same(stopped, whole)
    assert json.loads(cost.read_text())["time"]["stepping"] > 0 and picture.stat().st_size > 1000
    assert stopped.with_suffix(".xdmf").read_text().count("<Time") == 2 * finished(h5py.File(whole))


def test_frames_after_the_checkpoint_are_kept_as_they_are(whole: Path, tmp_path, monkeypatch):
    """With a checkpoint at the start alone and a failure later, not a frame is written again."""
    path = tmp_path / "x.h5"

    def killed() -> None:
        raise InterruptedError

    with monkeypatch.context() as patch:
        at_step(patch, 21, killed)
        arguments = ["-o", str(path), "--true-error", "3", "--checkpoint-every", "1000"]
        assert main(["run", str(whole.parent / "scene.toml"), *arguments]) == 1
    with h5py.File(path) as file:
        assert max(file["checkpoint/step"]) == 0 and finished(file) == 8
        times = file["frames/wall_time"][:]
    # the trimmed file is written anew
    assert main(["run", "--resume", str(path)]) == 0
    assert_same(path, whole)
    with h5py.File(path) as file:
        assert np.array_equal(file["frames/wall_time"][:8], times)


@pytest.mark.parametrize(
    ("every", "steps"), [("1", {39, 40}), ("4", {24, 36, 40}), ("1000", {0, 40})]
)
def test_checkpoints_come_as_often_as_asked_and_at_the_end(whole: Path, tmp_path, every, steps):
    path = tmp_path / "x.h5"
    assert (
        main(
            ["run", str(whole.parent / "scene.toml"), "-o", str(path), "--checkpoint-every", every]
        )
        == 0
    )
    with h5py.File(path) as file:
        assert set(file["checkpoint/step"]) <= steps and max(file["checkpoint/step"]) == STEPS


def test_nothing_is_left_to_do(whole: Path, capsys):
    before = whole.read_bytes()
    assert main(["run", "--resume", str(whole)]) == 0
    assert "nothing left to do" in capsys.readouterr().err
    assert whole.read_bytes() == before


def test_another_scene_is_refused_with_its_keys(stopped: Path, capsys):
    scene = Path(h5py.File(stopped).attrs["scene_file"])
    before = stopped.read_bytes()
    given = ["--set", "time.duration=0.8", "--set", "material.density=900", "--preset", "anderson"]
    assert main(["run", str(scene), "--resume", str(stopped), *given]) == 2
    told = capsys.readouterr().err
    for key, earlier in (
        ("time.duration", 0.4),
        ("material.density", 1000.0),
        ("solver.preset", "newton"),
    ):
        assert f"{key}: {earlier} in {stopped}" in told
    assert main(["run", "--resume", str(stopped), "--set", "time.step=0.005", "--force"]) == 2
    assert "time.step: 0.01 in" in capsys.readouterr().err
    assert stopped.read_bytes() == before


def test_other_options_of_petsc_are_refused_unless_they_only_tell(whole: Path):
    earlier, scene = Earlier.read(whole), load_scene(whole.parent / "scene.toml")
    with pytest.raises(InputError, match=r"-ksp_rtol: none in .*whole\.h5, 1e-2 now"):
        Resumed(earlier, scene, {"ksp_rtol": "1e-2"}, force=False)
    silent = {"log_view": "", "snes_monitor": "", "use_gpu_aware_mpi": "0"}
    assert Resumed(earlier, scene, silent, force=False).differs == []
    assert Resumed(earlier, scene, {"ksp_rtol": "1e-2"}, force=True).is_done


def test_a_longer_run(whole: Path, stopped: Path, tmp_path):
    """A longer run from a stopped and from a finished file.

    The 40th step had a frame as the last step; now it has none.
    """
    longer = tmp_path / "longer.h5"
    more = ["--set", "time.duration=0.56"]
    assert (
        main(
            ["run", str(whole.parent / "scene.toml"), "-o", str(longer), *more, "--true-error", "3"]
        )
        == 0
    )
    done = tmp_path / "done.h5"
    done.write_bytes(whole.read_bytes())
    for path in (stopped, done):
        assert main(["run", "--resume", str(path), *more, "--force"]) == 0
        assert_same(path, longer)
        with h5py.File(path) as file:
            assert tomllib.loads(file.attrs["scene"])["time"]["duration"] == 0.56
            assert "(to step " in file.attrs["earlier"]
    # no temporary file is left
    assert sorted(path.suffix for path in tmp_path.glob(".*")) == []


def left_by_a_kill(
    monkeypatch: pytest.MonkeyPatch, step: int, path: Path, arguments: list[str]
) -> None:
    """The run's file as a kill after that step would leave it."""
    left: list[bytes] = []
    with monkeypatch.context() as patch:
        at_step(patch, step, lambda: left.append(path.read_bytes()))
        assert main(arguments) == 0
    path.write_bytes(left[0])


@pytest.mark.parametrize("killed", [11, 13, 25])
def test_a_longer_run_after_a_stop_between_frames_and_a_kill(
    whole: Path, stopped: Path, tmp_path, monkeypatch, killed
):
    """The effort since the frame before the checkpoint counts, whatever frames came after it."""
    longer, more = tmp_path / "longer.h5", ["--set", "time.duration=0.56"]
    left_by_a_kill(
        monkeypatch,
        killed,
        stopped,
        ["run", "--resume", str(stopped), "--checkpoint-every", "1000"],
    )
    with h5py.File(stopped) as file:
        assert max(file["checkpoint/step"]) == 10 and finished(file) == 1 + killed // 3
    assert main(["run", "--resume", str(stopped), *more, "--force"]) == 0
    assert (
        main(
            ["run", str(whole.parent / "scene.toml"), "-o", str(longer), *more, "--true-error", "3"]
        )
        == 0
    )
    assert_same(stopped, longer)


def test_numbers_of_another_version_are_not_written_over(stopped: Path, capsys):
    with h5py.File(stopped, "r+") as file:
        file["checkpoint/numbers"].attrs["names"] += "_of_old"
    assert main(["run", "--resume", str(stopped)]) == 2
    assert "has no room for checkpoint/numbers as it is now: --force" in capsys.readouterr().err


def test_a_run_cannot_end_before_its_checkpoint(stopped: Path, capsys):
    before = stopped.read_bytes()
    for duration, steps in ((0.1, 10), (0.096, 10), (0.094, 9)):
        status = main(
            ["run", "--resume", str(stopped), "--set", f"time.duration={duration}", "--force"]
        )
        told = capsys.readouterr().err
        assert (status, "damaged" in told) == ((2, False) if steps == 10 else (0, False)), told
        assert (
            "has come to step 10 already: it cannot end at step 10" in told
            or "nothing left to do" in told
        )
        assert stopped.read_bytes() == before


def test_another_start_takes_no_frame_of_before_the_first_checkpoint(
    whole: Path, tmp_path, monkeypatch
):
    """Killed between frame 0 and the first checkpoint."""
    path, other = tmp_path / "x.h5", ["--set", "start.velocity=[1.0, 0.0, 0.0]"]
    scene = str(whole.parent / "scene.toml")
    left_by_a_kill(monkeypatch, 0, path, ["run", scene, "-o", str(path), "--frames", "3"])
    with h5py.File(path, "r+") as file:
        file["checkpoint/step"][...] = -1
        assert finished(file) == 1
    assert main(["run", "--resume", str(path), *other, "--force"]) == 0
    assert main(["run", scene, "-o", str(tmp_path / "other.h5"), "--frames", "3", *other]) == 0
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


@pytest.mark.parametrize(("step", "value"), [(9, 1e160), (10, 1e8)])
@pytest.mark.parametrize("name", ["q", "q_previous"])
def test_positions_that_no_frame_knows_are_refused(
    whole: Path, tmp_path, monkeypatch, name, step, value
):
    """After step 9, of which there is a frame, and step 10, of which there is none."""
    path = tmp_path / "x.h5"
    with monkeypatch.context() as patch:
        signal_after(patch, step, signal.SIGUSR1)
        main(["run", str(whole.parent / "scene.toml"), "-o", str(path)])
    with h5py.File(path, "r+") as file:
        assert max(file["checkpoint/step"]) == step
        file[f"checkpoint/{name}"][...] = value
    before = path.read_bytes()
    assert "damaged" in command_error("run", "--resume", path) and path.read_bytes() == before


@pytest.mark.parametrize("lies_there", ["mesh", "mesh and another scene"])
def test_a_file_cannot_name_meshes_of_another_folder(
    whole: Path, stopped: Path, tmp_path, lies_there: str
):
    """The folder that the file names is not trusted: it must hold the scene that names the mesh."""
    other = tmp_path / "other"
    other.mkdir()
    shutil.copy(whole.parent / "scene.ply", other / "scene.ply")
    if lies_there != "mesh":
        shutil.copy(other / "scene.ply", other / "its.ply")
        text = (whole.parent / "scene.toml").read_text()
        (other / "scene.toml").write_text(text.replace("scene.ply", "its.ply"))
    with h5py.File(stopped, "r+") as file:
        file.attrs["scene_file"] = str(other / "scene.toml")
    for force in ([], ["--force"]):
        assert "name the SCENE too" in command_error("run", "--resume", stopped, *force)
    assert main(["run", str(whole.parent / "scene.toml"), "--resume", str(stopped)]) == 0


@pytest.mark.parametrize(
    "option", ["-pc_type python -pc_python_type os.system", "-options_file x", "-log_view :x.py"]
)
def test_a_file_cannot_make_a_run_do_more_than_solve(
    stopped: Path, tmp_path, monkeypatch, option: str
):
    """Options without effect on results are dropped. Options that choose no solver are refused."""
    monkeypatch.chdir(tmp_path)
    with h5py.File(stopped, "r+") as file:
        file.attrs["petsc_options"] = option
    if option.startswith("-log_view"):
        assert main(["run", "--resume", str(stopped)]) == 0 and not list(tmp_path.glob("x*"))
    else:
        assert "is not taken from a file" in command_error("run", "--resume", stopped)


def test_a_file_that_is_being_written_is_left_alone(stopped: Path):
    from msmpetsc.results.disk import Lock

    held, done = multiprocessing.Event(), multiprocessing.Event()

    def hold() -> None:
        lock = Lock(stopped)
        held.set()
        done.wait(60)
        lock.free()
        os._exit(0)

    other = multiprocessing.get_context("fork").Process(target=hold)
    other.start()
    held.wait(60)
    assert "is being written by another run" in command_error("run", "--resume", stopped)
    done.set()
    other.join()
    assert main(["run", "--resume", str(stopped)]) == 0


def take_and_free(path: Path, times: int, twice) -> None:
    """Take and free a lock many times. A file for its holder alone reveals a second holder."""
    from msmpetsc.results.disk import Lock

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
        lock.free()
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


def test_on_two_ranks_exactly_and_on_another_number_closely(tmp_path):
    """Stopped on two ranks after its fifth step, then resumed on two ranks and on a single rank."""
    worker = WORKERS / "stop_worker.py"
    scene = hanging(tmp_path, 12, solver={"preset": "newton", "error": 1e-10})
    for step, name in ((5, "x.h5"), (-1, "whole.h5")):
        run(2, worker, step, "run", scene, "-o", tmp_path / name, status=0)
    (tmp_path / "y.h5").write_bytes((tmp_path / "x.h5").read_bytes())
    assert run(2, worker, -1, "run", "--resume", tmp_path / "x.h5").returncode == 0
    assert_same(tmp_path / "x.h5", tmp_path / "whole.h5")
    assert main(["run", "--resume", str(tmp_path / "y.h5")]) == 0
    assert_same(tmp_path / "y.h5", tmp_path / "whole.h5", rtol=1e-8)
