"""Policies on R and P against root finders, closed forms and simulation."""

import math

import numpy as np
import pytest
from scipy.stats import chi2
from worlds.innovations import cases, root, theta, two_axes

from nav.detection import ChiSquare, Eraim
from nav.weighting import (
    Fading,
    Gate,
    InOrder,
    MahalanobisInflation,
    SageHusa,
    Weight,
    inflation,
    normalised_weights,
)

LIMIT2 = chi2.ppf(0.99, 2)


@pytest.mark.ci
def test_inflation_finds_the_root():
    """Two axes, H P H' and R of like size, lambda up to 5000."""
    taken = []
    for nu, HPH, R in two_axes(3000, LIMIT2):
        lam, iterations = inflation(nu, HPH, R, LIMIT2)
        taken.append(iterations)
        exact = root(nu, HPH, R, LIMIT2)
        assert abs(theta(nu, HPH, R, lam) - LIMIT2) <= 1e-5
        assert abs(lam - exact) <= 1e-6 * exact
    assert max(taken) <= 5


def test_inflation_of_any_shape_ends_at_the_limit():
    for nu, HPH, R, limit in cases(500):
        lam, iterations = inflation(nu, HPH, R, limit)
        assert iterations < 60
        assert -1e-9 <= theta(nu, HPH, R, lam) - limit <= 1e-5


def test_inflation_in_one_step_when_proportional():
    R = np.array([400.0, 100.0, 25.0])
    nu = np.array([500.0, -300.0, 20.0])
    lam, iterations = inflation(nu, 0.3 * np.diag(R), R, chi2.ppf(0.99, 3))
    np.testing.assert_allclose(lam, np.sum(nu**2 / R) / chi2.ppf(0.99, 3) - 0.3, rtol=1e-12)
    assert iterations == 1


@pytest.mark.parametrize(
    ("ratio", "size", "sigma", "theta0", "expected"),
    [(0.01, 500.0, 20.0, 618.8, 67.85), (1.0, 500.0, 20.0, 312.5, 66.86), (0.01, 100.0, 20.0, 24.8, 2.704),
     (0.01, 500.0, 20 / math.sqrt(3), 1856.0, 203.6)],
)  # fmt: skip
def test_inflation_of_a_transponder_outlier(ratio, size, sigma, theta0, expected):
    nu, R = np.array([size, 0.0]), np.full(2, sigma**2)
    assert abs(theta(nu, ratio * np.diag(R), R, 1.0) - theta0) < 0.01 * theta0
    lam, _ = inflation(nu, ratio * np.diag(R), R, LIMIT2)
    assert abs(lam - expected) < 1e-3 * expected


def test_sound_measurements_are_left_alone():
    nu, R = np.array([1.0, -2.0]), np.array([4.0, 4.0])
    assert inflation(nu, np.eye(2), R, LIMIT2) == (1.0, 0)
    np.testing.assert_array_equal(MahalanobisInflation().adapt(nu, np.eye(2) + np.diag(R), R, 0.0), R)


def test_inflation_policy_limits_rejects_and_survives_garbage():
    R, HPH = np.array([1.0, 4.0]), np.array([[2.0, 0.5], [0.5, 1.0]])
    S = HPH + np.diag(R)
    nu = np.array([9.0, -3.0])
    used = MahalanobisInflation().adapt(nu, S, R, 0.0)
    assert abs(nu @ np.linalg.solve(HPH + np.diag(used), nu) - LIMIT2) < 1e-5
    np.testing.assert_allclose(used / R, (used / R)[0])
    assert np.isinf(MahalanobisInflation(reject_above=20.0).adapt(nu, S, R, 0.0)).all()
    np.testing.assert_allclose(MahalanobisInflation(reject_above=80.0).adapt(nu, S, R, 0.0), used)
    assert np.isinf(MahalanobisInflation().adapt(np.array([np.nan, 0.0]), S, R, 0.0)).all()
    assert np.isinf(MahalanobisInflation().adapt(np.array([np.inf, 0.0]), S, R, 0.0)).all()
    assert np.isinf(MahalanobisInflation().adapt(nu, -S, R, 0.0)).all()
    assert np.isinf(MahalanobisInflation().adapt(nu, HPH, np.zeros(2), 0.0)).all()  # nothing to inflate


def test_inflated_step_falls_with_the_outlier():
    """One axis: the state moves by P limit / nu."""
    limit, P, R = chi2.ppf(0.99, 1), 2.0, np.array([1.0])
    for nu in (10.0, 100.0, 1000.0):
        used = MahalanobisInflation().adapt(np.array([nu]), np.array([[P + 1.0]]), R, 0.0)
        np.testing.assert_allclose(P / (P + used[0]) * nu, P * limit / nu, rtol=1e-6)


