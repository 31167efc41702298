"""When a sensor reports: on which ticks, and how much later the sample arrives. How it is wrong lives elsewhere."""

from __future__ import annotations

from dataclasses import dataclass

from pydantic import Field

from testbed.errors import UserError
from testbed.schema import Section
from testbed.truth import TruthBlock

TICK_TOLERANCE = 1e-6  # of a tick: what 1/3 Hz and 0.1 s lose as decimal numbers


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

    rate_hz: float = Field(10.0, gt=0, le=10_000)
    offset_s: float = Field(0.0, ge=0, le=3600, description="time of the first sample, a whole number of ticks")
    latency_s: float = Field(0.0, ge=0, le=10, description="from the time of validity to the time of arrival")


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
