"""The sequential probability ratio test: evidence for a constant bias, gathered over samples."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum
from typing import Protocol

import numpy as np

from nav.detection.base import Alarm, Decision, chi_square_threshold, sound_axes, whiten
from nav.detection.means import Mean
from nav.detection.snapshot import ChiSquare
from nav.samples import Array


class Reset(Enum):
    """What `Sprt` does when its evidence is over the limit but falling and the sample alone is sound."""

    NONE = "none"
    FAST = "fast"  # evidence to zero, the mean is kept (Wang 2016): lasting with `Recursive` evidence only
    COMPLETE = "complete"  # evidence and mean start again from this sample (Zhou et al. 2025)


class Evidence(Protocol):
    """What a mean of residuals says for a bias [nats], and how much of that is an alarm."""

    def threshold(self, false_alarm: float, m: int) -> float:
        """The limit for ``m`` axes, ``false_alarm`` being the probability per sample."""
        ...

    def add(self, evidence: float, mean: Mean, r: Array, t: float) -> float:
        """The evidence with the residuals ``r`` (2, m) of one more sample at ``t`` [s], which are added to ``mean``."""
        ...

    def alone(self, gamma2: float) -> float:
        """What it is after a complete reset to one sample of squared distance ``gamma2``."""
        ...


@dataclass(frozen=True)
class Quadratic:
    """``|mean|^2 / (2 variance)``, a likelihood ratio with the mean estimated; it is not Wald's test.

    Twice of it is chi-square of m degrees of freedom at each sample, so the limit is half the quantile.
    """

    def threshold(self, false_alarm: float, m: int) -> float:
        """See `Evidence`."""
        return 0.5 * chi_square_threshold(false_alarm, m)

    def add(self, evidence: float, mean: Mean, r: Array, t: float) -> float:
        """See `Evidence`."""
        mean.add(r, t)
        mu = mean.value[0]
        return 0.5 * float(mu.dot(mu)) * (1.0 / mean.variance)

    def alone(self, gamma2: float) -> float:
        """See `Evidence`."""
        return 0.5 * gamma2


@dataclass(frozen=True)
class Recursive:
    """``E <- decay E + mean' r - |mean|^2 / 2`` with the mean *before* r; it can fall below zero.

    exp(E) has an expectation of at most one, so ``-ln(false_alarm)`` bounds the alarms per sample.
    """

    def threshold(self, false_alarm: float, m: int) -> float:
        """See `Evidence`."""
        return -math.log(false_alarm)

    def add(self, evidence: float, mean: Mean, r: Array, t: float) -> float:
        """See `Evidence`."""
        mu = mean.value[0] if mean.n else np.zeros_like(r[0])
        mean.add(r, t)
        return mean.decay * evidence + float(mu.dot(r[0] - 0.5 * mu))

    def alone(self, gamma2: float) -> float:
        """See `Evidence`."""
        return 0.0


class SampleTest(Protocol):
    """Whether one sample alone is sound; `ChiSquare` is one."""

    def passes(self, gamma2: float, m: int) -> bool:
        """Whether the squared distance ``gamma2`` of ``m`` axes is small enough; a NaN is not."""
        ...


@dataclass
class Sprt:
    """Evidence for a constant bias, gathered over samples (Zhou et al. 2025, Eq 12-21).

    ``mean`` is what it remembers, ``evidence`` what it makes of that, and ``false_alarm`` the probability per sample.
    ``end_test`` is what the sample alone must pass for a reset. ``axis_mask`` takes out the axes whose own mean is
    beyond its limit, or all if none is.
    """

    false_alarm: float
    mean: Mean
    reset: Reset = Reset.NONE
    evidence: Evidence = Quadratic()
    end_test: SampleTest = field(default_factory=lambda: ChiSquare(1e-3))
    _gathered: float = field(default=0.0, init=False)
    _alarm: Alarm = field(default_factory=Alarm, init=False)

    def step(self, nu: Array, S: Array, t: float) -> Decision:
        """Judge one sample; see `Detector`."""
        m = len(nu)
        r, gamma2 = whiten(nu, S)
        threshold = self.evidence.threshold(self.false_alarm, m)
        if not math.isfinite(gamma2):
            return self._alarm.decide(gamma2, threshold, m, np.full(m, False))
        before = self._gathered
        self._gathered = self.evidence.add(before, self.mean, r, t)
        over = self._gathered > threshold
        if over and self._gathered < before and self.reset is not Reset.NONE and self.end_test.passes(gamma2, m):
            over = False
            if self.reset is Reset.COMPLETE:
                self.mean.restart(r, t)
                self._gathered = self.evidence.alone(gamma2)
            else:
                self._gathered = 0.0
        sound = sound_axes(self.mean.value[1], self.mean.variance, self.false_alarm) if over else None
        return self._alarm.decide(self._gathered, threshold, m, sound)
