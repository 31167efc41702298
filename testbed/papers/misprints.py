"""Formulas of the papers that are wrong as they are printed, as they are printed; what is right is in `nav`.

Claims and tests show what each of them does. They are handed to the estimators of `nav` where those take another rule:
a function of a configuration, a detector, what a sequential test remembers or makes of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from nav.ahrs import limited
from nav.detection import Decision, Mean, chi_square_threshold, whiten
from nav.detection.base import Alarm
from nav.earth import STANDARD_GRAVITY
from nav.fusion import scaled_inverse
from nav.samples import Array
from nav.weighting import ITERATIONS, TOLERANCE, inflated_distance

# --- Zhou et al. 2025


@dataclass
class UnsquaredDistance:
    """Equations 13 and 14: the Mahalanobis distance itself against the chi-square quantile of its square.

    The limit of one axis moves from 3.3 to 10.8 sigma at 1e-3.
    """

    false_alarm: float
    _alarm: Alarm = field(default_factory=Alarm, init=False)

    def passes(self, gamma2: float, m: int) -> bool:
        """Whether the root of the squared distance ``gamma2`` of ``m`` axes is small enough; a NaN is not."""
        return math.sqrt(gamma2) <= chi_square_threshold(self.false_alarm, m)

    def step(self, nu: Array, S: Array, t: float) -> Decision:
        """Judge one sample; see `nav.detection.Detector`."""
        m, gamma2 = len(nu), whiten(nu, S)[1]
        sound = None if self.passes(gamma2, m) else np.full(m, False)
        return self._alarm.decide(math.sqrt(gamma2), chi_square_threshold(self.false_alarm, m), m, sound)


def wald_limit(false_alarm: float) -> float:
    """Equation 18 with p_m = p_f, for one axis and for many: too low for many [nats]."""
    return math.log((1.0 - false_alarm) / false_alarm)


@dataclass(frozen=True)
class CountedEvidence:
    """Equation 17: n |mean|^2 / 2, which is right for the plain mean only. See `nav.detection.Evidence`."""

    def threshold(self, false_alarm: float, m: int) -> float:
        """Wald's."""
        return wald_limit(false_alarm)

    def add(self, evidence: float, mean: Mean, r: Array, t: float) -> float:
        """From ``mean`` with the residuals ``r``."""
        mean.add(r, t)
        mu = mean.value[0]
        return 0.5 * float(mu.dot(mu)) * mean.n

    def alone(self, gamma2: float) -> float:
        """Equation 21."""
        return 0.5 * gamma2


@dataclass(frozen=True)
class InclusiveEvidence:
    """``E <- decay E + mean' r - |mean|^2 / 2`` with a mean that includes r already: it drifts upwards without a fault.

    See `nav.detection.Evidence`; `nav.detection.Recursive` has the mean before.
    """

    def threshold(self, false_alarm: float, m: int) -> float:
        """Wald's."""
        return wald_limit(false_alarm)

    def add(self, evidence: float, mean: Mean, r: Array, t: float) -> float:
        """From ``mean`` with the residuals ``r``."""
        mean.add(r, t)
        mu = mean.value[0]
        return mean.decay * evidence + float(mu.dot(r[0] - 0.5 * mu))

    def alone(self, gamma2: float) -> float:
        """Equation 21."""
        return 0.5 * gamma2


@dataclass
class FadingMean:
    """Equation 20, ``mean <- (s k - 1)/(s k) mean + r/(s k)``: meant to fade, but an old fault is never forgotten.

    The weights grow as a power of age, i^(1/s - 1). See `nav.detection.Mean`; `nav.detection.exponential` forgets.
    """

    s: float
    decay: float = field(default=1.0, init=False)
    n: float = field(default=0.0, init=False)
    value: Array = field(default_factory=lambda: np.zeros((2, 1)), init=False)
    variance: float = field(default=0.0, init=False)

    def __post_init__(self) -> None:
        if not 0 < self.s < 1:
            raise ValueError(f"a forgetting factor between 0 and 1 is needed, not {self.s}")

    def add(self, r: Array, t: float) -> None:
        """Take the residuals ``r`` (2, m) of one sample at ``t`` [s]."""
        self.n += 1.0
        gain = 1.0 / (self.s * self.n)
        self.value = self.value + gain * (r - self.value)
        self.variance = (1.0 - gain) ** 2 * self.variance + gain**2

    def restart(self, r: Array, t: float) -> None:
        """Forget all but ``r`` (equation 21)."""
        self.n, self.value, self.variance = 1.0, r, 1.0


