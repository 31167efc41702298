"""GNSS receiver: position and velocity of the antenna, with denial and reacquisition.

Errors are white plus first-order Gauss-Markov, independent along north, east and down. They go on while the receiver
hears nothing, as the atmosphere does. The reported accuracy is the standard deviation of what is added, or follows it
late. Of an uncertain latency the stamp is off by one draw of a run, and velocity is older than position by another.
"""

from __future__ import annotations

import datetime
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from pydantic import Field, model_validator

from nav._jit import njit
from nav.columns import delivered
from nav.earth import earth_rate_n, ecef_from_geodetic, radii, wrap_longitude
from nav.rotation import quat_rotate
from nav.samples import Array, FixType, GnssSample, Sample
from testbed.motion.table import TruthBlock
from testbed.noise import Process, stream
from testbed.schema import Section
from testbed.sensors.gnss_lapses import VERTICAL, Accuracy, Jumps, Older
from testbed.sensors.grades import with_grade
from testbed.sensors.timing import AidingTiming, Schedule, Windows
from testbed.sensors.units import DEG, LeverArm

GPS_EPOCH, WEEK_S = datetime.datetime(1980, 1, 6, tzinfo=datetime.UTC), 604_800  # of GPS time
# How far GPS time is ahead of UTC [s] since when [s since 1970], the newest first (IERS, Bulletin C).
LEAPS = tuple(
    (datetime.datetime(year, month, 1, tzinfo=datetime.UTC).timestamp(), ahead)
    for year, month, ahead in ((2017, 1, 18), (2015, 7, 17), (2012, 7, 16), (2009, 1, 15), (2006, 1, 14), (1980, 1, 13))
)
LEAP_S = LEAPS[0][1]
NO_FIX_DOP = 99.99  # what receivers report when they have none
REPORTED_AT_LEAST = 1e-3  # accuracy is reported in whole millimetres, never as none at all [m], [m/s]
SATELLITES_SIGMA = 1.0  # how the number in view comes and goes
SATELLITES_TAU = 300.0  # [s]
MIN_SATELLITES = 5  # below which this receiver would not call it a 3D fix

