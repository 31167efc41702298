"""How what sensors measure reaches whoever listens: some of it is lost on the way, and stamps are late.

Who reads a sensor is now and then busy, and stamps what he reads when he comes to it: never before it was measured.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from statistics import NormalDist
from typing import Any

import numpy as np
import numpy.typing as npt

from nav.samples import Array, ImuSamples, Sample
from testbed.noise import Process, stream
from testbed.sensors.timing import AidingTiming, InterruptedTiming
from testbed.sensors.units import PERCENT

LATEST_SIGMAS = 3.0
LATEST_PERIODS = 0.9  # so that samples stay in order
ON_TIME_S = 1e-9  # what times lose as binary numbers


class _Luck:
    """Which of a sensor's samples are lost, each by itself, and how late the others are stamped [s]."""

    def __init__(self, name: str, dropout_percent: float, jitter_s: float, period_s: float, seed: int) -> None:
        share = dropout_percent * PERCENT
        self._lost_below = NormalDist().inv_cdf(share) if share else -math.inf
        self._chance = Process.white(stream(seed, name, "dropout"), [1.0 if share else 0.0])
        self._jitter = Process.white(stream(seed, name, "jitter"), [jitter_s])
        self._latest = latest(jitter_s, period_s)

    def lost(self, n: int) -> npt.NDArray[np.bool_]:
        """Of the next ``n`` samples."""
        lost: npt.NDArray[np.bool_] = self._chance.take(n)[:, 0] < self._lost_below
        return lost

    def late(self, n: int) -> Array:
        """Of the next ``n`` samples: half-normal, cut where the next sample is near."""
        late: Array = np.minimum(np.abs(self._jitter.take(n)[:, 0]), self._latest)
        return late


def latest(jitter_s: float, period_s: float) -> float:
    """The latest [s] that a sample is stamped whose stamps jitter."""
    return min(LATEST_SIGMAS * jitter_s, LATEST_PERIODS * period_s)


class Delivery:
    """What comes through of an aiding sensor's samples. ``of`` is given all of them, once and in order.

    A sensor with windows of denial sees to its losses itself (`testbed.sensors.timing.Interruptions`).
    """

    def __init__(self, name: str, timing: AidingTiming, seed: int) -> None:
        dropout = 0.0 if isinstance(timing, InterruptedTiming) else timing.dropout_percent
        self._perfect = not (dropout or timing.jitter_s)
        self._luck = _Luck(name, dropout, timing.jitter_s, 1 / timing.rate_hz, seed)

    def of(self, samples: Sequence[Any]) -> Sequence[Sample]:
        """The samples that arrive: times of validity and of arrival are as late as the stamp."""
        if self._perfect:
            return samples
        n = len(samples)
        chances = zip(samples, self._luck.lost(n).tolist(), self._luck.late(n).tolist(), strict=True)
        return [
            replace(one, t=one.t + late, t_arrival=one.t_arrival + late) if late else one
            for one, lost, late in chances
            if not lost
        ]


class InertialDelivery:
    """What comes through of a unit's increments, every ``period_s``. ``of`` is given all of them, once and in order.

    For a lost one the last rates are read again. As a log's, increments are mean rates times the steps of their stamps,
    which do not end where the rates were measured. The first step is the longest that there may be, so that no wait for
    the next comes as a surprise (as in `testbed.feeds.stamps.bridged`).
    """

    def __init__(self, name: str, dropout_percent: float, jitter_s: float, period_s: float, seed: int) -> None:
        self._perfect = not (dropout_percent or jitter_s)
        self._jitters = jitter_s > 0.0
        self._luck = _Luck(name, dropout_percent, jitter_s, period_s, seed)
        self._longest = period_s + latest(jitter_s, period_s)
        self._held = np.full((1, 6), np.nan)  # the last rates that came through
        self._stamp = math.nan  # of the last increment that was given
        self._waiting = (np.empty(0), np.empty((0, 6)))  # stamped later than what is known by now

    def of(self, measured: ImuSamples, now: float) -> ImuSamples:
        """The increments that are stamped by ``now`` [s]."""
        if self._perfect:
            return measured
        rates = self._kept(np.hstack([measured.dtheta, measured.dv]) / measured.dt[:, None])
        if not self._jitters:
            return ImuSamples(measured.t, measured.dt, *_halves(rates * measured.dt[:, None]))
        stamps = np.concatenate([self._waiting[0], measured.t + self._luck.late(len(measured))])
        rates = np.vstack([self._waiting[1], rates])
        due = int(np.searchsorted(stamps, now + ON_TIME_S, side="right"))
        self._waiting = (stamps[due:], rates[due:])
        t, rates = stamps[:due], rates[:due]
        if due and math.isnan(self._stamp):
            self._stamp = float(t[0]) - self._longest
        dt = np.diff(t, prepend=self._stamp)
        if due:
            self._stamp = float(t[-1])
        return ImuSamples(t, dt, *_halves(rates * dt[:, None]))

    def _kept(self, rates: Array) -> Array:
        """The same with those of lost samples replaced by the ones before."""
        n = len(rates)
        if not n:
            return rates
        lost = self._luck.lost(n)
        if np.isnan(self._held).all():
            self._held = rates[:1]  # the first comes through
            lost[0] = False
        newest = np.maximum.accumulate(np.where(lost, 0, np.arange(1, n + 1)))
        kept: Array = np.vstack([self._held, rates])[newest]
        self._held = kept[-1:]
        return kept


def _halves(increments: Array) -> tuple[Array, Array]:
    return np.ascontiguousarray(increments[:, :3]), np.ascontiguousarray(increments[:, 3:])
