"""What sensors deliver and what estimators return: the only vocabulary that `nav` and `testbed` share.

The consumer defines these structures and the simulator fills the same ones. Every field is SI with radians;
frames are those of the conventions page (`nav`). Aiding samples carry two times: ``t`` is when the measurement
was true, ``t_arrival`` when the receiver of it could first have known (``t_arrival >= t``).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum, IntFlag
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

Array: TypeAlias = npt.NDArray[np.float64]

NO_SENSOR = "no sensor"  # that a report is of what is known without a sample
RATE_LIMIT, FORCE_LIMIT = 100.0, 2000.0  # what an IMU could possibly report [rad/s, m/s^2]


class FixType(IntEnum):
    """GNSS fix type, numbered as in MAVLink's GPS_FIX_TYPE."""

    NO_FIX = 1
    FIX_2D = 2
    FIX_3D = 3


def has_fix(fix_type: FixType | npt.NDArray[np.integer]) -> bool | npt.NDArray[np.bool_]:
    """Whether a receiver has a fix that can be navigated by: of three dimensions. The one place that decides it."""
    return fix_type >= FixType.FIX_3D


class Outcome(IntEnum):
    """What became of an aiding sample, or of the part of it that a report is on."""

    FUSED = 0  # used as it is
    WEAKENED = 1  # used with less information than it claims, as a measurement policy says; at weight 0 left out by it
    OUTSIDE_GATE = 2  # its innovation was refused by gate or detector, on one axis at least
    ISOLATED = 3  # its sensor is out of use, on one axis at least, until it has been sound for a while
    WITHHELD = 4  # not used for another reason than itself, such as probation or a refused position
    OUT_OF_RANGE = 5  # a sound reading, but where the sensor tells nothing: too slow for a pitot tube
    UNSOUND = 6  # refused before an innovation was formed: no number, impossible, or too late


class Status(IntFlag):
    """What an estimator says of itself."""

    ALIGNING = 1  # no attitude, velocity or position yet: every number in the estimate is NaN
    ALIGNED = 2
    GNSS_FUSED = 4  # a GNSS sample was fused within the last two seconds
    DEAD_RECKONING = 8  # aligned, and no position aid is being fused
    BAD_SAMPLE = 16  # a non-finite or out-of-range sample was refused within the last second
    ATTITUDE_ONLY = 32  # no position and no velocity are estimated: they are NaN, and so is their covariance


@dataclass(frozen=True, slots=True)
class ImuSamples:
    """A block of N consecutive inertial increments.

    ``t`` (N,) end of each interval [s]; ``dt`` (N,) its length [s]; ``dtheta`` (N, 3) integrated angular rate
    of b relative to i [rad]; ``dv`` (N, 3) integrated specific force [m/s], both in rotating body axes.
    Averages over the interval are ``dtheta/dt`` and ``dv/dt``.
    """

    t: Array
    dt: Array
    dtheta: Array
    dv: Array

    def __len__(self) -> int:
        return len(self.t)


def usable(dtheta: Array, dv: Array, dt: Array) -> npt.NDArray[np.bool_]:
    """Which of N increments an IMU could possibly report (N,): not those that are no numbers."""
    sizes = np.maximum(np.abs(dtheta) / RATE_LIMIT, np.abs(dv) / FORCE_LIMIT).max(axis=1)
    found: npt.NDArray[np.bool_] = sizes <= dt
    return found


@dataclass(frozen=True, slots=True)
class GnssSample:
    """One GNSS epoch at the antenna. ``sigma_position_n`` and ``sigma_velocity_n`` are the receiver's own 1-sigma.

    Without a fix (``fix_type`` NO_FIX) position and velocity are NaN and the sample only says that there is none.
    """

    t: float
    t_arrival: float
    lat: float
    lon: float
    h: float
    v_n: Array
    sigma_position_n: Array
    sigma_velocity_n: Array
    fix_type: FixType
    satellites: int
    hdop: float
    vdop: float
    sensor: str = "gnss"

    @property
    def has_fix(self) -> bool:
        """Whether there is a position that can be navigated by."""
        return bool(has_fix(self.fix_type))


@dataclass(frozen=True, slots=True)
class BarometerSample:
    """Static pressure [Pa]."""

    t: float
    t_arrival: float
    pressure: float
    sensor: str = "barometer"


@dataclass(frozen=True, slots=True)
class MagnetometerSample:
    """Magnetic flux density in body axes (3,) [T]."""

    t: float
    t_arrival: float
    field_b: Array
    sensor: str = "magnetometer"


@dataclass(frozen=True, slots=True)
class AirspeedSample:
    """Equivalent airspeed along the pitot tube (body x) [m/s]: sqrt(2 q / rho0), rho0 = 1.225 kg/m^3."""

    t: float
    t_arrival: float
    eas: float
    sensor: str = "airspeed"


@dataclass(frozen=True, slots=True)
class BodyVelocitySample:
    """Velocity over ground in body axes (3,) [m/s], NaN on the axes that the instrument does not measure."""

    t: float
    t_arrival: float
    v_b: Array
    sensor: str = "body_velocity"


