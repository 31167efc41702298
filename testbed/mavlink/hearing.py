"""What sensors have said by instants of a run, and which of them have fallen silent."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import TypeAlias, TypeVar, cast

import numpy as np
import numpy.typing as npt

from nav.samples import (
    AirspeedSample,
    Array,
    BarometerSample,
    GnssSample,
    ImuSamples,
    MagnetometerSample,
    PositionSample,
    Sample,
)

Places: TypeAlias = npt.NDArray[np.intp]
S = TypeVar("S", GnssSample, BarometerSample, MagnetometerSample, AirspeedSample)
_KINDS = (GnssSample, BarometerSample, MagnetometerSample, AirspeedSample, PositionSample)


class Hearing:
    """What sensors have said by each of N instants at ``t`` (N,)."""

    def __init__(
        self,
        before: Mapping[str, Sample],
        news: Sequence[tuple[int, Sample]],
        t: Array,
        silent_s: Mapping[str, float],
        first: Mapping[type[Sample], str],
    ) -> None:
        """The newest samples ``before``, by sensor, and those since, each with the instant by which it was there.

        ``silent_s`` says after how long a sensor that says nothing counts as failed, ``first`` which is the first
        sensor of a kind; of a kind that is not in it, the first to speak is.
        """
        self._t, self._times, self._silent_s = t, t.tolist(), silent_s
        # From which instants on which samples are the newest, by sensor, who spoke first before the others.
        self._own: dict[str, tuple[list[int], list[Sample]]] = {
            name: ([-1], [sample]) for name, sample in before.items()
        }
        for row, sample in news:
            rows, samples = self._own.setdefault(sample.sensor, ([], []))
            if rows and rows[-1] == row:
                samples[-1] = sample
            else:
                rows.append(row)
                samples.append(sample)
        self._first = dict(first)
        self._since: dict[type[Sample], int] = {}  # the instant by which any of a kind has spoken
        for name, (rows, samples) in self._own.items():
            kind = _kind(samples[0])
            self._first.setdefault(kind, name)
            self._since[kind] = min(rows[0], self._since.get(kind, rows[0]))

    def last(self) -> dict[str, Sample]:
        """The newest sample of each sensor at the end."""
        return {name: samples[-1] for name, (_, samples) in self._own.items()}

    def knows(self, kind: type[Sample], row: int) -> bool:
        """Whether a sensor of this kind has said anything by an instant."""
        return kind in self._since and self._since[kind] <= row

    def newest(self, kind: type[Sample], row: int) -> Sample | None:
        """The newest sample of the first sensor of a kind, None when there is none or it is silent."""
        name = self._first.get(kind)
        return None if name is None or name not in self._own else self._newest_of(name, row)

    def fixed(self, row: int) -> bool:
        """Whether any sensor tells where the vehicle is; the estimator takes its last word for fresh a while longer."""
        for name in self._own:
            sample = self._newest_of(name, row)
            if isinstance(sample, PositionSample) or (isinstance(sample, GnssSample) and sample.has_fix):
                return True
        return False

    def _newest_of(self, name: str, row: int) -> Sample | None:
        rows, samples = self._own[name]
        at = bisect_right(rows, row) - 1
        speaks = at >= 0 and self._times[row] - samples[at].t_arrival < self._silent_s[name]
        return samples[at] if speaks else None

    def codes(self) -> dict[str, npt.NDArray[np.int64]]:
        """By sensor a number (N,) that changes with all that health depends on: known, speaking, sound, with a fix."""
        found = {}
        for name, (_, samples) in self._own.items():
            which, speaks = self._newest(name)
            sound = np.array([_sound(sample) for sample in samples])[which]
            found[name] = np.where(which < 0, 0, 1 + 2 * speaks + 4 * sound)
        return found

    @cached_property
    def field_b(self) -> Array:
        """Newest magnetic field measured (N, 3) [T], NaN where it is not known."""
        return self._column(MagnetometerSample, lambda sample: sample.field_b, (3,))

    @cached_property
    def pressure(self) -> Array:
        """Static pressure measured (N,) [Pa], NaN where it is not known."""
        return self._column(BarometerSample, lambda sample: sample.pressure)

    @cached_property
    def eas(self) -> Array:
        """Equivalent airspeed measured (N,) [m/s], NaN where it is not known."""
        return self._column(AirspeedSample, lambda sample: sample.eas)

    def _column(self, kind: type[S], of: Callable[[S], object], shape: tuple[int, ...] = ()) -> Array:
        """A number of the samples of the first sensor of a kind."""
        name = self._first.get(kind)
        if name is None or name not in self._own:
            return np.full((len(self._t), *shape), math.nan)
        which, speaks = self._newest(name)
        values = np.array([of(cast("S", sample)) for sample in self._own[name][1]], float)[which]
        values[~speaks] = math.nan
        return values

    def _newest(self, name: str) -> tuple[Places, npt.NDArray[np.bool_]]:
        """Which sample of a sensor is the newest, -1 before the first, and whether it has not fallen silent since."""
        rows, samples = self._own[name]
        which = np.searchsorted(rows, np.arange(len(self._t)), "right") - 1
        arrival = np.array([sample.t_arrival for sample in samples])
        return which, (which >= 0) & (self._t - arrival[which] < self._silent_s[name])


def _kind(sample: Sample) -> type[Sample]:
    """The one of `_KINDS` that a sample is of, of what is none its class."""
    own = type(sample)
    return own if own in _KINDS else next((kind for kind in _KINDS if isinstance(sample, kind)), own)


def _sound(sample: Sample) -> int:
    """0 when it holds nothing, 1 when it does, 3 with a fix."""
    if isinstance(sample, GnssSample):
        return 3 if sample.has_fix else 1
    if isinstance(sample, BarometerSample):
        return int(math.isfinite(sample.pressure))
    return int(math.isfinite(sample.eas)) if isinstance(sample, AirspeedSample) else 1


class Inertial:
    """Newest angular rates [rad/s] and specific forces [m/s^2] measured (N, 3), body."""

    def __init__(self) -> None:
        self._imu: ImuSamples | None = None
        self._readings: list[tuple[Array, Array, Array]] = []  # of the newest increments, and of those before
        self._last = np.full(3, math.nan), np.full(3, math.nan)

    def read(self, imu: ImuSamples | None, t: Array) -> tuple[Array, Array]:
        """Those up to ``t`` (N,): with an IMU slower than these they may be of the increments before."""
        if imu is not self._imu:
            own = [] if imu is None else [(imu.t, imu.dtheta / imu.dt[:, None], imu.dv / imu.dt[:, None])]
            self._readings = own + self._readings[:1] if own else []
            self._imu = imu
        gyro, accel = np.empty((len(t), 3)), np.empty((len(t), 3))
        gyro[:], accel[:] = self._last
        for times, rates, forces in reversed(self._readings):
            newest = times.searchsorted(t + 1e-6) - 1
            there = newest >= 0
            gyro[there], accel[there] = rates[newest[there]], forces[newest[there]]
        self._last = gyro[-1], accel[-1]
        return gyro, accel
