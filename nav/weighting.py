"""What becomes of R and P when a measurement is not what the filter expects.

Every policy on R has one method, ``adapt(nu, S, R, t) -> variances``: from the innovation ``nu`` (m,), its covariance
``S = H P H' + diag(R)`` (m, m), the variances ``R`` (m,) and the time ``t`` [s], the variances to use in this update;
an infinite one leaves its axis out. A policy holds the state of one sensor: build one for each.

Order of application (`InOrder` sees to it that each policy is told the S that the one before has left; a local filter
has gate and detectors of its own and keeps the same order around them: see `split`):

1. `SageHusa`: what R has been learned to be, so that everything after it judges by the R that is true;
2. `Gate`: an axis that a detector refuses is left out, and is neither inflated nor learned from;
3. `MahalanobisInflation`: what passes and is still too far off counts for less;
4. `Weight`: what the detectors of all sensors together say (`normalised_weights`);
5. after the update `learn` shows to `SageHusa` what is left of the innovation.

`Fading` is about P: it raises the gain, so it must never answer an outlier of the measurement. Gate first, then apply
its factor to P, and form S (and the sigma points) anew before the update.

Detectors are given S with the told or the learned R, never with one that was inflated or weighted here: otherwise a
weight would feed back into the statistic that made it. They need the learned R, or a sensor noisier than it says would
be condemned for that alone. Learning is a feedback too, but a slow one: R is learned only from what passed, and each
sample changes the mean by 1 - b of it at most. The price: a fault that grows more slowly than the memory of 1/(1 - b)
samples, and stays below the limit while it does, is learned as noise. Where slow faults are to be found, make the
memory longer than what the detector gathers, or do not learn R.

Sources: Zhou et al. 2025 (normalised weights, Eq 22-26), Cheng et al. 2020 (Sage-Husa, Eq 25-30; fading, Eq 31-36),
Zhu et al. 2020 (inflation, Eq 8-12), Chang, J. Geodesy 88 (2014) 391 (inflation by the Mahalanobis distance).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol, TypeAlias

import numpy as np

from nav._jit import njit
from nav.detection import Detector, chi_square_threshold, whiten
from nav.kalman import invert
from nav.samples import Array

TOLERANCE = 1e-7  # of the distance, relative to its limit
ITERATIONS = 200  # a bound: a handful is usual
Normalise: TypeAlias = Callable[[Array, Array], Array]  # as `normalised_weights`: statistics, thresholds; weights
R_FLOOR, R_CEILING = 0.25, 100.0  # of the nominal variance, between which `SageHusa` may go


class Policy(Protocol):
    """Anything that decides on the variances of one sensor's measurement."""

    def adapt(self, nu: Array, S: Array, R: Array, t: float) -> Array:
        """Variances (m,) to use for the innovation ``nu`` (m,), S = H P H' + diag(R), at ``t`` [s]."""
        ...


@dataclass
class Gate:
    """Leaves out the axes that a ``detector`` refuses."""

    detector: Detector

    def adapt(self, nu: Array, S: Array, R: Array, t: float) -> Array:
        """See `Policy`."""
        return np.where(self.detector.step(nu, S, t).axis_mask, R, np.inf)


@njit
def inflated_distance(nu: Array, HPH: Array, R: Array, lam: float) -> tuple[float, float]:
    """(nu' y, y' R y), ``y = (H P H' + lambda R)^-1 nu``: the squared distance, and how fast it falls with lambda.

    The distance is NaN when that covariance is not positive definite.
    """
    m = len(nu)
    S = np.empty((m, m))
    for i in range(m):
        for j in range(m):
            S[i, j] = HPH[i, j]
        S[i, i] += lam * R[i]
    inverse, definite = invert(S)
    theta, slope = 0.0, 0.0
    for i in range(m):
        y = 0.0
        for j in range(m):
            y += inverse[i, j] * nu[j]
        theta += nu[i] * y
        slope += R[i] * y * y
    return theta if definite else math.nan, slope


