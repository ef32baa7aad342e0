"""A single step against closed forms, dense linear algebra, and other presets."""

import gc
from dataclasses import replace

import numpy as np
import pytest
from lattices import COMM, GRAVITY, T, beam, block, cages_of, one_spring, swing, weight
from petsc4py import PETSc

from msmpetsc.elasticity.energy import Elasticity
from msmpetsc.errors import StepFailed
from msmpetsc.lattice.lattice import Lattice, build_lattice
from msmpetsc.scene.body import Material
from msmpetsc.solve.nonlinear.functional import StepProblem
from msmpetsc.solve.nonlinear.step import Stepper
from msmpetsc.solve.petsc.library import petsc_errors
from msmpetsc.solve.presets import PRESETS, find_preset


def brick(*cells: int, young: float = 2e5) -> Lattice:
    """Return a free lattice of springs with cells of 0.1 m."""
    material = Material(density=1000, young_modulus=young, law="linear")
    return build_lattice(cages_of(block(*cells), 0.1), material)


def residual(lattice: Lattice, x: np.ndarray, q: np.ndarray, before: np.ndarray) -> np.ndarray:
    """Return F(x) by numpy alone, at the free nodes."""
    ends = x[lattice.springs]
    along = ends[:, 0] - ends[:, 1]
    length = np.linalg.norm(along, axis=1)
    force = (lattice.stiffness * (1 - lattice.rest_length / length))[:, None] * along
    gradient = np.zeros_like(x)
    np.add.at(gradient, lattice.springs[:, 0], force)
    np.add.at(gradient, lattice.springs[:, 1], -force)
    F = lattice.mass[:, None] * (x - 2 * q + before) + T**2 * (gradient - weight(lattice))
    return F[~lattice.pinned]


@pytest.fixture(scope="module")
def reference() -> list:
    return swing("newton", 6, error=1e-12)


@pytest.mark.parametrize("preset", PRESETS)
def test_free_fall_is_the_schemes_own(preset: str):
    """Implicit Euler from rest gives q_n = q_0 + g t^2 n (n + 1) / 2.

    With ``paper`` this holds to the tolerance of the KSP.
    """
    lattice = brick(3, 2, 2)
    fallen = swing(preset, 5, lattice)[-1].position - lattice.nodes
    tolerance = {"paper": 1e-8}.get(preset, 1e-12)
    np.testing.assert_allclose(
        fallen, np.tile(GRAVITY * T**2 * 15, (len(fallen), 1)), atol=tolerance
    )


def test_newton_solves_the_step_to_rounding(reference: list):
    lattice = beam()
    path = [lattice.nodes, lattice.nodes, *(result.position for result in reference)]
    scale = np.linalg.norm(T**2 * weight(lattice))
    for before, q, x in zip(path, path[1:], path[2:], strict=False):
        assert np.linalg.norm(residual(lattice, x, q, before)) < 1e-10 * scale


@pytest.mark.parametrize("preset", PRESETS)
def test_one_mass_on_a_spring_follows_its_recurrence(preset: str):
    """Along the spring the scheme is linear: (m + t^2 k) x = m (2 q_n - q_(n-1)) + t^2 k r."""
    m, k, r = 0.3, 40.0, 1.0
    lattice = one_spring(m, k, r)
    stepper = Stepper(COMM, lattice, T, find_preset(preset), error=1e-7)
    x = before = r + 0.2
    q = q_before = np.array([[0.0, 0, 0], [0, 0, x]])
    for _ in range(10):
        x, before = (m * (2 * x - before) + T**2 * k * r) / (m + T**2 * k), x
        q, q_before = stepper.step(StepProblem(q, 2 * q - q_before, np.zeros((2, 3)))).position, q
        np.testing.assert_allclose(q[1], [0, 0, x], atol=1e-8)
    stepper.destroy()


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("error", [1e-2, 1e-4])
def test_every_preset_comes_as_near_as_it_says(preset: str, error: float):
    """The stated error of a step is |x - x*|_M / |x* - y|_M.

    An estimate is within a factor of 3. A bound may be farther above the error.
    """
    lattice = beam()
    q = swing("newton", 3, error=1e-12)
    q, before = q[-1].position, q[-2].position

    def one_step(name: str, error: float):
        stepper = Stepper(COMM, lattice, T, find_preset(name), error=error)
        try:
            result = stepper.step(StepProblem(q, 2 * q - before, weight(lattice)))
            by_estimate = PETSc.SNES.ConvergedReason.CONVERGED_SNORM_RELATIVE
            return result, stepper.snes.reason == by_estimate
        finally:
            stepper.destroy()

    result, estimated = one_step(preset, error)
    exact = one_step("newton", 1e-12)[0].position
    norm = lambda v: np.sqrt((v**2).sum(axis=1) @ lattice.mass)  # noqa: E731
    true = norm(result.position - exact) / norm(exact - (2 * q - before))
    assert true <= 1.5 * result.cost.step_error and result.cost.step_error <= error
    assert not estimated or result.cost.step_error <= 3 * true


