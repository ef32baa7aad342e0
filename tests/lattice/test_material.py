"""The material against elasticity: constants, a clamped beam, a wave, free flight, and scikit-fem's
hexahedra."""

from functools import cache

from lab import slope

import numpy as np
import pytest
import skfem
import small_strain as study
from scipy.spatial.transform import Rotation
from skfem.models.elasticity import lame_parameters, linear_elasticity
from small_strain import ACROSS, BEAM, DENSITY, GRAVITY, NU, WIDTH, E, factorise, hessian
from strains import elastic_constant, uniform_strains

from msmpetsc.elasticity.energy import Elasticity

lattice_beam = cache(study.lattice_beam)
laws = pytest.mark.parametrize("poisson", study.LAWS.values(), ids=study.LAWS)


# ---- uniform strain


STRAINS = {name: rest for name, *rest in uniform_strains()}


@laws
def test_the_matrix_is_the_products_own_hessian_at_rest(poisson: float | None):
    lattice = study.box((4, 3, 2), 0.1, poisson)
    v = np.random.default_rng(0).standard_normal(lattice.nodes.shape)
    product = np.zeros_like(v)
    Elasticity(lattice).hessian_at(lattice.nodes).add_product(v, product)
    np.testing.assert_allclose((hessian(lattice) @ v.ravel()).reshape(-1, 3), product, atol=1e-9)


@laws
@pytest.mark.parametrize("name", STRAINS)
def test_elastic_constants_in_every_direction(name: str, poisson: float | None):
    """C11 = 6/5 E, C12 = C44 = 2/5 E, of a whole block with its boundary."""
    G, other, exact = STRAINS[name]
    lattice = study.box((5, 4, 4), 0.1, poisson)
    assert elastic_constant(lattice, G, other) == pytest.approx(exact, rel=1e-10)


# ---- a clamped beam


@cache
def fem_sag(across: int, order: int = 1) -> float:
    """Tip deflection [m] of the same beam of scikit-fem's hexahedra on the same grid: trilinear, or
    of order 2."""
    sides = [np.linspace(0, side * WIDTH, side * across + 1) for side in (BEAM, 1, 1)]
    element = skfem.ElementVector({1: skfem.ElementHex1, 2: skfem.ElementHex2}[order]())
    # exact for cubes
    basis = skfem.Basis(skfem.MeshHex.init_tensor(*sides), element, intorder=2 * order + 1)
    K = linear_elasticity(*lame_parameters(E, NU)).assemble(basis).tocsc()
    f = skfem.LinearForm(lambda v, _: -DENSITY * GRAVITY * v[2]).assemble(basis)
    free = basis.complement_dofs(basis.get_dofs(lambda x: np.isclose(x[0], 0)))
    u = np.zeros(basis.N)
    u[free] = factorise(K[free][:, free])(f[free])
    return -u[basis.nodal_dofs[2, np.isclose(basis.mesh.p[0], BEAM * WIDTH)]].mean()


@pytest.mark.parametrize("across", ACROSS)
def test_the_excess_stiffness_is_that_of_cells_that_cannot_curve(across: int):
    """E I (1 + 169/140 (h/b)^2).

    The rest is the clamp, which holds the width, too: 0.7% by scikit-fem, twice as much at two
    cells across.
    """
    sag, frequency = lattice_beam(across)
    assert -0.015 < sag / study.timoshenko_sag(across) - 1 < 0
    assert 0 < frequency / study.timoshenko_frequency(across) - 1 < 0.0075


def test_it_comes_to_the_solid_of_scikit_fem_with_second_order():
    """Trilinear hexahedra on the same grid: their excess is 1/2 (h/b)^2, so the difference goes as
    h^2."""
    difference = [1 - lattice_beam(across)[0] / fem_sag(across) for across in ACROSS]
    # (169/140 - 1/2) / 8^2 = 1.1%
    assert 0 < difference[-1] < 0.013
    assert 1.6 < slope(1 / np.array(ACROSS), difference) < 2.2
    solid = fem_sag(2, order=2)
    errors = [1 - lattice_beam(across)[0] / solid for across in ACROSS]
    assert 1.6 < slope(1 / np.array(ACROSS), errors) < 2.2