@njit
def inflation(nu: Array, HPH: Array, R: Array, limit: float) -> tuple[float, int]:
    """(lambda, iterations) with ``theta(lambda) = nu' (H P H' + lambda R)^-1 nu = limit``; lambda = 1 when it is less.

    Newton's method on 1/theta from 1, with ``y = (H P H' + lambda R)^-1 nu`` and ``theta' = -y' R y``:

    lambda += (1/limit - 1/theta) theta^2 / (y' R y)

    1/theta is concave, so lambda comes from the left and theta stays over the limit until it is within `TOLERANCE` of
    it; one step does when H P H' is proportional to R. (Eq 12 takes theta itself, which takes more steps.) NaN when S
    is not positive definite, and when there is no R to inflate.
    """
    lam = 1.0
    for iteration in range(ITERATIONS):
        theta, slope = inflated_distance(nu, HPH, R, lam)
        if not math.isfinite(theta):
            return math.nan, iteration
        excess = theta - limit
        if excess <= (TOLERANCE * limit if lam > 1.0 else 0.0):
            return lam, iteration
        if slope == 0.0:
            return math.nan, iteration
        lam += excess * theta / (limit * slope)
    return lam, ITERATIONS


@dataclass
class MahalanobisInflation:
    """R -> lambda R, so that the squared distance nu' S^-1 nu of a suspect measurement is at its limit.

    The limit is the chi-square quantile that a sound measurement exceeds with probability ``false_alarm`` (1 % in Zhu
    et al.). What the measurement moves then falls with its error, but never to nothing: from a squared distance of
    ``reject_above`` on it is left out altogether. A measurement without a distance (not a number) is left out too.
    """

    false_alarm: float = 0.01
    reject_above: float = math.inf

    def adapt(self, nu: Array, S: Array, R: Array, t: float) -> Array:
        """See `Policy`."""
        limit = chi_square_threshold(self.false_alarm, len(nu))
        theta = whiten(nu, S)[1]
        if theta <= limit:
            return R
        if not theta <= self.reject_above:
            return np.full_like(R, np.inf)
        lam, _ = inflation(nu, S - np.diag(R), R, limit)
        return lam * R if math.isfinite(lam) else np.full_like(R, np.inf)


def normalised_weights(statistics: Array, thresholds: Array, lower: float = 0.2, upper: float = 0.9) -> Array:
    """Weights N of several sensors from their detectors' ``statistics`` (J,) or, axis by axis, (J, m); same shape.

    B_j = 1 - statistic_j / threshold_j says how far sensor j is from an alarm (Eq 22), and

    N_j = B_j / max B                                                           (Eq 24 has the sum instead)

    with N = 0 (left out) where B is at most ``lower`` or no number, and N = 1 where B is at least ``upper`` (Eq 23).
    R_j = R0_j / N_j: see `Weight`. The best sensor keeps its R, and a sensor that is alone is never weakened.
    """
    health = 1.0 - np.asarray(statistics, dtype=float) / thresholds
    if health.ndim == 1:
        return _weights(health, lower, upper)
    return np.column_stack([_weights(axis, lower, upper) for axis in health.T.copy()])


@njit
def _weights(health: Array, lower: float, upper: float) -> Array:
    """`normalised_weights` of one axis, from how far each sensor (J,) is from an alarm."""
    best = 0.0
    for one in health:
        if one > lower:
            best = max(best, one)
    weights = np.empty(len(health))
    for j, one in enumerate(health):
        weights[j] = 1.0 if one >= upper else one / best if one > lower else 0.0
    return weights


@dataclass
class Weight:
    """R -> R / N with the weight ``N`` of `normalised_weights`, one number or one for each axis; 0 leaves out.

    For a dense R0 this would be D^-1/2 R0 D^-1/2 with D = diag(N); D^-1 R0 (Eq 26) is symmetric for diagonal R0 only.
    Whoever fuses the sensors sets ``N`` before each update.
    """

    N: Array | float = 1.0

    def adapt(self, nu: Array, S: Array, R: Array, t: float) -> Array:
        """See `Policy`."""
        if isinstance(self.N, float):
            return R / self.N if self.N > 0.0 else np.full_like(R, np.inf)
        return np.where(self.N > 0.0, R / np.where(self.N > 0.0, self.N, 1.0), np.inf)


