"""Innovations and their covariances, and whether alarms come as often as they should."""

import numpy as np
from scipy.optimize import brentq
from scipy.stats import chi2


def positive(rng, m):
    root = rng.normal(size=(m, m))
    return root @ root.T + 0.1 * np.eye(m)


def within_binomial(count, looks, p, sigmas=4.0):
    """Whether ``count`` of ``looks`` is what the probability ``p`` gives."""
    return abs(count - looks * p) <= sigmas * np.sqrt(looks * p * (1 - p))


def alarm_share(detector, rng, m, looks):
    """Share of alarms in unit white residuals."""
    S, x = np.eye(m), rng.normal(size=(looks, m))
    return np.mean([detector.step(x[k], S, 0.2 * k).alarm for k in range(looks)])


def cases(n, seed=0):
    """Innovations beyond the limit: m 1 to 4, H P H' from 1e-3 to 1e3 times R, distances up to 1e4 sigma."""
    rng = np.random.default_rng(seed)
    while n:
        m = rng.integers(1, 5)
        R = 10.0 ** rng.uniform(-2, 2, m)
        root = rng.normal(size=(m, m)) * 10.0 ** rng.uniform(-1.5, 1.5)
        HPH = root @ root.T * np.sqrt(np.outer(R, R))
        nu = rng.normal(size=m) * np.sqrt(np.diag(HPH) + R) * 10.0 ** rng.uniform(0, 3)
        limit = chi2.ppf(0.99, m)
        if theta(nu, HPH, R, 1.0) > limit:
            n -= 1
            yield nu, HPH, R, limit


def two_axes(n, limit, seed=1):
    """Innovations of two axes beyond ``limit``, up to 2000 times; H P H' and R of like size."""
    rng = np.random.default_rng(seed)
    while n:
        R = rng.uniform(0.1, 10, 2)
        half = rng.normal(size=(2, 2))
        HPH, nu = half @ half.T, rng.normal(size=2) * 10 ** rng.uniform(0, 2)
        if limit < theta(nu, HPH, R, 1.0) < 2000 * limit:
            n -= 1
            yield nu, HPH, R


def theta(nu, HPH, R, lam):
    return nu @ np.linalg.solve(HPH + lam * np.diag(R), nu)


def root(nu, HPH, R, limit):
    high = 2.0
    while theta(nu, HPH, R, high) > limit:
        high *= 2
    return brentq(lambda lam: theta(nu, HPH, R, lam) - limit, 1.0, high, xtol=1e-13, rtol=1e-14)
