"""Runs on a GPU, real or pretended (pretend_gpu), give the frames of a CPU.

Arrays of CPU and GPU never mix. Only frames and checkpoints are copied to the CPU.
"""

import importlib
import json
import re
import shutil
import struct
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import patch

import h5py
import numba
import numpy as np
import pretend_gpu
import pytest
from block_scene import CELL, GRAVITY, block_scene, box_at, plane_at, play, solid_of
from conftest import WORKERS, python, run
from mpi4py import MPI
from petsc4py import PETSc
from pretend_gpu import pretended
from scipy.sparse import csr_array
from stopped_runs import assert_goes_on_exactly

import msmpetsc
from msmpetsc.build import build_model
from msmpetsc.fields import Frame
from msmpetsc.scene.reading import load_scene
from msmpetsc.solve.linear.assembled_hessian import assembled, blocks_of
from msmpetsc.solve.petsc import device
from msmpetsc.solve.simulate import TimeLoop

PACKAGE = Path(msmpetsc.__file__).parent
T = 0.01
FALL = {
    "time": {"step": T, "duration": 8 * T},
    "gravity": GRAVITY,
    "start": {"velocity": [0.1, 0, -1.0]},
}
FLOOR = plane_at(-0.01)
PRESSES = [{"time": 4 * T, "by": [0.01, 0, -0.05]}]
PLATE = box_at([[-1, -1, 0.25], [2, 2, 0.5]], response="penalty", friction=0.3, path=PRESSES)
# thinner than the path of a node in a step
THIN = box_at([[-1, -1, -0.0041], [2, 2, -0.004]])
HELD = {"pin": [{"region": {"box": [[0, 0, 0], [0.1, 1, 1]], "relative": True}}]}
LED = {
    "anchor": [{"region": {"box": [[0.9, 0, 0], [1, 1, 1]], "relative": True}, "stop": 4 * T,
                "path": [{"time": 4 * T, "by": [0.05, 0, 0]}]}]
}  # fmt: skip
SOFT = {"material": {"young_modulus": 2e4, "density": 1000.0, "law": "linear"}}
SOLID = {"material": solid_of(2e4, 0.4)}
VISCOUS = {"material": {**SOLID["material"], "retardation_time": 0.01}}
ROLLS = {
    "pin": [*HELD["pin"], {"region": {"half_space": {"point": [0, 0.01, 0], "normal": [0, -1, 0]}},
                           "fix": ["y"]}],
    "traction": [{"region": {"box": [[0.9, 0, 0], [1, 1, 1]], "relative": True},
                  "value": [200, 100, 50], "stop": 4 * T}],
}  # fmt: skip
CASES = {
    "newton": FALL,
    "solid": {**FALL, **SOLID, **HELD, **LED},
    "solid, pressed, viscous": {**FALL, **VISCOUS,
    "obstacle": [{**FLOOR, "response": "penalty"}, PLATE]},
    "solid, static": {
        "time": {**FALL["time"], "integrator": "static"},
        "gravity": {"acceleration": [0, 0, -40.0]}, **HELD,
        "material": {**SOLID["material"], "poisson_ratio": 0.499, "volume": "log"},
        "output": {"stress": True},
    },
    "solid, verlet": {
        **FALL, **SOLID, **ROLLS, **LED, "time": {**FALL["time"], "integrator": "verlet"},
    },
    "solid, multigrid": {**FALL, **VISCOUS, **ROLLS,
    "solver": {"preset": "newton-multigrid", "error": 1e-9}},
    "held, led and let go": {**FALL, **HELD, **LED},
    "reflected": {**FALL, "obstacle": [{**FLOOR, "response": "reflect"}]},
    "pressed and rubbed": {**FALL, **SOFT, "obstacle": [{**FLOOR, "response": "penalty"}, PLATE]},
    "thin plates": {**FALL,
    "obstacle": [{**THIN, "response": "penalty", "friction": 0.3}, {**THIN, "start": 5 * T}]},
    "thin plates, verlet": {
        **FALL, "time": {**FALL["time"], "integrator": "verlet"},
        "obstacle": [{**THIN, "response": "penalty", "path": [{"time": 1.0, "by": [0, 0, 1.0]}]}],
    },
    "bdf2": {**FALL, **HELD, "time": {**FALL["time"], "integrator": "bdf2"}},
    "static": {
        "time": {**FALL["time"], "integrator": "static"}, "gravity": GRAVITY, **HELD, **LED, **SOFT,
        "obstacle": [{**PLATE, "friction": 0.0}],
    },
    "verlet": {
        **FALL, **LED, "time": {**FALL["time"], "integrator": "verlet"},
        "obstacle": [{**FLOOR, "response": "reflect"}, PLATE],
    },
    **{
        preset: {**FALL, **HELD, "solver": {"preset": preset, "error": 1e-9}}
        for preset in ("anderson", "lbfgs", "newton-multigrid", "newton-projected", "fast-msm")
    },
    "paper": {**FALL, **HELD, "solver": {"preset": "paper"}},
}  # fmt: skip