@dataclass
class SageHusa:
    """R learned from the residuals (Cheng et al. 2020, Eq 25-30): only R, axis by axis, between floors.

    R <- (1 - d_k) R + d_k (e e' + H P+ H'),  e = z - h(x+),  d_k = (1 - b) / (1 - b^(k+1))

    ``b`` (0.95 to 0.99) sets the memory, 1/(1 - b) samples. k counts from one, so that the nominal R is the first
    member of the mean (Eq 25 prints b^k with k = 0 at first: a division by zero). What is learned is the ratio to the
    nominal variance, so a sensor that tells its own sigma is followed; it stays within `R_FLOOR` and `R_CEILING`.

    Behind a gate of 1e-3 that judges by what has been learned, a sensor twice as noisy as it says is known to be so
    after some tens of samples, one four times as noisy after a hundred or so: the few that pass open the gate. In a
    federation a sensor that was isolated before teaches nothing, and stays so.
    """

    b: float = 0.98
    ratio: Array | None = field(default=None, init=False)  # (m,) learned variance / nominal variance
    _taken: Array = field(default_factory=lambda: np.zeros(1), init=False)  # (m,) that have taught
    _R: Array = field(default_factory=lambda: np.ones(1), init=False)  # nominal, of the last sample

    def __post_init__(self) -> None:
        if not 0.0 < self.b < 1.0:
            raise ValueError(f"a forgetting factor between 0 and 1 is needed, not {self.b}")

    def learned(self, R: Array) -> Array:
        """What the nominal variances ``R`` (m,) of a sample are learned to be; it always has all its axes."""
        if self.ratio is None:
            self.ratio, self._taken = np.ones_like(R), np.zeros_like(R)
        self._R = R
        return self.ratio * R

    def adapt(self, nu: Array, S: Array, R: Array, t: float) -> Array:
        """See `Policy`."""
        return self.learned(R)

    def learn(self, nu: Array, HPH: Array, used: Array) -> None:
        """Take the sample just adapted: innovation (m,), H P H' (m, m) before the update, the variances of that (m,).

        An axis whose variance is infinite or none at all teaches nothing, nor does one whose residual is no number. A
        residual whose variance was made k times larger by other policies counts as one k^-1/2 times as large, so that
        an outlier teaches no more than the limit that it was inflated to.
        """
        if self.ratio is None or not np.isfinite(used).any():
            return
        left, after = residual(nu, HPH, used)
        _teach(self.ratio, self._taken, left, after, self._R, used, self.b)


@njit
def _teach(ratio: Array, taken: Array, left: Array, after: Array, R: Array, used: Array, b: float) -> None:
    """Put a `residual` into what is learned, ``ratio`` (m,) and ``taken`` (m,), in place: see `SageHusa.learn`."""
    for i in range(len(ratio)):
        if math.isfinite(left[i]) and R[i] > 0.0:
            taken[i] += 1.0
            d = (1.0 - b) / (1.0 - b ** (taken[i] + 1.0))
            latest = left[i] ** 2 * (ratio[i] * R[i] / used[i]) + after[i, i]
            ratio[i] = min(max((1.0 - d) * ratio[i] + d * latest / R[i], R_FLOOR), R_CEILING)