@dataclass(frozen=True, slots=True)
class StarSample:
    """Attitude against the stars: ``q_ib`` (4,) takes b to the inertial frame i, which coincides with e at t = 0."""

    t: float
    t_arrival: float
    q_ib: Array
    sensor: str = "star_tracker"


@dataclass(frozen=True, slots=True)
class PositionSample:
    """A position found by other means than GNSS: latitude, longitude [rad], ``h`` [m], NaN when not measured."""

    t: float
    t_arrival: float
    lat: float
    lon: float
    h: float
    sensor: str = "position_fix"


@dataclass(frozen=True, slots=True)
class RangeSample:
    """Range to the ground along body z, down [m]."""

    t: float
    t_arrival: float
    range: float
    sensor: str = "rangefinder"


@dataclass(frozen=True, slots=True)
class OpticalFlowSample:
    """How the image of a camera that looks along body z, down, moves: means over an interval whose middle is ``t``.

    ``flow_b`` (2,) rates of the line of sight about body x and y, positive as by a rotation of the body about them
    (MAVLink, OPTICAL_FLOW_RAD), and ``rotation_b`` (2,) that rotation by the sensor's own gyro [rad/s]; ``quality`` of
    the match from 0 to 1, to whose inverse the variance of its noise is proportional.
    """

    t: float
    t_arrival: float
    flow_b: Array
    rotation_b: Array
    quality: float
    sensor: str = "optical_flow"


@dataclass(frozen=True, slots=True)
class WindSample:
    """The wind by radio: velocity of the air over ground north and east ``wind_n`` (2,), a mean without gusts [m/s].

    It is of ``age`` [s] before ``t``, when it was reported; ``sigma`` is the 1-sigma per axis that is told with it.
    """

    t: float
    t_arrival: float
    wind_n: Array
    age: float
    sigma: float
    sensor: str = "wind_report"


Sample: TypeAlias = (
    GnssSample
    | BarometerSample
    | MagnetometerSample
    | AirspeedSample
    | BodyVelocitySample
    | StarSample
    | PositionSample
    | RangeSample
    | OpticalFlowSample
    | WindSample
)


@dataclass(frozen=True, slots=True)
class UpdateReport:
    """What became of one aiding sample, one report per aid (a GNSS sample gives position and velocity).

    ``t`` is the sample's time of validity; ``aid`` the measurement's name, such as ``gnss_position``; ``innovation``
    (m,) = measurement - prediction; ``S`` (m, m) its covariance before the update; ``nis`` = innovation' S^-1
    innovation, not divided by m, and ``threshold`` the gate for it; ``weight`` the factor on the information of the
    sample (1 taken as it is, 0 rejected), the mean over the axes; ``outcome`` what became of it, ``reason`` the same in
    words for people.
    """

    t: float
    sensor: str
    aid: str
    innovation: Array
    S: Array
    nis: float
    threshold: float
    weight: float
    outcome: Outcome
    reason: str = ""  # why it was refused or weakened, empty when it was simply fused; no code reads it


@dataclass(frozen=True, slots=True)
class Estimate:
    """State of an estimator at ``t``.

    ``covariance`` (9, 9) is of [position error NED m, velocity error NED m/s, attitude error phi rad], in that
    order. ``extra`` holds further states by name (wind, aid biases) as (value, sigma) pairs, each array (k,).
    While aligning all numbers are NaN and ``status`` says so.
    """

    t: float
    lat: float
    lon: float
    h: float
    v_n: Array
    q_nb: Array
    gyro_bias: Array
    accel_bias: Array
    covariance: Array
    sigma_gyro_bias: Array
    sigma_accel_bias: Array
    status: Status
    extra: Mapping[str, tuple[Array, Array]] = field(default_factory=dict)

    @classmethod
    def of(
        cls, t: float, *, q_nb: Array | None = None, lla: Array | None = None, v_n: Array | None = None,
        covariance: Array | None = None, gyro_bias: Array | None = None, accel_bias: Array | None = None,
        extra: Mapping[str, tuple[Array, Array]] | None = None, status: Status | None = None,
    ) -> Estimate:  # fmt: skip
        """An estimate of what is given, ``lla`` being (lat, lon, h); what is not given is NaN, and not known.

        Without ``status`` it is aligned when there is an attitude, and of attitude only when there is no position.
        """
        if status is None:
            aligned = Status.ALIGNED if lla is not None else Status.ALIGNED | Status.ATTITUDE_ONLY
            status = Status.ALIGNING if q_nb is None else aligned
        unknown = np.full(3, np.nan)
        lat, lon, h = unknown if lla is None else lla
        return cls(
            t, float(lat), float(lon), float(h), unknown if v_n is None else v_n,
            np.full(4, np.nan) if q_nb is None else q_nb, unknown if gyro_bias is None else gyro_bias,
            unknown if accel_bias is None else accel_bias,
            np.full((9, 9), np.nan) if covariance is None else covariance, unknown, unknown, status,
            {} if extra is None else extra,
        )  # fmt: skip
