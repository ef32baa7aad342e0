"""A step ends at a minimum, not at a saddle, and as near as it reports.

Rounding counts as an error. In these cases steps once reported at most 1e-3 for errors of 0.4 to 1.
A random sample of hard scenes follows.
"""

import json
from contextlib import suppress
from pathlib import Path

import block_scene as blocks
import numpy as np
import pytest
import trimesh
from block_scene import GRAVITY, loop_of, plane_at
from conftest import ROOT, run
from lattices import T, chain
from mpi4py import MPI

from msmpetsc.errors import InputError, StepFailed
from msmpetsc.fields import Frame
from msmpetsc.scene.reading import load_scene
from msmpetsc.solve.nonlinear.curvature import Alarm
from msmpetsc.solve.nonlinear.functional import Configuration, StepProblem
from msmpetsc.solve.nonlinear.step import Stepper
from msmpetsc.solve.presets import find_preset

BEAM, CUBE = [1, 0.2, 0.2], [1, 1, 1]
PLATES = [
    plane_at(-0.11, response="penalty", friction=0.3),
    plane_at(0.1, -1, response="penalty"),
]
CASES = {
    "crushed": dict(
        sides=BEAM, cells=80, young=283262.4, step=0.00208, frames=1, gravity=GRAVITY,
        start={"scale": [2, 0.05, 2]}
    ),
    "pressed": dict(
        sides=BEAM, cells=80, young=174399181.2, step=0.003704954, frames=4, gravity=GRAVITY,
        obstacle=[PLATES[0], PLATES[1] | {"path": [{"time": 0.0222297, "by": [0, 0, -0.1]}]}],
    ),
    "collapsed": dict(sides=CUBE, cells=64, young=1e5, step=0.02, frames=2, gravity=GRAVITY,
                      start={"scale": [1, 1, 0.05]}),
}  # fmt: skip


def write_case(folder: Path, name: str, **solver) -> Path:
    case = CASES[name] | {}
    trimesh.creation.box(case.pop("sides")).export(folder / "body.ply")
    scene = {
        "mesh": {"source": "body.ply"},
        # the scene in which the saddles were found
        "cages": {"count": case.pop("cells"), "boundary": "whole"},
        "material": {"young_modulus": case.pop("young"), "density": 1000.0, "law": "linear"},
        "time": {"step": (step := case.pop("step")), "duration": case.pop("frames") * step},
        "solver": {"error": 1e-3} | solver,
        "output": {"surface": False},
    }
    return blocks.write_scene(folder, name, **scene | case)


def play(path: Path, *overrides: str) -> list[Frame]:
    """Return the frames until the end or until a step fails, with true errors measured."""
    frames = []
    with loop_of(path, *overrides, true_error=1) as simulation, suppress(StepFailed):
        frames.extend(simulation.frames())
    return frames[1:]


@pytest.mark.parametrize(
    ("name", "preset"),
    [
        ("crushed", "newton"),
        ("pressed", "newton-multigrid"),
        ("collapsed", "newton"),
        ("collapsed", "anderson"),
    ],
)
def test_a_symmetric_start_ends_at_a_minimum_or_says_that_it_does_not(
    tmp_path: Path, name: str, preset: str
):
    frames = play(write_case(tmp_path, name, preset=preset))
    assert frames or preset == "anderson", "which may stop with status 3, as the others may not"
    for frame in frames:
        assert frame.true_error < 3 * frame.step_error and frame.step_error <= 1e-3, frame


def test_a_budget_that_ends_where_no_minimum_is_near_says_so(tmp_path: Path):
    """A single iteration leaves the crushed beam flat, so no bound on the error exists."""
    (frame,) = play(
        write_case(tmp_path, "crushed", preset="newton", max_iterations=1),
        "solver={preset='newton', max_iterations=1}",
    )
    assert frame.step_error > frame.true_error / 3


def squashed(tmp_path: Path, share: float) -> tuple[Stepper, np.ndarray]:
    simulation = loop_of(write_case(tmp_path, "crushed"), f"start.scale=[1, 1, {share}]")
    return simulation, simulation.state.q


