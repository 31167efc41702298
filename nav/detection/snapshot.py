"""Judged by one sample alone: chi-square, the same with the faulty axes left out (ERAIM), and the gate of a filter."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from scipy.special import chdtri

from nav.detection.base import Alarm, Decision, Event, Mask, chi_square_threshold, every_axis, whiten
from nav.samples import Array


@dataclass
class ChiSquare:
    """One sample: nu' S^-1 nu, the squared Mahalanobis distance, against chi-square of m degrees of freedom.

    ``false_alarm`` is the probability per sample.
    """

    false_alarm: float
    _alarm: Alarm = field(default_factory=Alarm, init=False)

    @property
    def alarmed(self) -> bool:
        """Whether the last sample was an alarm."""
        return self._alarm.on

    def passes(self, gamma2: float, m: int) -> bool:
        """Whether the squared distance ``gamma2`` of ``m`` axes is small enough; a NaN is not."""
        return gamma2 <= chi_square_threshold(self.false_alarm, m)

    def step(self, nu: Array, S: Array, t: float) -> Decision:
        """Judge one sample; see `Detector`."""
        m = len(nu)
        gamma2 = whiten(nu, S)[1]
        sound = None if self.passes(gamma2, m) else np.full(m, False)
        return self._alarm.decide(gamma2, chi_square_threshold(self.false_alarm, m), m, sound)


class Never:
    """No alarm, whatever comes: for a sensor whose measurement policy alone shall answer (`nav.weighting`)."""

    def step(self, nu: Array, S: Array, t: float) -> Decision:
        """Judge one sample; see `Detector`."""
        return Decision(False, whiten(nu, S)[1], math.inf, every_axis(len(nu)), Event.NONE)


@dataclass
class Eraim:
    """`ChiSquare`, and on alarm the axis of the largest w-test goes, again and again, until the rest passes.

    Extrapolated receiver autonomous integrity monitoring: least squares over the measurement and the prediction. Its
    global statistic is nu' S^-1 nu and leaving an axis out is leaving its row and column out of nu and S (Cui et al.
    name the method without equations). ``axis_mask`` keeps the sound axes; ``statistic`` is that of all axes.
    """

    false_alarm: float
    _alarm: Alarm = field(default_factory=Alarm, init=False)

    def step(self, nu: Array, S: Array, t: float) -> Decision:
        """Judge one sample; see `Detector`."""
        m = len(nu)
        gamma2 = whiten(nu, S)[1]
        threshold = chi_square_threshold(self.false_alarm, m)
        return self._alarm.decide(gamma2, threshold, m, None if gamma2 <= threshold else self._exclude(nu, S))

    def _exclude(self, nu: Array, S: Array) -> Mask:
        """The axes left when the rest passes the global test."""
        used = np.isfinite(nu)
        while used.any():
            part = S[np.ix_(used, used)]
            gamma2 = whiten(nu[used], part)[1]
            if math.isnan(gamma2):
                return np.zeros_like(used)
            if gamma2 <= chi_square_threshold(self.false_alarm, len(part)):
                break
            used[np.flatnonzero(used)[w_tests(nu[used], part).argmax()]] = False
        return used


def w_tests(nu: Array, S: Array) -> Array:
    """|w_i| = |(S^-1 nu)_i| / sqrt((S^-1)_ii): Baarda's test of axis i, the others taken for sound. Unit normal. (m,).

    The same as the w-test of the least squares that stacks the measurement and the filter's prediction (ERAIM).
    """
    S_inverse = np.linalg.inv(S)
    w: Array = np.abs(S_inverse @ nu) / np.sqrt(np.diag(S_inverse))
    return w


@dataclass(frozen=True)
class ChiSquareGate:
    """Accept an innovation when nu' S^-1 nu stays below the chi-square quantile of its dimension.

    ``false_rejection`` is the probability that a sound measurement of a consistent filter is turned away; 0: no gate.
    """

    false_rejection: float
    thresholds: tuple[float, ...] = field(init=False)

    def __post_init__(self) -> None:
        if not 0 <= self.false_rejection < 1:
            raise ValueError(f"a probability between 0 and 1 is needed, not {self.false_rejection}")
        object.__setattr__(self, "thresholds", tuple(float(chdtri(m, self.false_rejection)) for m in range(1, 7)))

    def threshold(self, dimension: int) -> float:
        """The largest accepted statistic for an innovation of ``dimension`` (1 to 6)."""
        return self.thresholds[dimension - 1]