@njit
def residual(nu: Array, HPH: Array, R: Array) -> tuple[Array, Array]:
    """(z - h(x+) (m,), H P+ H' (m, m)) that an update with variances ``R`` (m,) leaves, of a linear measurement.

    With S = H P H' + diag(R): R S^-1 nu and R - R S^-1 R. An axis of infinite variance is NaN in the first.
    """
    m, kept = len(R), np.flatnonzero(np.isfinite(R))
    left, after = np.full(m, math.nan), np.zeros((m, m))
    S = np.empty((len(kept), len(kept)))
    for a, i in enumerate(kept):
        for c, j in enumerate(kept):
            S[a, c] = HPH[i, j]
        S[a, a] += R[i]
    inverse, _ = invert(S)
    for a, i in enumerate(kept):
        left[i] = 0.0
        for c, j in enumerate(kept):
            left[i] += R[i] * inverse[a, c] * nu[j]
            after[i, j] = (R[i] if i == j else 0.0) - R[i] * inverse[a, c] * R[j]
    return left, after


class InOrder:
    """Policies one after the other, each with the S that belongs to the R of the one before; `SageHusa` is the first.

    An axis that one has left out is not shown to the next.
    """

    def __init__(self, policies: Sequence[Policy]) -> None:
        self.policies = tuple(policies)
        if any(isinstance(policy, SageHusa) for policy in self.policies[1:]):
            raise ValueError("what learns R comes first: everything after it judges by the R that is true")
        self._used: Array = np.empty(0)

    def adapt(self, nu: Array, S: Array, R: Array, t: float) -> Array:
        """See `Policy`; ``R`` is finite."""
        HPH = S - np.diag(R)
        for policy in self.policies:
            kept = np.isfinite(R)
            if not kept.any():
                break
            adapted = np.full_like(R, np.inf)
            adapted[kept] = policy.adapt(nu[kept], HPH[np.ix_(kept, kept)] + np.diag(R[kept]), R[kept], t)
            R = adapted
        self._used = R
        return R

    def learn(self, nu: Array, HPH: Array) -> None:
        """Show the sample just adapted to the first policy, where that learns: see `SageHusa.learn`."""
        first = self.policies[0] if self.policies else None
        if isinstance(first, SageHusa):
            first.learn(nu, HPH, self._used)


def split(policy: Policy | None) -> tuple[SageHusa | None, Policy | None]:
    """(what learns R, the rest) of a policy: the first must be asked before the gate of a filter, the rest after it."""
    if isinstance(policy, SageHusa):
        return policy, None
    if isinstance(policy, InOrder) and policy.policies and isinstance(policy.policies[0], SageHusa):
        return policy.policies[0], InOrder(policy.policies[1:])
    return None, policy


@dataclass
class Fading:
    """The factor on P that makes it as large as the last innovations say (Cheng et al. 2020, Eq 31-36).

    Divergence: nu' S^-1 nu > ``alpha`` m. Then lambda = max(1, tr(S^-1 C) / m), with C the mean of nu nu' over the
    last ``window`` samples. Both are free of units, where Eq 31 and 33 add m^2, (m/s)^2 and rad^2.
    """

    window: int = 10
    alpha: float = 1.5
    _taken: deque[Array] = field(default_factory=deque, init=False)

    def factor(self, nu: Array, S: Array) -> float:
        """Lambda (at least 1) to multiply P with, from a gated innovation ``nu`` (m,) and its covariance ``S``."""
        if not np.isfinite(nu).all():
            return 1.0
        if self._taken and len(self._taken[0]) != len(nu):
            self._taken.clear()
        self._taken.append(nu)
        if len(self._taken) > self.window:
            self._taken.popleft()
        last, mean = _distances(np.array(self._taken), S)
        return max(1.0, mean / len(nu)) if last > self.alpha * len(nu) else 1.0


@njit
def _distances(rows: Array, S: Array) -> tuple[float, float]:
    """Squared distance nu' S^-1 nu of the last of ``rows`` (N, m), and the mean of all; NaN if S is not positive."""
    inverse, definite = invert(S)
    if not definite:
        return math.nan, math.nan
    total = last = 0.0
    for nu in rows:
        last = 0.0
        for i in range(len(nu)):
            for j in range(len(nu)):
                last += nu[i] * inverse[i, j] * nu[j]
        total += last
    return last, total / len(rows)