@pytest.mark.parametrize("multigrid", [False, True])
@pytest.mark.parametrize("share", [0.2, 0.6, 0.97])
def test_the_lowest_curvature_is_that_of_a_dense_matrix(
    tmp_path: Path, petsc_options, share: float, multigrid: bool
):
    """The search without a known mode finds the lowest curvature of a squashed free beam.

    The modes include the rigid motions of the beam.
    """
    petsc_options(pc_type="mg" if multigrid else "jacobi")
    simulation, q = squashed(tmp_path, share)
    stepper = simulation.integrator.stepper
    functional, curvature = stepper.functional, stepper.optimality.curvature
    functional.begin(StepProblem(q, q, np.zeros((len(q), 3))))
    stepper.jacobian.hessian.linearise(q, None)
    stepper.jacobian.preconditioner.prepare(q, None)
    found, direction = curvature.lowest(
        q, curvature.compression(Configuration(q, None)), Alarm.NOWHERE, None
    )
    assert stepper.jacobian.preconditioner.is_uniform == multigrid
    dense, root = dense_hessian(stepper), np.sqrt(functional.mass)
    lowest = np.linalg.eigvalsh(dense / root / root[:, None])[0]
    # below 0 a direction is a mix of the modes found below 0
    rayleigh = direction @ dense @ direction / (direction**2 @ functional.mass)
    assert found - 1e-9 <= rayleigh <= (0.0 if found < 0 else found) + 1e-9
    assert found >= lowest - 1e-9 and (found < 0) == (lowest < 0)
    if lowest > 0:
        assert found < lowest + 0.1
    # 0 if no curvature was computed
    known = curvature.compression(Configuration(q, None)).least_curvature
    assert known == 0 or lowest >= known - 1e-9
    simulation.destroy()


def dense_hessian(stepper: Stepper) -> np.ndarray:
    x, y = stepper.jacobian.operator.createVecs()
    columns = []
    for row in range(x.getSize()):
        x.set(0.0)
        x[row] = 1.0
        x.assemble()
        stepper.jacobian.hessian.mult(None, x, y)
        columns.append(y.array.copy())
    return np.array(columns)


@pytest.mark.parametrize("preset", ["newton", "anderson", "fast-msm"])
@pytest.mark.parametrize("shift", [0.0, 0.1], ids=["exactly", "by rounding"])
def test_a_compressed_body_that_nothing_moves_is_at_rest(preset: str, shift: float):
    """A compressed body at rest has an error of 0 / 0, or rounding over 0, which counts as small.

    Let c = k (r - 1) be the push in each spring. The bound of M^(-1) H by single springs is 1 - 4
    t^2 c / m. It is negative here, so a search is needed. The lowest eigenvalue is 1 - 3 t^2 c / m.
    """
    k, r = 2e3, 1.1
    lattice = chain(T**2 * k * (r - 1) / 0.29, k, r)
    stepper = Stepper(MPI.COMM_SELF, lattice, T, find_preset(preset), error=1e-3)
    q = lattice.nodes + shift
    compression = stepper.optimality.curvature.compression(Configuration(q, None))
    assert compression.least_curvature == 0 and compression.greatest == pytest.approx(4 * 0.29)
    result = stepper.step(StepProblem(q, q, np.zeros((len(q), 3))))
    stepper.destroy()
    np.testing.assert_allclose(result.position, q, atol=1e-12)
    assert result.cost.step_error < 1e-3


def test_a_body_at_rest_is_not_far_off_its_solution(tmp_path: Path, caplog):
    """The body moves by rounding, 1e-12 of its size; the estimate is up to 2.8 times that."""
    path = blocks.block_scene(
        tmp_path, sides=blocks.CELL * np.array([16, 1, 1]),
        pin=[{"region": {"box": [[-1, -1, -1], [0.01, 1, 1]]}}],
        material={"young_modulus": 1.92e7, "density": 1000.0}, time={"step": 0.3, "duration": 12.0},
        gravity=GRAVITY,
        solver={"preset": "newton", "error": 1e-3},
    )  # fmt: skip
    _, frames = blocks.play(path)
    errors = np.array([frame.step_error for frame in frames])
    assert frames[-1].kinetic < 1e-20 * frames[-1].elastic
    assert errors.max() < 0.3 and errors[-5:].max() > 0
    assert not [record for record in caplog.records if "off" in record.getMessage()]


def test_rounding_is_an_error_and_no_zero(tmp_path: Path):
    """A goal below double precision ends with the rounding error, not with 0."""
    for preset in ("newton", "anderson"):
        (frame,) = play(
            write_case(tmp_path, "crushed", preset=preset),
            "start.scale=[1,1,1]",
            "solver.error=1e-15",
        )
        assert 1e-16 < frame.step_error < 1e-6 and frame.true_error > 0


PART = "part=[{region={half_space={point=[0.0,0.0,0.0], normal=[1,0,0]}}, young_modulus=%g}]"


@pytest.mark.parametrize("soft, stiff", [(1e5, 1e40), (1e-9, 1e5), (1e3, 1e11)])
def test_parts_that_are_as_good_as_rigid_are_refused_at_once(
    tmp_path: Path, soft: float, stiff: float
):
    """At a ratio of 1e8 a squashed body took 3,000 iterations of newton, or did not converge."""
    with pytest.raises(InputError, match="as good as rigid"):
        load_scene(
            write_case(tmp_path, "crushed"), [f"material.young_modulus={soft!r}", PART % stiff]
        )


