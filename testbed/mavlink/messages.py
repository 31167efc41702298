"""What each message says: one function per message, from a snapshot of the run to the message's fields.

A function returns None when what its message is about is not known; a single unknown number is NaN, and the encoder
turns it into the field's own "unknown". Heights are above the WGS84 ellipsoid, also where MAVLink says mean sea level:
the testbed has no geoid.
Source of the fields' meaning and units: https://mavlink.io/en/messages/all.html
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias, TypeVar

import numpy as np
from pymavlink.dialects.v20 import all as mav  # type: ignore[import-untyped]

from nav.earth import SEA_LEVEL_DENSITY, STANDARD_GRAVITY, position_difference_n, pressure_altitude
from nav.rotation import dcm_from_quat, euler_from_quat, quat_conjugate, quat_multiply, rotvec_from_quat, skew
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
from testbed.mavlink.encode import Fields, boot_ms, centidegrees, latitude_e7, longitude_e7, microseconds
from testbed.mavlink.identity import Identity
from testbed.motion.table import TruthBlock

S = TypeVar("S", GnssSample, BarometerSample, MagnetometerSample, AirspeedSample)
Point: TypeAlias = tuple[float, float, float]

FLYING_MPS = 8.0  # faster than this, through the air or over ground, is flight: well below any stall speed
TERRAIN_UNKNOWN = -10000.0  # ALTITUDE: below -1000 means unknown
NO_OFFSET = [0.0, 0.0, 0.0, 0.0]  # ATTITUDE_QUATERNION: no other attitude for display

# Blocks of an estimate's covariance.
_POSITION, _VELOCITY, _ATTITUDE = slice(0, 3), slice(3, 6), slice(6, 9)
_DOWN, _HEADING = slice(2, 3), slice(8, 9)
_UPPER = np.flatnonzero(np.triu(np.ones((6, 6))))  # upper right triangle of 6 x 6, row by row
_RATES = [21, 28, 35]  # the last three of its diagonal


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
        """What every call needs: time [s, ms, us], attitude and rates, which go out most often."""
        self.t = float(self.truth.t[0])
        self.boot_ms = boot_ms(self.t)
        self.usec = microseconds(self.t)
        # Estimated roll, pitch, heading [rad].
        self.euler = _euler(self.estimate)
        # Angular rate [rad/s], body: the gyro less its estimated bias; Earth rate and transport rate are left in.
        self.rates = _floats(self.gyro - self.estimate.gyro_bias)

    @cached_property
    def point(self) -> Point | None:
        """Estimated (lat, lon, h)."""
        return known_point(self.estimate)

    @cached_property
    def local_n(self) -> list[float] | None:
        """Estimated position from home [m], NED."""
        if self.point is None or self.home is None:
            return None
        return _floats(position_difference_n(*self.point, *self.home))

    @cached_property
    def v_n(self) -> list[float]:
        """Estimated velocity [m/s], NED."""
        return _floats(self.estimate.v_n)

    @cached_property
    def groundspeed(self) -> float:
        """Estimated horizontal speed over ground [m/s]."""
        return math.hypot(self.v_n[0], self.v_n[1])

    @cached_property
    def eas(self) -> float:
        """Measured equivalent airspeed [m/s]."""
        sample = self.newest(AirspeedSample)
        return float(sample.eas) if sample else math.nan

    @cached_property
    def pressure(self) -> float:
        """Measured static pressure [Pa]."""
        sample = self.newest(BarometerSample)
        return float(sample.pressure) if sample else math.nan

    @cached_property
    def gnss_fix(self) -> GnssSample | None:
        """The receiver's newest epoch if it has a fix."""
        sample = self.newest(GnssSample)
        return sample if sample and sample.has_fix else None

    @cached_property
    def fixed(self) -> bool:
        """Whether any sensor tells where the vehicle is; the estimator takes its last word for fresh a while longer."""
        return any(
            isinstance(sample, PositionSample) or (isinstance(sample, GnssSample) and sample.has_fix)
            for sample in self.samples.values()
            if self.t - sample.t_arrival < self.silent_s[sample.sensor]
        )

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
        return _floats(self.truth.dv[0] / dt)

    @cached_property
    def true_point(self) -> Point:
        """True (lat, lon, h)."""
        return float(self.truth.lat[0]), float(self.truth.lon[0]), float(self.truth.h[0])

    @cached_property
    def true_euler(self) -> list[float]:
        """True roll, pitch, heading [rad]."""
        return _floats(euler_from_quat(self.truth.q_nb[0]))

    @cached_property
    def errors(self) -> dict[str, float]:
        """Estimate less truth, and the estimator's own idea of it, of what is estimated."""
        if self.euler is None:
            return {}
        turn = _floats(rotvec_from_quat(quat_multiply(self.estimate.q_nb, quat_conjugate(self.truth.q_nb[0]))))
        of_attitude = {
            "err_tilt": math.degrees(math.hypot(turn[0], turn[1])),
            "err_head": math.degrees(turn[2]),
            "sig_tilt": math.degrees(self.sigma(_ATTITUDE, 2)),
            "sig_head": math.degrees(self.sigma(_HEADING)),
        }
        if self.point is None:
            return of_attitude
        north, east, down = _floats(position_difference_n(*self.point, *self.true_point))
        speed = _floats(self.estimate.v_n - self.truth.v_n[0])
        return {
            "err_horiz": math.hypot(north, east),
            "err_down": down,
            "err_vel": math.hypot(*speed),
            **of_attitude,
            "sig_horiz": self.sigma(_POSITION, 2),
            "sig_down": self.sigma(_DOWN),
            "sig_vel": self.sigma(_VELOCITY),
        }

    def newest(self, kind: type[S]) -> S | None:
        """The newest sample of the first sensor of this kind, None when there is none or it has fallen silent."""
        for sample in self.samples.values():
            if isinstance(sample, kind):
                return sample if self.t - sample.t_arrival < self.silent_s[sample.sensor] else None
        return None

    def sigma(self, block: slice, dimensions: int = 3) -> float:
        """Root of the summed variances of the first ``dimensions`` components of a block of the covariance."""
        return _root(np.diagonal(self.estimate.covariance)[block][:dimensions])

    def ratio(self, aid: str) -> float:
        """Newest innovation of an aid over its gate, NaN when it is not known."""
        return self.ratios.get(aid, math.nan)


