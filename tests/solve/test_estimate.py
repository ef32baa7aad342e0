"""What a run says of its errors: the estimate, the true error, the way of a step, and what it cost."""

import json
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from block_scene import block_scene
from lattices import COMM, T, beam, one_spring, swing, weight
from mpi4py import MPI

from msmpetsc.build import build_model
from msmpetsc.scene.reading import load_scene
from msmpetsc.solve.instrumentation import Probes
from msmpetsc.solve.nonlinear import error_control, minimum
from msmpetsc.solve.nonlinear.estimate import ErrorEstimate
from msmpetsc.solve.nonlinear.functional import Iterate, StepProblem
from msmpetsc.solve.nonlinear.reference import Reference
from msmpetsc.solve.nonlinear.step import Stepper
from msmpetsc.solve.presets import PRESETS, find_preset
from msmpetsc.solve.simulate import TimeLoop

FLOOR = {"shape": "plane", "point": [0, 0, 0], "normal": [0, 0, 1]}
GRAVITY = {"acceleration": [0, 0, -9.81]}
PLATE = {"shape": "box", "box": [[-1, -1, 0.26], [2, 2, 0.5]], "path": [{"time": 0.2, "by": [0, 0, -0.1]}]}
SCENES = {
    "leaps": {
        "time": {"step": 0.005, "duration": 0.15},
        "material": {"young_modulus": 1e6, "density": 1000.0},
        "obstacle": [FLOOR | {"response": "reflect"}],
    },
    "is pressed": {
        "time": {"step": 0.01, "duration": 0.2},
        "material": {"young_modulus": 1e5, "density": 1000.0, "law": "stiffening"},
        "obstacle": [FLOOR | {"response": "penalty", "friction": 0.5}, PLATE | {"response": "penalty"}],
    },
    "swings": {
        "time": {"step": 0.02, "duration": 0.3},
        "pin": [{"region": {"box": [[0, 0, 0], [0.1, 1, 1]], "relative": True}}],
    },
}


@pytest.mark.parametrize("preset", ["anderson", "newton"])
@pytest.mark.parametrize("name", SCENES)
def test_the_estimate_is_within_three_of_the_true_error(
    tmp_path: Path, name: str, preset: str, monkeypatch: pytest.MonkeyPatch
):
    """Without early ends. Where the bound alone would do, what is said may be further above; it is never far below."""
    for module in (error_control, minimum):
        monkeypatch.setattr(module, "KNOWN", 0.0)
    scene = load_scene(
        block_scene(tmp_path, gravity=GRAVITY, **SCENES[name]), [f"solver={{preset='{preset}', error=1e-3}}"]
    )
    model = build_model(MPI.COMM_SELF, scene)
    ratios, estimated = [], []
    with TimeLoop(MPI.COMM_SELF, scene, model, Probes(true_error=1)) as simulation:
        stepper = simulation.integrator.stepper
        for frame in simulation.frames():
            if frame.index and frame.true_error > 1e-9:
                ratios.append(frame.step_error / frame.true_error)
                estimated.append(stepper.outcome.corrected)
    ratios, estimated = np.array(ratios), np.array(estimated)
    assert estimated.sum() >= 5 and (ratios[estimated] < 3).all() and (ratios > 1 / 3).all()


@pytest.mark.parametrize("kind", ["mg", "jacobi"])
@pytest.mark.parametrize("name", ["is pressed", "swings"])
def test_an_estimate_that_ends_early_is_a_bound(
    tmp_path: Path, name: str, kind: str, monkeypatch: pytest.MonkeyPatch, petsc_options
):
    """An error that is known to do is estimated in fewer iterations, and not below the true one."""
    petsc_options(pc_type=kind)
    scene = load_scene(block_scene(tmp_path, gravity=GRAVITY, **SCENES[name]), ["solver={preset='newton', error=1e-3}"])
    model, early, full, ratios = build_model(MPI.COMM_SELF, scene), 0, 0, []
    plain = ErrorEstimate.__call__

    def both(
        self: ErrorEstimate, iterate: Iterate, bound: float, enough: float, will_do: float = 0.0, lowest: float = 1.0
    ) -> float:
        nonlocal early, full
        plain(self, iterate, bound, enough, 0.0, lowest)
        full += self.ksp.its
        length = plain(self, iterate, bound, enough, will_do, lowest)
        early += self.ksp.its
        return length

    monkeypatch.setattr(ErrorEstimate, "__call__", both)
    with TimeLoop(MPI.COMM_SELF, scene, model, Probes(true_error=1)) as simulation:
        for frame in simulation.frames():
            if frame.index and frame.true_error > 1e-9:
                ratios.append(frame.step_error / frame.true_error)
    assert len(ratios) >= 5 and min(ratios) > 0.8 and early < 0.8 * full


DESCENDING = ("fast-msm", "fast-msm-kronecker", "paper", "lbfgs", "newton", "newton-multigrid")


