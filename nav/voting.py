"""Redundant inertial units as one: the mean of those that agree, by the parity of their rates and forces.

Units of one kind, turned to common axes and close together, sense the same motion, so their differences hold errors
only. Over each window of ``window_s`` the mean rates and specific forces y_i (6,) of the k units in use are compared:

    w_i = sum over axes of (y_i - mean y)^2 / (sigma^2 (1 - 1/k)),
    sigma^2 = bias_sigma^2 + noise^2 / window_s + (scale |mean y|)^2,

chi-square of six degrees of freedom for a sound unit (the parity vector's component that unit i alone explains). While
the largest is over the limit and three units or more are in use, that unit goes and the others are compared again. Of
two that disagree none can be told to be the faulty one: the ballot says so and both stay in use. A unit that was taken
out is compared with the mean of the others, sigma^2 (1 + 1/k), and comes back when it passed ``readmit_after`` windows
in succession. A ballot counts from the next increment on; an increment that is no number is left out at once.

Taking a unit out moves the mean by its share of the differences between biases, which the bias states must follow.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from nav.detection import Mask, chi_square_threshold
from nav.error_model import ImuModel
from nav.samples import FORCE_LIMIT, RATE_LIMIT, Array, ImuSamples

MOST = np.repeat([RATE_LIMIT, FORCE_LIMIT], 3)  # what a unit could possibly report


class Ballot(NamedTuple):
    """What came of one window that ended at ``t`` [s]."""

    t: float
    statistic: Array  # (units,) w_i of each, against the units in use
    threshold: float
    failed: tuple[bool, ...]  # which units are not in use from here on
    ambiguous: bool  # the units left disagree, and none can be told to be the faulty one


@dataclass
class Voter:
    """Votes over blocks of increments; ``false_alarm`` is the probability per unit and window.

    ``gyro_scale`` and ``accel_scale`` are what a unit's error grows by with rate and force: scale factor and
    misalignment, 1 sigma.
    """

    imu: ImuModel
    gyro_scale: float = 0.0
    accel_scale: float = 0.0
    false_alarm: float = 1e-6
    window_s: float = 0.2
    readmit_after: int = 25
    _failed: Mask | None = field(default=None, init=False)
    _passes: Array = field(init=False)
    _sums: Array = field(init=False)  # (units, 6) of the window that is running
    _elapsed: float = field(default=0.0, init=False)

    def vote(self, blocks: Sequence[ImuSamples]) -> tuple[ImuSamples, list[Ballot]]:
        """The increments to use, and the ballots on the way; ``blocks`` are those of each unit over the same times."""
        first = blocks[0]
        if any(len(b) != len(first) or not np.array_equal(b.t, first.t) for b in blocks[1:]):
            raise ValueError("the units' increments must end at the same times")
        if self._failed is None:
            self._failed = np.full(len(blocks), False)
            self._passes, self._sums = np.zeros(len(blocks)), np.zeros((len(blocks), 6))
        rows = np.stack([np.hstack([b.dtheta, b.dv]) for b in blocks])  # (units, N, 6)
        rows = np.where(
            np.abs(rows) <= MOST * first.dt[:, None], rows, np.nan
        )  # of another size it is no number either
        used = np.empty(rows.shape[1:])
        ballots = []
        start = 0
        for stop in self._windows(first.dt):
            _average(rows[:, start:stop], self._failed, used[start:stop])
            for k in range(start, stop):  # one by one, as sums depend on their order
                self._sums += rows[:, k]
            start = stop
            if self._elapsed >= self.window_s - 1e-9:
                ballots.append(self._count(float(first.t[stop - 1])))
        return ImuSamples(first.t, first.dt, used[:, :3], used[:, 3:]), ballots

    def _windows(self, dt: Array) -> Iterator[int]:
        """The rows after which a window ends, and the last; a generator, as `_elapsed` goes on with it."""
        for k, T in enumerate(dt.tolist()):
            self._elapsed += T
            if self._elapsed >= self.window_s - 1e-9 or k == len(dt) - 1:
                yield k + 1

    def _count(self, t: float) -> Ballot:
        """Compare the units over the window that ends at ``t``, and begin the next."""
        assert self._failed is not None
        T = self._elapsed
        imu, y = self.imu, self._sums / T
        gyro, accel = imu.gyro_bias_sigma**2 + imu.gyro_noise**2 / T, imu.accel_bias_sigma**2 + imu.accel_noise**2 / T
        threshold = chi_square_threshold(self.false_alarm, 6)
        finite = np.array([bool(np.isfinite(row).all()) for row in y])
        failed: Mask = self._failed | ~finite
        if failed.all():  # whatever still gives numbers is better than nothing
            failed = ~finite
        if failed.all():
            failed = self._failed.copy()
        mean = y[~failed].mean(axis=0)
        gyro += self.gyro_scale**2 * float(mean[:3] @ mean[:3])
        accel += self.accel_scale**2 * float(mean[3:] @ mean[3:])
        variance = np.repeat([gyro, accel], 3)
        while True:
            statistic = _compare(y, failed, variance)
            bad = ~failed & ~(statistic <= threshold)
            if not bad.any() or np.sum(~failed) < 3:
                break
            failed[np.where(bad, statistic, -1.0).argmax()] = True
        self._passes = np.where(failed & (statistic <= threshold), self._passes + 1.0, 0.0)
        failed &= self._passes < self.readmit_after
        self._failed, self._elapsed = failed, 0.0
        self._sums = np.zeros_like(self._sums)
        return Ballot(t, statistic, threshold, tuple(map(bool, failed)), bool(bad.any()))


def _compare(y: Array, failed: Mask, variance: Array) -> Array:
    """w_i (units,) of the mean rates ``y`` (units, 6) against the mean of the units in use."""
    k = int(np.sum(~failed))
    apart = y - y[~failed].mean(axis=0)
    share = np.where(failed, 1.0 + 1.0 / k, max(1.0 - 1.0 / k, 1e-12))
    w: Array = np.sum(apart * apart / variance, axis=1) / share
    return w


def _average(rows: Array, failed: Mask, out: Array) -> None:
    """Mean over the units in use of ``rows`` (units, N, 6), without increments that are no number, into ``out``."""
    use = ~failed[:, None] & np.isfinite(rows).all(axis=2)
    count = use.sum(axis=0)
    total = np.zeros_like(out)
    for unit in range(len(rows)):
        total += np.where(use[unit, :, None], rows[unit], 0.0)
    out[:] = total / np.where(count, count, np.nan)[:, None]
