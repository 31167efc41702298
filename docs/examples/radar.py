"""A sensor of one's own: a radar altimeter over flat ground at the height of the ellipsoid."""

from dataclasses import dataclass, field

import numpy as np
from pydantic import Field

from nav.aids.base import Measurement
from nav.error_model import POS
from testbed.noise import Process, stream
from testbed.sensors.timing import AidingTiming, Schedule


@dataclass(frozen=True, slots=True)
class RadarSample:
    t: float
    t_arrival: float
    height: float = field(metadata={"unit": "m", "meaning": "measured height above ground"})
    sensor: str = "radar"


@dataclass(frozen=True)
class RadarAid:
    """What a filter is told of it: one measurement, of one axis, without error states of its own."""

    sensor: str
    sigma: float

    parts = (("radar", 1),)
    states = ()

    def blocks(self):
        return []

    def measure(self, part, sample, at):
        nu = np.array([sample.height - at.state.lla[2]])  # measured - predicted
        H = np.zeros((1, len(at.x)))  # by the error states: position error is north, east, down
        H[0, POS + 2] = -1.0
        return Measurement(nu, H, np.array([self.sigma**2]))


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

    @staticmethod
    def aid(name, section, imu):
        return RadarAid(name, section.noise_m)
