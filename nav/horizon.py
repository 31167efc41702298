"""Time order: inertial increments and aiding samples reach an estimator as they happened, not as they arrived.

A GNSS fix describes the past by the time it arrives, and a sample may fall between two inertial ones. The estimator
therefore runs ``lag_s`` behind the newest increment, so that nothing comes too late: each sample is applied at its own
time, for which an increment is split in two, and the present is predicted from there whenever it is asked for.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol, cast

from nav.columns import Estimated, Estimates, Reported, Reports
from nav.increments import COINCIDENT, Increments, Steps, joined, share_of
from nav.samples import Estimate, ImuSamples, Sample, UpdateReport
from nav.strapdown import compensate


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


class TakesSteps(Protocol):
    """An estimator that takes many steps at once, as one after the other would have been, but in less time."""

    @property
    def in_steps(self) -> bool:
        """Whether it does so now: as long as it does it listens, and accepts the same sensors."""
        ...

    def take(self, steps: Steps, ahead: Increments, reports: Reported, estimates: Estimated) -> int:
        """How many of the next ``steps`` it took, zero when the next of them must be taken by itself."""
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
        self._ahead = Increments()
        self._queue: list[tuple[float, str, int, Sample]] = []
        self._count = 0

    def push(self, imu: ImuSamples, samples: Sequence[Sample] = ()) -> list[UpdateReport]:
        """Add consecutive increments and the samples that arrived with them; what became of the samples applied now."""
        return [*self.track(imu, samples, ())[0]]

    def track(self, imu: ImuSamples, samples: Sequence[Sample], times: Sequence[float]) -> tuple[Reports, Estimates]:
        """`push`, and the estimates at ``times`` [s] on the way, ascending, the last less than an increment ahead.

        Each is the one that would have been had at its time: it knows no sample younger than ``lag_s``, and none that
        had not arrived.
        """
        lag_s, queue = self.lag_s, self._queue
        if not self.estimator.listening:
            samples = ()
        for count, sample in enumerate(samples, self._count):
            t = sample.t if math.isfinite(sample.t) else sample.t_arrival  # when the estimator will refuse it
            known = sample.t_arrival - lag_s  # not before, however early it is handed over
            queue.append((known if known > t + COINCIDENT else t, sample.sensor, count, sample))
        self._count += len(samples)
        queue.sort()  # which leaves a heap, and takes less than to put in and take out one after the other
        if len(imu):
            ready = compensate(imu, self._raw) if self.coning else imu
            self._raw = ImuSamples(imu.t[-1:], imu.dt[-1:], imu.dtheta[-1:], imu.dv[-1:])
            self._ahead.append(ready)
        reports: Reported = []
        estimates: Estimated = []
        estimator = self.estimator
        if getattr(estimator, "in_steps", False) and self._ahead.next:
            self._take(cast(TakesSteps, estimator), times, reports, estimates)
            told = Reports(reports)
            return Reports.joined([told]) if len(reports) > 1 else told, Estimates.of(estimates)
        for t in times:
            self._use(t, reports)
            estimates.append(self.estimate_at(t))
        if len(self._ahead.imu):
            self._use(float(self._ahead.imu.t[-1]), reports)
        return Reports(reports), Estimates.of(estimates)

    def estimate_at(self, t: float) -> Estimate:
        """The state at ``t`` [s], predicted with the increments pushed so far; the estimator itself does not move.

        Raises ValueError when ``t`` is a whole increment past the newest or before what the estimator has already used.
        """
        ahead = self._ahead
        if ahead.t > t + COINCIDENT:  # added as where increments are looked up, so that rounding is the same
            raise ValueError(f"the estimator is at {ahead.t} s already, it cannot tell the state at {t} s")
        if t <= ahead.t + COINCIDENT:
            estimate = self.estimator.estimate()
            return replace(estimate, t=t) if math.isnan(estimate.t) else estimate  # it may have seen nothing yet
        stop = ahead.row_after(t)
        if not stop:
            estimate = self.estimator.estimate()
            return estimate if estimate.t == t else replace(estimate, t=t)
        front = ahead.rows(ahead.next, stop)
        further = t - max(float(ahead.imu.t[stop - 1]), ahead.t)
        if further > ahead.longest + COINCIDENT:
            raise ValueError(f"no inertial samples up to {t} s")
        if further > COINCIDENT:  # as the next increment would be if one's rates went on
            last = ahead.rows(stop - 1, stop)
            front = joined(front, share_of(last, further / last.dt[0], t))
        return self.estimator.predict(front)

    def _take(self, estimator: TakesSteps, times: Sequence[float], reports: Reported, estimates: Estimated) -> None:
        """`track` of an estimator that takes steps, each that it can't take with others by itself."""
        lag = self.lag_s if self.estimator.listening else 0.0
        queue, accepts, due = self._queue, self.estimator.accepts, 0
        all_times = [*times, float(self._ahead.imu.t[-1])]
        steps = Steps()
        t_of, horizons, samples = steps.t, steps.horizon, steps.samples
        for t, end in zip(all_times, self._ahead.ends_by(all_times), strict=True):
            horizon = end - lag
            while due < len(queue) and queue[due][0] <= horizon + COINCIDENT:
                turn, _, _, sample = queue[due]
                if accepts(sample):
                    t_of.append(sample.t)
                    horizons.append(turn)
                    samples.append(sample)
                due += 1
            t_of.append(t)
            horizons.append(horizon)
            samples.append(None)
        del queue[:due]
        steps.t[-1] = math.nan
        while steps.next < len(steps.t):
            taken = estimator.take(steps, self._ahead, reports, estimates)
            if not taken:
                self._go(steps, reports, estimates)
            steps.next += max(taken, 1)

    def _go(self, steps: Steps, reports: Reported, estimates: Estimated) -> None:
        """Take one step by itself."""
        t, horizon, sample = steps.t[steps.next], steps.horizon[steps.next], steps.samples[steps.next]
        if sample is not None:
            self._apply(horizon, sample, reports)
            return
        self._propagate_to(horizon, reports)
        if not math.isnan(t):
            estimates.append(self.estimate_at(t))

    def _use(self, now: float, reports: Reported) -> None:
        """Bring the estimator to ``lag_s`` before the last increment by ``now``, with every sample up to there.

        An estimator that listens to no sample any more need not wait for any.
        """
        stop = self._ahead.row_after(now)
        if not stop:
            return
        horizon = float(self._ahead.imu.t[stop - 1]) - (self.lag_s if self.estimator.listening else 0.0)
        while self._queue and self._queue[0][0] <= horizon + COINCIDENT:
            turn, _, _, sample = heapq.heappop(self._queue)
            if self.estimator.accepts(sample):
                self._apply(turn, sample, reports)
        self._propagate_to(horizon, reports)

    def _apply(self, turn: float, sample: Sample, reports: Reported) -> None:
        """Hand over a sample at its time; one whose ``turn`` is later is refused then."""
        t = sample.t if math.isfinite(sample.t) else turn
        if turn > t:  # too late, wherever the blocks were cut
            self._propagate_to(turn, reports)
        if self._ahead.t > t + COINCIDENT:
            reports += self.estimator.refuse(sample, f"{self._ahead.t - t:.3g} s too late")
            return
        self._propagate_to(t, reports)
        part = self._ahead.part(t)
        if part is not None:
            reports += self.estimator.propagate(part) or ()
        reports += self.estimator.update(sample)

    def _propagate_to(self, t: float, reports: Reported) -> None:
        """Hand over the whole increments that end by ``t``."""
        whole = self._ahead.whole(t)
        if whole is not None:
            reports += self.estimator.propagate(whole) or ()
