"""Energy, gradient and Hessian of springs against closed forms and finite differences."""

import numpy as np
import pytest

from msmpetsc.elasticity.springs import (
    OwnedSprings,
    add_elastic_gradient,
    add_elastic_product,
    elastic_hessian,
)
from msmpetsc.lattice.lattice import Springs

RNG = np.random.default_rng(5)
N = 12
SPRINGS = np.array([(a, b) for a in range(N) for b in range(a)])
REST = RNG.uniform(0.5, 1.5, len(SPRINGS))
STIFFNESS = RNG.uniform(1, 100, len(SPRINGS))
Q = RNG.normal(size=(N, 3))

HOOKE = Springs(SPRINGS, REST, STIFFNESS)


def energy(q: np.ndarray, springs: Springs = HOOKE) -> float:
    """Return the energy by its change from springs of length zero, which have k r^2 / 2."""
    without_length = 0.5 * springs.stiffness @ springs.rest_length**2
    return without_length + OwnedSprings(springs).change(q, np.zeros_like(q))


def gradient(q: np.ndarray, springs: Springs = HOOKE) -> np.ndarray:
    g = np.zeros_like(q)
    add_elastic_gradient(q, springs, g)
    return g


def hessian_times(q: np.ndarray, v: np.ndarray, projected: bool = False) -> np.ndarray:
    product, blocks = np.zeros_like(q), np.empty((len(SPRINGS), 4))
    elastic_hessian(q, HOOKE, projected, blocks)
    add_elastic_product(SPRINGS, blocks, v, product)
    return product


def test_one_spring_has_hookes_energy_and_force():
    q = np.array([[0.0, 0, 0], [0, 3, 4]])
    one = Springs(np.array([[0, 1]]), np.array([2.0]), np.array([10.0]))
    # Eq. 13
    assert energy(q, one) == pytest.approx(0.5 * 10 * (5 - 2) ** 2)
    # k (l - r) along the spring
    np.testing.assert_allclose(gradient(q, one), [[0, -18, -24], [0, 18, 24]])


def test_gradient_is_the_slope_of_the_energy():
    v = RNG.normal(size=Q.shape)
    step = 1e-5
    slope = (energy(Q + step * v) - energy(Q - step * v)) / (2 * step)
    assert (gradient(Q) * v).sum() == pytest.approx(slope, rel=1e-8)


def test_hessian_is_the_slope_of_the_gradient():
    v = RNG.normal(size=Q.shape)
    step = 1e-5
    slope = (gradient(Q + step * v) - gradient(Q - step * v)) / (2 * step)
    np.testing.assert_allclose(
        hessian_times(Q, v), slope, rtol=1e-6, atol=1e-6 * np.abs(slope).max()
    )


def dense_hessian(q: np.ndarray, projected: bool) -> np.ndarray:
    return np.array(
        [hessian_times(q, unit.reshape(N, 3), projected).ravel() for unit in np.eye(3 * N)]
    )


def test_projected_hessian_is_positive_where_the_true_one_is_not():
    pressed = 0.2 * Q
    true, projected = dense_hessian(pressed, False), dense_hessian(pressed, True)
    np.testing.assert_allclose(true, true.T, atol=1e-13 * abs(true).max())
    assert np.linalg.eigvalsh(true)[0] < -1
    assert np.linalg.eigvalsh(projected)[0] > -1e-13 * abs(projected).max()
    stretched = 20 * Q
    np.testing.assert_array_equal(dense_hessian(stretched, True), dense_hessian(stretched, False))


def test_a_change_of_energy_keeps_its_digits():
    """A small change equals its Taylor sum; a difference of energies would have no digits."""
    # Q + dQ is rounded, so v is dQ after rounding
    v = (Q + 1e-10 * RNG.normal(size=Q.shape)) - Q
    first, second = (gradient(Q) * v).sum(), 0.5 * (hessian_times(Q, v) * v).sum()
    change = OwnedSprings(HOOKE).change(Q + v, Q)
    # near a minimum the change is of second order, without the loads
    assert change - first == pytest.approx(second, rel=1e-4, abs=0)
    far = 3 * Q + 1
    assert OwnedSprings(HOOKE).change(far, Q) == pytest.approx(energy(far) - energy(Q), rel=1e-12)


def test_springs_without_length_pull_nothing_and_give_no_nan():
    q = np.zeros((N, 3))
    np.testing.assert_array_equal(gradient(q), 0)
    assert np.isfinite(hessian_times(q, Q)).all()
    stretch = np.linalg.norm(Q[SPRINGS[:, 1]] - Q[SPRINGS[:, 0]], axis=1) - REST
    before = (0.5 * STIFFNESS * stretch**2).sum()
    without_length = 0.5 * STIFFNESS @ REST**2
    assert OwnedSprings(HOOKE).change(q, Q) == pytest.approx(without_length - before)