def error_study(*words: object, status: int | None = 0) -> str:
    """Return the output of scripts/error_study.py; its status is 1 if a step says too little."""
    return run(1, ROOT / "scripts" / "error_study.py", *words, status=status).stdout


def shares_said(seed: int, number: int, *changes: str, status: int | None = 0) -> list[float]:
    """Return the reported error over the true error for each step of a scene."""
    more = [word for change in changes for word in ("--set", change)]
    printed = error_study("--seed", seed, "--only", number, *more, status=status)
    return [error / true for error, true in json.loads(printed)["steps"]]


@pytest.mark.parametrize(("seed", "kinds"), [(7, ["any"]), (8, ["rub", "far", "touch"])])
def test_random_hard_scenes_say_no_less_than_a_third_of_their_error(seed: int, kinds: list[str]):
    """In 12 scenes of scripts/error_study.py steps report at least a third of their error."""
    (last,) = (
        line
        for line in error_study("--scenes", 12, "--seed", seed, "--kinds", *kinds).splitlines()
        if line.startswith("| all |")
    )
    done, stopped, refused, cut_off, faults, steps = map(int, last.split("|")[2:8])
    assert done + stopped + refused + cut_off + faults == 12 and steps > 15


SOLID = 'material.law="neo-hookean"', "material.poisson_ratio=0.45"


MULTIGRID = 'solver.preset="newton-multigrid"'


def test_what_cg_has_left_is_no_bound_across_a_kink():
    """Friction and contact make F at the next iterate differ from CG's residual.

    Without a look at F at x - y, an error of 1.6 was reported as 0.07.
    """
    assert min(shares_said(32, 30, MULTIGRID, *SOLID)) > 1 / 3


def test_what_cg_has_left_is_no_bound_for_a_body_that_springs_back():
    """A body springs back from an eighth of its length, in 70 iterations.

    Its path is chaotic, so the median of five densities counts: 0.36 without a look at F at x - y,
    0.52 with it. A single density may report less than a third, which ends the script with 1.
    """
    densities = [f"material.density={1000 + 0.01 * k}" for k in range(5)]
    said = [min(shares_said(31, 10, MULTIGRID, rho, status=None)) for rho in densities]
    assert np.median(said) > 0.43


@pytest.mark.parametrize("seed, number, was", [(85, 40, 0.025), (85, 54, 0.078), (86, 115, 0.09)])
def test_an_error_is_no_less_than_what_its_estimate_does_not_know(
    seed: int, number: int, was: float
):
    """Estimates must not miss contact or modes that CG has not seen.

    A stiff block lands on a plane with friction (40, 54). Nodes begin to touch within the missing
    part of e, where g was not evaluated. A cell hangs by an edge (115): few iterations of CG
    contain nothing of its mode.

    was : the least reported share before
    """
    assert was < 1 / 3 < min(shares_said(seed, number, MULTIGRID))


def test_a_mode_that_stiffens_hides_no_lower_one():
    """The search for curvature must not only follow the mode of the step before.

    That mode had 1.57 when the lowest had 0.29, and the step reported 0.13 of its error. On the way
    to the solution the Hessian had negative curvatures.
    """
    said = shares_said(28, 11, 'solver.preset="newton-projected"')
    # 0.98 with PETSc 3.18, 0.896 with 3.22
    assert len(said) == 3 and min(said) > 0.85


def test_a_preconditioner_far_from_the_hessian_bounds_no_error(tmp_path: Path):
    """A step of fast spin has folded a ball, and the bound by P^(-1) fails.

    CG had found 0.008 as the least eigenvalue of P^(-1) H. The residual of a solve of nine
    iterations was 22 times its bound, so 0.18 of the error was reported.
    """
    trimesh.creation.icosphere(2, 0.3).export(tmp_path / "ball.ply")
    scene = {
        "mesh": {"source": "ball.ply"},
        "cages": {"count": 96},
        "material": {"young_modulus": 85594841.27062145, "density": 1000.0, "law": "linear"},
        "time": {"step": 0.3316432908174203, "duration": 0.6632865816348406},
        "gravity": {"acceleration": [-9.126659967734636, -1.6587640714055587, 3.191971113397505]},
        "start": {
            "spin": [-38.34936159106727, -267.39473131613147, -109.9781407748381],
            "velocity": [-2.3607346401851053, 5.561076327491708, 5.703682468065478],
        },
        "obstacle": [plane_at(-0.3, response="reflect")],
        "solver": {"preset": "newton", "error": 0.3},
        "output": {"surface": False},
    }
    frames = play(blocks.write_scene(tmp_path, **scene))
    assert len(frames) == 2 and all(frame.true_error < 3 * frame.step_error for frame in frames)