def known_point(estimate: Estimate) -> Point | None:
    """(lat, lon, h) of an estimate, None while it has no position."""
    if Status.ALIGNED not in estimate.status:
        return None
    point = float(estimate.lat), float(estimate.lon), float(estimate.h)
    return point if math.isfinite(point[0] + point[1] + point[2]) else None


def _floats(x: Array) -> list[float]:
    values: list[float] = x.tolist()  # encoding Python's own floats is several times faster
    return values


def _euler(estimate: Estimate) -> list[float] | None:
    if Status.ALIGNED not in estimate.status:
        return None
    euler = _floats(euler_from_quat(estimate.q_nb))
    return euler if math.isfinite(euler[0] + euler[1] + euler[2]) else None


def _root(variances: Array) -> float:
    total = float(variances.sum())
    return math.sqrt(total) if total >= 0 else math.nan


# The vehicle


def heartbeat_of(s: Snapshot) -> Fields:
    """HEARTBEAT of a snapshot."""
    return heartbeat(s, s.identity)


def heartbeat(s: Snapshot | None, identity: Identity) -> Fields:
    """Fixed wing, on its own; armed when flying; calibrating until the estimator is aligned, and before the run."""
    mode = mav.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | mav.MAV_MODE_FLAG_AUTO_ENABLED | mav.MAV_MODE_FLAG_STABILIZE_ENABLED
    flying = s is not None and s.flying
    if s is None or Status.ALIGNED not in s.estimate.status:
        state = mav.MAV_STATE_CALIBRATING
    else:
        state = mav.MAV_STATE_ACTIVE if flying else mav.MAV_STATE_STANDBY
    return {
        "type": mav.MAV_TYPE_FIXED_WING,
        "autopilot": identity.autopilot,
        "base_mode": mode | (mav.MAV_MODE_FLAG_SAFETY_ARMED if flying else 0),
        "custom_mode": identity.mode,
        "system_status": state,
        "mavlink_version": 3,
    }


def system_time(s: Snapshot) -> Fields:
    """Simulated date and time of day, and time since boot."""
    return {"time_unix_usec": s.start_us + s.usec, "time_boot_ms": s.boot_ms}


