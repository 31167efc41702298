"""What each message on the estimates says, and on the truth; as those of `testbed.mavlink.messages`."""

from __future__ import annotations

import math

import numpy as np
from pymavlink.dialects.v20 import all as mav  # type: ignore[import-untyped]

from nav.earth import SEA_LEVEL_DENSITY, STANDARD_GRAVITY, pressure_altitude
from nav.rotation import dcm_from_quat, skew
from nav.samples import Status
from testbed.mavlink.encode import Fields, centidegrees, latitude_e7, longitude_e7
from testbed.mavlink.snapshot import ATTITUDE, POSITION, VELOCITY, Snapshot, floats, known_euler, known_point, root

TERRAIN_UNKNOWN = -10000.0  # ALTITUDE: below -1000 means unknown
NO_OFFSET = [0.0, 0.0, 0.0, 0.0]  # ATTITUDE_QUATERNION: no other attitude for display
_UPPER = np.flatnonzero(np.triu(np.ones((6, 6))))  # upper right triangle of 6 x 6, row by row
_RATES = [21, 28, 35]  # the last three of its diagonal


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
    w, x, y, z = floats(s.estimate.q_nb)
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
        "horiz_accuracy": root(sigma * sigma),
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
    vx, vy, vz = floats(C_bn @ s.estimate.v_n)
    p, q, r = s.rates
    pose = np.empty((6, 6))
    pose[:3, :3] = P[POSITION, POSITION]
    pose[:3, 3:] = -P[POSITION, ATTITUDE]
    pose[3:, 3:] = P[ATTITUDE, ATTITUDE]
    J = np.empty((3, 6))
    J[:, :3] = C_bn
    J[:, 3:] = -C_bn @ skew(s.estimate.v_n)
    velocity = np.zeros((6, 6))
    velocity[:3, :3] = J @ P[VELOCITY.start :, VELOCITY.start :] @ J.T
    velocity.flat[_RATES] = s.estimate.sigma_gyro_bias * s.estimate.sigma_gyro_bias
    return {
        "time_usec": s.usec,
        "frame_id": mav.MAV_FRAME_LOCAL_NED,
        "child_frame_id": mav.MAV_FRAME_BODY_FRD,
        "x": x,
        "y": y,
        "z": z,
        "q": floats(s.estimate.q_nb),
        "vx": vx,
        "vy": vy,
        "vz": vz,
        "rollspeed": p,
        "pitchspeed": q,
        "yawspeed": r,
        "pose_covariance": floats(pose.take(_UPPER)),
        "velocity_covariance": floats(velocity.take(_UPPER)),
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
        "flags": (_solution(s) if s.aligned else 0) | (mav.ESTIMATOR_GPS_GLITCH if s.doubted else 0),
        "vel_ratio": s.ratio("gnss_velocity"),
        "pos_horiz_ratio": s.ratio("gnss_position"),
        "pos_vert_ratio": s.ratio("barometer"),
        "mag_ratio": s.ratio("magnetometer"),
        "hagl_ratio": math.nan,
        "tas_ratio": s.ratio("airspeed"),
        "pos_horiz_accuracy": s.sigma(POSITION, 2),
        "pos_vert_accuracy": root(np.diagonal(s.estimate.covariance)[POSITION][2:]),
    }


def ekf_flags(s: Snapshot) -> int:
    """What the estimator holds for known, in the bits of EKF_STATUS_REPORT."""
    known: int = _solution(s) if s.aligned else mav.EKF_UNINITIALIZED
    return known | (mav.EKF_GPS_GLITCHING if s.doubted else 0)


def ekf_status_report(s: Snapshot) -> Fields:
    """The same in ArduPilot's form."""
    return {
        "flags": ekf_flags(s),
        "velocity_variance": s.ratio("gnss_velocity"),  # "variance" means the same ratio, in ArduPilot's usage
        "pos_horiz_variance": s.ratio("gnss_position"),
        "pos_vert_variance": s.ratio("barometer"),
        "compass_variance": s.ratio("magnetometer"),
        "terrain_alt_variance": math.nan,
        "airspeed_variance": s.ratio("airspeed"),
    }


# The truth


def hil_state_quaternion(s: Snapshot) -> Fields:
    """Truth, in the message that clients read as ground truth; accelerations are specific force."""
    p, q, r = floats(s.truth.omega_b[0])
    lat, lon, h = s.true_point
    north, east, down = floats(s.truth.v_n[0])
    tas = float(s.truth.airspeed[0])
    xacc, yacc, zacc = s.specific_force
    milli_g = 1e3 / STANDARD_GRAVITY
    return {
        "time_usec": s.usec,
        "attitude_quaternion": floats(s.truth.q_nb[0]),
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
    xgyro, ygyro, zgyro = floats(s.truth.omega_b[0])
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
    w, x, y, z = floats(s.truth.q_nb[0])
    north, east, down = floats(s.truth.v_n[0])
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
    point, euler = known_point(estimate), known_euler(estimate)
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
