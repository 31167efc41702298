"""Optical flow: how the image of a camera that looks along the body's down axis moves, from frame to frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from pydantic import Field, model_validator

from nav._jit import njit
from nav.earth import earth_rate_n
from nav.rotation import dcm_from_quat
from nav.samples import Array, OpticalFlowSample
from testbed.motion.table import TruthBlock
from testbed.noise import Process, stream
from testbed.sensors.grades import with_grade
from testbed.sensors.sight import lines_of_sight
from testbed.sensors.site import Site
from testbed.sensors.timing import InterruptedTiming, Interruptions, Schedule
from testbed.sensors.units import DEG_PER_H, PERCENT

LEAST_QUALITY = 0.1  # below it a match is no match
WRONG_RADPS = 0.1  # 1 sigma per axis: how far off a wrong match is

GRADES: dict[str, dict[str, Any]] = {
    "perfect": {"max_range_m": 1e5, "max_rate_radps": 1e3},
    # A camera of 640 pixels over 60 deg, 1.6 mrad each: a tenth of a pixel from frame to frame in 0.1 s, which tracking
    # of corners reaches. Scale from the calibration of its lens, half a percent, and the gyro of a consumer's module:
    # assumed. Texture of fields is lost some 1000 m away.
    "camera": {
        "noise_radps": 0.0016,
        "scale_percent": 0.5,
        "bias_degph": 20.0,
        "max_range_m": 1000.0,
        "max_rate_radps": 2.0,
        "outlier_percent": 1.0,
        "rate_hz": 10.0,
    },
    # PixArt PMW3901MB, data sheet: 35 pixels over 42 deg, 21 mrad each, up to 7.4 rad/s, from 8 cm on. A tenth of a
    # pixel, the range, scale and gyro are assumed.
    "pmw3901": {
        "noise_radps": 0.02,
        "scale_percent": 2.0,
        "bias_degph": 40.0,
        "max_range_m": 30.0,
        "max_rate_radps": 7.4,
        "outlier_percent": 2.0,
        "rate_hz": 20.0,
    },
}


@dataclass(frozen=True, slots=True)
class OpticalFlowErrors:
    """The instrument's datasheet in SI, 1 sigma per axis: white ``noise`` at full quality and Gauss-Markov ``bias``,
    that of its gyro, with ``tau`` [rad/s, s]; constant ``scale`` of the optics [1]; ``latency`` [s].
    """

    noise: float
    scale: float
    bias: float
    tau: float
    latency: float


class OpticalFlowConfig(InterruptedTiming):
    """Keys of an optical flow sensor. ``grade`` sets errors and limits; each may be given to override it.

    What it sees in darkness or over water is nothing: ``denied``.
    """

    kind: Literal["optical_flow"] = Field(
        default="optical_flow", description="what the sensor is; the table's name where it is left out"
    )
    grade: Literal["perfect", "camera", "pmw3901"] = Field(
        default="camera", description="datasheet that presets every error below"
    )

    noise_radps: float = Field(0.0, ge=0, le=10, description="white noise per axis at full quality")
    scale_percent: float = Field(0.0, ge=0, le=20, description="scale factor error of the optics, constant")
    bias_degph: float = Field(0.0, ge=0, le=1e5, description="bias of its own gyro, Gauss-Markov")
    bias_time_s: float = Field(600.0, gt=0, le=1e6, description="correlation time of that")
    outlier_percent: float = Field(
        0.0, ge=0, lt=50, description="of the samples that are a wrong match, off by 0.1 rad/s, 1 sigma per axis"
    )
    max_range_m: float = Field(1000.0, gt=0, le=1e5, description="where texture is lost: quality falls with its square")
    max_rate_radps: float = Field(2.0, gt=0, le=1e3, description="of the image, where it smears: the same")

    @model_validator(mode="before")
    @classmethod
    def _on_top_of_grade(cls, data: Any) -> Any:
        return with_grade(data, GRADES, "camera")

    @property
    def age_s(self) -> float:
        """The largest age of a sample when it arrives [s]: it is of the middle of what was seen."""
        return self.latency_s + 0.5 / self.rate_hz

    def errors(self) -> OpticalFlowErrors:
        """The same in SI."""
        bias = self.bias_degph * DEG_PER_H
        return OpticalFlowErrors(self.noise_radps, self.scale_percent * PERCENT, bias, self.bias_time_s, self.latency_s)


class OpticalFlow:
    """One instrument on one run: means over the ticks since the sample before, valid in the middle of them.

    Of a camera that turns with the body at w relative to the ground, at the range r from it,

        flow = (1 + scale) (w_x - v_y / r, w_y + v_x / r) + noise / sqrt(quality) + outlier
        quality = (1 - (r / max_range)^2) (1 - (|flow| / max_rate)^2)

    and its own gyro feels w + C_nb' w_ie + bias. The signs are those of MAVLink's OPTICAL_FLOW_RAD. Without ground in
    sight, or below a quality of 0.1, there is no sample.
    """

    def __init__(self, name: str, config: OpticalFlowConfig, tick_rate_hz: float, seed: int, site: Site) -> None:
        self.name = name
        self.rate_hz = config.rate_hz
        self.errors = e = config.errors()
        self._max_range, self._max_rate = config.max_range_m, config.max_rate_radps
        self._wrong_share = config.outlier_percent * PERCENT
        self._schedule = Schedule.of(name, config, tick_rate_hz)
        self._middle_s = 0.5 * (self._schedule.every - 1) / tick_rate_hz
        self._interruptions = Interruptions(name, config, seed)
        self._terrain, self._raised = site.ground(seed), site.raised(seed)
        self._scale = float(stream(seed, name, "scale").standard_normal()) * e.scale
        self._white = Process.white(stream(seed, name, "white"), np.full(2, e.noise))
        self._bias = Process.gauss_markov(stream(seed, name, "bias"), np.full(2, e.bias), e.tau, 1 / config.rate_hz)
        self._luck = stream(seed, name, "outliers")
        self._seen = np.empty((0, 4))  # flow and rotation of the ticks since the last sample

    def sense(self, truth: TruthBlock) -> list[OpticalFlowSample]:
        """The samples that fall inside this block and come through."""
        r = lines_of_sight(truth.lat, truth.lon, truth.h, truth.q_nb, self._raised, self._terrain)
        flow, rotation = _motion(np.ascontiguousarray(truth.q_nb), truth.v_n, truth.omega_b, truth.lat, r)
        seen = np.concatenate([self._seen, np.hstack([flow, rotation])])
        rows, every = self._schedule.rows(truth), self._schedule.every
        before = len(self._seen)
        self._seen = seen[(before + rows[-1] + 1 if len(rows) else 0) :][-every:]
        samples = []
        for k in rows:
            white, bias = self._white.take(1)[0], self._bias.take(1)[0]
            odd = self._luck.random() < self._wrong_share
            wrong = self._luck.standard_normal(2) * WRONG_RADPS
            kept = self._interruptions.kept(truth.t[k : k + 1])[0]
            if before + k + 1 < every or not kept:
                continue
            mean = _mean(seen[before + k + 1 - every : before + k + 1])
            quality = (1.0 - (r[k] / self._max_range) ** 2) * (1.0 - float(mean[:2] @ mean[:2]) / self._max_rate**2)
            if not (quality >= LEAST_QUALITY and r[k] < self._max_range):
                continue
            moved = (1.0 + self._scale) * mean[:2] + white / np.sqrt(quality) + (wrong if odd else 0.0)
            t = float(truth.t[k])
            samples.append(
                OpticalFlowSample(
                    t - self._middle_s, t + self._schedule.latency, moved, mean[2:] + bias, float(quality), self.name
                )
            )
        return samples


@njit
def _motion(q_nb: Array, v_n: Array, omega_b: Array, lat: Array, r: Array) -> tuple[Array, Array]:
    """Flow at full scale and rotation relative to inertial space, about body x and y (n, 2) [rad/s]."""
    flow, rotation = np.empty((len(r), 2)), np.empty((len(r), 2))
    for k in range(len(r)):
        C_nb, earth_n = dcm_from_quat(q_nb[k]), earth_rate_n(lat[k])
        ahead, right = 0.0, 0.0
        for i in range(3):
            ahead += C_nb[i, 0] * v_n[k, i]
            right += C_nb[i, 1] * v_n[k, i]
        for axis in range(2):
            turning = omega_b[k, axis]
            for i in range(3):
                turning -= C_nb[i, axis] * earth_n[i]
            flow[k, axis] = turning + (-right if axis == 0 else ahead) / r[k]
            rotation[k, axis] = omega_b[k, axis]
    return flow, rotation


@njit
def _mean(rows: Array) -> Array:
    """The mean (4,) of the rows, summed in order: it can't depend on how a run is cut into blocks."""
    total = np.zeros(rows.shape[1])
    for row in rows:
        total += row
    return total / len(rows)