def sys_status(s: Snapshot) -> Fields:
    """Which sensors there are and which of them work.

    Failed are those that are silent, or isolated by the estimator, and a receiver without a fix.
    """
    inertial = mav.MAV_SYS_STATUS_SENSOR_3D_GYRO | mav.MAV_SYS_STATUS_SENSOR_3D_ACCEL
    always = mav.MAV_SYS_STATUS_GEOFENCE  # without it MAVProxy reports a breach
    present = always | inertial | mav.MAV_SYS_STATUS_AHRS | mav.MAV_SYS_STATUS_PREARM_CHECK
    health = always
    if np.isfinite(s.gyro).all() and np.isfinite(s.accel).all():
        health |= inertial
    if Status.ALIGNED in s.estimate.status:
        health |= mav.MAV_SYS_STATUS_AHRS | mav.MAV_SYS_STATUS_PREARM_CHECK
    aids: list[tuple[type[Any], int, bool]] = [
        (MagnetometerSample, mav.MAV_SYS_STATUS_SENSOR_3D_MAG, True),
        (BarometerSample, mav.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE, math.isfinite(s.pressure)),
        (AirspeedSample, mav.MAV_SYS_STATUS_SENSOR_DIFFERENTIAL_PRESSURE, math.isfinite(s.eas)),
        (GnssSample, mav.MAV_SYS_STATUS_SENSOR_GPS, s.gnss_fix is not None),
    ]
    for kind, bit, is_sound in aids:
        if any(isinstance(sample, kind) for sample in s.samples.values()):
            present |= bit
            health |= bit if is_sound and s.works(kind) else 0
    return {
        "onboard_control_sensors_present": present,
        "onboard_control_sensors_enabled": present,
        "onboard_control_sensors_health": health,
        "load": 0,
        "voltage_battery": 2**16 - 1,  # not sent, nor the two below
        "current_battery": -1,
        "battery_remaining": -1,
        "drop_rate_comm": 0,
        "errors_comm": 0,
        "errors_count1": 0,
        "errors_count2": 0,
        "errors_count3": 0,
        "errors_count4": 0,
        "onboard_control_sensors_present_extended": 0,
        "onboard_control_sensors_enabled_extended": 0,
        "onboard_control_sensors_health_extended": 0,
    }


def extended_sys_state(s: Snapshot) -> Fields:
    """On the ground or in the air."""
    landed = {
        None: mav.MAV_LANDED_STATE_UNDEFINED,
        False: mav.MAV_LANDED_STATE_ON_GROUND,
        True: mav.MAV_LANDED_STATE_IN_AIR,
    }
    return {"vtol_state": mav.MAV_VTOL_STATE_UNDEFINED, "landed_state": landed[s.flying]}


def current_item(s: Snapshot) -> int:
    """The mission item being flown: that of the leg; the last one when the plan is flown."""
    leg = float(s.truth.leg[0])
    first = int(s.identity.home_first)
    return first + (int(leg) if 0 <= leg < s.legs else max(0, s.legs - 1))


def mission_current(s: Snapshot) -> Fields:
    """The leg being flown, as an item of the mission."""
    if not s.legs:
        state = mav.MISSION_STATE_NO_MISSION
    else:
        state = mav.MISSION_STATE_ACTIVE if s.truth.leg[0] >= 0 else mav.MISSION_STATE_COMPLETE
    return {
        "seq": current_item(s) if s.legs else 0,
        "total": s.legs,
        "mission_state": state,
        "mission_mode": 0,  # unknown: there is but one mode
        "mission_id": 0,
        "fence_id": 0,
        "rally_points_id": 0,
    }


def home_position(s: Snapshot) -> Fields | None:
    """Where the estimator first knew its position."""
    if s.home is None:
        return None
    lat, lon, h = s.home
    return {
        "latitude": latitude_e7(lat),
        "longitude": longitude_e7(lon),
        "altitude": h * 1e3,
        "x": 0,
        "y": 0,
        "z": 0,
        "q": [1.0, 0.0, 0.0, 0.0],
        "approach_x": 0,
        "approach_y": 0,
        "approach_z": 0,
        "time_usec": s.usec,
    }


# The estimate


def attitude(s: Snapshot) -> Fields | None:
    """Estimated attitude and angular rate."""
    if s.euler is None:
        return None
    roll, pitch, yaw = s.euler
    p, q, r = s.rates
    return {
        "time_boot_ms": s.boot_ms,
        "roll": roll,
        "pitch": pitch,
        "yaw": yaw,
        "rollspeed": p,
        "pitchspeed": q,
        "yawspeed": r,
    }