def test_normalised_weights():
    thresholds = np.array([8.0, 8.0, 4.0])
    np.testing.assert_array_equal(normalised_weights(np.zeros(3), thresholds), 1.0)
    # half-way to the alarm, sound, beyond the alarm
    np.testing.assert_allclose(normalised_weights(np.array([4.0, 0.0, 5.0]), thresholds), [0.5, 1.0, 0.0])
    # all are suspect alike: nobody is weakened
    np.testing.assert_allclose(normalised_weights(np.array([4.0, 4.0, 2.0]), thresholds), 1.0)
    # limits: B = 0.15 is out, B = 0.95 keeps its R though another is better
    np.testing.assert_allclose(normalised_weights(np.array([6.8, 0.4, 0.0]), thresholds), [0.0, 1.0, 1.0])
    np.testing.assert_allclose(
        normalised_weights(np.array([6.8, 4.0, 0.0]), thresholds, lower=0.1, upper=0.5), [0.15, 1.0, 1.0]
    )
    assert normalised_weights(np.array([np.nan, np.inf, 0.0]), thresholds).tolist() == [0.0, 0.0, 1.0]
    assert not normalised_weights(np.full(3, 9.0), thresholds).any()
    # one sensor alone is not weakened short of its limit
    np.testing.assert_array_equal(normalised_weights(np.array([5.0]), np.array([8.0])), [1.0])
    # axis by axis
    table = normalised_weights(np.array([[0.0, 4.0], [6.0, 0.0]]), 8.0)
    np.testing.assert_allclose(table, [[1.0, 0.5], [0.25, 1.0]])


def test_weight_leaves_out_at_zero():
    R = np.array([1.0, 4.0, 9.0])
    used = Weight(np.array([1.0, 0.5, 0.0])).adapt(np.zeros(3), np.eye(3), R, 0.0)
    np.testing.assert_array_equal(used, [1.0, 8.0, np.inf])


def walk(policy, R_true, looks, seed, outlier=None, m=2):
    """Random-walk states measured directly with variances that are `R_true`, told 1; the variances last used."""
    rng = np.random.default_rng(seed)
    truth, x, P = np.zeros(m), np.zeros(m), np.eye(m)
    used = np.ones(m)
    for k in range(looks):
        truth = truth + 0.3 * rng.normal(size=m)
        P = P + 0.09 * np.eye(m)
        z = truth + np.sqrt(R_true) * rng.normal(size=m)
        if outlier and k % outlier == outlier - 1:
            z = z + 500.0
        nu = z - x
        used = policy.adapt(nu, P + np.eye(m), np.ones(m), float(k))
        if isinstance(policy, SageHusa):
            policy.learn(nu, P, used)
        else:
            policy.learn(nu, P)
        K = P @ np.linalg.inv(P + np.diag(np.where(np.isinf(used), 1e12, used)))
        x = x + K @ nu
        P = (np.eye(m) - K) @ P
    return used


@pytest.mark.ci
def test_sage_husa_finds_a_fourfold_variance():
    """Within 25 % after 200 looks: two axes, one of them as told, and in the mean over runs without bias."""
    found = np.array([walk(SageHusa(b=0.99), np.array([4.0, 1.0]), 200, seed) for seed in range(60)])
    assert np.mean(np.abs(found[:, 0] / 4 - 1) < 0.25) > 0.9
    np.testing.assert_allclose(found.mean(axis=0), [4.0, 1.0], rtol=0.1)


def test_sage_husa_stays_between_its_floors():
    policy = SageHusa(b=0.95)
    for residual, expected in ((0.0, 0.25), (1e9, 100.0)):
        for _ in range(200):
            R = policy.adapt(np.zeros(2), 2 * np.eye(2), np.ones(2), 0.0)
            policy.learn(np.full(2, residual), np.zeros((2, 2)), R)
        np.testing.assert_array_equal(policy.adapt(np.zeros(2), 2 * np.eye(2), np.ones(2), 0.0), expected)
        assert (R > 0).all()
    # the ratio is what is learned: a sensor that now tells a tenth of its sigma is followed
    np.testing.assert_allclose(policy.adapt(np.zeros(2), 2 * np.eye(2), np.full(2, 0.01), 0.0), 1.0)


def test_sage_husa_ignores_an_axis_without_residual():
    policy = SageHusa()
    policy.adapt(np.zeros(2), 2 * np.eye(2), np.ones(2), 0.0)
    policy.learn(np.array([3.0, 3.0]), np.zeros((2, 2)), np.array([1.0, np.inf]))
    assert policy.ratio[0] > 1
    assert policy.ratio[1] == 1
    with pytest.raises(ValueError, match="between 0 and 1"):
        SageHusa(b=1.0)


def test_sage_husa_learns_nothing_of_an_axis_without_noise():
    policy, alone = SageHusa(), SageHusa()
    policy.adapt(np.zeros(2), np.eye(2), np.array([0.0, 1.0]), 0.0)
    policy.learn(np.array([3.0, 3.0]), np.eye(2), np.array([0.0, 1.0]))
    alone.adapt(np.zeros(1), np.eye(1), np.ones(1), 0.0)
    alone.learn(np.array([3.0]), np.eye(1), np.ones(1))
    np.testing.assert_array_equal(policy.ratio, [1.0, *alone.ratio])


