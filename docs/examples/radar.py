"""A sensor of one's own: a radar altimeter over flat ground at the height of the ellipsoid."""

from dataclasses import dataclass, field

from pydantic import Field

from testbed.noise import Process, stream
from testbed.sensors.timing import AidingTiming, Schedule


@dataclass(frozen=True, slots=True)
class RadarSample:
    t: float
    t_arrival: float
    height: float = field(metadata={"unit": "m", "meaning": "measured height above ground"})
    sensor: str = "radar"


class Radar:
    """Kind ``./radar.py:Radar``: white noise, and no echo from above ``ceiling_m``."""

    class Section(AidingTiming):
        noise_m: float = Field(0.5, ge=0, description="white noise")
        ceiling_m: float = Field(600.0, gt=0, description="largest height that it measures")

    def __init__(self, name, section, tick_rate_hz, seed):
        self.name, self.ceiling = name, section.ceiling_m
        self.schedule = Schedule.of(name, section, tick_rate_hz)
        self.noise = Process.white(stream(seed, name, "noise"), [section.noise_m])

    def sense(self, truth):
        rows = self.schedule.rows(truth)
        noise = self.noise.take(len(rows))[:, 0]  # drawn for all, so that a lost echo changes no later sample
        latency = self.schedule.latency
        return [
            RadarSample(truth.t[k], truth.t[k] + latency, truth.h[k] + error, self.name)
            for k, error in zip(rows, noise, strict=True)
            if truth.h[k] <= self.ceiling
        ]
