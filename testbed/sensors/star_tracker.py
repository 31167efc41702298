"""Star tracker: attitude against the stars."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from pydantic import Field, model_validator

from nav.earth import quat_en, quat_ie
from nav.rotation import quat_from_rotvec, quat_multiply
from nav.samples import Array, StarSample
from testbed.motion.table import TruthBlock
from testbed.noise import Process, stream
from testbed.sensors.grades import with_grade
from testbed.sensors.timing import InterruptedTiming, Interruptions, Schedule
from testbed.sensors.units import ARCSEC

GRADES: dict[str, dict[str, Any]] = {
    "perfect": {},
    # Cui et al. 2022, table 1: 5", 5", 15" at 1 Hz. The order of its axes is not said; a tracker is poor about its
    # boresight.
    "standard": {"across_arcsec": 5.0, "boresight_arcsec": 15.0},
}


@dataclass(frozen=True, slots=True)
class StarTrackerErrors:
    """The tracker's datasheet in SI: ``noise_b`` (3,) white, 1 sigma about each body axis [rad]; ``latency`` [s]."""

    noise_b: Array
    latency: float


class StarTrackerConfig(InterruptedTiming):
    """Keys of a star tracker. ``grade`` sets the errors; each may be given to override it."""

    kind: Literal["star_tracker"] = Field(
        default="star_tracker", description="what the sensor is; the table's name where it is left out"
    )
    grade: Literal["perfect", "standard"] = Field(
        default="standard", description="datasheet that presets every error below"
    )
    rate_hz: float = Field(1.0, gt=0, le=10_000, description="samples per second; divides the tick rate")

    boresight: Literal["forward", "right", "down"] = Field("down", description="the body axis that it looks along")
    across_arcsec: float = Field(
        0.0, ge=0, le=36_000, description="white noise about the two axes across the boresight"
    )
    boresight_arcsec: float = Field(0.0, ge=0, le=36_000, description="white noise about the boresight, the poor one")

    @model_validator(mode="before")
    @classmethod
    def _on_top_of_grade(cls, data: Any) -> Any:
        return with_grade(data, GRADES, "standard")

    def errors(self) -> StarTrackerErrors:
        """The same in SI."""
        noise_b = np.full(3, self.across_arcsec * ARCSEC)
        noise_b[("forward", "right", "down").index(self.boresight)] = self.boresight_arcsec * ARCSEC
        return StarTrackerErrors(noise_b, self.latency_s)


class StarTracker:
    """One tracker on one run: C_ib = C_ie(t) C_en C_nb exp([noise_b x])."""

    def __init__(self, name: str, config: StarTrackerConfig, tick_rate_hz: float, seed: int) -> None:
        self.name = name
        self.rate_hz = config.rate_hz
        self.errors = config.errors()
        self._schedule = Schedule.of(name, config, tick_rate_hz)
        self._interruptions = Interruptions(name, config, seed)
        self._white = Process.white(stream(seed, name, "white"), self.errors.noise_b)

    def sense(self, truth: TruthBlock) -> list[StarSample]:
        """The samples that fall inside this block and come through."""
        rows = self._schedule.rows(truth)
        n = len(rows)
        if not n:
            return []
        noise_b = self._white.take(n)
        kept = self._interruptions.kept(truth.t[rows.start :: rows.step])
        return [self._sample(truth, k, noise_b[i]) for i, k in enumerate(rows) if kept[i]]

    def _sample(self, truth: TruthBlock, k: int, noise_b: Array) -> StarSample:
        t = float(truth.t[k])
        q_eb = quat_multiply(quat_en(truth.lat[k], truth.lon[k]), truth.q_nb[k])
        q_ib = quat_multiply(quat_multiply(quat_ie(t), q_eb), quat_from_rotvec(noise_b))
        return StarSample(t, t + self._schedule.latency, q_ib, self.name)
