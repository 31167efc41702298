"""Range to the ground: a laser rangefinder or a radar altimeter that looks along the body's down axis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from pydantic import Field, model_validator

from nav.columns import delivered
from nav.samples import RangeSample, Sample
from testbed.motion.table import TruthBlock
from testbed.noise import Process, stream
from testbed.sensors.grades import with_grade
from testbed.sensors.sight import lines_of_sight
from testbed.sensors.site import Site
from testbed.sensors.timing import InterruptedTiming, Interruptions, Schedule
from testbed.sensors.units import PERCENT

GRADES: dict[str, dict[str, Any]] = {
    "perfect": {"max_range_m": 1e4},
    # LightWare LW20/C, data sheet: 0.2 to 100 m, +-10 cm, taken as three sigma of white noise.
    "laser": {"noise_m": 0.033, "min_range_m": 0.2, "max_range_m": 100.0, "rate_hz": 20.0},
    # Radar altimeters by RTCA DO-155: within 3 ft, above 500 ft within 5 %, up to 2500 ft; each taken as three sigma,
    # the share as a scale factor.
    "radar": {"noise_m": 0.3, "scale_percent": 1.7, "max_range_m": 760.0, "rate_hz": 10.0},
}


@dataclass(frozen=True, slots=True)
class RangefinderErrors:
    """The instrument's datasheet in SI, 1 sigma: white ``noise`` [m], constant ``scale`` [1], ``latency`` [s]."""

    noise: float
    scale: float
    latency: float


class RangefinderConfig(InterruptedTiming):
    """Keys of a rangefinder. ``grade`` sets errors and limits; each may be given to override it."""

    kind: Literal["rangefinder"] = Field(
        default="rangefinder", description="what the sensor is; the table's name where it is left out"
    )
    grade: Literal["perfect", "laser", "radar"] = Field(
        default="radar", description="datasheet that presets every error below"
    )

    noise_m: float = Field(0.0, ge=0, le=100, description="white noise")
    scale_percent: float = Field(0.0, ge=0, le=20, description="scale factor error, constant")
    min_range_m: float = Field(0.0, ge=0, le=1e4, description="nearer it measures nothing")
    max_range_m: float = Field(1000.0, gt=0, le=1e4, description="farther it measures nothing")

    @model_validator(mode="before")
    @classmethod
    def _on_top_of_grade(cls, data: Any) -> Any:
        return with_grade(data, GRADES, "radar")

    def errors(self) -> RangefinderErrors:
        """The same in SI."""
        return RangefinderErrors(self.noise_m, self.scale_percent * PERCENT, self.latency_s)


class Rangefinder:
    """One instrument on one run: (1 + scale) range + noise, from the centre of gravity; silent out of its limits."""

    def __init__(self, name: str, config: RangefinderConfig, tick_rate_hz: float, seed: int, site: Site) -> None:
        self.name = name
        self.rate_hz = config.rate_hz
        self.errors = e = config.errors()
        self._limits = config.min_range_m, config.max_range_m
        self._schedule = Schedule.of(name, config, tick_rate_hz)
        self._interruptions = Interruptions(name, config, seed)
        self._terrain, self._raised = site.ground(seed), site.raised(seed)
        self._scale = float(stream(seed, name, "scale").standard_normal()) * e.scale
        self._white = Process.white(stream(seed, name, "white"), [e.noise])

    def sense(self, truth: TruthBlock) -> Sequence[Sample]:
        """The samples that fall inside this block and come through."""
        rows = self._schedule.rows(truth)
        n = len(rows)
        if not n:
            return []
        due = slice(rows.start, None, rows.step)
        true = lines_of_sight(
            truth.lat[due], truth.lon[due], truth.h[due], truth.q_nb[due], self._raised, self._terrain
        )  # fmt: skip
        measured = (1.0 + self._scale) * true + self._white.take(n)[:, 0]
        with np.errstate(invalid="ignore"):
            kept = (measured >= self._limits[0]) & (measured <= self._limits[1])
        t = truth.t[due]
        kept &= self._interruptions.kept(t)
        return delivered(RangeSample, self.name, t[kept], self._schedule.latency, range=measured[kept])
