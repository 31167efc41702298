"""Barometer: static pressure with bias, drift and noise."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from pydantic import Field, model_validator

from nav.columns import delivered
from nav.samples import Array, BarometerSample, Sample
from testbed.motion.table import TruthBlock
from testbed.noise import Process, stream
from testbed.sensors.grades import with_grade
from testbed.sensors.timing import AidingTiming, Schedule
from testbed.sensors.units import DEG, PERCENT

GRADES: dict[str, dict[str, Any]] = {
    "perfect": {},
    # TE MS5611-01BA03 data sheet: accuracy +-1.5 mbar (taken as three sigma), resolution 0.012 mbar rms at the highest
    # oversampling. Drift, from temperature inside its +-2.5 mbar error band and from the weather, assumed.
    "mems": {"bias_pa": 50.0, "drift_pa": 15.0, "drift_time_s": 1800.0, "noise_pa": 1.2},
    # The same in a fuselage without a static port: cabin pressure changes with airspeed, sideslip and propeller.
    # Measured on three recorded aeroplanes against GNSS height, with errors of the receiver in it, 1.5 m: it changes
    # by 1.2 to 3.3 m in 5 s, 1.7 to 4.0 m in 10 s, 2.4 to 5.8 m in 30 s and 3.2 to 6.7 m in a minute (root of half the
    # mean square); 18 +- 5 and 44 +- 23 % of dynamic pressure are in the static one, and with 10 deg of sideslip 12 +-
    # 14 % more (least squares beside a drift). White noise from sample to sample is 20 Pa on one and 1.2 Pa in a
    # quadcopter: filters go by what they see of it.
    "hobby": {
        "bias_pa": 100.0,
        "drift_pa": 80.0,
        "drift_time_s": 300.0,
        "noise_pa": 3.0,
        "unsteady_pa": 32.0,
        "unsteady_time_s": 8.0,
        "follow_s": 5.0,
        "dynamic_percent": 15.0,
        "sideslip_percent": 10.0,
        "fused_hz": 10.0,
    },
}


@dataclass(frozen=True, slots=True)
class BarometerErrors:
    """The sensor's datasheet, 1 sigma: ``noise``, Gauss-Markov ``unsteady`` [Pa] with ``unsteady_tau`` [s], constant
    ``bias``, Gauss-Markov ``drift`` [Pa] with ``drift_tau``, ``latency`` [s]. Near the ground 12 Pa are a metre.
    """

    noise: float
    unsteady: float
    unsteady_tau: float
    bias: float
    drift: float
    drift_tau: float
    latency: float


def position_error(name: str, dynamic_percent: float, sideslip_percent: float, seed: int) -> Array:
    """What of `exposure` (2,) gets into a static pressure: draws of these sizes, the second for 10 deg of sideslip."""
    per_square = 1 / math.sin(10 * DEG) ** 2
    sizes = np.array([dynamic_percent, sideslip_percent * per_square]) * PERCENT
    return stream(seed, name, "static pressure").standard_normal(2) * sizes


def exposure(truth: TruthBlock, due: slice) -> Array:
    """Dynamic pressure, and that times the squared sine of sideslip (2, n) [Pa]."""
    q = 0.5 * truth.density[due] * truth.airspeed[due] ** 2
    return np.stack([q, q * np.sin(truth.beta[due]) ** 2])


class BarometerConfig(AidingTiming):
    """Keys of a barometer. ``grade`` sets the errors; each may be given to override it."""

    kind: Literal["barometer"] = Field(
        default="barometer", description="what the sensor is; the table's name where it is left out"
    )
    grade: Literal["perfect", "mems", "hobby"] = Field(
        default="mems", description="datasheet that presets every error below"
    )

    bias_pa: float = Field(
        0.0, ge=0, le=1e5, description="constant offset of the pressure; near the ground 12 Pa are a metre"
    )
    drift_pa: float = Field(0.0, ge=0, le=1e5, description="Gauss-Markov drift of the pressure")
    drift_time_s: float = Field(1800.0, gt=0, le=1e6, description="correlation time of the drift")
    noise_pa: float = Field(0.0, ge=0, le=1e5, description="white noise of the pressure")
    unsteady_pa: float = Field(0.0, ge=0, le=1e5, description="Gauss-Markov error of the airframe's wake")
    unsteady_time_s: float = Field(8.0, gt=0, le=1e4, description="correlation time of that")
    follow_s: float = Field(
        0.0, ge=0, le=3600, description="told to an INS: over which that error follows innovations; 0: it does not"
    )
    dynamic_percent: float = Field(
        0.0, ge=0, le=100, description="of dynamic pressure that gets into the static one, constant in a run"
    )
    sideslip_percent: float = Field(
        0.0, ge=0, le=100, description="what 10 deg of sideslip add to that; it grows with the square of the angle"
    )

    @model_validator(mode="before")
    @classmethod
    def _on_top_of_grade(cls, data: Any) -> Any:
        return with_grade(data, GRADES, "mems")

    def errors(self) -> BarometerErrors:
        """The same as a plain record."""
        return BarometerErrors(
            self.noise_pa, self.unsteady_pa, self.unsteady_time_s, self.bias_pa, self.drift_pa, self.drift_time_s,
            self.latency_s,
        )  # fmt: skip


class Barometer:
    """One barometer on one run: measured = pressure + (a + b sin(beta)^2) q + bias + drift + wake + noise.

    q = rho/2 V^2; a and b are drawn: the airframe has another pressure where it is taken (Gracey, NASA RP-1046).
    """

    def __init__(self, name: str, config: BarometerConfig, tick_rate_hz: float, seed: int) -> None:
        self.name = name
        self.rate_hz = config.rate_hz
        self.errors = e = config.errors()
        self._schedule = Schedule.of(name, config, tick_rate_hz)
        self._bias = stream(seed, name, "bias").standard_normal() * e.bias
        self._drift = Process.gauss_markov(stream(seed, name, "drift"), [e.drift], e.drift_tau, 1 / config.rate_hz)
        self._white = Process.white(stream(seed, name, "white"), [e.noise])
        self._unsteady = Process.gauss_markov(
            stream(seed, name, "unsteady"), [e.unsteady], e.unsteady_tau, 1 / config.rate_hz
        )
        self._position = position_error(name, config.dynamic_percent, config.sideslip_percent, seed)

    def sense(self, truth: TruthBlock) -> Sequence[Sample]:
        """The samples that fall inside this block."""
        rows = self._schedule.rows(truth)
        n = len(rows)
        if not n:
            return []
        error = self._bias + self._drift.take(n)[:, 0] + self._white.take(n)[:, 0]
        error += self._unsteady.take(n)[:, 0]
        due = slice(rows.start, None, rows.step)
        if self._position.any():
            error += self._position @ exposure(truth, due)
        pressure = truth.pressure[due] + error
        return delivered(BarometerSample, self.name, truth.t[due].copy(), self._schedule.latency, pressure=pressure)