def weights_by_sum(statistics: Array, thresholds: Array) -> Array:
    """Equations 22 to 25 without limits, N_j = B_j / sum B: 1/J for J sound sensors, which makes every R J-fold.

    Shapes as in `nav.weighting.normalised_weights`.
    """
    health = 1.0 - np.asarray(statistics, dtype=float) / thresholds
    health = np.where(health > 0.0, health, 0.0)
    whole = health.sum(axis=0)
    weights: Array = health / np.where(whole > 0.0, whole, 1.0)
    return weights


# --- Zhu et al. 2020


def inflation_upside_down(nu: Array, HPH: Array, R: Array, limit: float) -> tuple[float, int]:
    """Equation 12, its fraction upside down: (lambda, iterations), which ends at the root by chance only.

    Arguments as of `nav.weighting.inflation`.
    """
    return _iterated(nu, HPH, R, limit, lambda excess, slope: slope / excess)


def inflation_by_newton(nu: Array, HPH: Array, R: Array, limit: float) -> tuple[float, int]:
    """Equation 12 with its fraction put right: Newton's method on the squared distance, which is convex.

    As `nav.weighting.inflation`, which takes the reciprocal and so fewer steps.
    """
    return _iterated(nu, HPH, R, limit, lambda excess, slope: excess / slope)


def _iterated(
    nu: Array, HPH: Array, R: Array, limit: float, step: Callable[[float, float], float]
) -> tuple[float, int]:
    lam = 1.0
    for iteration in range(ITERATIONS):
        theta, slope = inflated_distance(nu, HPH, R, lam)
        excess = theta - limit
        if excess <= (TOLERANCE * limit if lam > 1.0 else 0.0):
            return lam, iteration
        lam += step(excess, slope)
    return lam, ITERATIONS


def weights_eq13(P: Array, common: int, members: Array) -> Array:
    """Equation 13: weights (filters,) that are ``|diag(P_i^-1 P_i^-T)|_F`` over their sum.

    They mix units, are decided by the gyro biases and hardly react to a filter whose position is lost. Arguments as of
    `nav.fusion.weights_by_covariance`.
    """
    norms = np.zeros(len(P))
    for i in np.flatnonzero(members):
        inverse = scaled_inverse(P[i], common)[0]
        norms[i] = np.linalg.norm(np.sum(inverse * inverse, axis=1))
    weights: Array = norms / norms.sum()
    return weights


DEGREES = np.degrees(1.0)
# What the paper's 13 states are in: deg; m/s; m; deg/h; ug. Height and vertical velocity are none of them.
UNITS = np.repeat([DEGREES, 1.0, 0.0, 1.0, 0.0, 3600 * DEGREES, 1e6 / STANDARD_GRAVITY], [3, 2, 1, 2, 1, 3, 3])


def weights_eq13_in_degrees(P: Array, common: int, members: Array) -> Array:
    """Equation 13 with the states in the units of the paper's tables and figures (`UNITS`)."""
    states = np.flatnonzero(UNITS)
    units = UNITS[states]
    return weights_eq13(P[:, states[:, None], states] * np.outer(units, units), len(states), members)


# --- Jiang et al. 2021


def correction_eq10(phi: Array, limit: float) -> Array:
    """Equation 10: both level axes are corrected by the error of the north axis, see `nav.ahrs.limited`."""
    return limited(phi[[0, 0, 2]], limit)


# --- Cheng et al. 2020


def noise_eq29(R: Array, z: Array, z_hat: Array, points: Array, d: float) -> Array:
    """Equations 25 to 29: R (m, m) learned from a measurement ``z`` (m,), predicted as ``z_hat``, by the weight ``d``.

    R <- (1 - d) R + d (nu nu' - mean of (z - Z_j)(z - Z_j)') over the sigma ``points`` (N, m) of equal weights: with
    the measurement where the mean of the points belongs, that is -H P- H' whatever was measured, and R gets negative.
    """
    nu, off = z - z_hat, z - points
    learned: Array = (1.0 - d) * R + d * (np.outer(nu, nu) - off.T @ off / len(points))
    return learned


def fading_eq33(innovations: Array, S: Array, alpha: float) -> float:
    """Equations 31 to 33: the factor on P from the latest ``innovations`` (N, m), the last of covariance ``S``.

    1 as long as nu' nu is at most alpha tr(S), else tr(C) / tr(S): sums of m^2, (m/s)^2 and rad^2, in which a position
    hides whatever heading does. See `nav.weighting.Fading`.
    """
    squares, expected = np.sum(innovations**2, axis=1), float(np.trace(S))
    return max(1.0, float(squares.mean()) / expected) if squares[-1] > alpha * expected else 1.0