# Horizontal figures are per axis. For a circular Gaussian with sigma per axis, CEP = 1.177 sigma, 95 % = 2.448 sigma;
# vertical 95 % = 1.96 sigma. Correlation: multipath 10-900 s, troposphere 900-2700 s (Joerger & Pervan 2020); 300 s
# stands for the mixture. Where not stated, the split into white and correlated is assumed.
GRADES: dict[str, dict[str, Any]] = {
    "perfect": {},
    # Single-frequency SPS, 1.5 m rms horizontally: between the 2 m CEP of the u-blox M9 data sheet and the FAA SPS
    # Performance Analysis Report 108 (survey-grade sites). Velocity 0.05 m/s: u-blox M9.
    "standalone": {
        "horizontal_white_m": 0.4,
        "horizontal_correlated_m": 1.0,
        "vertical_white_m": 0.8,
        "vertical_correlated_m": 2.0,
        "correlation_time_s": 300.0,
        "horizontal_velocity_white_mps": 0.05,
        "horizontal_velocity_correlated_mps": 0.02,
        "vertical_velocity_white_mps": 0.08,
        "vertical_velocity_correlated_mps": 0.03,
        "velocity_correlation_time_s": 10.0,
        "latency_s": 0.1,
        "reacquire_s": 2.0,
        "satellites": 12,
        "hdop": 0.9,
        "vdop": 1.4,
    },
    # FAA WAAS Performance Analysis Report 10: 95 % of 0.61-1.06 m horizontally, 1.03-1.79 m vertically.
    "sbas": {
        "horizontal_white_m": 0.2,
        "horizontal_correlated_m": 0.3,
        "vertical_white_m": 0.35,
        "vertical_correlated_m": 0.6,
        "correlation_time_s": 300.0,
        "horizontal_velocity_white_mps": 0.05,
        "horizontal_velocity_correlated_mps": 0.02,
        "vertical_velocity_white_mps": 0.08,
        "vertical_velocity_correlated_mps": 0.03,
        "velocity_correlation_time_s": 10.0,
        "latency_s": 0.1,
        "reacquire_s": 2.0,
        "satellites": 14,
        "hdop": 0.8,
        "vdop": 1.2,
    },
    # u-blox ZED-F9P data sheet: RTK 0.01 m + 1 ppm CEP horizontally and vertically, velocity 0.05 m/s.
    "rtk": {
        "horizontal_white_m": 0.005,
        "horizontal_correlated_m": 0.007,
        "vertical_white_m": 0.01,
        "vertical_correlated_m": 0.012,
        "correlation_time_s": 100.0,
        "horizontal_velocity_white_mps": 0.03,
        "horizontal_velocity_correlated_mps": 0.01,
        "vertical_velocity_white_mps": 0.05,
        "vertical_velocity_correlated_mps": 0.02,
        "velocity_correlation_time_s": 10.0,
        "latency_s": 0.1,
        "reacquire_s": 10.0,
        "satellites": 20,
        "hdop": 0.6,
        "vdop": 0.9,
    },
    # u-blox NEO-M8 data sheet UBX-15031086: 2.5 m CEP, 2.1 m per axis, most of it the same for minutes, velocity 0.05
    # m/s; of what stays, half is left here: filters that reckon with more follow recorded receivers by 0.5 m less. It
    # is late by 0.2 s, as recorded flights show against their inertial units, and not known to 0.1 s. Measured in 0.43
    # h of three recordings: one step of 7 m against the receiver's velocity, a dozen of 1.5 m (how long they last is
    # assumed); steps of stamps that deviate by 5 to 36 ms; of a thousand fixes 3 missing. In two more: stated
    # accuracies that fall from the first fixes on with a time constant of 11 s, or slower.
    "u-blox-m8": {
        "horizontal_white_m": 0.5,
        "horizontal_correlated_m": 1.0,
        "vertical_white_m": 0.7,
        "vertical_correlated_m": 2.4,
        "correlation_time_s": 300.0,
        "horizontal_velocity_white_mps": 0.2,
        "horizontal_velocity_correlated_mps": 0.05,
        "vertical_velocity_white_mps": 0.3,
        "vertical_velocity_correlated_mps": 0.1,
        "latency_sigma_s": 0.1,
        "follow_s": 5.0,
        "velocity_correlation_time_s": 10.0,
        "latency_s": 0.2,
        "jitter_s": 0.01,
        "dropout_percent": 0.3,
        "jumps_per_h": 4.0,
        "jump_m": 5.0,
        "jump_s": 10.0,
        "accuracy_lag_s": 10.0,
        "reacquire_s": 2.0,
        "satellites": 10,
        "hdop": 1.1,
        "vdop": 1.8,
    },
}


class Jammer(Section):
    """A transmitter on the ground inside whose radius the receiver hears nothing."""

    lat_deg: float = Field(ge=-90, le=90, description="geodetic latitude, WGS84")
    lon_deg: float = Field(ge=-180, le=180, description="longitude, east positive")
    radius_m: float = Field(
        gt=0, le=1e6, description="around it on the ground, inside which the receiver hears nothing"
    )


@dataclass(frozen=True, slots=True)
class GnssErrors:
    """The receiver's datasheet in SI, 1 sigma along north, east, down: what an estimator may be told.

    ``position_white_n``, ``position_correlated_n`` (3,) [m] with ``position_tau`` [s]; ``velocity_white_n``,
    ``velocity_correlated_n`` (3,) [m/s] with ``velocity_tau`` [s]; ``lever_arm_b`` (3,) [m] from the centre of gravity
    to the antenna; ``latency`` [s], known to ``latency_sigma``, and by how much more velocity is late. ``largest_jump``
    [m]: one sigma of a jump downwards, 0 without jumps; in recorded flights it was 6.2 m.
    """

    position_white_n: Array
    position_correlated_n: Array
    position_tau: float
    velocity_white_n: Array
    velocity_correlated_n: Array
    velocity_tau: float
    lever_arm_b: Array
    latency: float
    latency_sigma: float
    velocity_lag: float
    largest_jump: float


