"""What each message on the estimates says, and on the truth; as those of `testbed.mavlink.messages`."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from pymavlink.dialects.v20 import all as mav  # type: ignore[import-untyped]

from nav._jit import njit
from nav.earth import SEA_LEVEL_DENSITY, STANDARD_GRAVITY
from nav.rotation import dcm_from_quat, dot, skew
from nav.samples import Array, Status
from testbed.mavlink.encode import Fields, latitudes_e7, longitudes_e7
from testbed.mavlink.snapshot import ATTITUDE, DOWN, POSITION, VELOCITY, Rows, Snapshot, root

TERRAIN_UNKNOWN = -10000.0  # ALTITUDE: below -1000 means unknown
_UPPER = np.flatnonzero(np.triu(np.ones((6, 6))))  # upper right triangle of 6 x 6, row by row
_RATES = [21, 28, 35]  # the last three of its diagonal


# The estimate


def attitude(r: Rows) -> Fields:
    """Estimated attitude and angular rate."""
    return {
        "time_boot_ms": r.boot_ms,
        "roll": r.euler[:, 0],
        "pitch": r.euler[:, 1],
        "yaw": r.euler[:, 2],
        **_rates(r.rates),
    }


def attitude_quaternion(r: Rows) -> Fields:
    """Estimated attitude and angular rate."""
    w, x, y, z = r.q_nb.T
    no_offset = np.zeros((len(r), 4))  # no other attitude for display
    return {
        "time_boot_ms": r.boot_ms,
        "q1": w,
        "q2": x,
        "q3": y,
        "q4": z,
        **_rates(r.rates),
        "repr_offset_q": no_offset,
    }


def _rates(rates: Array) -> dict[str, Array]:
    return {"rollspeed": rates[:, 0], "pitchspeed": rates[:, 1], "yawspeed": rates[:, 2]}


def global_position_int(r: Rows) -> Fields:
    """Estimated position, velocity and heading."""
    lat, lon, h = r.point.T
    north, east, down = r.v_n.T
    return {
        "time_boot_ms": r.boot_ms,
        "lat": latitudes_e7(lat),
        "lon": longitudes_e7(lon),
        "alt": h * 1e3,
        "relative_alt": -r.local_n[:, 2] * 1e3,
        "vx": north * 100,
        "vy": east * 100,
        "vz": down * 100,
        "hdg": np.rint(np.degrees(r.euler[:, 2]) * 100) % 36000,
    }


def local_position_ned(r: Rows) -> Fields:
    """Estimated position from home, and velocity."""
    x, y, z = r.local_n.T
    vx, vy, vz = r.v_n.T
    return {"time_boot_ms": r.boot_ms, "x": x, "y": y, "z": z, "vx": vx, "vy": vy, "vz": vz}


def vfr_hud(r: Rows) -> Fields:
    """What a pilot looks at; airspeed is the equivalent airspeed measured, throttle what is commanded."""
    return {
        "airspeed": r.eas,
        "groundspeed": np.hypot(r.v_n[:, 0], r.v_n[:, 1]),
        "heading": np.rint(np.degrees(r.euler[:, 2])) % 360,
        "throttle": 100 * r.truth("controls")[:, 3],
        "alt": r.point[:, 2],
        "climb": -r.v_n[:, 2],
    }


def altitude(r: Rows) -> Fields:
    """Estimated height, and the barometer's own for the one that never jumps."""
    up = -r.local_n[:, 2]
    return {
        "time_usec": r.usec,
        "altitude_monotonic": r.pressure_altitude,
        "altitude_amsl": r.point[:, 2],
        "altitude_local": up,
        "altitude_relative": up,
        "altitude_terrain": TERRAIN_UNKNOWN,
        "bottom_clearance": -1,  # no measurement
    }