# bodies that strike too hard for the plain iteration to converge
FAILING = {
    **CASES["pressed and rubbed"], "time": {"step": T, "duration": 2 * T},
    "solver": {"preset": "fast-msm", "error": 1e-9}, "start": {"velocity": [0.1, 0, -10.0]},
}  # fmt: skip


@contextmanager
def real() -> Iterator[None]:
    """Make runs within the context compute on the machine's GPU; skip the test if there is none."""
    lacking = device.what_is_missing()
    if lacking:
        pytest.skip(lacking)
    PETSc.Options()["mat_type"] = "aijcusparse"
    try:
        yield
    finally:
        del PETSc.Options()["mat_type"]


on_a_gpu = pytest.mark.parametrize(
    "on_gpu", [pretended, pytest.param(real, marks=pytest.mark.cuda)]
)


def positions(frames: list[Frame]) -> np.ndarray:
    """Return the positions (T, n, 3) [m] of all frames."""
    return np.array([frame.position for frame in frames])


# cases whose kernels take a minute to compile or run in the pretended GPU
LONG = {"solid": pytest.mark.slow, "solid, static": pytest.mark.slow}


@on_a_gpu
@pytest.mark.parametrize("case", [pytest.param(case, marks=LONG.get(case, ())) for case in CASES])
def test_frames_are_those_of_the_cpu(tmp_path: Path, case: str, on_gpu):
    path = block_scene(tmp_path, **CASES[case])
    with on_gpu() as counted:
        there = play(path)[1]
    here = play(path)[1]
    assert not counted or counted["launches"] > 50
    assert np.abs(positions(here) - here[0].position).max() > 1e-3
    np.testing.assert_allclose(positions(there), positions(here), rtol=0, atol=1e-8)
    for name in ("kinetic", "elastic", "potential", "contact"):
        energies = [[getattr(frame, name) for frame in frames] for frames in (there, here)]
        np.testing.assert_allclose(*energies, rtol=1e-5, atol=1e-9)
    assert [frame.inverted for frame in there] == [frame.inverted for frame in here]


@on_a_gpu
@pytest.mark.parametrize(
    "case",
    ["pressed and rubbed", pytest.param("solid, pressed, viscous", marks=pytest.mark.slow)],
)
def test_an_exported_hessian_is_that_of_the_cpu(tmp_path: Path, case: str, on_gpu):
    scene = load_scene(block_scene(tmp_path, **CASES[case]))

    def second_hessian() -> np.ndarray:
        found = []

        def keep(step, _, jacobian):
            if step == 2:
                found.append(assembled(jacobian.unknowns, blocks_of(jacobian.hessian)))

        model = build_model(MPI.COMM_SELF, scene)
        with TimeLoop(MPI.COMM_SELF, scene, model, system_monitor=keep) as simulation:
            for _ in simulation.advance():
                if found:
                    return csr_array(found[0].getValuesCSR()[::-1]).toarray()
        raise AssertionError("no system was solved")

    with on_gpu():
        there = second_hessian()
    here = second_hessian()
    np.testing.assert_allclose(there, here, rtol=0, atol=1e-8 * np.abs(here).max())


