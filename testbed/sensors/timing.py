"""When a sensor reports: on which ticks, and how much later the sample arrives. How it is wrong lives elsewhere."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from statistics import NormalDist
from typing import Annotated, TypeAlias

import numpy as np
import numpy.typing as npt
from pydantic import AfterValidator, Field

from nav.samples import Array
from testbed.errors import UserError
from testbed.motion.table import TruthBlock
from testbed.noise import Process, stream
from testbed.schema import Section
from testbed.sensors.units import PERCENT

SILENT_S = 0.5  # beyond its period, or half of it if that is longer, before a sensor that says nothing is silent
TICK_TOLERANCE = 1e-6  # of a tick: what 1/3 Hz and 0.1 s lose as decimal numbers


def _in_order(windows: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
    for start, end in windows:
        if start < 0:
            raise ValueError(f"window [{start:g}, {end:g}] starts before the run; times are seconds from its start")
        if end <= start:
            raise ValueError(f"window [{start:g}, {end:g}] ends before it starts; write [start, end] in seconds")
    ordered = tuple(sorted(windows))
    for (a, b), (c, d) in pairwise(ordered):
        if c < b:
            raise ValueError(f"windows [{a:g}, {b:g}] and [{c:g}, {d:g}] overlap; join them into one")
    return ordered


# Windows [start, end) of simulated time, sorted, apart from each other.
Windows: TypeAlias = Annotated[tuple[tuple[float, float], ...], AfterValidator(_in_order)]


def ticks_per_sample(name: str, rate_hz: float, tick_rate_hz: float) -> int:
    """Ticks from one sample to the next. Raises UserError when the rate does not divide the tick rate."""
    ratio = tick_rate_hz / rate_hz
    ticks = round(ratio)
    if ticks < 1 or abs(ratio - ticks) > TICK_TOLERANCE * ticks:
        raise UserError(
            f"sensors.{name}.rate_hz: {rate_hz:g} Hz does not divide the tick rate of {tick_rate_hz:g} Hz; "
            f"choose {tick_rate_hz:g} divided by a whole number"
        )
    return ticks


class AidingTiming(Section):
    """The timing keys that every aiding sensor has."""

    rate_hz: float = Field(10.0, gt=0, le=10_000, description="samples per second; divides the tick rate")
    offset_s: float = Field(0.0, ge=0, le=3600, description="time of the first sample, a whole number of ticks")
    latency_s: float = Field(0.0, ge=0, le=10, description="from the time of validity to the time of arrival")
    jitter_s: float = Field(
        0.0, ge=0, le=1, description="how late samples are stamped beyond that: half-normal, by less than a period"
    )
    dropout_percent: float = Field(0.0, ge=0, lt=100, description="of the samples that are lost, each by itself")
    fused_hz: float | None = Field(
        default=None,
        gt=0,
        le=10_000,
        description="an INS takes no more of its samples per second: errors of closer ones are alike; none: all",
    )

    @property
    def age_s(self) -> float:
        """The largest age of a sample when it arrives [s]."""
        return self.latency_s


def patience(rate_hz: float) -> float:
    """After how long [s] without a sample a sensor of this rate counts as silent, everywhere in the house."""
    return 1 / rate_hz + max(SILENT_S, 0.5 / rate_hz)


@dataclass(frozen=True, slots=True)
class Schedule:
    """Samples fall on tick ``first`` and every ``every`` ticks from there."""

    every: int
    first: int
    latency: float

    @classmethod
    def of(cls, name: str, timing: AidingTiming, tick_rate_hz: float) -> Schedule:
        """The schedule of sensor ``name``. Raises UserError when it does not fall on ticks."""
        every = ticks_per_sample(name, timing.rate_hz, tick_rate_hz)
        first = timing.offset_s * tick_rate_hz
        if abs(first - round(first)) > TICK_TOLERANCE * max(1.0, first):
            raise UserError(
                f"sensors.{name}.offset_s: {timing.offset_s:g} s is not a whole number of ticks of "
                f"{1 / tick_rate_hz:g} s"
            )
        return cls(every, round(first), timing.latency_s)

    def rows(self, block: TruthBlock) -> range:
        """The rows of ``block`` on which the sensor reports."""
        wait = self.first - block.tick
        return range(wait if wait > 0 else wait % self.every, len(block), self.every)


class InterruptedTiming(AidingTiming):
    """The timing keys of a sensor that is silent at times: then it delivers nothing."""

    denied: Windows = Field((), description="windows of simulated time without samples")


def outside(windows: Windows, t: Array) -> npt.NDArray[np.bool_]:
    """Which of the times (n,) [s] are in none of the windows."""
    free = np.full(len(t), True)
    for start, end in windows:
        free &= (t < start) | (t >= end)
    return free


class Interruptions:
    """Which samples of one sensor come through. ``kept`` is asked about every scheduled sample, once and in order."""

    def __init__(self, name: str, timing: InterruptedTiming, seed: int) -> None:
        share = timing.dropout_percent * PERCENT
        self._denied = timing.denied
        self._lost_below = NormalDist().inv_cdf(share) if share else -math.inf
        self._luck = Process.white(stream(seed, name, "dropout"), [1.0 if share else 0.0])

    def kept(self, t: Array) -> npt.NDArray[np.bool_]:
        """Whether the samples at ``t`` (n,) [s] are delivered."""
        kept: npt.NDArray[np.bool_] = self._luck.take(len(t))[:, 0] >= self._lost_below
        return kept & outside(self._denied, t)
