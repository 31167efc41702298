"""The filter's steps against the textbook's dense matrices."""

import numpy as np
import pytest
from scipy.linalg import solve

from nav.kalman import correct, innovate, invert, predict


def positive(rng, n):
    root = rng.normal(size=(n, n))
    return root @ root.T + 0.1 * np.eye(n)


@pytest.mark.parametrize(("n", "columns"), [(15, 15), (22, 15), (30, 21)])
def test_predict_is_the_dense_equation(n, columns):
    rng = np.random.default_rng(n)
    Phi = np.eye(9, columns) + 0.1 * rng.normal(size=(9, columns)) * (rng.random((9, columns)) < 0.5)
    decay = np.where(rng.random(n) < 0.5, 1.0, rng.uniform(0.8, 1.0, n))
    half_noise = rng.uniform(0, 0.1, n)
    T = np.diag(decay)
    T[:9] = 0
    T[:9, :columns] = Phi
    P = positive(rng, n)
    expected = T @ (P + np.diag(half_noise)) @ T.T + np.diag(half_noise)
    predict(P, Phi, decay, half_noise, np.empty((9, n)))
    np.testing.assert_allclose(P, expected, rtol=1e-12, atol=1e-12)
    assert (P == P.T).all()


@pytest.mark.parametrize("m", [1, 2, 3])
def test_update_is_the_dense_equation(m):
    rng = np.random.default_rng(m)
    n = 19
    P, H, R, nu = positive(rng, n), rng.normal(size=(m, n)), rng.uniform(0.1, 1, m), rng.normal(size=m)
    S_dense = H @ P @ H.T + np.diag(R)
    K = solve(S_dense, H @ P).T
    left = np.eye(n) - K @ H
    expected = left @ P @ left.T + K @ np.diag(R) @ K.T

    S, S_inverse, HP, nis = innovate(P, H, R, nu)
    np.testing.assert_allclose(S, S_dense, rtol=1e-12)
    np.testing.assert_allclose(nis, nu @ solve(S_dense, nu), rtol=1e-10)
    np.testing.assert_allclose(correct(P, H, R, HP, S_inverse, nu), K @ nu, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(P, expected, rtol=1e-9, atol=1e-10)
    assert (P == P.T).all()


def test_inverse():
    S = positive(np.random.default_rng(0), 4)
    inverse, definite = invert(S)
    assert definite
    np.testing.assert_allclose(inverse @ S, np.eye(4), atol=1e-12)
    assert not invert(np.array([[1.0, 2.0], [2.0, 1.0]]))[1]
    assert not invert(np.full((1, 1), np.nan))[1]


def test_a_singular_innovation_is_no_number():
    P, H = np.zeros((9, 9)), np.ones((1, 9))
    assert np.isnan(innovate(P, H, np.zeros(1), np.ones(1))[3])


def test_positive_after_ten_thousand_sharp_updates():
    """Units from 1e-6 to 1e3 in one covariance and measurements a million times sharper than the prior."""
    rng = np.random.default_rng(1)
    n = 17
    scale = 10.0 ** rng.uniform(-6, 3, n)
    P = positive(rng, n) * np.outer(scale, scale)
    Phi = np.eye(9, 15) + 1e-3 * rng.normal(size=(9, 15)) * np.outer(scale[:9], 1 / scale[:15])
    half_noise = (1e-7 * scale) ** 2
    for _ in range(10_000):
        predict(P, Phi, np.ones(n), half_noise, np.empty((9, n)))
        H = rng.normal(size=(3, n)) / scale
        R = np.full(3, 1e-6)
        nu = rng.normal(size=3)
        _, S_inverse, HP, _ = innovate(P, H, R, nu)
        correct(P, H, R, HP, S_inverse, nu)
    assert (P == P.T).all()
    assert np.linalg.eigvalsh(P / np.outer(scale, scale)).min() > 0
