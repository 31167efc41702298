"""Time order: inertial increments and aiding samples reach an estimator as they happened, not as they arrived.

A GNSS fix describes the past by the time it arrives, and a sample may fall between two inertial ones. The estimator
therefore runs ``lag_s`` behind the newest increment, so that nothing comes too late: each sample is applied at its own
time, for which an increment is split in two, and the present is predicted from there whenever it is asked for.
"""

from __future__ import annotations

import heapq
import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np

from nav.samples import Estimate, ImuSamples, Sample, UpdateReport
from nav.strapdown import compensate

COINCIDENT = 1e-6  # two times this close are the same [s]


class Estimator(Protocol):
    """Whatever turns sensors into an estimate: `nav.ins.Ins` and its kin."""

    def propagate(self, imu: ImuSamples) -> Sequence[UpdateReport] | None:
        """Advance by a block of increments; how the increments are cut into blocks makes no difference.

        Reports are on what the estimator made of the increments themselves, such as levelling, if it does that.
        """
        ...

    @property
    def listening(self) -> bool:
        """Whether a sample of some kind would still be used."""
        ...

    def accepts(self, sample: Sample) -> bool:
        """Whether `update` would use the sample now, for aiding or for alignment."""
        ...

    def update(self, sample: Sample) -> list[UpdateReport]:
        """Use a sample that is valid at the estimator's own time."""
        ...

    def refuse(self, sample: Sample, reason: str) -> list[UpdateReport]:
        """The reports on a sample that can't be used: one for each aid that it would have served."""
        ...

    def estimate(self) -> Estimate:
        """The state at the estimator's own time."""
        ...

    def predict(self, imu: ImuSamples) -> Estimate:
        """The state after further increments, the estimator itself staying where it is."""
        ...