# ---- a wave, free flight


@pytest.mark.parametrize(("poisson", "late"), [(None, -0.0024), (NU, -0.0028)], ids=study.LAWS)
def test_a_compression_wave_runs_at_the_root_of_E_over_rho(poisson: float | None, late: float):
    """Its centre to the strain, its peak as dispersion and implicit Euler move it, its height as
    Euler damps it."""
    centre, peak, height = study.wave_speeds(*study.struck_bar(1 / 4, poisson))
    assert abs(centre) < study.STRAIN
    # linear theory of springs: bar -0.11%, cells -0.18%, implicit Euler +0.05%
    assert peak == pytest.approx(late, abs=1e-4)
    # variance of the pulse [cells^2]
    near, far = (5**2 + station / 4 for station in study.STATIONS)
    assert height == pytest.approx(np.sqrt(near / far), rel=0.01)


def free_flight(t: float, shake: float, error: float, poisson: float | None) -> tuple[float, float]:
    """Return the drift of momentum and the loss of angular momentum in a second, of a block that
    spins at 2 rad/s.

    shake : standard deviation of random node velocities [m/s]. A body that stays symmetric about
            its middle keeps its momentum whatever the solver does, a shaken body need not
    """
    lattice, throw = study.box((4, 3, 2), 0.1, poisson), np.array([0.6, -0.48, 0.64])
    mass, q = lattice.mass, lattice.nodes
    middle, turn = mass @ q / mass.sum(), Rotation.from_rotvec([0, 0, -2 * t])
    velocity = throw + shake * np.random.default_rng(0).standard_normal(q.shape)
    before = turn.apply(q - middle) + middle - velocity * t

    def momenta(q: np.ndarray, before: np.ndarray) -> tuple[np.ndarray, float]:
        each = mass[:, None] * (q - before) / t
        return each.sum(axis=0), np.cross(q - mass @ q / mass.sum(), each)[:, 2].sum()

    start, spin = momenta(q, before)
    *_, last = study.steps(lattice, t, q, before, round(1 / t) * [np.zeros_like(q)], error)
    end, spin_left = momenta(*last)
    return float(np.linalg.norm(end - start) / np.linalg.norm(start)), 1 - spin_left / spin


@laws
@pytest.mark.parametrize("error", [1e-2, 1e-10])
def test_a_shaken_body_keeps_its_momentum_however_loose_its_steps(
    error: float, poisson: float | None
):
    """Every cell gives each of its corners the same mass and the same diagonal entry of L.

    So Jacobi's preconditioner is a multiple of M, and CG brings in no net force however early it
    stops. A start from q_n would, but is not used here.
    """
    assert free_flight(1 / 100, 0.1, error, poisson)[0] < 1e-12


def rigid_loss(angle: float, steps: int) -> float:
    """Return the share of angular momentum that implicit Euler takes from a rigid body.

    It turns by ``angle`` a step. Central forces make no torque, so sum_i x_(n+1) x M (x_(n+1) - 2
    x_n + x_(n-1)) = 0. For the n-th turn a_n this is sin(a_n + a_(n-1)) = 2 sin a_n. The momentum
    goes as sin a_n, and da/dn = -a^3 for small turns.
    """
    last = angle
    for _ in range(steps):
        last = np.arctan2(np.sin(last), 2 - np.cos(last))
    return 1 - np.sin(last) / np.sin(angle)


@laws
def test_a_spin_loses_what_implicit_euler_takes_from_a_rigid_body(poisson: float | None):
    """7.15% in a second by steps of 1/50 s."""
    assert free_flight(1 / 50, 0.0, 1e-10, poisson)[1] == pytest.approx(
        rigid_loss(2 / 50, 50), abs=1e-4
    )
