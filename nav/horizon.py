"""Time order: inertial increments and aiding samples reach an estimator as they happened, not as they arrived.

A GNSS fix describes the past by the time it arrives, and a sample may fall between two inertial ones. The estimator
therefore runs ``lag_s`` behind the newest increment, so that nothing comes too late: each sample is applied at its own
time, for which an increment is split in two, and the present is predicted from there whenever it is asked for.
"""

from __future__ import annotations

import heapq
import math
from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import replace
from operator import itemgetter
from typing import Protocol, TypeAlias, cast, overload

import numpy as np
import numpy.typing as npt

from nav.columns import Estimated, Estimates, Reported, Reports, Samples, column, one_by_one
from nav.increments import COINCIDENT, Increments, Steps, joined, share_of
from nav.samples import Array, Estimate, ImuSamples, Sample, UpdateReport
from nav.strapdown import compensate

Handed: TypeAlias = Sequence[Sample | Samples]  # one by one, or many of a sensor at once


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
        self._queue: list[tuple[float, str, int, Sample]] = []  # when it is its turn, and who comes first at one time
        self._count = 0

    def push(self, imu: ImuSamples, samples: Handed = ()) -> list[UpdateReport]:
        """Add consecutive increments and the samples that arrived with them; what became of the samples applied now."""
        return [*self.track(imu, samples, ())[0]]

    def track(self, imu: ImuSamples, samples: Handed, times: Sequence[float]) -> tuple[Reports, Estimates]:
        """`push`, and the estimates at ``times`` [s] on the way, ascending, the last less than an increment ahead.

        Each is the one that would have been had at its time: it knows no sample younger than ``lag_s``, and none that
        had not arrived.
        """
        if not self.estimator.listening:
            samples = ()
        if len(imu):
            ready = compensate(imu, self._raw) if self.coning else imu
            self._raw = ImuSamples(imu.t[-1:], imu.dt[-1:], imu.dtheta[-1:], imu.dv[-1:])
            self._ahead.append(ready)
        reports: Reported = []
        estimates: Estimated = []
        estimator = self.estimator
        if getattr(estimator, "in_steps", False) and self._ahead.next:
            self._take(cast(TakesSteps, estimator), samples, times, reports, estimates)
            told = Reports(reports)
            return Reports.joined([told]) if len(reports) > 1 else told, Estimates.of(estimates)
        self._wait(samples)
        for t in times:
            self._use(t, reports)
            estimates.append(self.estimate_at(t))
        if len(self._ahead.imu):
            self._use(float(self._ahead.imu.t[-1]), reports)
        return Reports(reports), Estimates.of(estimates)

    def _wait(self, samples: Handed) -> None:
        """Let samples wait for their turn."""
        lag_s, queue = self.lag_s, self._queue
        for count, sample in enumerate(one_by_one(samples), self._count):
            t = sample.t if math.isfinite(sample.t) else sample.t_arrival  # when the estimator will refuse it
            known = sample.t_arrival - lag_s  # not before, however early it is handed over
            queue.append((known if known > t + COINCIDENT else t, sample.sensor, count, sample))
        self._count += sum(len(one) if isinstance(one, Samples) else 1 for one in samples)
        queue.sort()  # which leaves a heap, and takes less than to put in and take out one after the other

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

    def _take(
        self, estimator: TakesSteps, samples: Handed, times: Sequence[float], reports: Reported, estimates: Estimated
    ) -> None:
        """`track` of an estimator that takes steps, each that it can't take with others by itself."""
        lag = self.lag_s if self.estimator.listening else 0.0
        all_times = [*times, float(self._ahead.imu.t[-1])]
        ends = self._ahead.ends_by(all_times)
        many = [piece for piece in samples if isinstance(piece, Samples)]
        self._wait([piece for piece in samples if not isinstance(piece, Samples)] if many else samples)
        steps = self._many_steps(all_times, ends, lag, many) if many else self._steps(all_times, ends, lag)
        while steps.next < len(steps.t):
            taken = estimator.take(steps, self._ahead, reports, estimates)
            if not taken:
                self._go(steps, reports, estimates)
            steps.next += max(taken, 1)

    def _steps(self, times: Sequence[float], ends: Sequence[float], lag: float) -> Steps:
        """What to do up to the ``ends`` of the increments by the ``times``, less the ``lag``."""
        queue, accepts, due = self._queue, self.estimator.accepts, 0
        t_of: list[float] = []
        horizons: list[float] = []
        samples: list[Sample | None] = []
        groups: dict[str, tuple[list[int], list[Sample]]] = {}
        for t, end in zip(times, ends, strict=True):
            horizon = end - lag
            while due < len(queue) and queue[due][0] <= horizon + COINCIDENT:
                turn, sensor, _, sample = queue[due]
                if accepts(sample):
                    where, own = groups.setdefault(sensor, ([], []))
                    where.append(len(t_of))
                    own.append(sample)
                    t_of.append(sample.t)
                    horizons.append(turn)
                    samples.append(sample)
                due += 1
            t_of.append(t)
            horizons.append(horizon)
            samples.append(None)
        del queue[:due]
        t_of[-1] = math.nan
        return Steps(t_of, horizons, samples, [(sensor, *group) for sensor, group in groups.items()])

    def _many_steps(self, times: Sequence[float], ends: Sequence[float], lag: float, many: list[Samples]) -> Steps:
        """`_steps` with ``many`` samples more, in arrays."""
        horizons = np.array(ends) - lag
        last = float(horizons[-1]) + COINCIDENT
        due = _Due(self._queue, last, self.estimator.accepts)
        for own in many:
            t = np.where(np.isfinite(own.t), own.t, own.t_arrival)
            known = own.t_arrival - self.lag_s
            turn = np.where(known > t + COINCIDENT, known, t)
            count = self._count + np.arange(len(own))
            self._count += len(own)
            waits = ~(turn <= last)
            if waits.any():
                rest = zip(turn[waits].tolist(), count[waits].tolist(), own[waits], strict=True)
                self._queue += [(when, own.sensor, number, sample) for when, number, sample in rest]
                turn, count, own = turn[~waits], count[~waits], own[~waits]
            if len(own) and self.estimator.accepts(own[0]):
                due.add(own.sensor, own, turn, count)
        self._queue.sort()
        return due.steps(np.array(times), horizons)

    def _go(self, steps: Steps, reports: Reported, estimates: Estimated) -> None:
        """Take one step by itself."""
        t, horizon, sample = float(steps.t[steps.next]), float(steps.horizon[steps.next]), steps.samples[steps.next]
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


