"""Airspeed: a pitot tube along body x and a differential pressure transducer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from pydantic import Field, model_validator

from nav.columns import delivered
from nav.earth import SEA_LEVEL_DENSITY
from nav.samples import AirspeedSample, Sample
from testbed.motion.table import FLYING_MPS, TruthBlock
from testbed.noise import Process, stream
from testbed.sensors.barometer import exposure, position_error
from testbed.sensors.grades import with_grade
from testbed.sensors.timing import AidingTiming, Schedule
from testbed.sensors.units import PERCENT

BLOWN_S = 3.0  # for which gusts and the propeller's wake blow alike on the ground, as measured in a recording
REFERENCE_EAS = 25.0  # [m/s], where `AirspeedErrors` turns pressure into speed

GRADES: dict[str, dict[str, Any]] = {
    "perfect": {},
    # TE MS4525DO, +-1 psi, 14 bit: 1.05 Pa per count, accuracy 0.25 % of span (17 Pa) before the zero taken on the
    # ground. What is left after that zero, and the calibration of the tube on the airframe, assumed.
    "mems": {"scale_percent": 1.0, "bias_pa": 3.0, "noise_pa": 2.0},
    # The same kind of part on a hobby airframe, its tube not calibrated and in the propeller's wake: assumed, at the
    # size that innovations on recorded flights have, alike from 8 to 20 m/s, nine tenths of which are the same after
    # 0.1 s; in sideslip the static port is off as the barometer is. On the ground 5 to 18 Pa are blown into the tubes
    # of two recorded aeroplanes, alike for some 3 s.
    # Near the ground the wind itself walks by 2 m/s in minutes, and gusts turn these small aircraft sideways by degrees
    # for seconds: 1.8 m/s against a constant wind, so that no sideslip is no constraint.
    "hobby": {
        "scale_percent": 5.0,
        "bias_pa": 15.0,
        "noise_pa": 3.0,
        "unsteady_pa": 9.5,
        "unsteady_time_s": 2.0,
        "sideslip_percent": 10.0,
        "blown_pa": 15.0,
        "wind_walk_mps_per_sqrt_s": 0.1,
        "gust_mps": 1.5,
        "gust_time_s": 3.0,
        "slips": True,
        "slowest_mps": 5.0,
        "fused_hz": 10.0,
    },
}


@dataclass(frozen=True, slots=True)
class AirspeedErrors:
    """The sensor's datasheet in SI, 1 sigma, as errors of speed: ``scale`` [1]; ``bias``, ``noise`` [m/s] at
    `REFERENCE_EAS`, from where they grow as 1/EAS; ``unsteady`` [m/s] at any airspeed; ``latency`` [s].
    """

    scale: float
    bias: float
    noise: float
    unsteady: float
    latency: float


class AirspeedConfig(AidingTiming):
    """Keys of an airspeed sensor. ``grade`` sets the errors; each may be given to override it."""

    kind: Literal["airspeed"] = Field(
        default="airspeed", description="what the sensor is; the table's name where it is left out"
    )
    grade: Literal["perfect", "mems", "hobby"] = Field(
        default="mems", description="datasheet that presets every error below"
    )

    scale_percent: float = Field(0.0, ge=0, le=50, description="of dynamic pressure: half of it in speed")
    bias_pa: float = Field(0.0, ge=0, le=1e4, description="constant offset of the differential pressure")
    noise_pa: float = Field(0.0, ge=0, le=1e4, description="white noise of the differential pressure")
    unsteady_pa: float = Field(
        0.0,
        ge=0,
        le=1e4,
        description="Gauss-Markov error of the airframe's wake at 25 m/s, from where it grows as EAS; "
        "told to filters as white noise",
    )
    unsteady_time_s: float = Field(1.0, gt=0, le=1e4, description="correlation time of that")
    sideslip_percent: float = Field(
        0.0, ge=0, le=100, description="of dynamic pressure that 10 deg of sideslip take or add at the static port"
    )
    blown_pa: float = Field(
        0.0, ge=0, le=1e4, description="what wind and propeller blow into the tube of a vehicle that stands or taxies"
    )

    wind_walk_mps_per_sqrt_s: float = Field(
        0.0, ge=0, le=10, description="told to filters: how the mean wind walks, at least"
    )
    gust_mps: float = Field(0.0, ge=0, le=50, description="told to filters: gusts, per axis, at least")
    gust_time_s: float | None = Field(
        None, gt=0, le=1e3, description="told to filters: how long a gust lasts; none: as long as the aircraft is in it"
    )
    slips: bool = Field(False, description="told to filters: it slips, so that no sideslip is no constraint")

    slowest_mps: float = Field(
        10.0, gt=0, le=10, description="told to filters: equivalent airspeed below which it says nothing"
    )

    @model_validator(mode="before")
    @classmethod
    def _on_top_of_grade(cls, data: Any) -> Any:
        return with_grade(data, GRADES, "mems")

    def errors(self) -> AirspeedErrors:
        """The same in SI, linearised: d(EAS) = dq / (rho0 EAS)."""
        per_pascal = 1 / (SEA_LEVEL_DENSITY * REFERENCE_EAS)
        return AirspeedErrors(
            self.scale_percent * PERCENT / 2, self.bias_pa * per_pascal, self.noise_pa * per_pascal,
            self.unsteady_pa * per_pascal, self.latency_s,
        )  # fmt: skip


class Airspeed:
    """One pitot on one run: q = rho/2 (V cos(alpha) cos(beta))^2, measured q' = (1 + scale) q + bias + noise + wake,
    EAS = sqrt(2 q'/rho0), zero when q' is negative. The wake is the same error of speed at any airspeed, as innovations
    on recorded flights are, so one of pressure that grows as EAS. The static port's error in sideslip is that of a
    barometer (`testbed.sensors.barometer`), with the other sign; what is blown into a standing tube is the size of a
    Gauss-Markov process of `BLOWN_S`.
    """

    def __init__(self, name: str, config: AirspeedConfig, tick_rate_hz: float, seed: int) -> None:
        self.name = name
        self.rate_hz = config.rate_hz
        self.errors = config.errors()
        self._schedule = Schedule.of(name, config, tick_rate_hz)
        self._scale = stream(seed, name, "scale").standard_normal() * config.scale_percent * PERCENT
        self._bias = stream(seed, name, "bias").standard_normal() * config.bias_pa
        self._white = Process.white(stream(seed, name, "white"), [config.noise_pa])
        self._unsteady = Process.gauss_markov(
            stream(seed, name, "unsteady"), [config.unsteady_pa], config.unsteady_time_s, 1 / config.rate_hz
        )
        self._position = position_error(name, 0.0, config.sideslip_percent, seed)
        self._blown = Process.gauss_markov(stream(seed, name, "blown"), [config.blown_pa], BLOWN_S, 1 / config.rate_hz)

    def sense(self, truth: TruthBlock) -> Sequence[Sample]:
        """The samples that fall inside this block."""
        rows = self._schedule.rows(truth)
        n = len(rows)
        if not n:
            return []
        due = slice(rows.start, None, rows.step)
        along = np.maximum(truth.airspeed[due] * np.cos(truth.alpha[due]) * np.cos(truth.beta[due]), 0.0)
        q = 0.5 * truth.density[due] * along**2
        wake = self._unsteady.take(n)[:, 0] * np.sqrt(2 * q / SEA_LEVEL_DENSITY) / REFERENCE_EAS
        q = (1 + self._scale) * q + self._bias + self._white.take(n)[:, 0] + wake
        if self._position.any():
            q -= self._position @ exposure(truth, due)
        standing = (truth.airspeed[due] < FLYING_MPS) & (np.linalg.norm(truth.v_n[due], axis=1) < FLYING_MPS)
        q += np.where(standing, np.abs(self._blown.take(n)[:, 0]), 0.0)
        eas = np.sqrt(2 * np.maximum(q, 0.0) / SEA_LEVEL_DENSITY)
        return delivered(AirspeedSample, self.name, truth.t[due].copy(), self._schedule.latency, eas=eas)