@pytest.mark.parametrize("preset", DESCENDING)
def test_g_falls_at_every_iteration_of_plain_and_line_searched_methods(preset: str):
    """A is no less than the Hessian, so that a plain iteration is a step down too."""
    lattice = beam(2e4)
    before, q = (result.position for result in swing("newton", 3, beam(2e4), error=1e-9)[-2:])
    stepper, values = Stepper(COMM, lattice, T, find_preset(preset), error=1e-6), []
    y = 2 * q - before

    def observe(positions: np.ndarray) -> None:
        values.append(stepper.functional.change(positions, y)[0])

    stepper.observer = observe
    stepper.step(StepProblem(q, 2 * q - before, weight(lattice)))
    stepper.destroy()
    falls = np.diff(values)
    assert len(values) > 2 and (falls <= 1e-12 * abs(values[-1])).all() and values[-1] < 0


def test_true_errors_are_those_of_a_dense_solve_of_one_spring():
    """A mass on a spring along z: x* in closed form, and g is a parabola, so its error is the other's square."""
    m, k, r = 0.3, 40.0, 1.0
    lattice = one_spring(m, k, r)
    reference = Reference(COMM, lattice, T, touches=False)
    q, before = np.array([[0.0, 0, 0], [0, 0, 1.3]]), np.array([[0.0, 0, 0], [0, 0, 1.25]])
    y = 2 * 1.3 - 1.25
    exact = (m * y + T**2 * k * r) / (m + T**2 * k)
    found = [np.array([[0.0, 0, 0], [0, 0, exact + e * (y - exact)]]) for e in (1.0, 0.5, -0.01)]
    errors = reference.errors(StepProblem(q, 2 * q - before, np.zeros((2, 3))), found)
    reference.destroy()
    np.testing.assert_allclose(errors, [[1, 1], [0.5, 0.25], [0.01, 1e-4]], rtol=1e-6)


def run(*words: str | Path) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "msmpetsc.cli.main", "run", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=60)


def test_a_run_tells_its_true_errors_its_iterates_and_its_cost(tmp_path: Path):
    path, out, told = block_scene(tmp_path, gravity=GRAVITY, **SCENES["swings"]), tmp_path / "o.h5", tmp_path / "m.json"
    done = run(path, "-o", out, "--true-error", 2, "--trace", 3, "--measure", told, "--frames", 4, "--error", 1e-4,
               "-reference_ksp_rtol", 1e-2)  # fmt: skip
    assert done.returncode == 0, done.stderr
    with h5py.File(out) as file:
        frames = file["frames"]
        measured = np.isfinite(frames["true_error"][:])
        # every second step, and the one that is followed
        assert measured.tolist() == [False, False, True, True, True]
        np.testing.assert_array_equal(np.isfinite(frames["energy_error"][:]), measured)
        cost, wall = json.loads(told.read_text()), frames["wall_time"][:].sum()
        last = frames["true_error"][3], frames["ksp_its"][3]
    times, trace = cost["time"], cost["trace"]
    assert times["stepping"] == pytest.approx(wall) and cost["ranks"] == 1 and cost["memory"] > 1e7
    assert 0 < times["local"] + times["ksp"] < times["stepping"] and times["setup"] > 0
    cells, nodes = 4 * 4 * 2, 5 * 5 * 3
    assert (cost["cells"], cost["nodes"], cost["unknowns"]) == (cells, nodes, nodes - 5 * 3)
    assert trace["frame"] == 3 and trace["iteration"] == list(range(len(trace["iteration"])))
    assert trace["position_error"][-1] == pytest.approx(last[0]) and trace["ksp_its"][-1] <= last[1]
    assert all(np.diff(trace[name]).min() >= 0 for name in ("seconds", "ksp_its"))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--true-error", "0"], "--true-error must be at least 1, not 0"),
        (["--trace", "2"], "--trace needs --measure"),
        (["--true-error", "1", "-reference_gone", "1"], "-reference_gone: no part of this run uses"),
        (["--true-error", "1", "--set", "time.integrator=verlet"], "verlet has none"),
        (["--measure", "/dev/null/m.json"], "cannot be written"),
    ],
)
def test_what_cannot_be_measured_is_one_clear_line(tmp_path: Path, words: list[str], said: str):
    done = run(block_scene(tmp_path, **SCENES["swings"]), "-o", tmp_path / "o.h5", "--frames", "1", *words)
    lines = [line for line in done.stderr.splitlines() if "note:" not in line]
    assert done.returncode == 2 and said in done.stderr and len(lines) <= 3, done.stderr
    if said == "cannot be written":
        assert not (tmp_path / "o.h5").exists(), "known before the run"


def test_linear_solves_are_no_tighter_than_the_step_needs():
    """A step to 1e-1 asks for looser ones than a step to 1e-6 does; a tolerance of the user's is left alone."""

    def tolerances(error: float) -> list[float]:
        lattice, seen = beam(), []
        stepper = Stepper(COMM, lattice, T, find_preset("newton"), error=error)
        stepper.observer = lambda _: seen.append(stepper.ksp.getTolerances()[0])
        stepper.step(StepProblem(lattice.nodes, lattice.nodes + np.array([0, 0, 1e-3]), weight(lattice)))
        stepper.destroy()
        return seen[1:]

    loose, tight = tolerances(1e-1), tolerances(1e-8)
    assert max(loose) > 0.1 and min(tight) == float(PRESETS["newton"].options["ksp_rtol"])