def attitude_quaternion(s: Snapshot) -> Fields | None:
    """Estimated attitude and angular rate."""
    if s.euler is None:
        return None
    w, x, y, z = _floats(s.estimate.q_nb)
    p, q, r = s.rates
    return {
        "time_boot_ms": s.boot_ms,
        "q1": w,
        "q2": x,
        "q3": y,
        "q4": z,
        "rollspeed": p,
        "pitchspeed": q,
        "yawspeed": r,
        "repr_offset_q": NO_OFFSET,
    }


def global_position_int(s: Snapshot) -> Fields | None:
    """Estimated position, velocity and heading."""
    if s.point is None or s.local_n is None:
        return None
    lat, lon, h = s.point
    return {
        "time_boot_ms": s.boot_ms,
        "lat": latitude_e7(lat),
        "lon": longitude_e7(lon),
        "alt": h * 1e3,
        "relative_alt": -s.local_n[2] * 1e3,
        "vx": s.v_n[0] * 100,
        "vy": s.v_n[1] * 100,
        "vz": s.v_n[2] * 100,
        "hdg": centidegrees(s.euler[2]) if s.euler else math.nan,
    }


def local_position_ned(s: Snapshot) -> Fields | None:
    """Estimated position from home, and velocity."""
    if s.local_n is None:
        return None
    return {
        "time_boot_ms": s.boot_ms,
        "x": s.local_n[0],
        "y": s.local_n[1],
        "z": s.local_n[2],
        "vx": s.v_n[0],
        "vy": s.v_n[1],
        "vz": s.v_n[2],
    }


def vfr_hud(s: Snapshot) -> Fields | None:
    """What a pilot looks at; airspeed is the equivalent airspeed measured, throttle what is commanded."""
    if s.point is None or s.euler is None:
        return None
    return {
        "airspeed": s.eas,
        "groundspeed": s.groundspeed,
        "heading": round(math.degrees(s.euler[2])) % 360,
        "throttle": 100 * float(s.truth.controls[0, 3]),
        "alt": s.point[2],
        "climb": -s.v_n[2],
    }


def altitude(s: Snapshot) -> Fields | None:
    """Estimated height, and the barometer's own for the one that never jumps."""
    if s.point is None or s.local_n is None:
        return None
    return {
        "time_usec": s.usec,
        "altitude_monotonic": pressure_altitude(s.pressure) if s.pressure > 0 else math.nan,
        "altitude_amsl": s.point[2],
        "altitude_local": -s.local_n[2],
        "altitude_relative": -s.local_n[2],
        "altitude_terrain": TERRAIN_UNKNOWN,
        "bottom_clearance": -1,  # no measurement
    }


def wind_cov(s: Snapshot) -> Fields | None:
    """Estimated wind, from an estimator that has wind states."""
    if "wind" not in s.estimate.extra or s.point is None:
        return None
    wind, sigma = s.estimate.extra["wind"]
    return {
        "time_usec": s.usec,
        "wind_x": float(wind[0]),
        "wind_y": float(wind[1]),
        "wind_z": math.nan,
        "var_horiz": math.nan,
        "var_vert": math.nan,
        "wind_alt": s.point[2],
        "horiz_accuracy": _root(sigma * sigma),
        "vert_accuracy": 0,  # unknown
    }


def odometry(s: Snapshot) -> Fields | None:
    """Pose in local NED; velocity, rates and their covariance in body axes, as REP 147 has it.

    Rotation uncertainty is about the fixed axes n. An attitude estimate is off by the rotation -phi, so its cross terms
    change sign. Velocity: v_b = C_nb' v_n gives dv_b = C_nb' (dv_n - v_n x phi).
    """
    if s.local_n is None or s.euler is None:
        return None
    P = s.estimate.covariance
    C_bn = dcm_from_quat(s.estimate.q_nb).T
    x, y, z = s.local_n
    vx, vy, vz = _floats(C_bn @ s.estimate.v_n)
    p, q, r = s.rates
    pose = np.empty((6, 6))
    pose[:3, :3] = P[_POSITION, _POSITION]
    pose[:3, 3:] = -P[_POSITION, _ATTITUDE]
    pose[3:, 3:] = P[_ATTITUDE, _ATTITUDE]
    J = np.empty((3, 6))
    J[:, :3] = C_bn
    J[:, 3:] = -C_bn @ skew(s.estimate.v_n)
    velocity = np.zeros((6, 6))
    velocity[:3, :3] = J @ P[_VELOCITY.start :, _VELOCITY.start :] @ J.T
    velocity.flat[_RATES] = s.estimate.sigma_gyro_bias * s.estimate.sigma_gyro_bias
    return {
        "time_usec": s.usec,
        "frame_id": mav.MAV_FRAME_LOCAL_NED,
        "child_frame_id": mav.MAV_FRAME_BODY_FRD,
        "x": x,
        "y": y,
        "z": z,
        "q": _floats(s.estimate.q_nb),
        "vx": vx,
        "vy": vy,
        "vz": vz,
        "rollspeed": p,
        "pitchspeed": q,
        "yawspeed": r,
        "pose_covariance": _floats(pose.take(_UPPER)),
        "velocity_covariance": _floats(velocity.take(_UPPER)),
        "reset_counter": 0,
        "estimator_type": mav.MAV_ESTIMATOR_TYPE_AUTOPILOT,
        "quality": 0,  # unset
    }


