"""Monitors: what is known of the soundness of a sensor, and which of its axes are isolated for it."""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass
from enum import Enum, auto
from typing import NamedTuple

import numpy as np

from nav.aids.base import Aid
from nav.detection import ChiSquare, Decision, Detector, LongRunVariance, Mask, chi_square_threshold, whiten
from nav.samples import Array
from nav.weighting import Policy, split

PATIENT, ALONE_FALSE_ALARM = 10, 1e-3  # see `Monitor`
SUDDEN = 4.0  # times a gate
LATELY_S = 5.0  # in which a suspicion is forgotten
ROUNDING = 1e-6  # of times [s]
SAME = 1e-6  # between two statistics, relative


@dataclass(frozen=True)
class MonitoredAid:
    """A sensor of a local filter; detector and policy are made anew for each part of its samples.

    ``coloured`` says that its detector gathers evidence over samples, which may be coloured (`LongRunVariance`).
    """

    aid: Aid
    detector: Callable[[], Detector] = lambda: ChiSquare(1e-3)
    policy: Callable[[], Policy] | None = None
    coloured: bool = False


@dataclass(frozen=True)
class Patience:
    """How long a sensor must have been condemned to be isolated, and sound to be readmitted."""

    isolate_after: int = 3  # consecutive condemned samples
    isolate_s: float = 0.0  # and from the first of them to the last
    readmit_after: int = 10  # consecutive sound samples


class Change(Enum):
    """What a measurement changed in the isolation of its sensor; NONE is false."""

    NONE = auto()
    ISOLATED = auto()
    READMITTED = auto()

    def __bool__(self) -> bool:
        return self is not Change.NONE


class Isolation(NamedTuple):
    """An event: part of a sensor's samples was isolated or readmitted, by axis."""

    t: float
    local: str
    sensor: str
    part: str
    isolated: tuple[bool, ...]  # per axis, after the event


def shown_limit(threshold: float, statistic: float, nis: float) -> float:
    """The gate that a report shows beside ``nis``: NaN where the detector judged by another ``statistic``."""
    return threshold if math.isclose(statistic, nis, rel_tol=SAME) else math.nan


def shown_limits(threshold: Array, statistic: Array, nis: Array) -> Array:
    """`shown_limit` of finite numbers, each (N,)."""
    same = np.abs(statistic - nis) <= SAME * np.maximum(np.abs(statistic), np.abs(nis))
    return np.where(same, threshold, math.nan)


class Monitor:
    """What is known of one part of a sensor's samples: which axes are isolated, how long each has been bad or good.

    Of its policy ``noise`` is what learns R, before the detector judges, and ``policy`` the rest (`split`).

    A refused measurement goes axis by axis (`Decision.axis_mask`). An axis that the detector refused as often in a row,
    and for as long, as `Patience` says is isolated. It is readmitted when it has been sound ``readmit_after`` times in
    a row, or when all isolated axes would each be sound alone `PATIENT` times as often: while a sensor is isolated
    nothing estimates its slow errors, its innovations are correlated, and a detector that gathers them might never let
    it go. The detector begins anew then; what was learned of the colour of its innovations is kept.

    ``suspect`` says that some axis is isolated, ``out`` that every one is. ``sudden`` says that what was refused last
    began far outside the gate: no more of a fault was used before than a gate lets pass. ``suspicion`` is the statistic
    of the latest measurement over its threshold, infinite when there is none; ``judged`` the time of that measurement
    [s]; ``suspected`` the largest suspicion of late, those before with a factor of exp(-age / `LATELY_S`).
    """

    def __init__(
        self, detector: Detector, policy: Policy | None, size: int, patience: Patience, coloured: bool = False
    ) -> None:
        self.detector = detector
        self.noise, self.policy = split(policy)
        self._patience, self._variance = patience, LongRunVariance() if coloured else None
        self.isolated: Mask = np.full(size, False)
        self.suspect = self.out = self.sudden = False
        self.suspicion, self.suspected, self.judged = 0.0, 0.0, -math.inf
        self._bad, self._good, self._alone = np.zeros(size), np.zeros(size), np.zeros(size)
        self._bad_since = np.full(size, math.inf)  # time of the first of those in a row
        self._clean = True
        self._new_detector = deepcopy(detector)

    def limit(self, m: int) -> float | None:
        """Up to which statistic a measurement of ``m`` axes is sound, and changes nothing but `passed`; None if more
        than that decides.
        """
        detector, simple = self.detector, self._variance is None and self.noise is None and self.policy is None
        if not (simple and self._clean and isinstance(detector, ChiSquare) and not detector.alarmed):
            return None
        return chi_square_threshold(detector.false_alarm, m)

    def passed(self, statistic: float, threshold: float, t: float) -> None:
        """A measurement was judged: how suspicious it made the sensor."""
        ratio = statistic / threshold
        self.suspicion = max(ratio, 0.0) if ratio == ratio else math.inf
        faded = self.suspected * math.exp((self.judged - t) / LATELY_S) if 0 < self.suspected < math.inf else 0.0
        self.suspected, self.judged = max(self.suspicion, faded), t

    def judge(self, nu: Array, S: Array, t: float) -> tuple[Decision, Change]:
        """The detector's decision on a measurement, and what it changes; an axis isolated outweighs one readmitted."""
        if self._variance is not None:
            S = self._variance.widened(nu, S, t, sound=self._clean)
        decision = self.detector.step(nu, S, t)
        self.passed(decision.statistic, decision.threshold, t)
        if not decision.alarm and self._clean:
            return decision, Change.NONE
        sound, before = decision.axis_mask, self.isolated
        if decision.alarm and not self._bad.any():
            self.sudden = whiten(nu, S)[1] > SUDDEN * chi_square_threshold(ALONE_FALSE_ALARM, len(nu))
        self._bad = np.where(sound, 0.0, self._bad + 1.0)
        self._bad_since = np.where(sound, math.inf, np.minimum(self._bad_since, t))
        self._good = np.where(sound, self._good + 1.0, 0.0)
        alone = nu * nu <= chi_square_threshold(ALONE_FALSE_ALARM, 1) * S.diagonal()
        self._alone = np.where(before & alone, self._alone + 1.0, 0.0)
        patience = self._patience
        patient = self.suspect and bool((self._alone[before] >= PATIENT * patience.readmit_after).all())
        kept = before & (self._good < patience.readmit_after) & (not patient)
        lasting = (self._bad >= patience.isolate_after) & (t - self._bad_since >= patience.isolate_s - ROUNDING)
        self.isolated = kept | (~before & lasting)
        if patient:
            self.detector, self._alone = deepcopy(self._new_detector), np.zeros(len(nu))
        self.suspect, self.out = bool(self.isolated.any()), bool(self.isolated.all())
        self._clean = not self.suspect and not self._bad.any()
        if (self.isolated & ~before).any():
            return decision, Change.ISOLATED
        return decision, Change.READMITTED if (before & ~self.isolated).any() else Change.NONE

    def doubt(self) -> None:
        """Sound measurements before this one speak for no readmission."""
        self._good[:] = self._alone[:] = 0.0

    def isolate(self) -> None:
        """Isolate every axis, whatever the detector found."""
        self.isolated, self._good = np.full(len(self.isolated), True), np.zeros(len(self.isolated))
        self.suspect = self.out = True
        self._clean = False
