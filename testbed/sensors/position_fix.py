"""Position fixes other than GNSS: an acoustic transponder heard within its range, terrain matching."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from pydantic import Field, model_validator

from nav.earth import ecef_from_geodetic
from nav.samples import Array, PositionSample
from testbed.motion.table import TruthBlock
from testbed.noise import Process, stream
from testbed.schema import Section
from testbed.sensors.gnss import displaced
from testbed.sensors.grades import with_grade
from testbed.sensors.timing import InterruptedTiming, Interruptions, Schedule
from testbed.sensors.units import DEG

GRADES: dict[str, dict[str, Any]] = {
    "perfect": {},
    # Zhu et al. 2020: every 10 s a random error of amplitude 20 m, taken as uniform along north and east; no height.
    "transponder": {"distribution": "uniform", "horizontal_m": 20.0, "height": False, "rate_hz": 0.1},
    # Cui et al. 2022, table 1: "positioning accuracy" 30 m, not said whose: taken for their terrain aid, Gaussian
    # along each axis; once in a second as their other aids.
    "terrain": {"horizontal_m": 30.0, "vertical_m": 30.0, "rate_hz": 1.0},
}


class Transponder(Section):
    """Where the transponder is and how far it is heard, as the crow flies."""

    lat_deg: float = Field(ge=-90, le=90, description="geodetic latitude, WGS84")
    lon_deg: float = Field(ge=-180, le=180, description="longitude, east positive")
    alt_m: float = Field(0.0, ge=-12_000, le=10_000, description="height above the ellipsoid")
    range_m: float = Field(gt=0, le=1e6, description="distance up to which it is heard, as the crow flies")


@dataclass(frozen=True, slots=True)
class PositionFixErrors:
    """The instrument's datasheet in SI: ``position_n`` (3,) white, standard deviation along north, east, down [m];
    whether it measures ``height``; ``latency`` [s].
    """

    position_n: Array
    height: bool
    latency: float


class PositionFixConfig(InterruptedTiming):
    """Keys of a position fix. ``grade`` sets errors and rate; each may be given to override it."""

    kind: Literal["position_fix"] = Field(
        default="position_fix", description="what the sensor is; the table's name where it is left out"
    )
    grade: Literal["perfect", "transponder", "terrain"] = Field(
        default="transponder", description="datasheet that presets every error below"
    )
    rate_hz: float = Field(1.0, gt=0, le=10_000, description="samples per second; divides the tick rate")

    distribution: Literal["gaussian", "uniform"] = Field("gaussian", description="of the errors")
    horizontal_m: float = Field(
        0.0, ge=0, le=1e4, description="error north and east each: 1 sigma, or the amplitude when uniform"
    )
    vertical_m: float = Field(0.0, ge=0, le=1e4, description="the same of height")
    height: bool = Field(True, description="whether height is measured")
    transponder: Transponder | None = Field(
        None, description="out of whose range there is no fix; none: fixes everywhere"
    )

    @model_validator(mode="before")
    @classmethod
    def _on_top_of_grade(cls, data: Any) -> Any:
        return with_grade(data, GRADES, "transponder")

    def errors(self) -> PositionFixErrors:
        """The same in SI; the standard deviation of a uniform error is its amplitude over sqrt(3)."""
        spread = 1 / math.sqrt(3) if self.distribution == "uniform" else 1.0
        size = np.array([self.horizontal_m, self.horizontal_m, self.vertical_m])
        return PositionFixErrors(spread * size, self.height, self.latency_s)


class PositionFix:
    """One instrument on one run: position of the centre of gravity plus error, where and while it can be had."""

    def __init__(self, name: str, config: PositionFixConfig, tick_rate_hz: float, seed: int) -> None:
        self.name = name
        self.rate_hz = config.rate_hz
        self.errors = config.errors()
        self._config = config
        self._schedule = Schedule.of(name, config, tick_rate_hz)
        self._interruptions = Interruptions(name, config, seed)
        self._size = np.array([config.horizontal_m, config.horizontal_m, config.vertical_m])
        self._white = Process.white(stream(seed, name, "white"), np.ones(3))
        heard = config.transponder
        self._centre_e = ecef_from_geodetic(heard.lat_deg * DEG, heard.lon_deg * DEG, heard.alt_m) if heard else None
        self._range = heard.range_m if heard else math.inf

    def sense(self, truth: TruthBlock) -> list[PositionSample]:
        """The fixes that fall inside this block and come through."""
        rows = self._schedule.rows(truth)
        n = len(rows)
        if not n:
            return []
        errors = self._white.take(n)
        if self._config.distribution == "uniform":
            errors = np.array([[math.erf(z / math.sqrt(2)) for z in row] for row in errors.tolist()])  # 2 Phi(z) - 1
        errors = errors * self._size
        kept = self._interruptions.kept(truth.t[rows.start :: rows.step])
        return [
            self._sample(truth, k, errors[i]) for i, k in enumerate(rows) if kept[i] and self._is_in_range(truth, k)
        ]

    def _sample(self, truth: TruthBlock, k: int, error_n: Array) -> PositionSample:
        t = float(truth.t[k])
        lat, lon, h = displaced(truth.lat[k], truth.lon[k], truth.h[k], error_n)
        return PositionSample(t, t + self._schedule.latency, lat, lon, h if self.errors.height else math.nan, self.name)

    def _is_in_range(self, truth: TruthBlock, k: int) -> bool:
        if self._centre_e is None:
            return True
        here_e = ecef_from_geodetic(truth.lat[k], truth.lon[k], truth.h[k])
        return math.dist(here_e, self._centre_e) <= self._range