def _solution(s: Snapshot) -> int:
    """What an aligned estimator knows, in the bits that ESTIMATOR_STATUS and EKF_STATUS_REPORT have in common.

    MAVSDK has its health from the latter, so position is no longer absolute as soon as nothing fixes it.
    """
    if Status.ATTITUDE_ONLY in s.estimate.status:
        return int(mav.EKF_ATTITUDE)
    known: int = (
        mav.EKF_ATTITUDE
        | mav.EKF_VELOCITY_HORIZ
        | mav.EKF_VELOCITY_VERT
        | mav.EKF_POS_HORIZ_REL
        | mav.EKF_POS_VERT_ABS
        | mav.EKF_PRED_POS_HORIZ_REL
    )
    absolute: int = mav.EKF_POS_HORIZ_ABS | mav.EKF_PRED_POS_HORIZ_ABS
    return known if Status.DEAD_RECKONING in s.estimate.status or not s.fixed else known | absolute


def estimator_status(s: Snapshot) -> Fields:
    """What the estimator holds for known, innovations over their gates, its own sigma."""
    return {
        "time_usec": s.usec,
        "flags": (_solution(s) if Status.ALIGNED in s.estimate.status else 0)
        | (mav.ESTIMATOR_GPS_GLITCH if s.doubted else 0),
        "vel_ratio": s.ratio("gnss_velocity"),
        "pos_horiz_ratio": s.ratio("gnss_position"),
        "pos_vert_ratio": s.ratio("barometer"),
        "mag_ratio": s.ratio("magnetometer"),
        "hagl_ratio": math.nan,
        "tas_ratio": s.ratio("airspeed"),
        "pos_horiz_accuracy": s.sigma(_POSITION, 2),
        "pos_vert_accuracy": _root(np.diagonal(s.estimate.covariance)[_POSITION][2:]),
    }


def ekf_status_report(s: Snapshot) -> Fields:
    """The same in ArduPilot's form."""
    return {
        "flags": (_solution(s) if Status.ALIGNED in s.estimate.status else mav.EKF_UNINITIALIZED)
        | (mav.EKF_GPS_GLITCHING if s.doubted else 0),
        "velocity_variance": s.ratio("gnss_velocity"),  # "variance" means the same ratio, in ArduPilot's usage
        "pos_horiz_variance": s.ratio("gnss_position"),
        "pos_vert_variance": s.ratio("barometer"),
        "compass_variance": s.ratio("magnetometer"),
        "terrain_alt_variance": math.nan,
        "airspeed_variance": s.ratio("airspeed"),
    }


# Receiver and sensors


def gps_raw_int(s: Snapshot) -> Fields | None:
    """What the receiver says: no fix and nothing known when it is denied."""
    if not any(isinstance(sample, GnssSample) for sample in s.samples.values()):
        return None
    fix = s.gnss_fix
    if fix is None:
        sample = s.newest(GnssSample)
        return {
            "time_usec": microseconds(sample.t) if sample else s.usec,
            "fix_type": mav.GPS_FIX_TYPE_NO_FIX,
            **dict.fromkeys(("lat", "lon", "alt", "eph", "epv", "vel", "cog", "alt_ellipsoid"), math.nan),
            "satellites_visible": sample.satellites if sample else 0,
            **dict.fromkeys(("h_acc", "v_acc", "vel_acc"), math.nan),
            "hdg_acc": 0,
            "yaw": 0,
        }
    north, east, _ = _floats(fix.v_n)
    variance = fix.sigma_position_n * fix.sigma_position_n
    return {
        "time_usec": microseconds(fix.t),
        "fix_type": fix.fix_type,
        "lat": latitude_e7(fix.lat),
        "lon": longitude_e7(fix.lon),
        "alt": fix.h * 1e3,
        "eph": fix.hdop * 100,
        "epv": fix.vdop * 100,
        "vel": math.hypot(north, east) * 100,
        "cog": centidegrees(math.atan2(east, north)),
        "satellites_visible": fix.satellites,
        "alt_ellipsoid": fix.h * 1e3,
        "h_acc": _root(variance[:2]) * 1e3,
        "v_acc": _root(variance[2:]) * 1e3,
        "vel_acc": _root(fix.sigma_velocity_n * fix.sigma_velocity_n) * 1e3,
        "hdg_acc": 0,
        "yaw": 0,  # not measured
    }


