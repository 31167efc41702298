"""The run at one row, as messages see it: truth, estimates, samples, and what follows from them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias, TypeVar, cast

import numpy as np

from nav.earth import displacement_n
from nav.rotation import euler_from_quat, quat_conjugate, quat_multiply, rotvec_from_quat
from nav.samples import (
    AirspeedSample,
    Array,
    BarometerSample,
    Estimate,
    GnssSample,
    MagnetometerSample,
    PositionSample,
    Sample,
    Status,
)
from testbed.mavlink.encode import boot_ms, microseconds
from testbed.mavlink.identity import Identity
from testbed.motion.table import FLYING_MPS, TruthBlock

S = TypeVar("S", GnssSample, BarometerSample, MagnetometerSample, AirspeedSample)
_KINDS = (GnssSample, BarometerSample, MagnetometerSample, AirspeedSample, PositionSample)
Point: TypeAlias = tuple[float, float, float]

# Blocks of an estimate's covariance.
POSITION, VELOCITY, ATTITUDE = slice(0, 3), slice(3, 6), slice(6, 9)
DOWN, HEADING = slice(2, 3), slice(8, 9)


@dataclass
class Snapshot:
    """One instant of a run, in the numbers that several messages share; worked out when first asked for.

    ``gyro`` [rad/s] and ``accel`` [m/s^2] are the newest inertial reading; ``home`` (lat, lon, h) the origin of local
    coordinates, None until the estimator is aligned; ``start_us`` the run's start in microseconds since 1970;
    ``ratios`` the newest innovation over its gate, by aid; ``legs`` how many the plan has; ``silent_s`` after how long
    a sensor that says nothing counts as failed; ``isolated`` and ``refused`` are sensors that the estimator has shut
    out, or whose samples it has long refused.
    """

    truth: TruthBlock
    estimate: Estimate
    samples: Mapping[str, Sample]
    gyro: Array
    accel: Array
    others: Sequence[tuple[str, Estimate]]
    home: Point | None
    start_us: int
    ratios: Mapping[str, float]
    identity: Identity
    legs: int
    silent_s: Mapping[str, float]
    isolated: frozenset[str]
    refused: frozenset[str]

    def __post_init__(self) -> None:
        """What every call needs: time [s, ms, us], what goes out most often, and what health depends on."""
        self.t = float(self.truth.t[0])
        self.boot_ms = boot_ms(self.t)
        self.usec = microseconds(self.t)
        self.aligned = Status.ALIGNED in self.estimate.status
        # Estimated roll, pitch, heading [rad].
        self.euler = known_euler(self.estimate)
        # Angular rate [rad/s], body: the gyro less its estimated bias; Earth rate and transport rate are left in.
        self.rates = floats(self.gyro - self.estimate.gyro_bias)
        # The newest sample of the first sensor of each kind, and those of them that have not fallen silent.
        self.first: dict[type[Sample], Sample] = {}
        self._heard: dict[type[Sample], Sample] = {}
        # Whether any sensor tells where the vehicle is; the estimator takes its last word for fresh a while longer.
        self.fixed = False
        for sample in self.samples.values():
            kind = _kind(sample)
            speaks = self.t - sample.t_arrival < self.silent_s[sample.sensor]
            if kind not in self.first:
                self.first[kind] = sample
                if speaks:
                    self._heard[kind] = sample
            places = isinstance(sample, PositionSample) or (isinstance(sample, GnssSample) and sample.has_fix)
            self.fixed |= speaks and places
        barometer, pitot, receiver = self.newest(BarometerSample), self.newest(AirspeedSample), self.newest(GnssSample)
        # Measured static pressure [Pa] and equivalent airspeed [m/s]; the receiver's newest epoch if it has a fix.
        self.pressure = float(barometer.pressure) if barometer else math.nan
        self.eas = float(pitot.eas) if pitot else math.nan
        self.gnss_fix = receiver if receiver and receiver.has_fix else None

    @cached_property
    def point(self) -> Point | None:
        """Estimated (lat, lon, h)."""
        return known_point(self.estimate)

    @cached_property
    def local_n(self) -> list[float] | None:
        """Estimated position from home [m], NED."""
        if self.point is None or self.home is None:
            return None
        return floats(displacement_n(*self.point, *self.home))

    @cached_property
    def v_n(self) -> list[float]:
        """Estimated velocity [m/s], NED."""
        return floats(self.estimate.v_n)

    @cached_property
    def groundspeed(self) -> float:
        """Estimated horizontal speed over ground [m/s]."""
        return math.hypot(self.v_n[0], self.v_n[1])

    def works(self, kind: type[S]) -> bool:
        """Whether the first sensor of this kind says something, and is not isolated."""
        sample = self.newest(kind)
        return sample is not None and sample.sensor not in self.isolated

    @cached_property
    def doubted(self) -> bool:
        """Whether the estimator has isolated, or long refused, a receiver that has a fix."""
        return self.gnss_fix is not None and self.gnss_fix.sensor in self.isolated | self.refused

    @cached_property
    def flying(self) -> bool | None:
        """Whether the vehicle is in the air, as far as it can tell itself."""
        speeds = [speed for speed in (self.eas, self.groundspeed) if math.isfinite(speed)]
        return max(speeds) > FLYING_MPS if speeds else None

    @cached_property
    def specific_force(self) -> list[float]:
        """True specific force over the last tick [m/s^2], body."""
        dt = self.t / self.truth.tick if self.truth.tick else math.inf
        return floats(self.truth.dv[0] / dt)

    @cached_property
    def true_point(self) -> Point:
        """True (lat, lon, h)."""
        return float(self.truth.lat[0]), float(self.truth.lon[0]), float(self.truth.h[0])

    @cached_property
    def true_euler(self) -> list[float]:
        """True roll, pitch, heading [rad]."""
        return floats(euler_from_quat(self.truth.q_nb[0]))

    @cached_property
    def errors(self) -> dict[str, float]:
        """Estimate less truth, and the estimator's own idea of it, of what is estimated."""
        if self.euler is None:
            return {}
        turn = floats(rotvec_from_quat(quat_multiply(self.estimate.q_nb, quat_conjugate(self.truth.q_nb[0]))))
        of_attitude = {
            "err_tilt": math.degrees(math.hypot(turn[0], turn[1])),
            "err_head": math.degrees(turn[2]),
            "sig_tilt": math.degrees(self.sigma(ATTITUDE, 2)),
            "sig_head": math.degrees(self.sigma(HEADING)),
        }
        if self.point is None:
            return of_attitude
        north, east, down = floats(displacement_n(*self.point, *self.true_point))
        speed = floats(self.estimate.v_n - self.truth.v_n[0])
        return {
            "err_horiz": math.hypot(north, east),
            "err_down": down,
            "err_vel": math.hypot(*speed),
            **of_attitude,
            "sig_horiz": self.sigma(POSITION, 2),
            "sig_down": self.sigma(DOWN),
            "sig_vel": self.sigma(VELOCITY),
        }

    def newest(self, kind: type[S]) -> S | None:
        """The newest sample of the first sensor of this kind, None when there is none or it has fallen silent."""
        return cast("S | None", self._heard.get(kind))

    def sigma(self, block: slice, dimensions: int = 3) -> float:
        """Root of the summed variances of the first ``dimensions`` components of a block of the covariance."""
        return root(np.diagonal(self.estimate.covariance)[block][:dimensions])

    def ratio(self, aid: str) -> float:
        """Newest innovation of an aid over its gate, NaN when it is not known."""
        return self.ratios.get(aid, math.nan)


def _kind(sample: Sample) -> type[Sample]:
    """The one of `_KINDS` that a sample is of, of what is none its class."""
    own = type(sample)
    return own if own in _KINDS else next((kind for kind in _KINDS if isinstance(sample, kind)), own)


def known_point(estimate: Estimate) -> Point | None:
    """(lat, lon, h) of an estimate, None while it has no position."""
    if Status.ALIGNED not in estimate.status:
        return None
    point = float(estimate.lat), float(estimate.lon), float(estimate.h)
    return point if math.isfinite(point[0] + point[1] + point[2]) else None


def floats(x: Array) -> list[float]:
    """Python's own floats of an array."""
    values: list[float] = x.tolist()  # encoding Python's own floats is several times faster
    return values


def known_euler(estimate: Estimate) -> list[float] | None:
    """Roll, pitch, heading [rad] of an estimate, None while it has no attitude."""
    if Status.ALIGNED not in estimate.status:
        return None
    euler = floats(euler_from_quat(estimate.q_nb))
    return euler if math.isfinite(euler[0] + euler[1] + euler[2]) else None


def root(variances: Array) -> float:
    """Root of summed variances, NaN where their sum is negative."""
    total = float(variances.sum())
    return math.sqrt(total) if total >= 0 else math.nan
