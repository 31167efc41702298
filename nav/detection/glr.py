"""The generalised likelihood ratio: a bias that began at any sample of a window, and when it ended."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from scipy.special import chdtrc, exp1

from nav._jit import njit
from nav.detection.base import Alarm, Decision, Mask, chi_square_threshold, small_axes, sound_axes, whiten
from nav.detection.means import Window
from nav.samples import Array

OVERSHOOT = 0.583  # mean overshoot of a unit normal walk over a distant limit, -zeta(1/2)/sqrt(2 pi)
FAULT_MEAN_GAIN = 0.05  # how fast `Glr` follows a fault that grows


def glr_false_alarm(threshold: float, m: int, n: int) -> float:
    """The probability that the largest of |r_1 + .. + r_j|^2 / (2 j), j = 1..n, of sound residuals exceeds a limit.

    With b^2 = 2 threshold and the density f of chi of m degrees of freedom,
    ``P = P(chi > b) + b f(b) int nu(x)/x dx`` from b/sqrt(n) to b, nu(x) = exp(-0.583 x): the rate at which the
    Ornstein-Uhlenbeck process S_j/sqrt(j) of log j leaves the ball of radius b, corrected for looking at whole j only
    (after Siegmund 1985; m axes by the density of the radius). Good to a tenth at 1e-3 and below.
    """
    b = math.sqrt(2.0 * threshold)
    density = math.exp((m - 1) * math.log(b) - threshold - (0.5 * m - 1) * math.log(2.0) - math.lgamma(0.5 * m))
    crossings = b * density * (exp1(OVERSHOOT * b / math.sqrt(n)) - exp1(OVERSHOOT * b))
    return float(chdtrc(m, b * b) + crossings)


@cache
def glr_threshold(false_alarm: float, m: int, n: int) -> float:
    """The limit that `glr_false_alarm` meets with ``n`` samples of ``m`` axes [nats]."""
    low = 0.5 * chi_square_threshold(false_alarm, m)
    if n == 1:
        return low
    from scipy.optimize import brentq  # takes half as long to load as the rest of this package, and few need it

    high = 0.5 * chi_square_threshold(0.1 * false_alarm / n, m)  # beyond the limit of n independent samples
    return float(brentq(lambda T: math.log(glr_false_alarm(T, m, n) / false_alarm), low, high))


@njit
def _largest_evidence(rows: Array) -> tuple[float, int]:
    """(max over j of |sum of the last j rows|^2 / (2 j), that j) of the joint residuals ``rows[:, 0]`` (n, m)."""
    n, _, m = rows.shape
    total = np.zeros(m)
    largest, length = 0.0, 1
    for j in range(1, n + 1):
        square = 0.0
        for i in range(m):
            total[i] += rows[n - j, 0, i]
            square += total[i] * total[i]
        if square > 2 * j * largest:
            largest, length = square / (2 * j), j
    return largest, length


@dataclass
class Glr:
    """Generalised likelihood ratio for a bias that began at any sample within ``window_s``; reverse CUSUM for its end.

    Onset: ``max_j j |mean of the last j|^2 / 2`` over `glr_threshold` of the samples in the window, so ``false_alarm``
    holds per sample at any rate and from the first on. While the alarm lasts, the fault's mean follows the residuals
    and ``G <- max(0, G + |mean|^2 / 2 - mean' r)`` gathers evidence that the mean is zero; over ``end_evidence`` [nats]
    the fault is over and everything starts again from that sample.
    (Basseville and Nikiforov, Detection of Abrupt Changes, 1993, chapter 2.)

    ``axis_mask`` takes out the axes whose own mean is beyond the chi-square limit; when none is any more, those that
    were last.
    """

    false_alarm: float
    window_s: float = 40.0
    end_evidence: float = 7.0
    _window: Window = field(init=False)
    _fault: Array | None = field(default=None, init=False)  # mean of the residuals (2, m) while the alarm lasts
    _variance: float = field(default=1.0, init=False)  # of each of its components when its axis is sound
    _end: float = field(default=0.0, init=False)
    _sound: Mask = field(init=False)
    _alarm: Alarm = field(default_factory=Alarm, init=False)

    def __post_init__(self) -> None:
        self._window = Window(self.window_s)

    def step(self, nu: Array, S: Array, t: float) -> Decision:
        """Judge one sample; see `Detector`."""
        m = len(nu)
        r, gamma2 = whiten(nu, S)
        if not math.isfinite(gamma2):
            return self._alarm.decide(gamma2, glr_threshold(self.false_alarm, m, 1), m, np.full(m, False))
        rows = self._window.push(r, t)
        statistic, length = _largest_evidence(rows)
        threshold = glr_threshold(self.false_alarm, m, len(rows))
        if self._fault is not None:
            self._follow(self._fault, r)
            if self._end > self.end_evidence:
                self._fault = None
                self._window.clear()
                self._window.push(r, t)
                statistic, threshold = 0.5 * gamma2, glr_threshold(self.false_alarm, m, 1)
        elif statistic > threshold:
            self._fault, self._variance = rows[-length:].mean(axis=0), 1.0 / length
            self._end = 0.0
            self._sound = sound_axes(self._fault[1], self._variance, self.false_alarm)
        return self._alarm.decide(statistic, threshold, m, None if self._fault is None else self._sound)

    def _follow(self, fault: Array, r: Array) -> None:
        """Evidence for the end of the ``fault``; without any, its mean follows ``r`` and names the axes anew."""
        mu = fault[0]
        self._end = max(0.0, self._end + float(mu.dot(0.5 * mu - r[0])))
        if self._end == 0.0:
            fault += FAULT_MEAN_GAIN * (r - fault)
            self._variance = (1.0 - FAULT_MEAN_GAIN) ** 2 * self._variance + FAULT_MEAN_GAIN**2
            small = small_axes(fault[1], self._variance, self.false_alarm)
            if not small.all():
                self._sound = small