def gnss_integrity(s: Snapshot) -> Fields | None:
    """Jamming is reported while there is no fix, as nothing but interference takes it away in this testbed.

    Spoofing is reported while the estimator isolates, or long refuses, a receiver that has one.
    """
    if not any(isinstance(sample, GnssSample) for sample in s.samples.values()):
        return None
    spoofing = mav.GPS_SPOOFING_STATE_UNKNOWN
    if s.gnss_fix:
        spoofing = mav.GPS_SPOOFING_STATE_DETECTED if s.doubted else mav.GPS_SPOOFING_STATE_NOT_SPOOFED
    return {
        "id": 0,
        "system_errors": 0,
        "authentication_state": mav.GPS_AUTHENTICATION_STATE_UNKNOWN,
        "jamming_state": mav.GPS_JAMMING_STATE_NOT_JAMMED if s.gnss_fix else mav.GPS_JAMMING_STATE_DETECTED,
        "spoofing_state": spoofing,
        "raim_state": mav.GPS_RAIM_STATE_UNKNOWN,
        "raim_hfom": 2**16 - 1,
        "raim_vfom": 2**16 - 1,
        "corrections_quality": 255,
        "system_status_summary": 255,
        "gnss_signal_quality": 255,
        "post_processing_quality": 255,
    }


def _pressures(s: Snapshot) -> tuple[float, float]:
    """Static and differential pressure [hPa]."""
    return s.pressure / 100, 0.5 * SEA_LEVEL_DENSITY * s.eas * s.eas / 100


def highres_imu(s: Snapshot) -> Fields:
    """Inertial, magnetic and pressure readings; the bits say which of them there are."""
    sample = s.newest(MagnetometerSample)
    static, differential = _pressures(s)
    xacc, yacc, zacc = _floats(s.accel)
    xgyro, ygyro, zgyro = _floats(s.gyro)
    xmag, ymag, zmag = _floats(sample.field_b * 1e4) if sample else (math.nan,) * 3
    numbers = {
        "xacc": xacc,
        "yacc": yacc,
        "zacc": zacc,
        "xgyro": xgyro,
        "ygyro": ygyro,
        "zgyro": zgyro,
        "xmag": xmag,
        "ymag": ymag,
        "zmag": zmag,
        "abs_pressure": static,
        "diff_pressure": differential,
        "pressure_alt": pressure_altitude(s.pressure) if s.pressure > 0 else math.nan,
        "temperature": math.nan,
    }
    updated = sum(1 << bit for bit, number in enumerate(numbers.values()) if number == number)
    return {"time_usec": s.usec, **numbers, "fields_updated": updated, "id": 0}


def scaled_pressure(s: Snapshot) -> Fields | None:
    """Static and differential pressure."""
    static, differential = _pressures(s)
    if static != static:
        return None
    return {
        "time_boot_ms": s.boot_ms,
        "press_abs": static,
        "press_diff": differential,
        "temperature": 0,
        "temperature_press_diff": 0,
    }


# The truth


