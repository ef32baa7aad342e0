"""Runs from Python: msmpetsc.run writes and prints as the command does, and raises exceptions."""

import inspect
import shlex
import signal
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
from block_scene import GRAVITY, block_scene
from conftest import WORKERS, run
from one_process import errors, input_error
from stopped_runs import signal_after

import msmpetsc
from msmpetsc.app import abort, checkpoint_writer
from msmpetsc.app.request import OPTIONS, RunRequest
from msmpetsc.cli.main import main, parsed
from msmpetsc.errors import InputError
from msmpetsc.solve.petsc.words import options_of

FALL = {"gravity": GRAVITY, "time": {"step": 0.01, "duration": 0.05}}


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return block_scene(tmp_path, **FALL)


def positions(path: Path) -> np.ndarray:
    with h5py.File(path) as file:
        return file["frames/position"][...]


def test_it_writes_what_the_command_writes(scene: Path, tmp_path: Path, capsys):
    path = msmpetsc.run(
        scene, tmp_path / "python.h5", frames=2, set={"material.density": 900.0}, preset="newton"
    )
    assert path == tmp_path / "python.h5" and path.with_suffix(".xdmf").is_file()
    assert "frame 2/2" in capsys.readouterr().err
    words = ["--frames", "2", "--set", "material.density=900.0", "--preset", "newton"]
    assert main(["run", str(scene), "-o", str(tmp_path / "command.h5"), *words]) == 0
    assert np.array_equal(positions(path), positions(tmp_path / "command.h5"))
    # the stored command can be pasted
    with msmpetsc.open(path) as result:
        command = result.attributes["command"]
        assert command.startswith(
            f"msmpetsc run {scene} --output={path} --preset=newton --frames=2 --set="
        )


def test_the_xdmf_file_takes_little_time_even_with_a_checkpoint_at_each_frame(
    scene: Path, tmp_path: Path, monkeypatch
):
    """The file is written whole, so that writing it with each frame took ten times the run."""
    written: list[Path] = []
    monkeypatch.setattr(checkpoint_writer, "write_xdmf", written.append)
    time = {"time.step": 1e-3, "time.duration": 0.1}
    msmpetsc.run(scene, tmp_path / "x.h5", set=time, checkpoint_every=1, quiet=True)
    assert 1 <= len(written) < 50


def test_petsc_options_are_those_of_one_run(scene: Path, tmp_path: Path):
    from petsc4py import PETSc

    msmpetsc.run(scene, tmp_path / "first.h5", frames=1, quiet=True, preset="newton")
    before = PETSc.Options().getAll()
    for options in ("-ksp_rtol 1e-3 -ksp_max_it 77", {"ksp_rtol": 1e-3, "-ksp_max_it": 77}):
        path = msmpetsc.run(
            scene,
            tmp_path / "x.h5",
            frames=1,
            overwrite=True,
            quiet=True,
            preset="newton",
            petsc_options=options,
        )
        with msmpetsc.open(path) as result:
            assert options_of(result.attributes["petsc_options"].split()) | before == {
                "ksp_rtol": "0.001" if isinstance(options, dict) else "1e-3", "ksp_max_it": "77",
                **before,
            }  # fmt: skip
        assert PETSc.Options().getAll() == before
    with pytest.raises(InputError, match="-ksp_tpye: no part of this run"):
        msmpetsc.run(scene, tmp_path / "y.h5", quiet=True, petsc_options={"ksp_tpye": "cg"})
    assert PETSc.Options().getAll() == before
    with pytest.raises(InputError, match="-malloc_debug: PETSc runs already"):
        msmpetsc.run(scene, tmp_path / "y.h5", quiet=True, petsc_options="-malloc_debug")
    assert not (tmp_path / "y.h5").exists()


WRONG = {
    "--device is cpu or cuda": {"device": "gpu"},
    "material.dens": {"set": {"material.dens": 1}},
    "is no name of an option": {"petsc_options": {"ksp rtol": 1e-3}},
    "petsc_options must be str or Mapping, not ['-ksp_view']": {"petsc_options": ["-ksp_view"]},
    "set must be Mapping or Sequence, not 4": {"set": 4},
    "numbers like 1,5,20, not '[1, 2]'": {"export": "systems", "export_steps": [1, 2]},
}