@on_a_gpu
def test_a_step_that_fails_is_rescued(tmp_path: Path, on_gpu):
    path = block_scene(tmp_path, **FAILING, safety={"on_failure": "fallback"})
    with on_gpu():
        there = play(path)[1]
    here = play(path)[1]
    assert sum(frame.fallbacks for frame in there) == sum(frame.fallbacks for frame in here) > 0
    np.testing.assert_allclose(positions(there), positions(here), rtol=0, atol=1e-6)


@pytest.mark.parametrize("case", ["newton", "held, led and let go", "pressed and rubbed", "verlet"])
def test_positions_come_back_for_frames_that_are_stored_and_no_other_array_is_carried(
    tmp_path: Path, case: str
):
    """No other array of the body's size is copied; a few numbers are, as obstacle positions."""
    scene = load_scene(block_scene(tmp_path, **CASES[case], output={"surface": False, "every": 4}))
    with (
        pretended() as counted,
        TimeLoop(MPI.COMM_SELF, scene, build_model(MPI.COMM_SELF, scene)) as simulation,
    ):
        frame = None
        for frame in simulation.advance():  # noqa: B007  # the last one is asked for
            if simulation.step == 4:
                counted.clear()
    assert simulation.step == 8 and frame is not None
    assert counted["arrays from the GPU"] == 1 and counted["arrays to the GPU"] == 0


@pytest.mark.parametrize("case", ["held, led and let go", "pressed and rubbed", "bdf2", "verlet"])
def test_a_run_goes_on_from_what_was_saved_to_the_last_bit(tmp_path: Path, case: str):
    with pretended():
        assert_goes_on_exactly(block_scene(tmp_path, **CASES[case]), every=4)


# 12 threads, because simulated threads are slow
SMALLEST = {
    "sides": np.array([2, 1, 1]) * CELL,
    "start": {"velocity": [0.3, 0, -3.0], "scale": [1, 1, 0.45]},
}
SIMULATED = {
    "pressed": {
        **CASES["pressed and rubbed"], "time": {"step": T, "duration": 2 * T},
        "solver": {"preset": "newton", "error": 1e-4},
    },
    "multigrid": {
        **CASES["pressed and rubbed"], "time": {"step": T, "duration": 2 * T},
        # only on a CPU its cycle is in single precision
        "solver": {"preset": "newton-multigrid", "error": 1e-9},
        # the body touches the obstacle at the start
        "obstacle": [{**FLOOR, "point": [0, 0, 0.01], "response": "penalty", "friction": 0.3}],
    },
    "verlet": {**CASES["verlet"], "time": {"step": T, "duration": T, "integrator": "verlet"}},
    "solid": {**CASES["solid, multigrid"], "time": {"step": T, "duration": 2 * T}},
}  # fmt: skip


def test_kernels_do_the_same_as_threads(tmp_path: Path):
    """All kernels give the same values as threads in numba's CUDA simulator."""
    paths = [
        block_scene(tmp_path, name=name, **{**case, **SMALLEST}) for name, case in SIMULATED.items()
    ]
    ran, *last = python(WORKERS / "simulator_worker.py", *paths, check=True).stdout.splitlines()
    assert set(ran.split()) == {body.__name__ for body in bodies()}
    for path, line in zip(paths, last, strict=True):
        accuracy = 1e-10 if path.stem == "multigrid" else 1e-12
        here, there = (
            positions(play(path)[1]),
            np.array([float.fromhex(x) for x in line.split()]).reshape(-1, 3),
        )
        assert np.abs(here[-1] - here[0]).max() > 1e-2
        np.testing.assert_allclose(there, here[-1], rtol=0, atol=accuracy)


def bodies() -> list[Callable]:
    """Return the bodies that ``kernel`` was called with."""
    found = []
    for path in PACKAGE.rglob("*.py"):
        if "\n@kernel\n" in path.read_text():
            module = importlib.import_module(
                ".".join(("msmpetsc", *path.relative_to(PACKAGE).with_suffix("").parts))
            )
            found += [one.__wrapped__ for one in vars(module).values() if hasattr(one, "compiled")]
    return found