class FusionHorizon:
    """Feeds one estimator in time order, ``lag_s`` [s] (the largest latency of its aids) behind the newest increment.

    Increments are split at samples only, whatever the blocks in which they are pushed, so the same data give the same
    result. An increment is known at the end of its interval; until then the state is carried on at the rates of the one
    before. With ``coning`` raw increments are compensated
    (`nav.strapdown.compensate`): right for an IMU that sums over intervals in which its rate changes, wrong for
    increments that are rotation vectors already.
    """

    def __init__(self, estimator: Estimator, lag_s: float = 0.0, coning: bool = False) -> None:
        self.estimator = estimator
        self.lag_s = lag_s
        self.coning = coning
        self._raw: ImuSamples | None = None  # last raw increment, for the compensation of the next
        self._imu = ImuSamples(np.empty(0), np.empty(0), np.empty((0, 3)), np.empty((0, 3)))
        self._ends: list[float] = []  # its times
        self._next = 0  # first row of _imu that the estimator has not used
        self._longest = 0.0  # of them [s]
        self._t = -math.inf  # up to where the estimator has come
        self._queue: list[tuple[float, str, int, Sample]] = []
        self._count = 0

    def push(self, imu: ImuSamples, samples: Sequence[Sample] = ()) -> list[UpdateReport]:
        """Add consecutive increments and the samples that arrived with them; what became of the samples applied now."""
        return self.track(imu, samples, ())[0]

    def track(
        self, imu: ImuSamples, samples: Sequence[Sample], times: Sequence[float]
    ) -> tuple[list[UpdateReport], list[Estimate]]:
        """`push`, and the estimates at ``times`` [s] on the way, ascending, the last less than an increment ahead.

        Each is the one that would have been had at its time: it knows no sample younger than ``lag_s``, and none that
        had not arrived.
        """
        for sample in samples:
            t = sample.t if math.isfinite(sample.t) else sample.t_arrival  # when the estimator will refuse it
            known = sample.t_arrival - self.lag_s  # not before, however early it is handed over
            turn = known if known > t + COINCIDENT else t
            heapq.heappush(self._queue, (turn, sample.sensor, self._count, sample))
            self._count += 1
        if len(imu):
            self._append(imu)
        reports: list[UpdateReport] = []
        estimates = []
        for t in times:
            self._use(t, reports)
            estimates.append(self.estimate_at(t))
        if self._ends:
            self._use(self._ends[-1], reports)
        return reports, estimates

    def estimate_at(self, t: float) -> Estimate:
        """The state at ``t`` [s], predicted with the increments pushed so far; the estimator itself does not move.

        Raises ValueError when ``t`` is a whole increment past the newest or before what the estimator has already used.
        """
        if abs(t - self._t) <= COINCIDENT:
            estimate = self.estimator.estimate()
            return replace(estimate, t=t) if math.isnan(estimate.t) else estimate  # it may have seen nothing yet
        if t < self._t:
            raise ValueError(f"the estimator is at {self._t} s already, it cannot tell the state at {t} s")
        stop = self._row_after(t)
        if not stop:
            estimate = self.estimator.estimate()
            return estimate if estimate.t == t else replace(estimate, t=t)
        front = _cut(self._imu, self._next, stop)
        ahead = t - max(self._ends[stop - 1], self._t)
        if ahead > self._longest + COINCIDENT:
            raise ValueError(f"no inertial samples up to {t} s")
        if ahead > COINCIDENT:
            front = _join(front, self._beyond(stop - 1, t, ahead))
        return self.estimator.predict(front)

    def _use(self, now: float, reports: list[UpdateReport]) -> None:
        """Bring the estimator to ``lag_s`` before the last increment by ``now``, with every sample up to there.

        An estimator that listens to no sample any more need not wait for any.
        """
        stop = self._row_after(now)
        if not stop:
            return
        horizon = self._ends[stop - 1] - (self.lag_s if self.estimator.listening else 0.0)
        while self._queue and self._queue[0][0] <= horizon + COINCIDENT:
            turn, _, _, sample = heapq.heappop(self._queue)
            if not self.estimator.accepts(sample):
                continue
            t = sample.t if math.isfinite(sample.t) else turn
            if turn > t:  # too late, wherever the blocks were cut
                self._propagate_to(turn, reports)
            if t < self._t - COINCIDENT:
                reports += self.estimator.refuse(sample, f"{self._t - t:.3g} s too late")
                continue
            self._advance(t, reports)
            reports += self.estimator.update(sample)
        self._propagate_to(horizon, reports)

    def _append(self, imu: ImuSamples) -> None:
        if self._t == -math.inf:
            self._t = float(imu.t[0] - imu.dt[0])
        ready = compensate(imu, self._raw) if self.coning else imu
        self._raw = _cut(imu, len(imu) - 1, len(imu))
        kept = max(self._next - 1, 0)  # the last one used as well: its rates lead on
        self._imu = _join(_cut(self._imu, kept, len(self._imu)), ready)
        self._ends = self._imu.t.tolist()
        self._longest = max(self._longest, float(imu.dt.max()))
        self._next -= kept

    def _advance(self, t: float, reports: list[UpdateReport]) -> None:
        """Bring the estimator to ``t``, splitting an increment in which it falls."""
        self._propagate_to(t, reports)
        if t > self._t + COINCIDENT and self._next < len(self._ends):
            part = self._part(self._next, t)
            for rest, used in ((self._imu.dt, part.dt), (self._imu.dtheta, part.dtheta), (self._imu.dv, part.dv)):
                rest[self._next] -= used[0]
            reports += self.estimator.propagate(part) or ()
            self._t = t

    def _propagate_to(self, t: float, reports: list[UpdateReport]) -> None:
        """Hand over the whole increments that end by ``t``."""
        stop = self._row_after(t)
        if stop > self._next:
            reports += self.estimator.propagate(_cut(self._imu, self._next, stop)) or ()
            self._t = self._ends[stop - 1]
            self._next = stop

    def _row_after(self, t: float) -> int:
        return bisect_right(self._ends, t + COINCIDENT, self._next)

    def _part(self, row: int, t: float) -> ImuSamples:
        """The part of one increment up to ``t``: rate and force are constant over an increment."""
        whole = _cut(self._imu, row, row + 1)
        share = 1 - (whole.t[0] - t) / whole.dt[0]
        return ImuSamples(np.array([t]), share * whole.dt, share * whole.dtheta, share * whole.dv)

    def _beyond(self, row: int, t: float, ahead: float) -> ImuSamples:
        """What the next increment would be up to ``t``, ``ahead`` [s] long, if one's rates went on."""
        last = _cut(self._imu, row, row + 1)
        share = ahead / last.dt[0]
        return ImuSamples(np.array([t]), share * last.dt, share * last.dtheta, share * last.dv)


def _cut(imu: ImuSamples, start: int, stop: int) -> ImuSamples:
    return ImuSamples(imu.t[start:stop], imu.dt[start:stop], imu.dtheta[start:stop], imu.dv[start:stop])


def _join(first: ImuSamples, second: ImuSamples) -> ImuSamples:
    return ImuSamples(
        np.concatenate([first.t, second.t]),
        np.concatenate([first.dt, second.dt]),
        np.concatenate([first.dtheta, second.dtheta]),
        np.concatenate([first.dv, second.dv]),
    )