@pytest.mark.parametrize("words", WRONG)
def test_what_cannot_be_meant_raises(scene: Path, tmp_path: Path, words: str):
    given = {"output": tmp_path / "x.h5", "quiet": True} | WRONG[words]
    assert words in input_error(lambda: msmpetsc.run(scene, **given))
    assert not (tmp_path / "x.h5").exists()


def test_an_interrupt_raises_and_the_run_goes_on(scene: Path, tmp_path: Path, monkeypatch):
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        signal_after(patch, 2, signal.SIGINT)
        msmpetsc.run(scene, tmp_path / "x.h5", quiet=True)
    path = msmpetsc.run(resume=tmp_path / "x.h5", quiet=True)
    assert len(positions(path)) == 6


def test_a_request_is_recorded_as_its_command():
    changes = {
        "pin": [{"region": {"box": [[0, 0, 0], [1, 1, 1]], "relative": True}}],
        "title": "a b",
    }
    options = {"ksp_view": None, "options_left": False}
    asked = RunRequest("s.toml", true_error=3, picture=True, set=changes, petsc_options=options)
    words = shlex.split(asked.command)
    assert words == [
        "msmpetsc", "run", "s.toml",
        "--set=pin=[{region = {box = [[0, 0, 0], [1, 1, 1]], relative = true}}]",
        '--set=title="a b"', "--picture", "--true-error=3", "-ksp_view", "-options_left", "false",
    ]  # fmt: skip
    given = {name: value for name, value in vars(parsed(words[1:])).items() if name in OPTIONS}
    assert RunRequest(**given).command == asked.command


def test_help_shows_all_keywords_with_their_types():
    parameters = inspect.signature(msmpetsc.run).parameters
    assert list(parameters) == list(OPTIONS) and parameters["frames"].annotation == int | None
    assert all(f"{name} " in msmpetsc.run.__doc__ for name in OPTIONS)


# ranks that fail, place and kind of the failure
FAILING_RANKS = [("1", "step", "input"), ("0", "model", "memory"), ("1,2", "model", "input")]


@pytest.mark.parametrize(("ranks", "where", "what"), FAILING_RANKS)
def test_a_failure_of_some_ranks_ends_all_with_its_line_and_status(tmp_path, ranks, where, what):
    """All ranks end, and neither a lock nor a temporary file is left."""
    scene = block_scene(tmp_path, time={"step": 0.01, "duration": 0.1})
    worker = WORKERS / "alone_worker.py"
    done = run(3, worker, ranks, where, what, "run", scene, "-o", tmp_path / "x.h5")
    said = {"input": "it fails", "memory": "there is not enough memory (Unable"}[what]
    (line,) = errors(done.stderr)
    assert done.returncode == 2 and line.startswith(f"msmpetsc: error: {said}")
    assert "Traceback" not in done.stderr
    assert not [path.name for path in tmp_path.glob("*x.h5.*")]


def test_ranks_that_ask_for_different_runs_are_refused(scene: Path, tmp_path: Path):
    """They waited for each other for ever."""
    done = run(2, WORKERS / "unlike_worker.py", scene, tmp_path / "x.h5", status=0)
    unlike = ["true_error", "picture", "petsc_options", "scene"]
    said = [
        f"{number} {name}: all ranks must ask for the same" for number, name in enumerate(unlike)
    ]
    assert sorted(done.stdout.splitlines()) == sorted(2 * [*said, "4 ran"])


def test_ranks_lose_patience_seconds_apart(monkeypatch):
    """The first rank to lose patience ends all ranks before they also report the error."""
    clock = SimpleNamespace(now=0.0, monotonic=lambda: clock.now)
    clock.sleep = lambda seconds: setattr(clock, "now", clock.now + seconds)
    monkeypatch.setattr(abort, "time", clock)
    ends = []
    for rank in range(3):
        meeting = SimpleNamespace(rank=rank, size=3)
        meeting.Ibarrier = lambda: SimpleNamespace(Test=lambda: False)
        assert not abort._all_fail(meeting)
        ends.append(clock.now)
    waits = np.diff([0.0, *ends])
    assert np.diff(waits).min() > 3


def test_completion_offers_public_names_alone():
    names = {name for name in dir(msmpetsc) if not name.startswith("__")}
    public = {"Frame", "Result", "Scene", "Simulation", "frames", "open", "run"}
    assert names == public | {"register_force", "register_obstacle", "register_preset"}
    assert "__version__" in dir(msmpetsc)