def hil_state_quaternion(s: Snapshot) -> Fields:
    """Truth, in the message that clients read as ground truth; accelerations are specific force."""
    p, q, r = _floats(s.truth.omega_b[0])
    lat, lon, h = s.true_point
    north, east, down = _floats(s.truth.v_n[0])
    tas = float(s.truth.airspeed[0])
    xacc, yacc, zacc = s.specific_force
    milli_g = 1e3 / STANDARD_GRAVITY
    return {
        "time_usec": s.usec,
        "attitude_quaternion": _floats(s.truth.q_nb[0]),
        "rollspeed": p,
        "pitchspeed": q,
        "yawspeed": r,
        "lat": latitude_e7(lat),
        "lon": longitude_e7(lon),
        "alt": h * 1e3,
        "vx": north * 100,
        "vy": east * 100,
        "vz": down * 100,
        "ind_airspeed": 100 * tas * math.sqrt(max(0.0, float(s.truth.density[0])) / SEA_LEVEL_DENSITY),
        "true_airspeed": 100 * tas,
        "xacc": xacc * milli_g,
        "yacc": yacc * milli_g,
        "zacc": zacc * milli_g,
    }


def simstate(s: Snapshot) -> Fields:
    """Truth, as MAVProxy draws it on the map."""
    roll, pitch, yaw = s.true_euler
    xacc, yacc, zacc = s.specific_force
    xgyro, ygyro, zgyro = _floats(s.truth.omega_b[0])
    return {
        "roll": roll,
        "pitch": pitch,
        "yaw": yaw,
        "xacc": xacc,
        "yacc": yacc,
        "zacc": zacc,
        "xgyro": xgyro,
        "ygyro": ygyro,
        "zgyro": zgyro,
        "lat": latitude_e7(s.true_point[0]),
        "lng": longitude_e7(s.true_point[1]),
    }


def sim_state(s: Snapshot) -> Fields:
    """Truth, with more digits."""
    w, x, y, z = _floats(s.truth.q_nb[0])
    north, east, down = _floats(s.truth.v_n[0])
    body = dict(simstate(s))
    lat, lon = body.pop("lat"), body.pop("lng")
    return {
        **body,
        "q1": w,
        "q2": x,
        "q3": y,
        "q4": z,
        "lat": math.degrees(s.true_point[0]),
        "lon": math.degrees(s.true_point[1]),
        "alt": s.true_point[2],
        "std_dev_horz": 0,
        "std_dev_vert": 0,
        "vn": north,
        "ve": east,
        "vd": down,
        "lat_int": lat,
        "lon_int": lon,
    }


def error(name: str, s: Snapshot) -> Fields | None:
    """NAMED_VALUE_FLOAT of one of `Snapshot.errors`; MAVLink allows names of ten characters."""
    if name not in s.errors:
        return None
    return {"time_boot_ms": s.boot_ms, "name": name.encode(), "value": s.errors[name]}


# The other estimators


def _other(s: Snapshot, index: int) -> dict[str, float] | None:
    if index >= len(s.others):
        return None
    estimate = s.others[index][1]
    point, euler = known_point(estimate), _euler(estimate)
    if point is None or euler is None:
        return None
    return {
        "roll": euler[0],
        "pitch": euler[1],
        "yaw": euler[2],
        "altitude": point[2],
        "lat": latitude_e7(point[0]),
        "lng": longitude_e7(point[1]),
    }


def ahrs2(s: Snapshot) -> Fields | None:
    """The second estimator, as MAVProxy draws it on the map."""
    return _other(s, 0)


def ahrs3(s: Snapshot) -> Fields | None:
    """The third estimator."""
    fields = _other(s, 1)
    return None if fields is None else {**fields, "v1": 0, "v2": 0, "v3": 0, "v4": 0}


# Events

_SEVERITY = {"info": mav.MAV_SEVERITY_INFO, "warning": mav.MAV_SEVERITY_WARNING, "error": mav.MAV_SEVERITY_ERROR}
_CHUNK = 50  # bytes of text in one STATUSTEXT
_MAX_CHUNKS = 255


def statustext(severity: str, text: str, number: int) -> list[Fields]:
    """STATUSTEXT fields of one event, in chunks when it is longer than 50 bytes.

    ``number`` tells the chunks of one long text from another's; a text of one chunk has none. The last chunk of several
    must hold a zero byte, so a text that ends at the edge of a chunk is followed by an empty one.
    """
    encoded = text.replace("\0", " ").encode(errors="replace")[: _CHUNK * _MAX_CHUNKS]
    end = len(encoded) + 1 if len(encoded) > _CHUNK else _CHUNK
    chunked = len(encoded) > _CHUNK
    return [
        {
            "severity": _SEVERITY[severity],
            "text": encoded[start : start + _CHUNK],
            "id": 1 + number % (2**16 - 1) if chunked else 0,
            "chunk_seq": start // _CHUNK,
        }
        for start in range(0, end, _CHUNK)
    ]
