"""The long-run variance of innovations, against that of processes made here."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from nav.detection import LongRunVariance


def residuals(n: int, rho: float, sigma: float, seed: int) -> np.ndarray:
    """(n, 2) first-order autoregressions of variance ``sigma**2`` and correlation ``rho``."""
    white = np.random.default_rng(seed).standard_normal((n, 2))
    return sigma * lfilter([np.sqrt(1 - rho**2)], [1, -rho], white, axis=0)


def learned(rho: float, sigma: float, seconds: float = 2000.0, rate: float = 5.0) -> float:
    """Mean of what is learned, its beginning left out."""
    variance = LongRunVariance()
    S = np.array([[4.0, 1.0], [1.0, 2.0]])
    root = np.linalg.cholesky(S)
    found = []
    for k, r in enumerate(residuals(int(seconds * rate), rho, sigma, 1)):
        wide = variance.widened(root @ r, S, k / rate, sound=True)
        np.testing.assert_array_equal(wide, variance.value * S)
        found.append(variance.value)
    return float(np.mean(found[len(found) // 4 :]))


@pytest.mark.ci
@pytest.mark.parametrize(("rho", "sigma"), [(0.5, 1.0), (0.8, 0.6), (0.5, 0.8)])
def test_it_is_that_of_sums(rho: float, sigma: float) -> None:
    """Against the variance of sums of 100 s, over their length."""
    sums = residuals(1_000_000, rho, sigma, 2).reshape(-1, 500, 2).sum(axis=1)
    assert learned(rho, sigma) == pytest.approx(sums.var() / 500, rel=0.12)


def test_white_residuals_are_left_as_they_are() -> None:
    assert learned(0.0, 1.0) < 1.1
    assert learned(0.0, 0.5) == 1.0
    assert learned(-0.5, 1.0) < 1.1


def test_a_fault_that_is_found_in_time_teaches_nothing() -> None:
    variance = LongRunVariance()
    for k, r in enumerate(residuals(3000, 0.0, 1.0, 3)):
        variance.widened(r, np.eye(2), 0.2 * k, sound=True)
    before = variance.value
    for k in range(3000, 3095):  # 19 s of a fault
        variance.widened(np.array([3.0, 3.0]), np.eye(2), 0.2 * k, sound=True)
    for k in range(3095, 4000):
        variance.widened(np.array([3.0, 3.0]), np.eye(2), 0.2 * k, sound=False)
    assert variance.value == pytest.approx(before, abs=0.2)
    assert variance.value < 1.3


def test_one_outlier_is_no_colour_and_what_is_no_number_no_sample() -> None:
    quiet, hit = LongRunVariance(), LongRunVariance()
    for k, r in enumerate(residuals(3000, 0.0, 1.0, 4)):
        quiet.widened(r, np.eye(2), 0.2 * k, sound=True)
        spoiled = np.array([1e6, np.nan]) if k == 1500 else 100.0 * r if k == 2700 else r
        hit.widened(spoiled, np.eye(2), 0.2 * k, sound=True)
        assert np.isfinite(hit.value)
    assert hit.value == pytest.approx(quiet.value, rel=0.1)


def test_until_something_is_known_it_is_wide() -> None:
    variance = LongRunVariance()
    np.testing.assert_array_equal(variance.widened(np.zeros(1), np.eye(1), 0.0, sound=True), 4.0 * np.eye(1))
