"""Motion without an aircraft: for now a body at rest on the turning Earth."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from nav.earth import earth_rate_n, gravity, isa_density, isa_pressure, isa_temperature, wrap_longitude
from nav.rotation import quat_conjugate, quat_from_euler, quat_rotate
from testbed.truth import TruthBlock


class Placement(Protocol):
    """Where the body is and how it lies; heading, pitch, roll in the aerospace sequence."""

    lat_deg: float
    lon_deg: float
    alt_m: float
    heading_deg: float
    pitch_deg: float
    roll_deg: float


class Kinematic:
    """A body at rest, in still standard air, engine off. It never ends by itself.

    Its increments are exact: body rate and specific force are constant in body axes.
    """

    def __init__(self, config: Placement, rate_hz: float) -> None:
        self.rate_hz = rate_hz
        self.failure = ""
        self._tick = 0
        self._lat = math.radians(config.lat_deg)
        self._lon = float(wrap_longitude(math.radians(config.lon_deg)))
        self._h = float(config.alt_m)
        self._q_nb = quat_from_euler(
            math.radians(config.roll_deg), math.radians(config.pitch_deg), math.radians(config.heading_deg)
        )
        q_bn = quat_conjugate(self._q_nb)
        self._omega_b = quat_rotate(q_bn, earth_rate_n(self._lat))
        self._f_b = quat_rotate(q_bn, np.array([0.0, 0.0, -gravity(self._lat, self._h)]))

    def advance(self, ticks: int) -> TruthBlock:
        """The next ``ticks`` rows."""
        block = TruthBlock.empty(self._tick, ticks)
        block.t[:] = (self._tick + np.arange(ticks)) / self.rate_hz
        block.lat[:], block.lon[:], block.h[:] = self._lat, self._lon, self._h
        block.q_nb[:] = self._q_nb
        block.omega_b[:] = self._omega_b
        block.dtheta[:] = self._omega_b / self.rate_hz
        block.dv[:] = self._f_b / self.rate_hz
        if self._tick == 0:
            block.dtheta[:1] = block.dv[:1] = 0.0  # no interval ends at the first row of a run
        block.pressure[:] = isa_pressure(self._h)
        block.temperature[:] = isa_temperature(self._h)
        block.density[:] = isa_density(self._h)
        block.commands[:] = 0.0, self._h, 0.0
        block.leg[:] = -1.0
        self._tick += ticks
        return block

    def activity(self) -> str:
        """What is going on."""
        return "at rest"