class GnssConfig(AidingTiming):
    """Keys of a GNSS receiver. ``grade`` sets the errors; each may be given to override it. Horizontal: per axis."""

    kind: Literal["gnss"] = Field(
        default="gnss", description="what the sensor is; the table's name where it is left out"
    )
    grade: Literal["perfect", "standalone", "sbas", "rtk", "u-blox-m8"] = Field(
        default="standalone", description="datasheet that presets every error below"
    )
    rate_hz: float = Field(5.0, gt=0, le=10_000, description="samples per second; divides the tick rate")

    horizontal_white_m: float = Field(0.0, ge=0, le=1e4, description="white error of position, north and east each")
    horizontal_correlated_m: float = Field(
        0.0, ge=0, le=1e4, description="Gauss-Markov error of position, north and east each"
    )
    vertical_white_m: float = Field(0.0, ge=0, le=1e4, description="white error of height")
    vertical_correlated_m: float = Field(0.0, ge=0, le=1e4, description="Gauss-Markov error of height")
    correlation_time_s: float = Field(300.0, gt=0, le=1e6, description="of the Gauss-Markov errors of position")
    horizontal_velocity_white_mps: float = Field(
        0.0, ge=0, le=100, description="white error of velocity, north and east each"
    )
    horizontal_velocity_correlated_mps: float = Field(
        0.0, ge=0, le=100, description="Gauss-Markov error of velocity, north and east each"
    )
    vertical_velocity_white_mps: float = Field(0.0, ge=0, le=100, description="white error of vertical velocity")
    vertical_velocity_correlated_mps: float = Field(
        0.0, ge=0, le=100, description="Gauss-Markov error of vertical velocity"
    )
    velocity_correlation_time_s: float = Field(10.0, gt=0, le=1e6, description="of the Gauss-Markov errors of velocity")
    satellites: int = Field(12, ge=MIN_SATELLITES, le=60, description="usual number of satellites in use")
    hdop: float = Field(0.9, gt=0, le=50, description="reported horizontal dilution of precision")
    vdop: float = Field(1.4, gt=0, le=50, description="reported vertical dilution of precision")
    latency_sigma_s: float = Field(
        0.0,
        ge=0,
        le=10,
        description="how well the latency is known: it, and the velocity's lag, are off by draws of it",
    )
    velocity_lag_s: float = Field(
        0.0,
        ge=-10,
        le=10,
        description="by which velocity is older than the position beside it; at least 0 if simulated",
    )
    follow_s: float = Field(
        0.0,
        ge=0,
        le=3600,
        description="told to an INS: over which noise of positions and velocities follows innovations; 0: not",
    )
    jumps_per_h: float = Field(0.0, ge=0, le=3600, description="how often the position jumps away")
    jump_m: float = Field(5.0, ge=0, le=1e5, description="size of jumps, north and east each; 1.5 times that down")
    jump_s: float = Field(10.0, gt=0, le=1e5, description="how long it stays away, in the mean")
    accuracy_lag_s: float = Field(
        0.0, ge=0, le=1e3, description="time constant with which the reported accuracy follows the true one; 0: at once"
    )
    lever_arm_m: LeverArm = Field(
        (0.0, 0.0, 0.0), description="from the centre of gravity to the antenna, forward, right, down"
    )

    reacquire_s: float = Field(0.0, ge=0, le=3600, description="from the end of denial to the first fix")
    settle_factor: float = Field(
        2.0, ge=1, le=100, description="how many times larger errors and reported accuracy are at the first fix"
    )
    settle_s: float = Field(5.0, gt=0, le=3600, description="time constant with which they return to normal")
    denied: Windows = Field((), description="windows of simulated time without signals")
    jammers: tuple[Jammer, ...] = Field(default=(), description="transmitters that deny signals near them")

    @model_validator(mode="before")
    @classmethod
    def _on_top_of_grade(cls, data: Any) -> Any:
        return with_grade(data, GRADES, "standalone")

    def errors(self) -> GnssErrors:
        """The same in SI."""

        def ned(horizontal: float, vertical: float) -> Array:
            return np.array([horizontal, horizontal, vertical])

        return GnssErrors(
            position_white_n=ned(self.horizontal_white_m, self.vertical_white_m),
            position_correlated_n=ned(self.horizontal_correlated_m, self.vertical_correlated_m),
            position_tau=self.correlation_time_s,
            velocity_white_n=ned(self.horizontal_velocity_white_mps, self.vertical_velocity_white_mps),
            velocity_correlated_n=ned(self.horizontal_velocity_correlated_mps, self.vertical_velocity_correlated_mps),
            velocity_tau=self.velocity_correlation_time_s,
            lever_arm_b=np.array(self.lever_arm_m, dtype=float),
            latency=self.latency_s,
            latency_sigma=self.latency_sigma_s,
            velocity_lag=self.velocity_lag_s,
            largest_jump=VERTICAL * self.jump_m if self.jumps_per_h else 0.0,
        )


