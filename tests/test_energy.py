"""Energy, gradient and Hessian of springs against closed forms and finite differences."""

import numpy as np
import pytest

from msmpetsc.model.energy import add_elastic_gradient, add_elastic_hessian, elastic_change, elastic_energy

RNG = np.random.default_rng(5)
N = 12
SPRINGS = np.array([(a, b) for a in range(N) for b in range(a)])
REST = RNG.uniform(0.5, 1.5, len(SPRINGS))
STIFFNESS = RNG.uniform(1, 100, len(SPRINGS))
Q = RNG.normal(size=(N, 3))


def gradient(q: np.ndarray) -> np.ndarray:
    g = np.zeros_like(q)
    add_elastic_gradient(q, SPRINGS, REST, STIFFNESS, g)
    return g


def hessian_times(q: np.ndarray, v: np.ndarray, projected: bool = False) -> np.ndarray:
    product = np.zeros_like(q)
    add_elastic_hessian(q, SPRINGS, REST, STIFFNESS, projected, v, product)
    return product


def test_one_spring_has_hookes_energy_and_force():
    q = np.array([[0.0, 0, 0], [0, 3, 4]])
    one = np.array([[0, 1]]), np.array([2.0]), np.array([10.0])
    assert elastic_energy(q, *one) == pytest.approx(0.5 * 10 * (5 - 2) ** 2)  # Eq. 13
    g = np.zeros((2, 3))
    add_elastic_gradient(q, *one, g)
    np.testing.assert_allclose(g, [[0, -18, -24], [0, 18, 24]])  # k (l - r) along the spring


def test_gradient_is_the_slope_of_the_energy():
    v = RNG.normal(size=Q.shape)
    step = 1e-5
    slope = (elastic_energy(Q + step * v, SPRINGS, REST, STIFFNESS) - elastic_energy(Q - step * v, SPRINGS, REST, STIFFNESS)) / (2 * step)
    assert (gradient(Q) * v).sum() == pytest.approx(slope, rel=1e-8)


def test_hessian_is_the_slope_of_the_gradient():
    v = RNG.normal(size=Q.shape)
    step = 1e-5
    slope = (gradient(Q + step * v) - gradient(Q - step * v)) / (2 * step)
    np.testing.assert_allclose(hessian_times(Q, v), slope, rtol=1e-6, atol=1e-6 * np.abs(slope).max())


def dense_hessian(q: np.ndarray, projected: bool) -> np.ndarray:
    return np.array([hessian_times(q, unit.reshape(N, 3), projected).ravel() for unit in np.eye(3 * N)])


def test_projected_hessian_is_positive_where_the_true_one_is_not():
    pressed = 0.2 * Q
    true, projected = dense_hessian(pressed, False), dense_hessian(pressed, True)
    np.testing.assert_allclose(true, true.T, atol=1e-10)
    assert np.linalg.eigvalsh(true)[0] < -1
    assert np.linalg.eigvalsh(projected)[0] > -1e-10
    stretched = 20 * Q
    np.testing.assert_array_equal(dense_hessian(stretched, True), dense_hessian(stretched, False))


def test_a_change_of_energy_keeps_its_digits():
    """Against the first and second derivative: a plain difference of energies has no digit left here."""
    v = 1e-10 * RNG.normal(size=Q.shape)
    change = elastic_change(Q + v, Q, SPRINGS, REST, STIFFNESS)
    assert change == pytest.approx((gradient(Q) * v).sum() + 0.5 * (hessian_times(Q, v) * v).sum(), rel=1e-5)
    far = 3 * Q + 1
    plain = elastic_energy(far, SPRINGS, REST, STIFFNESS) - elastic_energy(Q, SPRINGS, REST, STIFFNESS)
    assert elastic_change(far, Q, SPRINGS, REST, STIFFNESS) == pytest.approx(plain, rel=1e-12)


def test_springs_without_length_pull_nothing_and_give_no_nan():
    q = np.zeros((N, 3))
    np.testing.assert_array_equal(gradient(q), 0)
    assert np.isfinite(hessian_times(q, Q)).all()
    assert elastic_energy(q, SPRINGS, REST, STIFFNESS) == pytest.approx(0.5 * STIFFNESS @ REST**2)
