"""A wind report by radio: what a mast, a balloon or another aircraft measured of the wind some time ago."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from pydantic import Field, model_validator

from nav.samples import Array, WindSample
from testbed.motion.table import TruthBlock
from testbed.noise import Process, stream
from testbed.sensors.grades import with_grade
from testbed.sensors.timing import InterruptedTiming, Interruptions, Schedule

GRADES: dict[str, dict[str, Any]] = {
    "perfect": {"rate_hz": 1 / 60},
    # All assumed: the mean over two minutes, as at airfields, told every ten minutes, three later, from some kilometres
    # away, with errors of half of those that aircraft's own reports have (2 to 3 m/s as a vector).
    "nearby": {"noise_mps": 0.5, "local_mps": 0.8, "mean_s": 120.0, "delay_s": 180.0, "rate_hz": 1 / 600},
}


@dataclass(frozen=True, slots=True)
class WindReportErrors:
    """The report's datasheet in SI, 1 sigma per axis: white ``noise`` and Gauss-Markov ``local`` with ``tau``
    [m/s, s]; ``age`` of the wind when it is reported, ``latency`` of the radio [s].
    """

    noise: float
    local: float
    tau: float
    age: float
    latency: float


class WindReportConfig(InterruptedTiming):
    """Keys of a wind report. ``grade`` sets errors and times; each may be given to override it."""

    kind: Literal["wind_report"] = Field(
        default="wind_report", description="what the sensor is; the table's name where it is left out"
    )
    grade: Literal["perfect", "nearby"] = Field(
        default="nearby", description="datasheet that presets every error below"
    )

    noise_mps: float = Field(0.0, ge=0, le=50, description="white error per axis")
    local_mps: float = Field(
        0.0, ge=0, le=50, description="by how much the wind is another where it was measured, Gauss-Markov, per axis"
    )
    local_time_s: float = Field(3600.0, gt=0, le=1e6, description="correlation time of that")
    mean_s: float = Field(0.0, ge=0, le=3600, description="over which the wind was averaged; 0: the wind of a moment")
    delay_s: float = Field(0.0, ge=0, le=86_400, description="from the end of that to the report")

    @model_validator(mode="before")
    @classmethod
    def _on_top_of_grade(cls, data: Any) -> Any:
        return with_grade(data, GRADES, "nearby")

    def errors(self) -> WindReportErrors:
        """The same in SI."""
        age = self.delay_s + 0.5 * self.mean_s
        return WindReportErrors(self.noise_mps, self.local_mps, self.local_time_s, age, self.latency_s)


class WindReport:
    """Reports on one run: mean of the air's velocity, north and east, gusts among it, plus white and Markov errors.

    What is averaged are values a second apart. It ends ``delay_s`` before the report, or at the start of the run, and
    begins ``mean_s`` before that, or at the start. The age is that of its middle.
    """

    def __init__(self, name: str, config: WindReportConfig, tick_rate_hz: float, seed: int) -> None:
        self.name = name
        self.rate_hz = config.rate_hz
        self.errors = e = config.errors()
        self._mean_s, self._delay_s = config.mean_s, config.delay_s
        self._schedule = Schedule.of(name, config, tick_rate_hz)
        self._every = max(1, round(min(1.0, 1 / config.rate_hz) * tick_rate_hz))
        self._step_s = self._every / tick_rate_hz
        self._interruptions = Interruptions(name, config, seed)
        self._white = Process.white(stream(seed, name, "white"), np.full(2, e.noise))
        self._local = Process.gauss_markov(stream(seed, name, "local"), np.full(2, e.local), e.tau, 1 / config.rate_hz)
        self._winds: list[Array] = []  # each (2,) [m/s], a step apart, from the start of the run

    def sense(self, truth: TruthBlock) -> list[WindSample]:
        """The reports that fall inside this block and come through."""
        first = -truth.tick % self._every
        self._winds += list(truth.wind_n[first :: self._every, :2].copy())
        samples = []
        for k in self._schedule.rows(truth):
            error = self._white.take(1)[0] + self._local.take(1)[0]
            t = float(truth.t[k])
            if self._interruptions.kept(truth.t[k : k + 1])[0]:
                begin, end = (max(0, round((t - self._delay_s - back) / self._step_s)) for back in (self._mean_s, 0.0))
                mean = np.sum(self._winds[begin : end + 1], axis=0) / (end + 1 - begin)
                age = t - 0.5 * (begin + end) * self._step_s
                samples.append(
                    WindSample(t, t + self._schedule.latency, mean + error, age, self.errors.noise, self.name)
                )
        return samples