def wind_cov(s: Snapshot) -> Fields | None:
    """Estimated wind, from an estimator that has wind states."""
    if s.wind is None or s.point is None:
        return None
    wind, sigma = s.wind
    accuracy = root(sigma * sigma)
    return {
        "time_usec": s.usec,
        "wind_x": float(wind[0]),
        "wind_y": float(wind[1]),
        "wind_z": math.nan,
        "var_horiz": math.nan,
        "var_vert": math.nan,
        "wind_alt": s.point[2],
        "horiz_accuracy": accuracy if math.isfinite(accuracy) else 0,  # unknown, as the vertical one
        "vert_accuracy": 0,
    }


def odometry(r: Rows) -> Fields:
    """Pose in local NED; velocity, rates and their covariance in body axes, as REP 147 has it.

    Rotation uncertainty is about the fixed axes n. An attitude estimate is off by the rotation -phi, so its cross terms
    change sign. Velocity: v_b = C_nb' v_n gives dv_b = C_nb' (dv_n - v_n x phi).
    """
    P = r.covariance
    J, v_b = _body_velocity(r.q_nb, r.v_n)
    pose = np.empty((len(r), 6, 6))
    pose[:, :3, :3] = P[:, POSITION, POSITION]
    pose[:, :3, 3:] = -P[:, POSITION, ATTITUDE]
    pose[:, 3:, 3:] = P[:, ATTITUDE, ATTITUDE]
    velocity = np.zeros((len(r), 6, 6))
    velocity[:, :3, :3] = J @ P[:, VELOCITY.start :, VELOCITY.start :] @ J.transpose(0, 2, 1)
    velocity.reshape(-1, 36)[:, _RATES] = r.gyro_bias_variance
    x, y, z = r.local_n.T
    vx, vy, vz = v_b.T
    return {
        "time_usec": r.usec,
        "frame_id": mav.MAV_FRAME_LOCAL_NED,
        "child_frame_id": mav.MAV_FRAME_BODY_FRD,
        "x": x,
        "y": y,
        "z": z,
        "q": r.q_nb,
        "vx": vx,
        "vy": vy,
        "vz": vz,
        **_rates(r.rates),
        "pose_covariance": pose.reshape(-1, 36)[:, _UPPER],
        "velocity_covariance": velocity.reshape(-1, 36)[:, _UPPER],
        "reset_counter": 0,
        "estimator_type": mav.MAV_ESTIMATOR_TYPE_AUTOPILOT,
        "quality": 0,  # unset
    }


@njit
def _body_velocity(q_nb: Array, v_n: Array) -> tuple[Array, Array]:
    """What errors of velocity and attitude do to the velocity in body axes (N, 3, 6), and this velocity (N, 3)."""
    J, v_b = np.empty((len(q_nb), 3, 6)), np.empty((len(q_nb), 3))
    for k in range(len(q_nb)):
        C_nb, v_cross = dcm_from_quat(q_nb[k]), skew(v_n[k])
        for i in range(3):
            J[k, i, :3] = C_nb[:, i]
            v_b[k, i] = dot(C_nb[:, i], v_n[k])
            for j in range(3):
                J[k, i, 3 + j] = -dot(C_nb[:, i], v_cross[:, j])
    return J, v_b


@cache
def _solution(number: int, fixed: bool) -> int:
    """What an aligned estimator knows, in the bits that ESTIMATOR_STATUS and EKF_STATUS_REPORT have in common.

    MAVSDK has its health from the latter, so position is no longer absolute as soon as nothing fixes it.
    """
    status = Status(number)
    if Status.ATTITUDE_ONLY in status:
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
    return known if Status.DEAD_RECKONING in status or not fixed else known | absolute