def test_sage_husa_first_weight_is_finite():
    """The nominal is the first member of the mean: after one look R is near (1 + e^2) / 2."""
    policy = SageHusa(b=0.98)
    policy.adapt(np.zeros(1), np.eye(1), np.ones(1), 0.0)
    policy.learn(np.array([2.0]), np.zeros((1, 1)), np.ones(1))
    np.testing.assert_allclose(policy.ratio, (0.98 * 1 + 4) / 1.98)


def test_fading_answers_a_covariance_that_is_too_small():
    """Innovations twice as wide as S says: lambda near 4 once the window is full, and 1 for sound ones."""
    rng = np.random.default_rng(2)
    S = np.array([[4.0, 1.0], [1.0, 9.0]])
    L = np.linalg.cholesky(S)
    wide, sound = Fading(window=50, alpha=1.5), Fading(window=50, alpha=1.5)
    factors = [wide.factor(2 * L @ rng.normal(size=2), S) for _ in range(3000)]
    active = [f for f in factors[50:] if f > 1]
    assert 3.5 < np.mean(active) < 4.5
    assert all(sound.factor(0.5 * L @ rng.normal(size=2), S) == 1.0 for _ in range(1000))


def test_fading_is_the_trace_over_the_window():
    rng = np.random.default_rng(3)
    S = np.diag([1.0, 100.0, 1e-4])
    looks = 5 * np.sqrt(np.diag(S)) * rng.normal(size=(25, 3))
    fading = Fading(window=10, alpha=0.0)
    for k, nu in enumerate(looks):
        value = fading.factor(nu, S)
        C = np.mean([np.outer(v, v) for v in looks[max(0, k - 9) : k + 1]], axis=0)
        np.testing.assert_allclose(value, max(1.0, np.trace(np.linalg.solve(S, C)) / 3))
    assert fading.factor(np.array([np.nan, 0, 0]), S) == 1.0
    assert math.isfinite(fading.factor(np.array([1.0]), np.eye(1)))  # another sensor: begins anew


def test_order_gate_then_inflation_on_what_is_left():
    HPH = np.array([[2.0, 0.6, 0.1], [0.6, 1.0, 0.2], [0.1, 0.2, 1.5]])
    R, nu = np.array([1.0, 2.0, 1.0]), np.array([6.0, -5.0, 400.0])
    chain = InOrder([Gate(Eraim(1e-6)), MahalanobisInflation(0.01)])
    used = chain.adapt(nu, HPH + np.diag(R), R, 0.0)
    assert np.isinf(used[2])
    part = nu[:2] @ np.linalg.solve(HPH[:2, :2] + np.diag(used[:2]), nu[:2])
    assert abs(part - LIMIT2) < 1e-5
    # and a weight on top is a weight on what the inflation left
    weighted = InOrder([Gate(Eraim(1e-6)), MahalanobisInflation(0.01), Weight(0.5)]).adapt(nu, HPH + np.diag(R), R, 0.0)
    np.testing.assert_allclose(weighted, 2 * used)


def test_order_nothing_left():
    chain = InOrder([Gate(ChiSquare(1e-3)), MahalanobisInflation(), Weight(0.5)])
    nu, S, R = np.array([100.0, 0.0]), 2 * np.eye(2), np.ones(2)
    assert np.isinf(chain.adapt(nu, S, R, 0.0)).all()
    np.testing.assert_array_equal(chain.adapt(0.1 * nu / 100, S, R, 1.0), 2.0)


def test_order_learns_from_sound_looks_only():
    """500-sigma outliers each tenth look leave the learned R where it was; without the gate they take it away."""
    sound = InOrder([SageHusa(b=0.98), Gate(ChiSquare(1e-6)), MahalanobisInflation()])
    assert 0.6 < walk(sound, np.ones(2), 399, 1, outlier=10)[0] < 1.6
    assert walk(InOrder([SageHusa(b=0.98)]), np.ones(2), 399, 1, outlier=10)[0] > 50
    # with inflation in place of the gate, an outlier teaches no more than the limit that it was inflated to
    soft = InOrder([SageHusa(b=0.98), MahalanobisInflation()])
    walk(soft, np.ones(2), 399, 1, outlier=10)
    assert soft.policies[0].ratio[0] < 3
    # and a lasting rise of the noise is still learned through both
    rising = InOrder([SageHusa(b=0.98), Gate(ChiSquare(1e-6)), MahalanobisInflation()])
    learned = [walk(rising, np.full(2, 9.0), 400, seed)[0] for seed in range(3)]
    assert rising.policies[0].ratio.min() > 4
    assert np.isfinite(learned).any()
