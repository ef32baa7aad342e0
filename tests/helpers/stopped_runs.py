"""Runs to be stopped: a hanging block, signals at a step, ranks of an mpiexec, comparisons."""

import copy
import os
import signal
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import h5py
import numpy as np
import pytest
from block_scene import block_scene
from mpi4py import MPI

from msmpetsc.build import build_model
from msmpetsc.cli.main import main
from msmpetsc.fields import FRAME_FIELDS, Frame
from msmpetsc.results.untrusted_file import finished
from msmpetsc.scene.reading import load_scene
from msmpetsc.solve import simulate
from msmpetsc.solve.simulate import TimeLoop

EVERY, STEPS = 3, 40


@pytest.fixture(scope="module", autouse=True)
def every_step_forgets() -> Iterator[None]:
    """Write a checkpoint after each step, so that a run can continue from any step."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulate, "REMEMBERED", 1)
        yield


def hanging(folder: Path, steps: int = STEPS, **tables) -> Path:
    """Return a soft block that hangs by a side and swings, with a frame every third step."""
    side = [{"region": {"box": [[-0.01, -1.0, -1.0], [0.01, 1.0, 1.0]]}}]
    material = {"young_modulus": 1e5, "density": 1000.0}
    output = {"surface": True, "every": EVERY}
    gravity = {"acceleration": [0.0, 1.0, -9.81]}
    time, solver = {"step": 0.01, "duration": 0.01 * steps}, {"preset": "newton", "error": 1e-3}
    scene = dict(gravity=gravity, pin=side, time=time, material=material, output=output)
    return block_scene(folder, **scene | {"solver": solver} | tables)


def assert_same(path: Path, whole: Path, rtol: float = 0.0) -> None:
    """Assert that all frames agree to ``rtol``, bit by bit for 0, except wall times."""
    with h5py.File(path) as one, h5py.File(whole) as other:
        assert one["frames"].keys() == other["frames"].keys() and finished(one) == finished(other)
        stored = (FRAME_FIELDS.keys() & one["frames"]) - {"wall_time"}
        names = ["frames/position"] if rtol else [f"frames/{name}" for name in stored]
        for name in names:
            found, expected = one[name][...], other[name][...]
            assert found.shape == expected.shape, name
            if rtol:
                np.testing.assert_allclose(
                    found, expected, rtol=0, atol=rtol * np.abs(expected).max()
                )
            else:
                assert np.array_equal(found, expected, equal_nan=True), name


def at_step(
    monkeypatch: pytest.MonkeyPatch, step: int, action: Callable[[], object], is_stored: bool = True
) -> None:
    """Call ``action`` when the run has taken that step, before or after its frame is stored."""
    advance = TimeLoop.advance

    def watched(simulation):
        for frame in advance(simulation):
            if simulation.step == step and not is_stored:
                action()
            yield frame
            if simulation.step == step and is_stored:
                action()

    monkeypatch.setattr(TimeLoop, "advance", watched)


def signal_after(monkeypatch: pytest.MonkeyPatch, step: int, number: signal.Signals) -> None:
    """Send the signal to this process when the run has taken that step."""
    at_step(monkeypatch, step, lambda: os.kill(os.getpid(), number), is_stored=False)


def stopped_after(step: int, *words: object, number: signal.Signals = signal.SIGUSR1) -> int:
    """Run a command, to which the signal comes after that step, and return its exit status."""
    with pytest.MonkeyPatch.context() as patch:
        signal_after(patch, step, number)
        return main([*map(str, words)])


def assert_equal(found: dict, expected: dict) -> None:
    """Assert that frames or checkpoints agree bit by bit, except wall times."""
    assert found.keys() == expected.keys()
    for name in expected.keys() - {"wall_time", "Monitors.work.wall_time"}:
        assert expected[name] is None or np.array_equal(
            found[name], expected[name], equal_nan=True
        ), name


def assert_goes_on_exactly(path: Path, every: int) -> list[Frame | None]:
    """Check that two steps from some checkpoints of a run give the same frames and checkpoints.

    Agreement is to the last bit. Returns the frames of the whole run, None for a step without a
    frame.

    every : number of steps between checkpoints
    """
    scene, comm = load_scene(path), MPI.COMM_SELF
    model, frames, saved = build_model(comm, scene), [], []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulate, "REMEMBERED", every)
        with TimeLoop(comm, scene, model) as simulation:
            for frame in simulation.advance():
                frames.append(frame)
                saved.append(copy.deepcopy(simulation.saved))
        count = len(saved)
        begins = {every, 2 * every, 4 * every}
        begins |= {step // every * every for step in (count // 2, count - 2)}
        for begin in begins & {*range(1, count - 1)}:
            with TimeLoop(comm, scene, model) as simulation:
                simulation.restore(saved[begin])
                for frame, index in zip(
                    simulation.advance(), range(begin + 1, begin + 3), strict=False
                ):
                    after = simulation.saved
                    assert after.step == saved[index].step == index // every * every
                    assert_equal(after.rows, saved[index].rows)
                    assert_equal(after.numbers, saved[index].numbers)
                    assert (frame is None) == (frames[index] is None)
                    if frame is not None:
                        assert_equal(vars(frame), vars(frames[index]))
    return frames


def ranks_of(mpiexec: subprocess.Popen) -> list[int]:
    """Return the process numbers of its ranks."""
    children = Path(f"/proc/{mpiexec.pid}/task/{mpiexec.pid}/children").read_text().split()
    return sorted(
        int(child) for child in children if b"python" in Path(f"/proc/{child}/cmdline").read_bytes()
    )