class _Due:
    """Samples whose turn has come, by sensor, on their way among the steps that ask for an estimate."""

    def __init__(self, queue: list[tuple[float, str, int, Sample]], last: float, accepts: Callable[[Sample], bool]):
        """Begin with those of a sorted ``queue``, out of which they are taken, whose turn comes by ``last``."""
        self._groups: list[tuple[str, Sequence[Sample], Array, npt.NDArray[np.int64]]] = []
        stop = bisect_right(queue, last, key=itemgetter(0))
        by_sensor: dict[str, list[tuple[float, str, int, Sample]]] = {}
        for entry in queue[:stop]:
            if accepts(entry[3]):
                by_sensor.setdefault(entry[1], []).append(entry)
        del queue[:stop]
        for sensor, own in by_sensor.items():
            turns, _, counts, samples = zip(*own, strict=True)
            self.add(sensor, samples, np.array(turns), np.array(counts))

    def add(self, sensor: str, samples: Sequence[Sample], turn: Array, count: npt.NDArray[np.int64]) -> None:
        """Samples of one sensor, when it is their turn (N,) [s], and their numbers (N,)."""
        self._groups.append((sensor, samples, turn, count))

    def steps(self, times: Array, horizons: Array) -> Steps:
        """All of these in their turn, and to go on to ``horizons`` (M,) and say what is known of ``times`` (M,)."""
        sizes = [len(samples) for _, samples, _, _ in self._groups]
        asked, total = np.arange(len(times)), sum(sizes) + len(times)
        t, horizon = np.empty(total), np.empty(total)
        group, row = np.full(total, -1), np.zeros(total, np.int64)
        place = np.empty(0, np.int64)  # of each sample, group by group
        if self._groups:
            names = sorted({sensor for sensor, _, _, _ in self._groups})
            turn = np.concatenate([turn for _, _, turn, _ in self._groups])
            first = np.repeat([names.index(sensor) for sensor, _, _, _ in self._groups], sizes)
            order = np.lexsort((np.concatenate([count for _, _, _, count in self._groups]), first, turn))
            before = np.searchsorted(horizons + COINCIDENT, turn[order])  # so many that ask for an estimate
            place = np.empty(len(order), np.int64)
            place[order] = before + np.arange(len(order))
            asked = asked + np.searchsorted(before, asked, side="right")
            t[place] = np.concatenate([column(samples, "t") for _, samples, _, _ in self._groups])
            horizon[place] = turn
            group[place] = np.repeat(np.arange(len(sizes)), sizes)
            row[place] = np.concatenate([np.arange(size) for size in sizes])
        t[asked], horizon[asked] = times, horizons
        t[asked[-1]] = math.nan
        where = np.split(place, np.cumsum(sizes)[:-1]) if sizes else []
        groups = [(sensor, own, samples) for (sensor, samples, _, _), own in zip(self._groups, where, strict=True)]
        return Steps(t, horizon, _Merged([samples for _, _, samples in groups], group, row), groups)


class _Merged(Sequence[Sample | None]):
    """The samples of several sensors in the order of the steps that use them, of which some use none."""

    def __init__(
        self, several: Sequence[Sequence[Sample]], which: npt.NDArray[np.int64], row: npt.NDArray[np.int64]
    ) -> None:
        """Of each step ``which`` of the ``several`` its sample is in, -1 for none, and where."""
        self._several, self._which, self._row = several, which, row

    def __len__(self) -> int:
        return len(self._which)

    @overload
    def __getitem__(self, step: int) -> Sample | None: ...
    @overload
    def __getitem__(self, step: slice) -> list[Sample | None]: ...

    def __getitem__(self, step: int | slice) -> Sample | list[Sample | None] | None:
        """The sample of a step, or of those of a slice."""
        if isinstance(step, slice):
            return [self[k] for k in range(len(self))[step]]
        which = int(self._which[step])
        return None if which < 0 else self._several[which][int(self._row[step])]
