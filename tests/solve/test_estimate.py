"""Errors that a run reports: the estimate, the true error, the path of a step, and the cost."""

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from block_scene import CLAMP, GRAVITY, block_scene, box_at, loop_of, plane_at, solid_of
from conftest import run
from lattices import COMM, T, beam, one_spring, weight
from one_process import assert_one_line
from petsc4py import PETSc

from msmpetsc.backend.arrays import Rows
from msmpetsc.solve.instrumentation import true_errors
from msmpetsc.solve.nonlinear import error_control
from msmpetsc.solve.nonlinear.error_control import Outcome
from msmpetsc.solve.nonlinear.functional import Iterate, StepProblem
from msmpetsc.solve.nonlinear.newton import Newton
from msmpetsc.solve.nonlinear.preconditioning import LatticePreconditioner
from msmpetsc.solve.nonlinear.step import Stepper, StepResult
from msmpetsc.solve.presets import PRESETS, find_preset

FLOOR = plane_at()
PLATE = box_at([[-1, -1, 0.26], [2, 2, 0.5]], path=[{"time": 0.2, "by": [0, 0, -0.1]}])
SCENES = {
    "leaps": {
        "time": {"step": 0.005, "duration": 0.15},
        "material": {"young_modulus": 1e6, "density": 1000.0},
        "obstacle": [FLOOR | {"response": "reflect"}],
    },
    "is pressed": {
        "time": {"step": 0.01, "duration": 0.2},
        "material": solid_of(1e5),
        "obstacle": [
            FLOOR | {"response": "penalty", "friction": 0.5},
            PLATE | {"response": "penalty"},
        ],
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
    """Steps report an estimate or a bound, which may be far above the error, never far below."""
    step, estimates = Stepper.step, {}

    def estimated(self: Stepper, problem: StepProblem, start: Rows | None = None) -> StepResult:
        result = step(self, problem, start)
        length = self.control.estimate(self.functional.at(result.position))
        distance = self.functional.distance(result.position)
        estimates.setdefault(self, []).append(length / distance)
        return result

    monkeypatch.setattr(Stepper, "step", estimated)
    scene = block_scene(tmp_path, gravity=GRAVITY, **SCENES[name])
    solver = f"solver={{preset='{preset}', error=1e-3}}"
    with loop_of(scene, solver, true_error=1) as simulation:
        stepper = simulation.integrator.stepper
        errors = np.array(
            [
                (frame.true_error, frame.step_error, estimates[stepper][-1])
                for frame in simulation.frames()
                if frame.index and frame.true_error > 1e-9
            ]
        )
    said, estimate = (errors[:, 1:] / errors[:, :1]).T
    assert len(errors) and (estimate < 3).all() and (estimate > 1 / 3).all()
    assert (said > 1 / 3).all()


@pytest.mark.parametrize("law", ["linear", "neo-hookean"])
def test_with_multigrid_a_proof_is_cheap(tmp_path: Path, law: str):
    """The proof takes a small share of all products, 0.6 if each estimate begins anew."""
    scene = SCENES["swings"] | {"material": {"young_modulus": 5e5, "density": 1000.0, "law": law}}
    solver = "solver={preset='newton-multigrid', error=1e-3}"
    path = block_scene(tmp_path, gravity=GRAVITY, **scene)
    with loop_of(path, solver, "cages={cell_size=0.05}", true_error=1) as simulation:
        frames = [frame for frame in simulation.frames() if frame.index]
    assert min(frame.step_error / frame.true_error for frame in frames) > 0.99
    assert max(frame.step_error for frame in frames) <= 1e-3
    proof, products = (
        sum(getattr(frame, name) for frame in frames) for name in ("proof_products", "products")
    )
    assert 0 < proof < 0.45 * products


def test_the_age_of_a_hierarchy_counts_the_digits_that_its_solves_reached(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """A solve ends early once the error is acceptable; its tolerance then says nothing."""
    told: list[float] = []
    learn, solve = LatticePreconditioner.learn, Newton._solve
    monkeypatch.setattr(
        LatticePreconditioner,
        "learn",
        lambda self, its, reached: (told.append(reached), learn(self, its, reached)),
    )
    ratios: list[float] = []

    def solved(self: Newton, now: Iterate, *given: Any) -> Outcome:
        outcome = solve(self, now, *given)
        z = now.f.duplicate()
        self.jacobian.preconditioner.apply(None, now.f, z)
        ratios.append(self.ksp.getResidualNorm() / np.sqrt(z.dot(now.f)))
        return outcome

    monkeypatch.setattr(Newton, "_solve", solved)
    path = block_scene(tmp_path, gravity=GRAVITY, **SCENES["swings"])
    with loop_of(path, "solver={preset='newton-multigrid', error=0.01}") as simulation:
        tolerance = simulation.integrator.stepper.control.rtol
        list(simulation.frames())
    assert told == pytest.approx(ratios, rel=1e-6)
    assert max(told) > 3 * tolerance


def test_newtons_linear_solves_tell_the_error(tmp_path: Path):
    """With PETSc's own convergence test errors need separate solves, which cost more products."""
    words = ["--frames", "12", "--true-error", "1", "--error", "1e-3"]
    # |F| says little about the error of a stiff body
    stiff = solid_of(1e7)
    scene = SCENES["swings"] | {"material": stiff}
    path, products = block_scene(tmp_path, gravity=GRAVITY, **scene), []
    for options in ([], ["-ksp_convergence_test", "default"]):
        out = tmp_path / f"{len(options)}.h5"
        run(1, "-m", "msmpetsc", "run", path, "-o", out, *words, *options, status=0)
        with h5py.File(out) as file:
            said, true = (file["frames"][name][1:] for name in ("step_error", "true_error"))
            products.append(file["frames"]["products"][:].sum())
        assert (said <= 1e-3).all() and (true < 3 * said).all()
    assert products[0] < 0.9 * products[1]


def test_the_first_step_of_a_viscous_body_has_no_true_error_of_another_step(tmp_path: Path):
    """A step of length t has another solver than BDF2's steps: the error was 0.8."""
    scene = block_scene(
        tmp_path,
        time={"step": 0.01, "duration": 0.02, "integrator": "bdf2"},
        material=solid_of(1e5) | {"retardation_time": 0.005},
        pin=[CLAMP],
        gravity=GRAVITY,
        solver={"error": 1e-3},
    )
    with loop_of(scene, true_error=1) as simulation:
        _, first, second = simulation.frames()
    assert np.isnan(first.true_error) and 0 < second.true_error < 3 * second.step_error


def test_true_errors_are_those_of_a_dense_solve_of_one_spring():
    """The true error is known for a mass on a spring along z.

    x* has a closed form, and g is a parabola, so the energy error is the square of the error.
    """
    m, k, r = 0.3, 40.0, 1.0
    lattice = one_spring(m, k, r)
    stepper = Stepper(COMM, lattice, T, find_preset("newton"))
    q, before = np.array([[0.0, 0, 0], [0, 0, 1.3]]), np.array([[0.0, 0, 0], [0, 0, 1.25]])
    y = 2 * 1.3 - 1.25
    exact = (m * y + T**2 * k * r) / (m + T**2 * k)
    found = [np.array([[0.0, 0, 0], [0, 0, exact + e * (y - exact)]]) for e in (1.0, 0.5, -0.01)]
    problem = StepProblem(q, 2 * q - before, np.zeros((2, 3)))
    errors = [true_errors(stepper, problem, x) for x in found]
    stepper.destroy()
    np.testing.assert_allclose(errors, [[1, 1], [0.5, 0.25], [0.01, 1e-4]], rtol=1e-6)


def test_a_run_tells_its_true_errors_and_its_cost(tmp_path: Path):
    path, out, told = (
        block_scene(tmp_path, gravity=GRAVITY, **SCENES["swings"]),
        tmp_path / "o.h5",
        tmp_path / "m.json",
    )
    words = ["--true-error", "2", "--frames", "4", "--error", "1e-4", "-reference_ksp_rtol", "1e-2"]
    run(1, "-m", "msmpetsc", "run", path, "-o", out, "--measure", told, *words, status=0)
    with h5py.File(out) as file:
        frames = file["frames"]
        measured = np.isfinite(frames["true_error"][:])
        assert measured.tolist() == [False, False, True, False, True]
        np.testing.assert_array_equal(np.isfinite(frames["energy_error"][:]), measured)
        cost, wall = json.loads(told.read_text()), frames["wall_time"][:].sum()
    times = cost["time"]
    assert times["stepping"] == pytest.approx(wall) and cost["ranks"] == 1 and cost["memory"] > 1e7
    assert 0 < times["local"] + times["ksp"] < times["stepping"] and times["setup"] > 0
    cells, nodes = 4 * 4 * 2, 5 * 5 * 3
    assert (cost["cells"], cost["nodes"], cost["unknowns"]) == (cells, nodes, nodes - 5 * 3)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--true-error", "0"], "--true-error must be at least 1, not 0"),
        (
            ["--true-error", "1", "-reference_gone", "1"],
            "-reference_gone: no part of this run uses",
        ),
        (["--true-error", "1", "--set", "time.integrator=verlet"], "verlet has none"),
    ],
)
def test_what_cannot_be_measured_is_one_clear_line(tmp_path: Path, words: list[str], said: str):
    path = block_scene(tmp_path, **SCENES["swings"])
    assert_one_line(
        run(1, "-m", "msmpetsc", "run", path, "-o", tmp_path / "o.h5", "--frames", "1", *words),
        2,
        said,
    )


def test_linear_solves_are_as_close_as_the_step_needs():
    """A step to 1e-8 needs accurate solves near its end, a step to 1e-1 needs none."""

    def tolerances(error: float) -> list[float]:
        lattice, seen = beam(), []
        stepper = Stepper(COMM, lattice, T, find_preset("newton"), error=error)
        stepper.ksp.setMonitor(lambda ksp, *_: seen.append(ksp.getTolerances()[0]))
        stepper.step(
            StepProblem(lattice.nodes, lattice.nodes + np.array([0, 0, 1e-3]), weight(lattice))
        )
        stepper.destroy()
        return seen

    loose, tight = tolerances(1e-1), tolerances(1e-8)
    rtol = float(PRESETS["newton"].options["ksp_rtol"])
    assert set(loose) == {rtol} and max(tight) == rtol
    assert error_control.CLOSEST * rtol <= min(tight) < 0.1 * rtol


def test_the_first_solve_of_a_step_is_as_close_as_the_last_linearisation():
    """The beam is nearly linear, so its second step begins with a solve to the step error."""
    lattice, first = beam(), []
    stepper = Stepper(COMM, lattice, T, find_preset("newton"), error=1e-4)

    def note(ksp: PETSc.KSP, its: int, _: float) -> None:
        if its == 0:
            first.append(ksp.getTolerances()[0])

    stepper.ksp.setMonitor(note)
    q, before = lattice.nodes, lattice.nodes
    begun = []
    for _ in range(2):
        begun.append(len(first))
        result = stepper.step(StepProblem(q, 2 * q - before, weight(lattice)))
        q, before = result.position, q
    stepper.forget()
    begun.append(len(first))
    stepper.step(StepProblem(q, 2 * q - before, weight(lattice)))
    stepper.destroy()
    rtol = float(PRESETS["newton"].options["ksp_rtol"])
    expected = [first[at] for at in begun]
    assert expected[0] == expected[2] == rtol and expected[1] < 0.5 * rtol


@pytest.mark.slow
def test_an_estimate_does_not_trust_a_cycle_that_smooths_nothing(tmp_path: Path):
    """With a cycle that smooths nothing the bound by P^(-1) alone reported 0.59 as 2.6e-4."""
    held = [{"region": {"half_space": {"point": [0, 0, 0], "normal": [-1, 0, 0]}}}]
    tables = {
        "cages": {"cell_size": 0.0015}, "time": {"integrator": "static"}, "gravity": GRAVITY,
        "pin": held,
        "material": solid_of(1e9, 0.0),
        "solver": {"preset": "newton-multigrid"},
    }  # fmt: skip
    scene, out = block_scene(tmp_path, np.array([0.1, 0.02, 0.001]), **tables), tmp_path / "o.h5"
    broken = ("-mg_levels_ksp_chebyshev_eigenvalues", "1e9,1e10")
    run(1, "-m", "msmpetsc", "run", scene, "-o", out, "--true-error", 1, *broken, status=0)
    with h5py.File(out) as file:
        assert file["frames/true_error"][1] < 3 * file["frames/step_error"][1] < 3e-3