def test_kernels_compile_for_a_gpu(tmp_path: Path):
    """Kernels compile to PTX for the argument types of runs, without a GPU.

    If ptxas is installed, they also compile to machine code without register spills.
    """
    for package in ("numba_cuda", "cupy"):
        pytest.importorskip(package, reason=f"no {package} here: pip install 'msmpetsc[cuda]'")
    given = {}

    def launcher(body):
        def launch(count, *arguments):
            given[body] = arguments
            pretend_gpu.launcher(body)(count, *arguments)

        return launch

    with pretended(launcher):
        for name, case in SIMULATED.items():
            play(block_scene(tmp_path, name=name, **{**case, **SMALLEST}))
    assert set(given) == set(bodies())
    from msmpetsc.backend import launcher

    h100 = SimpleNamespace(compute_capability=(9, 0))

    def as_launched(argument):
        array = pretend_gpu.bare(argument)
        if isinstance(array, tuple):
            kinds, words = zip(*map(as_launched, argument), strict=True)
            return (type(array), *kinds), tuple(chain.from_iterable(words))
        if not isinstance(array, np.ndarray):
            return launcher.as_argument(array)
        return launcher.described(array.ctypes.data, array.shape, array.strides, array.dtype.str)

    def writable(kind):
        return kind.copy(readonly=False) if isinstance(kind, numba.types.Array) else kind

    for body, arguments in given.items():
        kinds, words = zip(*map(as_launched, arguments), strict=True)
        types = tuple(map(launcher.type_of, kinds))
        assert types == tuple(writable(numba.typeof(pretend_gpu.bare(one))) for one in arguments)
        with patch("numba.cuda.dispatcher.get_current_device", lambda: h100):
            ptx = launcher.ptx_of(body, kinds, (9, 0))
        assert ".target sm_90" in ptx
        # the number of words comes first
        words = (0, *chain.from_iterable(words))
        assert len(words) == len(re.findall(r"^\s*\.param ", ptx, re.M)), body.__name__
        struct.pack("q" + "".join(map(launcher.format_of, kinds)), *words)
        if shutil.which("ptxas"):
            (tmp_path / "kernel.ptx").write_text(ptx)
            files = [tmp_path / "kernel.cubin", tmp_path / "kernel.ptx"]
            command = ["ptxas", "-arch=sm_90", "-v", "-o", *files]
            said = subprocess.run(command, capture_output=True, text=True, check=True).stderr
            print(body.__name__, said)
            assert "0 bytes stack frame, 0 bytes spill stores, 0 bytes spill loads" in said


ON_GPUS = """
import sys, petsc4py
petsc4py.init([])
from pretend_gpu import pretended
from scipy.sparse import csr_array
from msmpetsc.cli.main import main
with pretended():
    sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.slow
@pytest.mark.parametrize("ranks", [3, pytest.param(2, marks=pytest.mark.cuda)])
def test_ranks_agree_on_gpus_too(tmp_path: Path, ranks: int):
    """Runs on ranks with ghosts, with pretended or real GPUs, agree with a run on a CPU."""
    path = block_scene(tmp_path, **CASES["pressed and rubbed"])
    there = ["-c", ON_GPUS, "run"]
    if ranks == 2:
        if lacking := device.what_is_missing():
            pytest.skip(lacking)
        there = ["-m", "msmpetsc", "run", "--device", "cuda"]
    files, devices = [], []
    for count, worker in ((1, ["-m", "msmpetsc", "run"]), (ranks, there)):
        files.append(tmp_path / f"{count}.h5")
        cost = files[-1].with_suffix(".json")
        run(count, *worker, path, "-o", files[-1], "--measure", cost, status=0)
        devices.append(json.loads(cost.read_text())["device"])
    assert devices == ["cpu", "cuda"]
    frames = [h5py.File(file)["frames/position"][:] for file in files]
    assert np.abs(frames[0] - frames[0][0]).max() > 1e-3
    np.testing.assert_allclose(*frames, rtol=0, atol=1e-8)