class Reception:
    """Whether a receiver hears its signals: outside its windows of denial and its jammers, and some time after them.

    ``has_fix`` is asked about every epoch, in order. While ``jammed`` is set, by who directs the run, it hears nothing
    wherever it is. ``denied_until`` [s] is when it last could not.
    """

    def __init__(self, config: GnssConfig) -> None:
        self.jammed = False
        self.denied_until = -math.inf
        self._denied, self._reacquire = config.denied, config.reacquire_s
        self._jammers = [
            (ecef_from_geodetic(j.lat_deg * DEG, j.lon_deg * DEG, 0.0), j.radius_m) for j in config.jammers
        ]

    def has_fix(self, t: float, lat: float, lon: float) -> bool:
        """Signals are heard at ``t`` [s] by an antenna there, and have been for the time it takes to reacquire."""
        for start, end in self._denied:
            if start <= t:
                self.denied_until = max(self.denied_until, end)
        if self._is_jammed(lat, lon):
            self.denied_until = max(self.denied_until, t)
            return False
        return t >= self.denied_until + self._reacquire

    def _is_jammed(self, lat: float, lon: float) -> bool:
        """Whether the point below the antenna is within a jammer's radius, as the crow flies."""
        if self.jammed or not self._jammers:
            return self.jammed
        ground = ecef_from_geodetic(lat, lon, 0.0)
        return any(math.dist(ground, centre) <= radius for centre, radius in self._jammers)


def without_fix(t: float, t_arrival: float, sensor: str) -> GnssSample:
    """What a receiver says that has no fix at ``t`` [s]."""
    nothing = np.full(3, np.nan)
    return GnssSample(
        t, t_arrival, math.nan, math.nan, math.nan, nothing, nothing, nothing,
        FixType.NO_FIX, 0, NO_FIX_DOP, NO_FIX_DOP, sensor,
    )  # fmt: skip


