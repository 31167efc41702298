"""What detectors have in common: the protocol, the decision, whitened residuals, thresholds, axes that are left."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from functools import cache
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from nav._jit import lean, njit
from nav.samples import Array

Mask = NDArray[np.bool_]


class Event(Enum):
    """What changed with this sample."""

    NONE = ""
    ONSET = "onset"
    END = "end"


class Decision(NamedTuple):
    """What a detector says of one sample."""

    alarm: bool  # the sensor is taken for faulty
    statistic: float  # NaN or infinite when the sample can't be judged: no number, or S not positive definite
    threshold: float
    axis_mask: Mask  # (m,) True where the axis may be used, all True without an alarm
    event: Event


class Detector(Protocol):
    """Anything that judges one sensor sample by sample."""

    def step(self, nu: Array, S: Array, t: float) -> Decision:
        """Judge the innovation ``nu`` (m,) with covariance ``S`` (m, m) at ``t`` [s]."""
        ...


@cache
def chi_square_threshold(false_alarm: float, m: int) -> float:
    """The value that a chi-square variable of ``m`` degrees of freedom exceeds with probability ``false_alarm``.

    Raises ValueError when ``false_alarm`` is no probability between 0 and 1.
    """
    if not 0 < false_alarm < 1:
        raise ValueError(f"a probability between 0 and 1 is needed, not {false_alarm}")
    return float(chdtri(m, false_alarm))


@njit
def whiten(nu: Array, S: Array) -> tuple[Array, float]:
    """(r, nu' S^-1 nu) of ``nu`` (m,) with covariance ``S`` (m, m): r (2, m) has the joint and the axis residuals.

    ``r[0] = L^-1 nu`` with ``S = L L'``; ``r[1] = nu_i / sqrt(S_ii)``, untouched by faults of other axes. When S is not
    positive definite or nu is no number, the second is NaN.
    """
    m = len(nu)
    L, r = np.empty((m, m)), np.empty((2, m))
    return r, whiten_in(L, r, nu, S)


@lean
def whiten_in(L: Array, r: Array, nu: Array, S: Array) -> float:
    """`whiten` with ``L`` (m, m) and into ``r`` (2, m); nu' S^-1 nu."""
    gamma2 = 0.0
    m = len(nu)
    for i in range(m):
        total = nu[i]
        for j in range(i):
            a = S[i, j]
            for k in range(j):
                a -= L[i, k] * L[j, k]
            L[i, j] = a / L[j, j]
            total -= L[i, j] * r[0, j]
        pivot = S[i, i]
        for k in range(i):
            pivot -= L[i, k] * L[i, k]
        if not (pivot > 0.0 and math.isfinite(nu[i])):
            return math.nan
        L[i, i] = math.sqrt(pivot)
        r[0, i] = total / L[i, i]
        r[1, i] = nu[i] / math.sqrt(S[i, i])
        gamma2 += r[0, i] * r[0, i]
    return gamma2


@cache
def every_axis(m: int) -> Mask:
    """All of ``m`` axes: the mask of a sound sample. It can't be written to."""
    mask = np.full(m, True)
    mask.flags.writeable = False  # shared by all healthy samples
    return mask


@dataclass
class Alarm:
    """Whether the last sample was an alarm."""

    on: bool = False

    def decide(self, statistic: float, threshold: float, m: int, sound: Mask | None) -> Decision:
        """The decision on ``m`` axes; ``sound`` is None without an alarm."""
        before, self.on = self.on, sound is not None
        event = Event.NONE if self.on == before else Event.ONSET if self.on else Event.END
        return Decision(self.on, statistic, threshold, every_axis(m) if sound is None else sound, event)


def small_axes(mean: Array, variance: float, false_alarm: float) -> Mask:
    """The axes whose own ``mean`` (m,) is no larger than chance allows."""
    small: Mask = mean * mean <= variance * chi_square_threshold(false_alarm, 1)
    return small


def sound_axes(mean: Array, variance: float, false_alarm: float) -> Mask:
    """The axes left on an alarm: those with a small ``mean`` (m,), or none when the fault can't be laid on any."""
    small = small_axes(mean, variance, false_alarm)
    return np.zeros_like(small) if small.all() else small
