"""Increments on their way into an estimator, which takes them up to the times of samples, splitting one if need be."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from nav._jit import inlined, njit
from nav.samples import Array, ImuSamples, Sample

COINCIDENT = 1e-6  # two times this close are the same [s]
FEW = 8  # times are found sooner one by one than by calls of numpy
# One of `Steps` among the rows of numbers that a kernel is handed: its times, and what it is where that is no sample.
TIME, HORIZON, WHAT, NUMBERS = 0, 1, 2, 3
ESTIMATE, ADVANCE = -1, -2


@dataclass
class Steps:
    """What an estimator is to do, step by step, from the ``next`` one on; those before it are done.

    Each time to go on to the ``horizon`` [s] and say what it knows of ``t`` [s], later or the same. With a sample it is
    to use that, which is valid at ``t``; a ``t`` of NaN asks for nothing. ``groups`` are samples of one sensor each,
    with the steps that they are used in. ``plan`` is room for what an estimator makes of all of them at once.
    """

    t: Sequence[float] | Array
    horizon: Sequence[float] | Array
    samples: Sequence[Sample | None]
    groups: Sequence[tuple[str, Sequence[int] | npt.NDArray[np.int64], Sequence[Sample]]]
    next: int = 0
    plan: Any = None

    def last(self, count: int) -> Sample | None:
        """The sample of the last of the next ``count``."""
        return self.samples[self.next + count - 1]


@dataclass
class Increments:
    """Increments that an estimator has not used, from row ``next`` on, and some that it has.

    It stands at ``t`` [s], which may be within an increment: of that the rest is left. ``longest`` [s] is the longest
    that there was.
    """

    imu: ImuSamples = field(
        default_factory=lambda: ImuSamples(np.empty(0), np.empty(0), np.empty((0, 3)), np.empty((0, 3)))
    )
    next: int = 0
    t: float = -np.inf
    longest: float = 0.0

    def append(self, imu: ImuSamples) -> None:
        """More increments, which follow on the last; of those used one is kept, whose rates lead on."""
        if self.t == -np.inf:
            self.t = float(imu.t[0] - imu.dt[0])
        kept = max(self.next - 1, 0)
        self.imu = joined(self.rows(kept, len(self.imu)), imu)
        self.longest = max(self.longest, float(imu.dt.max()))
        self.next -= kept

    def row_after(self, t: float) -> int:
        """The first row, of those not used, that ends after ``t`` [s]."""
        return bisect_right(self.imu.t, t + COINCIDENT, self.next)

    def ends_by(self, times: Sequence[float]) -> list[float]:
        """The end of the last row by each of the ``times`` [s], one at least having been used."""
        if len(times) < FEW:
            return [float(self.imu.t[self.row_after(t) - 1]) for t in times]
        rows = np.searchsorted(self.imu.t[self.next :], np.array(times) + COINCIDENT, side="right")
        ends: list[float] = self.imu.t[self.next - 1 + rows].tolist()
        return ends

    def rows(self, start: int, stop: int) -> ImuSamples:
        """Some rows, as views."""
        imu = self.imu
        return ImuSamples(imu.t[start:stop], imu.dt[start:stop], imu.dtheta[start:stop], imu.dv[start:stop])

    def whole(self, t: float) -> ImuSamples | None:
        """The whole increments that end by ``t`` [s], which are used with that; None without any."""
        stop = self.row_after(t)
        if stop <= self.next:
            return None
        taken = self.rows(self.next, stop)
        self.t, self.next = float(taken.t[-1]), stop
        return taken

    def part(self, t: float) -> ImuSamples | None:
        """What the next increment has up to ``t`` [s], which is used with that; None where ``t`` is not within it."""
        if not (t > self.t + COINCIDENT and self.next < len(self.imu)):
            return None
        imu, row = self.imu, self.next
        taken = share_of(self.rows(row, row + 1), 1 - (imu.t[row] - t) / imu.dt[row], t)
        for rest, used in ((imu.dt, taken.dt), (imu.dtheta, taken.dtheta), (imu.dv, taken.dv)):
            rest[row] -= used[0]
        self.t = t
        return taken


def share_of(one: ImuSamples, share: float, t: float) -> ImuSamples:
    """A share of one increment, whose rates are constant, that ends at ``t`` [s]."""
    return ImuSamples(np.array([t]), share * one.dt, share * one.dtheta, share * one.dv)


def joined(first: ImuSamples, second: ImuSamples) -> ImuSamples:
    """One after the other, in arrays of their own."""
    return ImuSamples(
        np.concatenate([first.t, second.t]),
        np.concatenate([first.dt, second.dt]),
        np.concatenate([first.dtheta, second.dtheta]),
        np.concatenate([first.dv, second.dv]),
    )


@njit
def row_after(t: Array, time: float, first: int) -> int:
    """`Increments.row_after`."""
    while first < len(t) and t[first] <= time + COINCIDENT:
        first += 1
    return first


@njit
def share(
    one_dt: Array, one_angle: Array, one_push: Array, dt: Array, dtheta: Array, dv: Array, row: int, part: float
) -> None:
    """`share_of` one row, in place."""
    one_dt[0] = part * dt[row]
    for i in range(3):
        one_angle[0, i], one_push[0, i] = part * dtheta[row, i], part * dv[row, i]


@inlined
def take_off(one_dt: Array, one_angle: Array, one_push: Array, dt: Array, dtheta: Array, dv: Array, row: int) -> None:
    """Leave of one row what a `share` of it does not have."""
    dt[row] -= one_dt[0]
    for i in range(3):
        dtheta[row, i] -= one_angle[0, i]
        dv[row, i] -= one_push[0, i]