class Gnss:
    """One receiver on one run. ``sense`` is called with consecutive truth blocks of any length."""

    def __init__(self, name: str, config: GnssConfig, tick_rate_hz: float, seed: int) -> None:
        self.name = name
        self.rate_hz = config.rate_hz
        self.errors = e = config.errors()
        self._config = config
        self._schedule = Schedule.of(name, config, tick_rate_hz)
        dt = 1 / config.rate_hz
        self._white = Process.white(
            stream(seed, name, "white"), np.concatenate([e.position_white_n, e.velocity_white_n])
        )
        self._correlated = Process.gauss_markov(
            stream(seed, name, "correlated"),
            np.concatenate([e.position_correlated_n, e.velocity_correlated_n]),
            np.repeat([e.position_tau, e.velocity_tau], 3),
            dt,
        )
        self._sky = Process.gauss_markov(stream(seed, name, "sky"), [SATELLITES_SIGMA], SATELLITES_TAU, dt)
        self._sigma_position_n = np.maximum(np.hypot(e.position_white_n, e.position_correlated_n), REPORTED_AT_LEAST)
        self._sigma_velocity_n = np.maximum(np.hypot(e.velocity_white_n, e.velocity_correlated_n), REPORTED_AT_LEAST)
        self.reception = Reception(config)
        self._jumps = Jumps(name, config.jumps_per_h, config.jump_m, config.jump_s, dt, seed)
        off, behind = (stream(seed, name, "latency").standard_normal(2) * config.latency_sigma_s).tolist()
        self._off = max(off, -config.latency_s)  # of the stamp: nothing arrives before it was measured
        self._older = Older(max(0, round((config.velocity_lag_s + behind) * tick_rate_hz)))
        self._accuracies = None
        if config.accuracy_lag_s:
            both = (self._sigma_position_n, self._sigma_velocity_n)
            self._accuracies = tuple(Accuracy(sigma, config.accuracy_lag_s, dt) for sigma in both)

    def sense(self, truth: TruthBlock) -> Sequence[Sample]:
        """The epochs that fall inside this block; those without a fix are delivered too."""
        rows = self._schedule.rows(truth)
        old_n = None
        if self._older.ticks:
            old_n = self._older.of(self._antenna(truth, range(len(truth)))[:, 3:])
        n = len(rows)
        if not n:
            return []
        noise = self._white.take(n)
        noise += self._correlated.take(n)
        sky = self._sky.take(n)
        jumps_n = self._jumps.take(truth.t[rows.start :: rows.step])
        antenna = self._antenna(truth, rows)
        if old_n is not None:
            antenna[:, 3:] = old_n[rows.start :: rows.step]
        t = truth.t[rows.start :: rows.step]
        unsettled = np.array(
            [self._unsettled(*where) for where in zip(t.tolist(), *antenna[:, :2].T.tolist(), strict=True)]
        )
        return self._samples(t + self._off, antenna, noise, jumps_n, sky[:, 0], unsettled)

    def _antenna(self, truth: TruthBlock, rows: range) -> Array:
        """Latitude, longitude, height and velocity NED (n, 6) of the antenna."""
        antenna = np.empty((len(rows), 6))
        _antenna(
            rows.start,
            rows.step,
            truth.lat,
            truth.lon,
            truth.h,
            truth.v_n,
            truth.q_nb,
            truth.omega_b,
            self.errors.lever_arm_b,
            antenna,
        )
        return antenna

    def _unsettled(self, t: float, lat: float, lon: float) -> float:
        """By how much errors at ``t`` [s] and a place are larger than usual; zero without a fix."""
        config = self._config
        if not self.reception.has_fix(t, lat, lon):
            return 0.0
        since = t - self.reception.denied_until - config.reacquire_s
        return 1 + (config.settle_factor - 1) * math.exp(-since / config.settle_s)

    def _samples(
        self, t: Array, antenna: Array, noise: Array, jumps_n: Array, sky: Array, unsettled: Array
    ) -> Sequence[Sample]:
        """The samples stamped ``t`` (N,) of the antenna's places and velocities (N, 6) and their errors.

        What goes with a fix is missing where there is none, ``unsettled`` being zero.
        """
        n, config, fixed = len(t), self._config, unsettled > 0.0
        factor, jumps_n = unsettled[fixed], jumps_n[fixed]
        noise = noise[fixed] * factor[:, None]
        noise[:, :3] += jumps_n
        place, v_n = np.full((n, 3), np.nan), np.full((n, 3), np.nan)
        place[fixed], v_n[fixed] = _displaced(antenna[fixed], noise), antenna[fixed, 3:] + noise[:, 3:]
        sigma_position_n, sigma_velocity_n = np.full((n, 3), np.nan), np.full((n, 3), np.nan)
        sigma_position_n[fixed], sigma_velocity_n[fixed] = self._stated(factor, jumps_n)
        satellites, kind = np.zeros(n, np.int64), np.array([FixType.NO_FIX, FixType.FIX_3D], object)[fixed.astype(int)]
        satellites[fixed] = np.maximum(np.round((config.satellites + sky[fixed]) / factor), MIN_SATELLITES)
        hdop, vdop = np.full(n, NO_FIX_DOP), np.full(n, NO_FIX_DOP)
        dilution = np.sqrt(config.satellites / satellites[fixed])
        hdop[fixed], vdop[fixed] = config.hdop * dilution, config.vdop * dilution
        return delivered(
            GnssSample, self.name, t, config.latency_s, lat=place[:, 0], lon=place[:, 1], h=place[:, 2], v_n=v_n,
            sigma_position_n=sigma_position_n, sigma_velocity_n=sigma_velocity_n, fix_type=kind, satellites=satellites,
            hdop=hdop, vdop=vdop,
        )  # fmt: skip

    def _stated(self, unsettled: Array, jumps_n: Array) -> tuple[Array, Array]:
        """The accuracies of position and velocity that it reports with each of N fixes, (N, 3) both."""
        if self._accuracies is None:
            return unsettled[:, None] * self._sigma_position_n, unsettled[:, None] * self._sigma_velocity_n
        position, velocity = self._accuracies
        stated = [
            (position.stated(factor, jump_n), velocity.stated(factor, np.zeros(3)))
            for factor, jump_n in zip(unsettled.tolist(), jumps_n, strict=True)
        ]
        both = np.array(stated).reshape(-1, 2, 3)
        return both[:, 0], both[:, 1]