def test_too_loose_a_solve_is_told():
    with pytest.raises(StepFailed, match=r"relative error .* try"):
        swing("paper", 3, error=1e-9)


def test_published_presets_take_ten_iterations_and_say_their_error():
    for result in swing("fast-msm", 3):
        # each iteration is one solve; the other iterations of CG estimate the error
        assert (
            result.cost.iterations == 10
            and 10 < result.cost.ksp_its <= 20
            and 0 < result.cost.step_error < 1
        )


def test_a_budget_is_kept_and_the_error_reported():
    results = swing("anderson", 3, error=1e-12, max_iterations=4)
    assert (
        all(result.cost.iterations <= 4 for result in results)
        and results[-1].cost.step_error > 1e-12
    )


def test_cg_and_cholesky_give_the_same_step(petsc_options):
    direct = swing("fast-msm", 4, error=1e-10)[-1].position
    petsc_options(ksp_type="cg", pc_type="icc", ksp_rtol="1e-12")
    np.testing.assert_allclose(swing("fast-msm", 4, error=1e-10)[-1].position, direct, atol=1e-11)


@pytest.mark.parametrize(
    ("preset", "options"),
    [
        # this method takes no initial guess for its solves
        ("newton", {"ksp_type": "preonly", "pc_type": "cholesky"}),
        # Chebyshev's method applies the Hessian when it is set up
        ("newton", {"ksp_type": "chebyshev"}),
        # Newton's loop solves without a nonlinear preconditioner
        ("anderson", {"snes_type": "newtonls"}),
        ("anderson", {"snes_type": "newtontr"}),
    ],
)
def test_another_type_goes_with_a_preset(petsc_options, preset: str, options: dict[str, str]):
    petsc_options(**options)
    assert all(result.cost.step_error <= 1e-3 for result in swing(preset, 2, error=1e-3))


def test_a_fault_of_ours_within_petsc_is_no_bad_option():
    """PETSc 3.18 passes a callback's exception on, 3.26 makes it the cause of its own error."""

    def fault(*_):
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError), petsc_errors("PETSc refuses"):
        snes = PETSc.SNES().create(COMM)
        x = PETSc.Vec().createMPI(2, comm=COMM)
        snes.setFunction(fault, x.duplicate())
        snes.solve(None, x)


def test_garbage_is_collected_again_after_the_outermost_block():
    with petsc_errors("outer"):
        with petsc_errors("inner"):
            assert not gc.isenabled()
        assert not gc.isenabled()
    assert gc.isenabled()


def test_a_preset_leaves_no_options_behind():
    before = PETSc.Options().getAll()
    for preset in PRESETS:
        swing(preset, 1)
    assert PETSc.Options().getAll() == before