def estimator_status(s: Snapshot) -> Fields:
    """What the estimator holds for known, innovations over their gates, its own sigma."""
    return {
        "time_usec": s.usec,
        "flags": (_solution(s.status, s.fixed) if s.aligned else 0) | (mav.ESTIMATOR_GPS_GLITCH if s.doubted else 0),
        "vel_ratio": s.ratio("gnss_velocity"),
        "pos_horiz_ratio": s.ratio("gnss_position"),
        "pos_vert_ratio": s.ratio("barometer"),
        "mag_ratio": s.ratio("magnetometer"),
        "hagl_ratio": math.nan,
        "tas_ratio": s.ratio("airspeed"),
        "pos_horiz_accuracy": s.sigma(POSITION, 2),
        "pos_vert_accuracy": s.sigma(DOWN),
    }


def ekf_flags(s: Snapshot) -> int:
    """What the estimator holds for known, in the bits of EKF_STATUS_REPORT."""
    known: int = _solution(s.status, s.fixed) if s.aligned else mav.EKF_UNINITIALIZED
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


def hil_state_quaternion(r: Rows) -> Fields:
    """Truth, in the message that clients read as ground truth; accelerations are specific force."""
    north, east, down = r.truth("v_n").T
    tas = r.truth("airspeed")
    xacc, yacc, zacc = r.specific_force.T * (1e3 / STANDARD_GRAVITY)  # thousandths of g
    return {
        "time_usec": r.usec,
        "attitude_quaternion": r.truth("q_nb"),
        **_rates(r.truth("omega_b")),
        "lat": latitudes_e7(r.truth("lat")),
        "lon": longitudes_e7(r.truth("lon")),
        "alt": r.truth("h") * 1e3,
        "vx": north * 100,
        "vy": east * 100,
        "vz": down * 100,
        "ind_airspeed": 100 * tas * np.sqrt(np.maximum(0.0, r.truth("density")) / SEA_LEVEL_DENSITY),
        "true_airspeed": 100 * tas,
        "xacc": xacc,
        "yacc": yacc,
        "zacc": zacc,
    }


def simstate(r: Rows) -> Fields:
    """Truth, as MAVProxy draws it on the map."""
    return {
        **_true_motion(r),
        "lat": latitudes_e7(r.truth("lat")),
        "lng": longitudes_e7(r.truth("lon")),
    }


def _true_motion(r: Rows) -> dict[str, Array]:
    names = "roll", "pitch", "yaw", "xacc", "yacc", "zacc", "xgyro", "ygyro", "zgyro"
    columns = (*r.true_euler.T, *r.specific_force.T, *r.truth("omega_b").T)
    return dict(zip(names, columns, strict=True))


def sim_state(r: Rows) -> Fields:
    """Truth, with more digits."""
    w, x, y, z = r.truth("q_nb").T
    north, east, down = r.truth("v_n").T
    lat, lon = r.truth("lat"), r.truth("lon")
    return {
        **_true_motion(r),
        "q1": w,
        "q2": x,
        "q3": y,
        "q4": z,
        "lat": np.degrees(lat),
        "lon": np.degrees(lon),
        "alt": r.truth("h"),
        "std_dev_horz": 0,
        "std_dev_vert": 0,
        "vn": north,
        "ve": east,
        "vd": down,
        "lat_int": latitudes_e7(lat),
        "lon_int": longitudes_e7(lon),
    }


def error(name: str, r: Rows) -> Fields:
    """NAMED_VALUE_FLOAT of one of `Rows.errors`; MAVLink allows names of ten characters."""
    return {"time_boot_ms": r.boot_ms, "name": name.encode(), "value": r.errors[name]}


# The other estimators


def _pose(pose: Array) -> dict[str, Array]:
    roll, pitch, yaw, lat, lon, h = pose.T
    return {
        "roll": roll,
        "pitch": pitch,
        "yaw": yaw,
        "altitude": h,
        "lat": latitudes_e7(lat),
        "lng": longitudes_e7(lon),
    }


def ahrs2(r: Rows) -> Fields:
    """The second estimator, as MAVProxy draws it on the map."""
    return _pose(r.second)


def ahrs3(r: Rows) -> Fields:
    """The third estimator."""
    return {**_pose(r.third), "v1": 0, "v2": 0, "v3": 0, "v4": 0}