@njit
def displaced(lat: float, lon: float, h: float, d_n: Array) -> tuple[float, float, float]:
    """(lat, lon, h) of a point ``d_n`` (3,) metres north, east, down of another, for small ``d_n``."""
    R_M, R_N = radii(lat)
    east = d_n[1] / ((R_N + h) * math.cos(lat))
    return lat + d_n[0] / (R_M + h), wrap_longitude(lon + east), h - d_n[2]


@njit
def _displaced(antenna: Array, d_n: Array) -> Array:
    """`displaced`, of each row of both (N, _)."""
    places = np.empty((len(antenna), 3))
    for k in range(len(antenna)):
        place = displaced(antenna[k, 0], antenna[k, 1], antenna[k, 2], d_n[k])
        places[k, 0], places[k, 1], places[k, 2] = place
    return places


@njit
def _antenna(
    start: int,
    step: int,
    lat: Array,
    lon: Array,
    h: Array,
    v_n: Array,
    q_nb: Array,
    omega_b: Array,
    lever: Array,
    out: Array,
) -> None:
    """[lat, lon, h, v_n] of the antenna on every ``step``-th row into ``out`` (n, 6).

    r_antenna = r + C_nb l; v_antenna = v + (C_nb omega_ib_b - omega_ie_n) x C_nb l.
    """
    has_lever = lever[0] != 0.0 or lever[1] != 0.0 or lever[2] != 0.0
    for i in range(out.shape[0]):
        k = start + i * step
        out[i, 0], out[i, 1], out[i, 2] = lat[k], lon[k], h[k]
        out[i, 3], out[i, 4], out[i, 5] = v_n[k, 0], v_n[k, 1], v_n[k, 2]
        if has_lever:
            arm = quat_rotate(q_nb[k], lever)
            rate, earth = quat_rotate(q_nb[k], omega_b[k]), earth_rate_n(lat[k])
            for c in range(3):
                rate[c] -= earth[c]
            out[i, 0], out[i, 1], out[i, 2] = displaced(lat[k], lon[k], h[k], arm)
            out[i, 3] += rate[1] * arm[2] - rate[2] * arm[1]
            out[i, 4] += rate[2] * arm[0] - rate[0] * arm[2]
            out[i, 5] += rate[0] * arm[1] - rate[1] * arm[0]
