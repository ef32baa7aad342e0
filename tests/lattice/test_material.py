"""The springs against elasticity: constants, a clamped beam, free flight."""

from functools import cache

import numpy as np
import pytest
import small_strain as study
from scipy.spatial.transform import Rotation
from small_strain import ACROSS
from strains import elastic_constant, uniform_strains

lattice_beam = cache(study.lattice_beam)
laws = pytest.mark.parametrize("poisson", study.LAWS.values(), ids=study.LAWS)


# ---- uniform strain


STRAINS = {name: rest for name, *rest in uniform_strains()}


@laws
@pytest.mark.parametrize("name", STRAINS)
def test_elastic_constants_in_every_direction(name: str, poisson: float | None):
    """C11 = 6/5 E and C12 = C44 = 2/5 E for a whole block with its boundary."""
    G, other, exact = STRAINS[name]
    lattice = study.box((5, 4, 4), 0.1, poisson)
    assert elastic_constant(lattice, G, other) == pytest.approx(exact, rel=1e-10)


# ---- a clamped beam


@pytest.mark.parametrize("across", ACROSS)
def test_the_excess_stiffness_is_that_of_cells_that_cannot_curve(across: int):
    """The stiffness is E I (1 + 169/140 (h/b)^2), except for the effect of the clamp.

    The clamp also holds the width: this is 0.7% by scikit-fem, twice as much at two cells across.
    """
    sag, frequency = lattice_beam(across)
    assert -0.015 < sag / study.timoshenko_sag(across) - 1 < 0
    assert 0 < frequency / study.timoshenko_frequency(across) - 1 < 0.0075


# ---- a wave, free flight


def free_flight(t: float, shake: float, error: float, poisson: float | None) -> tuple[float, float]:
    """Return a spinning block's drift of momentum and loss of angular momentum in a second.

    shake : standard deviation of random node velocities [m/s]; without it the block stays symmetric
            and keeps its momentum with any solver
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

    So Jacobi's preconditioner is a multiple of M, and CG adds no net force even if it stops early.
    A start from q_n would add a force, but is not used here.
    """
    assert free_flight(1 / 100, 0.1, error, poisson)[0] < 1e-12


def rigid_loss(angle: float, steps: int) -> float:
    """Return the share of angular momentum that implicit Euler takes from a rigid body.

    The body turns by ``angle`` per step. Central forces make no torque, so sum_i x_(n+1) x M
    (x_(n+1) - 2 x_n + x_(n-1)) = 0. For the n-th turn a_n this is sin(a_n + a_(n-1)) = 2 sin a_n.
    The momentum goes as sin a_n, and da/dn = -a^3 for small turns.
    """
    last = angle
    for _ in range(steps):
        last = np.arctan2(np.sin(last), 2 - np.cos(last))
    return 1 - np.sin(last) / np.sin(angle)


@laws
def test_a_spin_loses_what_implicit_euler_takes_from_a_rigid_body(poisson: float | None):
    """The loss is 7.15% in a second with steps of 1/50 s."""
    assert free_flight(1 / 50, 0.0, 1e-10, poisson)[1] == pytest.approx(
        rigid_loss(2 / 50, 50), abs=1e-4
    )
