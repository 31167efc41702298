"""Velocity over ground in body axes: Doppler radar, Doppler log of a ship, odometer of a car."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np
from pydantic import Field, field_validator, model_validator

from nav.columns import delivered
from nav.samples import Array, BodyVelocitySample, Sample
from testbed.motion.table import TruthBlock
from testbed.noise import Process, stream
from testbed.sensors.grades import with_grade
from testbed.sensors.timing import InterruptedTiming, Interruptions, Schedule
from testbed.sensors.units import PERCENT

Axis: TypeAlias = Literal["forward", "right", "down"]
AXES: tuple[Axis, ...] = ("forward", "right", "down")

GRADES: dict[str, dict[str, Any]] = {
    "perfect": {},
    # Zhou et al. 2025, table 1: forward speed 0.3 m/s at 50 Hz, taken as white.
    "odometer": {"noise_mps": 0.3, "axes": ("forward",), "rate_hz": 50.0},
    # Zhu et al. 2020, a 300 kHz log: 0.5 % V +- 0.5 cm/s at 1 Hz, taken as 1 sigma of a scale factor for each axis and
    # of white noise.
    "dvl": {"noise_mps": 0.005, "scale_percent": 0.5, "rate_hz": 1.0},
    # Cui et al. 2022 model a Markov terrain error and a constant scale factor at 1 Hz, without figures; these, of an
    # airborne Doppler radar, are assumed.
    "doppler": {
        "noise_mps": 0.1,
        "correlated_mps": 0.05,
        "correlation_time_s": 300.0,
        "scale_percent": 0.1,
        "rate_hz": 1.0,
    },
}


@dataclass(frozen=True, slots=True)
class BodyVelocityErrors:
    """The instrument's datasheet in SI, 1 sigma on each measured axis: what an estimator may be told.

    ``axes`` indices of the measured body axes, ascending; ``noise`` white and ``correlated`` Gauss-Markov [m/s] with
    ``tau`` [s]; ``scale`` [1]; ``latency`` [s].
    """

    axes: tuple[int, ...]
    noise: float
    correlated: float
    tau: float
    scale: float
    latency: float


class BodyVelocityConfig(InterruptedTiming):
    """Keys of a body velocity sensor. ``grade`` sets errors, axes and rate; each may be given to override it."""

    kind: Literal["body_velocity"] = Field(
        default="body_velocity", description="what the sensor is; the table's name where it is left out"
    )
    grade: Literal["perfect", "odometer", "dvl", "doppler"] = Field(
        default="doppler", description="datasheet that presets every error below"
    )
    rate_hz: float = Field(1.0, gt=0, le=10_000, description="samples per second; divides the tick rate")

    axes: tuple[Axis, ...] = Field(AXES, description="body axes that are measured")
    noise_mps: float = Field(0.0, ge=0, le=100, description="white noise per axis")
    correlated_mps: float = Field(0.0, ge=0, le=100, description="Gauss-Markov error per axis")
    correlation_time_s: float = Field(300.0, gt=0, le=1e6, description="of the Gauss-Markov error")
    scale_percent: float = Field(0.0, ge=0, le=50, description="scale factor error per axis, constant")

    @model_validator(mode="before")
    @classmethod
    def _on_top_of_grade(cls, data: Any) -> Any:
        return with_grade(data, GRADES, "doppler")

    @field_validator("axes")
    @classmethod
    def _each_once(cls, axes: tuple[Axis, ...]) -> tuple[Axis, ...]:
        if not axes or len(set(axes)) < len(axes):
            raise ValueError("must name each measured axis once: one or more of forward, right, down")
        return axes

    def errors(self) -> BodyVelocityErrors:
        """The same in SI."""
        return BodyVelocityErrors(
            tuple(sorted(AXES.index(axis) for axis in self.axes)),
            self.noise_mps,
            self.correlated_mps,
            self.correlation_time_s,
            self.scale_percent * PERCENT,
            self.latency_s,
        )


class BodyVelocity:
    """One instrument on one run: (1 + scale) C_nb' v + correlated + white on each measured axis, at the centre of
    gravity. Cui et al. 2022, equations 50-52.
    """

    def __init__(self, name: str, config: BodyVelocityConfig, tick_rate_hz: float, seed: int) -> None:
        self.name = name
        self.rate_hz = config.rate_hz
        self.errors = e = config.errors()
        self._schedule = Schedule.of(name, config, tick_rate_hz)
        self._interruptions = Interruptions(name, config, seed)
        self._scale = stream(seed, name, "scale").standard_normal(3) * e.scale
        self._correlated = Process.gauss_markov(
            stream(seed, name, "correlated"), np.full(3, e.correlated), e.tau, 1 / config.rate_hz
        )
        self._white = Process.white(stream(seed, name, "white"), np.full(3, e.noise))
        self._unmeasured = [axis for axis in range(3) if axis not in e.axes]

    def sense(self, truth: TruthBlock) -> Sequence[Sample]:
        """The samples that fall inside this block and come through."""
        rows = self._schedule.rows(truth)
        n = len(rows)
        if not n:
            return []
        due = slice(rows.start, None, rows.step)
        v_b = _in_body_axes(truth.q_nb[due], truth.v_n[due])
        v_b += v_b * self._scale + self._correlated.take(n) + self._white.take(n)
        v_b[:, self._unmeasured] = np.nan
        t = truth.t[due]
        kept = self._interruptions.kept(t)
        return delivered(BodyVelocitySample, self.name, t[kept], self._schedule.latency, v_b=v_b[kept])


def _in_body_axes(q_nb: Array, v_n: Array) -> Array:
    """C_nb' v of each row (n, 3)."""
    w, axis = q_nb[:, :1], -q_nb[:, 1:]
    turn = 2 * np.cross(axis, v_n)
    v_b: Array = v_n + w * turn + np.cross(axis, turn)
    return v_b
