"""The filter's steps against the textbook's dense matrices."""

from fractions import Fraction

import numpy as np
import pytest
from scipy.linalg import solve
from worlds.covariances import position_and_its_error, scaled_eigenvalues

from nav.kalman import correct, innovate, invert, keep_positive, predict, update


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
    predict(P, Phi, decay, half_noise, np.empty((9, n)), n)
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


def test_a_covariance_in_columns_that_lie_apart_is_refused():
    P = np.tile(np.eye(10), (1, 2))[:, ::2]
    with pytest.raises(ValueError, match="rows of P must be contiguous"):
        update(np.zeros(10), P, np.eye(1, 10), np.ones(1), np.ones(1), np.inf)


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
        predict(P, Phi, np.ones(n), half_noise, np.empty((9, n)), n)
        H = rng.normal(size=(3, n)) / scale
        R = np.full(3, 1e-6)
        nu = rng.normal(size=3)
        _, S_inverse, HP, _ = innovate(P, H, R, nu)
        correct(P, H, R, HP, S_inverse, nu)
    assert (P == P.T).all()
    assert np.linalg.eigvalsh(P / np.outer(scale, scale)).min() > 0


def exact_update(P, H, R):
    """P after one measurement in rational numbers, for which no rounding exists."""
    P, h = [[Fraction(v) for v in row] for row in P.tolist()], [Fraction(v) for v in H[0].tolist()]
    n = range(len(h))
    Ph = [sum(P[i][j] * h[j] for j in n) for i in n]
    S = sum(h[i] * Ph[i] for i in n) + Fraction(float(R[0]))
    return np.array([[float(P[i][j] - Ph[i] * Ph[j] / S) for j in n] for i in n])


def test_the_covariance_stays_positive_however_good_the_measurement():
    """Joseph's form alone loses it in a fifth of these."""
    lost = 0
    for seed in range(60):
        P, H, R = position_and_its_error(seed)
        by_joseph, P_after = P.copy(), P.copy()
        _, S_inverse, HP, _ = innovate(P, H, R, np.zeros(1))
        correct(by_joseph, H, R, HP, S_inverse, np.zeros(1))
        lost += scaled_eigenvalues(by_joseph)[0] <= 0
        update(np.zeros(6), P_after, H, R, np.zeros(1), np.inf)
        assert scaled_eigenvalues(P_after)[0] > 0, seed
        exact = exact_update(P, H, R)
        np.testing.assert_allclose(np.diag(P_after), np.diag(exact), rtol=1e-6)
    assert lost > 5


@pytest.mark.parametrize("ratio", 10.0 ** np.arange(-4, 33, 4))
def test_any_ratio_of_prior_to_noise(ratio):
    rng = np.random.default_rng(3)
    P = positive(rng, 9) * ratio
    for _ in range(30):
        update(np.zeros(9), P, rng.normal(size=(2, 9)), np.ones(2), rng.normal(size=2), np.inf)
        assert scaled_eigenvalues(P)[0] > 0


def test_what_is_positive_keeps_its_bits():
    P = positive(np.random.default_rng(5), 12)
    P[:, 7] = P[7, :] = 0.0  # a state that is not in use
    kept = P.copy()
    keep_positive(kept)
    np.testing.assert_array_equal(kept, P)


def test_a_negative_variance_is_given_back_its_size():
    P = np.diag([4.0, -1e-9, 1.0])
    P[0, 1] = P[1, 0] = 1e-6
    P[0, 2] = P[2, 0] = 2.0 + 1e-14  # more than whole correlation
    keep_positive(P)
    assert scaled_eigenvalues(P)[0] > 0
    np.testing.assert_allclose(np.diag(P), [4.0, 1e-9, 1.0], rtol=1e-12)