def test_A_is_M_plus_t2_L():
    """A equals a dense sum over springs. Without pins its rows sum to the mass."""
    lattice = brick(2, 2, 1)
    stepper = Stepper(COMM, lattice, T, find_preset("anderson"))
    rows = np.arange(lattice.owned, dtype=np.int32)
    A = stepper.jacobian.matrix.getValues(rows, rows)
    stepper.destroy()
    dense = np.diag(lattice.mass)
    for (a, b), k in zip(lattice.springs, lattice.stiffness, strict=True):
        dense[[a, b], [a, b]] += T**2 * k
        dense[[a, b], [b, a]] -= T**2 * k
    np.testing.assert_allclose(A, dense, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(A.sum(axis=1), lattice.mass, rtol=1e-10)


def test_a_plain_iteration_is_the_papers_global_step():
    """x - A^(-1) F(x) at y is (M + t^2 L)^(-1) (t^2 J d + M y + t^2 f_ext), Eq. 17."""
    lattice = brick(2, 2, 1)
    lattice = replace(lattice, rest_length=0.95 * lattice.rest_length)
    stepper = Stepper(COMM, lattice, T, find_preset("fast-msm"), max_iterations=1)
    rows = np.arange(lattice.owned, dtype=np.int32)
    A = stepper.jacobian.matrix.getValues(rows, rows)
    y = lattice.nodes
    x = stepper.step(StepProblem(y, y, weight(lattice))).position
    stepper.destroy()
    along = y[lattice.springs[:, 0]] - y[lattice.springs[:, 1]]
    d = lattice.rest_length[:, None] * along / np.linalg.norm(along, axis=1)[:, None]
    Jd = np.zeros_like(y)
    np.add.at(Jd, lattice.springs[:, 0], lattice.stiffness[:, None] * d)
    np.add.at(Jd, lattice.springs[:, 1], -lattice.stiffness[:, None] * d)
    b = T**2 * Jd + lattice.mass[:, None] * y + T**2 * weight(lattice)
    np.testing.assert_allclose(x, np.linalg.solve(A, b), atol=1e-12)


def test_a_strut_that_buckles_under_its_load():
    """A spring pressed to half is in balance with its load, so CG meets negative curvature across.

    The step must still reach F = 0, which may be a saddle.
    """
    m, k, r, length = 0.3, 4000.0, 1.0, 0.5
    lattice = one_spring(m, k, r)
    load = np.array([[0.0, 0, 0], [0, 0, -k * (r - length)]])
    q = np.array([[0.0, 0, 0], [1e-3, 0, length]])
    stepper = Stepper(COMM, lattice, T, find_preset("newton"), error=1e-9)
    stepper.first_guess.extrapolate = False
    x = stepper.step(StepProblem(q, q, load)).position[1]
    stepper.destroy()
    stretch = np.linalg.norm(x) - r
    F = m * (x - q[1]) + T**2 * (k * stretch * x / np.linalg.norm(x) - load[1])
    assert np.linalg.norm(F) < 1e-8 * T**2 * k * r


def test_a_body_pressed_to_half_still_gives_a_descent():
    """Springs under compression make the true Hessian indefinite; newton must still lower g."""
    lattice = brick(4, 3, 3, young=2e6)
    pressed = lattice.nodes * [1, 1, 0.5] + 1e-3 * np.random.default_rng(1).normal(
        size=lattice.nodes.shape
    )
    stepper = Stepper(COMM, lattice, T, find_preset("newton"), error=1e-6)
    x = stepper.step(StepProblem(pressed, pressed, weight(lattice))).position
    stepper.destroy()
    g = np.zeros_like(x)
    Elasticity(lattice).add_gradient(x, g)
    F = lattice.mass[:, None] * (x - pressed) + T**2 * (g - weight(lattice))
    away = np.sqrt(((x - pressed) ** 2).sum(axis=1) @ lattice.mass)
    # bound on the error, for a target of 1e-6: it may be too large by the root of H
    # over M, 20 here
    assert np.sqrt((F**2).sum(axis=1) @ (1 / lattice.mass)) <= 20 * 1e-6 * away
    energy = Elasticity(lattice).energy
    assert energy(x) < energy(pressed)
